"""A cell at one site, ready to compute: its numbers, and the laws that act at each stage of the physics."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from palpd.cell.cell_file import CROSSTALK_ARM_M, CellFile, Estimated
from palpd.cell.cell_file import CellSite as Place
from palpd.cell.dynamics import Memory
from palpd.cell.effects import EFFECTS, Effect, Site, Values
from palpd.cell.span import Constants, Span
from palpd.errors import ConfigError

Library = Mapping[str, Effect]
"""Effects by id."""


class ActingLaw(NamedTuple):
    """A law that acts on samples, its parameters, and the name under which it remembers."""

    id: str
    act: Callable[[Span, Values, Memory], None]
    values: Values


@dataclass(frozen=True, slots=True)
class Physics:
    """A cell at one site, ready to compute: its numbers, and per site the laws that act there in their order."""

    constants: Constants
    laws: Mapping[Site, tuple[ActingLaw, ...]]

    def apply(self, site: Site, span: Span, memory: Memory) -> None:
        """Let the effects of a site act on a span of samples.

        Args:
            site: Stage of the physics whose effects act.
            span: Samples that the effects change.
            memory: State of the effects, carried from span to span.
        """
        for law in self.laws.get(site, ()):
            law.act(span, law.values, memory.setdefault(law.id, {}))


def physics(cell: CellFile, place: Place | None = None, library: Library = EFFECTS, *, begun: bool = True) -> Physics:
    """The physics of a cell file, at one of its sites.

    Args:
        place: A site of the cell, or None for the cell's own tissue.
        begun: False leaves out what counts from the first row of a recording.

    Returns:
        Numbers and laws, ready to compute.

    Raises:
        ConfigError: The cell has an effect that the library has not.
    """
    tissue, effects = (place.tissue, cell.effects | place.effects) if place is not None else (cell.tissue, cell.effects)
    known = cell.estimated or Estimated()
    wall = cell.wall
    c = Constants(
        servo_natural_frequency_Hz=cell.robot.servo_natural_frequency_Hz * (1.0 + known.servo_natural_frequency),
        servo_damping_ratio=cell.robot.servo_damping_ratio,
        mass_kg=cell.probe.mass_kg + known.mass_kg,
        tip_radius_m=cell.probe.tip_radius_m,
        tip_length_m=cell.probe.tip_length_m,
        youngs_modulus_Pa=tissue.youngs_modulus_Pa * (1.0 + known.youngs_modulus) if tissue else 0.0,
        poisson_ratio=tissue.poisson_ratio if tissue else 0.0,
        surface_z_m=tissue.surface_z_m + known.surface_z_m if tissue else -np.inf,
        cutoff_Hz=(cell.sensor.filter_cutoff_Hz or np.inf) * (1.0 + known.filter_cutoff),
        noise_rms_N=cell.sensor.noise_rms_N,
        noise_rms_Nm=cell.sensor.noise_rms_Nm,
        wall_z_m=wall.z_m if wall else 0.0,
        wall_stiffness_N_per_m=wall.stiffness_N_per_m if wall and (begun or wall.appears_after_s is None) else 0.0,
        wall_after_s=(wall.appears_after_s or 0.0) if wall else 0.0,
        delay_s=known.latency_s,
        tip_compliance_m_per_N=1.0 / (cell.sensor.stiffness_N_per_m or np.inf),
        gain=1.0 + known.gain,
        fx_per_fz=known.crosstalk[0],
        fy_per_fz=known.crosstalk[1],
        tx_per_fz_m=known.crosstalk[2] * CROSSTALK_ARM_M,
        ty_per_fz_m=known.crosstalk[3] * CROSSTALK_ARM_M,
        bias_N=known.bias_N if begun else 0.0,
        drift_N_per_s=known.drift_N_per_min / 60.0 if begun else 0.0,
    )
    laws: dict[Site, list[ActingLaw]] = {}
    if effects:
        if unknown := [name for name in effects if name not in library]:
            raise ConfigError(f"there is no effect {unknown[0]!r} in the library; give its file with --effects")
        for effect in (e for name, e in library.items() if name in effects):
            if effect.starts_at_tare and not begun:
                continue
            if effect.setting is not None:
                effect.setting(c, effects[effect.id])
            if effect.law is not None:
                laws.setdefault(effect.site, []).append(ActingLaw(effect.id, effect.law, effects[effect.id]))
    for learned in cell.learned:
        if begun or not learned.effect().starts_at_tare:
            laws.setdefault(learned.site, []).append(ActingLaw(learned.id, learned.act, {"strength": 1.0}))
    return Physics(c, {site: tuple(listed) for site, listed in laws.items()})


def place_named(cell: CellFile, site: str | None) -> Place | None:
    """A site of a cell by its name.

    Args:
        site: Name of one of its sites, or None for the cell's own tissue.

    Returns:
        The site; None for the cell's own tissue.

    Raises:
        ConfigError: The cell has no such site.
    """
    if site is None:
        return None
    for place in cell.sites:
        if place.name == site:
            return place
    known = ", ".join(place.name for place in cell.sites) or "none"
    raise ConfigError(f"the cell has no site {site!r}; it has {known}")


def true_surface_m(cell: CellFile, site: str | None = None, library: Library = EFFECTS) -> float:
    """Height of the untouched surface (or wall) of a site: the stated one with deviations and effects.

    Args:
        site: Name of a site of the cell, or None for the cell's own tissue.

    Returns:
        Height in m; -inf with nothing in reach.
    """
    c = physics(cell, place_named(cell, site), library).constants
    return c.wall_z_m if c.wall_stiffness_N_per_m else c.surface_z_m
