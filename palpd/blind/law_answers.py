"""A learned law against the sealed truth: whether it has a right name, and whether its band holds what the true law changes.

The band is judged on the rows of the recording. The enriched cell is simulated on the noise-free motion with the law and without it, and
with each term raised by 1.96 standard deviations of its curve. That gives the change of the law and its band, row by row, in the channel
that the true law changes most among the law's own. A row is covered if the true change lies inside. Rows count where the band is wider
than 2 % of its widest place: elsewhere the law says nothing. Of a constant force the tare decides, so the mean over the rows is free
where the law is an added force.
"""

import tempfile
from collections.abc import Mapping, Sequence
from math import log
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import yaml

from palpd.blind.laws import Floats
from palpd.blind.stated_cell import CHANNELS
from palpd.blind.truth import LawName, LawStatement, TrueChange, Truth
from palpd.gap.commands import simulate_file
from palpd.recording.samples import Samples, write_csv

PERIOD_RATIO = 1.1
"""Largest ratio of a right period to the true one."""
CONSTANT_RATIO = 2.0
"""Largest ratio of a right constant of a memory to the true one."""
BAND_SDS = 1.96
LEAST_WIDTH = 0.02
"""Width of the band, as a share of its largest, from which a row counts."""
UNITS = (1e-4, 1.0, 1.0, 1.0, 0.05, 0.05, 0.05)
"""Units in which the changes of channels compare, in the order of CHANNELS: a torque as the force that usually comes with it."""


class LawOutcome(TypedDict):
    """What the search for laws said of one case, and whether it is right.

    `kind` is that of the true law; None where no effect outside the list is planted. `right`: the first term has a right name.
    `right_alike`: it has, or one of the laws that fit as well has. `covered`: share of rows whose true change lies in the band.
    `named_again`: once adopted, it, or a group with it, is named in another recording of the cell; None where there is none.
    """

    kind: str | None
    accepted: bool
    replaces: bool
    events: bool
    terms: int
    law: str
    right: bool
    right_alike: bool
    covered: float | None
    named_again: bool | None


def without_a_law(truth: Truth) -> LawOutcome:
    """The outcome of a case in which nothing was learned."""
    statement = _statement(truth)
    return LawOutcome(
        kind=None if statement is None else statement["kind"], accepted=False, replaces=False, events=False, terms=0, law="", right=False,
        right_alike=False, covered=None, named_again=None,
    )  # fmt: skip


def _statement(truth: Truth) -> LawStatement | None:
    return next((effect["statement"] for effect in truth["effects"] if "statement" in effect), None)


def law_outcome(truth: Truth, diagnosis: Mapping[str, Any], learned_file: Path, enriched: Path, change_file: Path) -> LawOutcome:
    """Judge what a diagnosis learned.

    Args:
        truth: The truth of the case.
        diagnosis: The content of its JSON file.
        enriched: The enriched cell.
        change_file: What the planted effect changes, as `write_true_change` wrote it.
    """
    outcome, statement, learned = without_a_law(truth), _statement(truth), diagnosis["learned"]
    outcome["events"] = bool(diagnosis["events"])
    if learned is None:
        return outcome
    terms = yaml.safe_load(learned_file.read_text(encoding="utf-8"))["learned"][0]["terms"]
    outcome["accepted"], outcome["replaces"] = True, bool(learned["replaces_listed"])
    outcome["terms"], outcome["law"] = len(terms), str(learned["what"])
    if statement is None:
        return outcome
    outcome["right"] = _is_named(terms[0], statement)
    outcome["right_alike"] = outcome["right"] or any(
        _is_alike(given, right) for given in learned["alike_laws"] for right in statement["names"]
    )
    if outcome["right"] and change_file.exists():
        outcome["covered"] = coverage(read_true_change(change_file), terms, enriched)
    return outcome


# names


def _is_named(term: Mapping[str, Any], statement: LawStatement) -> bool:
    """Whether a term of a learned law has a right name."""
    channels = set(term["channels"])
    channel = "lateral" if {"fx_N", "fy_N"} <= channels else next(iter(channels))
    driver = term["driver"]
    given = LawName(
        channel=channel, factor=term["factor"], quantity=driver["quantity"], memory=driver.get("memory"), constant=driver.get("constant"),
        period=driver.get("period"),
    )  # fmt: skip
    return any(_same(given, name) for name in statement["names"])


def _same(given: LawName, right: LawName) -> bool:
    same = given["memory"] == right["memory"] and _of_one_form(given, right)
    return same and _near(given["period"], right["period"], PERIOD_RATIO) and _near(given["constant"], right["constant"], CONSTANT_RATIO)


def _of_one_form(given: LawName, right: LawName) -> bool:
    """Whether channel, factor and quantity are the same, and either both laws repeat or neither does."""
    repeat = (given["period"] is None) == (right["period"] is None)
    return repeat and all(given[key] == right[key] for key in ("channel", "factor", "quantity"))


def _near(given: float | None, right: float | None, ratio: float) -> bool:
    return given is None or right is None or abs(log(given / right)) <= log(ratio) + 1e-9


def _is_alike(given: LawName, right: LawName) -> bool:
    """Whether a law that fits as well has a right name; constants and periods are not compared, nor the side of a dead band."""
    same_memory = given["memory"] == right["memory"] or {given["memory"], right["memory"]} == {"play", "stop"}
    return same_memory and _of_one_form(given, right)


# the band


def coverage(true: TrueChange, terms: Sequence[Mapping[str, Any]], enriched: Path) -> float | None:
    """Share of the rows at which the true change lies in the band of a law.

    Args:
        terms: The terms of the learned law, as in its file.
        enriched: The enriched cell, which holds the law.

    Returns:
        The share; None where the band has no width.
    """
    cell = yaml.safe_load(enriched.read_text(encoding="utf-8"))
    law = cell["learned"][-1]
    weights = {name: abs(w) for term in terms for name, w in term["channels"].items()}
    column = max((CHANNELS.index(name) for name in weights), key=lambda k: float(np.std(true.change[:, k])) / UNITS[k])
    curves = [dict(term) | {"formula": None} for term in law["terms"]]
    with tempfile.TemporaryDirectory() as folder:
        motion = Path(folder) / "motion.csv"
        write_csv(motion, true.motion)

        def change(some: Sequence[Mapping[str, Any]]) -> Floats:
            file, learned = Path(folder) / "cell.yaml", [*cell["learned"][:-1], *([dict(law) | {"terms": list(some)}] if some else [])]
            file.write_text(yaml.safe_dump(cell | {"learned": learned}, sort_keys=False), encoding="utf-8")
            out = simulate_file(motion, file, Path(folder) / "out.csv", from_commanded=column == 0)
            return out.z_m if column == 0 else np.asarray(out.wrench[:, column - 1])

        without = change([])
        centre = change(curves) - without
        halves = [change([*curves[:k], _raised(one), *curves[k + 1 :]]) - without - centre for k, one in enumerate(curves)]
    half = np.sqrt(np.sum(np.square(halves), axis=0))
    live = half > LEAST_WIDTH * half.max()
    if not half.max() > 0.0:
        return None
    miss = true.change[:, column] - centre
    if any(term["factor"] == "one" for term in terms) and column:
        miss = miss - miss[live].mean()
    return float(np.mean(np.abs(miss[live]) <= half[live]))


def _raised(term: Mapping[str, Any]) -> dict[str, Any]:
    """A term whose curve lies higher by the half width of its band."""
    return dict(term) | {"values": [value + BAND_SDS * sd for value, sd in zip(term["values"], term["sd"], strict=True)]}


def write_true_change(path: Path, true: TrueChange) -> None:
    """Write what planted effects change.

    Args:
        path: The file, .npz.
        true: The change and its motion.
    """
    motion = true.motion
    command = np.empty(0) if motion.z_cmd_m is None else motion.z_cmd_m
    np.savez(path, t_s=motion.t_s, z_cmd_m=command, z_m=motion.z_m, vz_m_per_s=motion.vz_m_per_s, change=true.change)


def read_true_change(path: Path) -> TrueChange:
    """Read what `write_true_change` wrote."""
    with np.load(path) as file:
        command = file["z_cmd_m"] if len(file["z_cmd_m"]) else None
        motion = Samples(file["t_s"], command, file["z_m"], file["vz_m_per_s"], np.zeros((len(file["t_s"]), 6)))
        return TrueChange(motion, file["change"])
