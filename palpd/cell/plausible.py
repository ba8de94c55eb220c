"""Ranges that a palpation keeps to: what lies outside is questioned where it is made, and counts once the operator accepts it.

What cannot be at all (not finite, negative, dead while moving) is refused where it is read, and nobody can accept it.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

from palpd.errors import BadInput

if TYPE_CHECKING:
    from palpd.cell.cell_file import CellFile

ACCEPT_OPTION = "--accept-implausible"
"""The option by which every command accepts what it questions."""


class PlausibleRange(NamedTuple):
    """From a least to a largest value, the unit of both, and why they are where they are."""

    low: float
    high: float
    unit: str
    reason: str

    def holds(self, value: float) -> bool:
        """Whether a value lies in the range; one that is not finite does not."""
        return self.low <= value <= self.high


PLAUSIBLE = {
    "mass": PlausibleRange(0.0, 5.0, "kg", "a UR5 carries 5 kg"),
    "tip radius": PlausibleRange(1e-8, 0.1, "m", "from a sharp AFM tip to a large ball"),
    "modulus": PlausibleRange(50.0, 3e7, "Pa", "from the softest gels and brain to cartilage and hard rubber"),
    "stroke": PlausibleRange(0.0, 1.0, "m", "a UR5 reaches 0.85 m"),
    "height": PlausibleRange(-2.0, 2.0, "m", "a UR5 on a table reaches from -0.85 to 0.85 m, a larger arm twice as far"),
    "speed": PlausibleRange(0.0, 3.0, "m/s", "the tip of a UR5 reaches 2.7 m/s with one joint at its 180 degrees per second"),
    "force": PlausibleRange(0.0, 1e5, "N", "the largest machines that test materials"),
    "rate": PlausibleRange(0.5, 1e5, "Hz", "from a slow log to a fast data acquisition"),
    "law force": PlausibleRange(0.0, 1e3, "N", "five times what the HEX-70 bears"),
    "law height": PlausibleRange(0.0, 0.1, "m", "no servo errs by a tenth of a metre"),
}
"""What is not questioned, by quantity."""


def doubts(quantity: str, value: float, name: str) -> list[str]:
    """A sentence where a value lies outside of its plausible range; empty otherwise.

    Args:
        quantity: Key of PLAUSIBLE.
        value: The value, in the unit of that range.
        name: What the sentence calls it.

    Returns:
        No sentence or one, without a full stop.
    """
    usual = PLAUSIBLE[quantity]
    if usual.holds(value):
        return []
    return [f"{name} is {value:.3g} {usual.unit}, expected {usual.low:g} to {usual.high:g} {usual.unit} ({usual.reason})"]


def doubts_of_cell(cell: "CellFile") -> list[str]:
    """A sentence for every implausible value of a cell: mass, tip, modulus and height of the surface, those of its sites too."""
    tissues = {"tissue": cell.tissue, **{f"site {site.name}: tissue": site.tissue for site in cell.sites}}
    of_tissues = [
        doubt
        for name, tissue in tissues.items()
        if tissue is not None
        for doubt in (
            *doubts("modulus", tissue.youngs_modulus_Pa, f"{name}.youngs_modulus_Pa"),
            *doubts("height", tissue.surface_z_m, f"{name}.surface_z_m"),
        )
    ]
    return [
        *doubts("mass", cell.probe.mass_kg, "probe.mass_kg"),
        *doubts("tip radius", cell.probe.tip_radius_m, "probe.tip_radius_m"),
        *of_tissues,
    ]


def ask(questions: Iterable[str], accepted: bool, check: str) -> tuple[str, ...]:
    """Refuse what is implausible, unless the operator accepts it.

    Args:
        questions: What is implausible, a sentence each without a full stop.
        accepted: Whether the operator accepts it.
        check: What to check or correct.

    Returns:
        Notes that say what was accepted.

    Raises:
        BadInput: There is a question, and nobody accepts it.
    """
    asked = tuple(question.rstrip(".") for question in questions)
    if asked and not accepted:
        raise BadInput(f"{'; '.join(asked)}; {check}, or accept it with {ACCEPT_OPTION}")
    return tuple(f"Accepted although implausible: {question}." for question in asked)
