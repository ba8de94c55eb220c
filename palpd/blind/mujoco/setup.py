"""What a cell file states, and what the cell really is: the descriptions that the other modules here work on."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from palpd.blind.stated_cell import CellNumbers
from palpd.recording.samples import Samples

Array = NDArray[np.float64]
Rig = Literal["slide", "arm"]
GRAVITY_m_per_s2 = 9.81
"""Acceleration of free fall in the models."""
TORQUE_ARM_M = 0.05
"""The contract states crosstalk as force per force; for torques it counts times this arm."""


@dataclass(frozen=True)
class PressPath:
    """One commanded vertical motion with the press-to-press scatter that its presses meet.

    `t_s` (n,) and `z_cmd_m` (n,) on the 1 ms grid, `edges_s` (k-1,) the free instants between k presses, `surface_m` (k,) and
    `stiffness` (k,) the scatter of each press (relative for the stiffness), `deepest_m` the deepest commanded indentation.
    """

    t_s: Array
    z_cmd_m: Array
    edges_s: Array
    surface_m: Array
    stiffness: Array
    deepest_m: float

    def press_of(self, t_s: Array) -> NDArray[np.intp]:
        """The number of the press that each instant belongs to.

        Args:
            t_s: (n,) instants, s.

        Returns:
            (n,) numbers from 0.
        """
        return np.searchsorted(self.edges_s, t_s)


@dataclass(frozen=True)
class StatedTolerances:
    """One standard deviation of what is within specification, in the units of the contract (docs/reference/contract.md §3)."""

    bias_N: float
    drift_N_per_min: float
    mass_kg: float
    surface_z_m: float
    gain: float = 0.005
    latency_s: float = 0.001
    filter_cutoff: float = 0.05
    crosstalk: float = 0.003
    youngs_modulus: float = 0.02
    servo_natural_frequency: float = 0.02


@dataclass(frozen=True)
class StatedCell(CellNumbers):
    """The numbers of one cell.yaml, and how often its robot reports."""

    tolerances: StatedTolerances
    report_rate_Hz: float

    def as_yaml(self) -> dict[str, Any]:
        """The blocks of cell.yaml (contract §3)."""
        repeatability = {"surface_z_m": self.scatter_surface_z_m, "stiffness": self.scatter_stiffness}
        return self.blocks() | {"tolerances": dict(vars(self.tolerances)), "repeatability": repeatability, "effects": {}}


@dataclass(frozen=True)
class ServoDesign:
    """How the controller turns the commanded height into joint targets.

    `hold_Hz`: targets are computed and held at that rate (None: every physics step). `extra_pole_Hz`: a third order.
    `jerk_window_s`: length of the moving average that limits the jerk. `inner_frequency_Hz`: the stiff position loop behind it.
    """

    name: str
    natural_frequency_Hz: float
    damping_ratio: float
    inner_frequency_Hz: float
    drive_filter_s: float
    hold_Hz: float | None = None
    extra_pole_Hz: float | None = None
    jerk_window_s: float = 0.0


@dataclass(frozen=True)
class Cable:
    """A line from the probe to the world, as one vertical slide joint that is connected to the probe."""

    stiffness_N_per_m: float = 0.0
    friction_N: float = 0.0
    viscous_N_s_per_m: float = 0.0
    snag_stiffness_N_per_m: float = 0.0
    snag_z_m: float = 0.0


@dataclass(frozen=True)
class RingingMount:
    """The part of the probe that rings on a flexible mount."""

    frequency_Hz: float
    damping_ratio: float
    participation: float


@dataclass(frozen=True)
class Table:
    """A table that carries the robot and gives way."""

    frequency_Hz: float
    damping_ratio: float
    mass_kg: float


@dataclass(frozen=True)
class Dashpot:
    """A linear Maxwell arm beside the elastic tissue."""

    stiffness_N_per_m: float
    tau_s: float


ForceTerm = Callable[[float, float, int], float]
"""(force_N, depth_m, step) -> force_N of the tissue."""
ShiftTerm = Callable[[float, int], float]
"""(tip height_m, step) -> m that are added to the depth."""
LateralTerm = Callable[[float, int], tuple[float, float]]
"""(force_N, step) -> lateral force on the tip along x and y in N."""
ProbeTerm = Callable[[float, float, int], float]
"""(tip height_m, speed_m_per_s, step) -> vertical force in N on the probe that is not the tissue's."""


@dataclass(frozen=True)
class PlantSetup:
    """The mechanical truth of one cell: what MuJoCo is given, and the laws of force that stand outside of its model.

    Terms with a memory are factories: every simulation makes them afresh from the path and the time step.
    """

    rig: Rig
    step_s: float
    servo: ServoDesign
    moving_mass_kg: float
    mass_kg: float
    tip_length_m: float
    hertz_N_per_m15: float
    surface_z_m: float
    tip_radius_m: float
    deepest_m: float = 0.003
    servo_ratio: float = 1.0
    vibration: tuple[float, float, float] = (0.0, 1.0, 0.0)
    tilt_rad: float = 0.0
    tilt_azimuth_rad: float = 0.0
    tip_stiffness_N_per_m: float | None = None
    backlash_m: float = 0.0
    guide_friction_N: float = 0.0
    loose_gap_m: float = 0.0
    loose_weight_N: float = 0.0
    ring: RingingMount | None = None
    cable: Cable | None = None
    table: Table | None = None
    dashpot: Dashpot | None = None
    engine_contact: bool = False
    surface_motions: tuple[Callable[[PressPath, Array], Array], ...] = ()
    shift_terms: tuple[Callable[[PressPath, Array], ShiftTerm], ...] = ()
    force_terms: tuple[Callable[[PressPath, Array], ForceTerm], ...] = ()
    lateral: Callable[[PressPath, Array], LateralTerm] | None = None
    probe_terms: tuple[Callable[[PressPath, Array], ProbeTerm], ...] = ()
    knocks: Callable[[PressPath, Array], Array] | None = None


@dataclass(frozen=True)
class PlantRun:
    """What the plant did, on the physics grid: (n,) times, reported height and speed, tip height, and (n, 6) wrench on the probe."""

    t_s: Array
    z_m: Array
    vz_m_per_s: Array
    tip_z_m: Array
    wrench: Array


Stage = Callable[[Array, PlantRun], Array]
"""(wrench (n, 6), run) -> wrench: one step of the transducer, before the filter."""
ZeroStage = Callable[[Array, PlantRun], Array]
"""(sample times (n,), run) -> (n,) N added to fz after the filter."""


@dataclass(frozen=True)
class SensorSetup:
    """The true force sensor."""

    cutoff_Hz: float | None
    gain: float = 0.0
    crosstalk: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    latency_s: float = 0.0
    bias_N: float = 0.0
    drift_N_per_s: float = 0.0
    clock_skew: float = 0.0
    stages: tuple[Stage, ...] = ()
    zero_stages: tuple[ZeroStage, ...] = ()
    dropout: Callable[[Array], NDArray[np.intp]] | None = None


@dataclass(frozen=True)
class CellSetup:
    """One true cell: its mechanics and its sensor."""

    plant: PlantSetup
    sensor: SensorSetup


@dataclass(frozen=True)
class Reading:
    """A recording without noise and rounding, and for every row the row whose noise it carries (dropouts repeat one)."""

    samples: Samples
    noise_row: NDArray[np.intp] = field(repr=False)
