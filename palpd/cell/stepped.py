"""The simulated cell step by step: moved by commands, as the emulators need it, or by another simulator."""

from dataclasses import dataclass

import numpy as np

from palpd.cell.cell_file import CellFile, Wall
from palpd.cell.cell_file import CellSite as Place
from palpd.cell.dynamics import Floats, Memory, delayed, servo
from palpd.cell.effects import EFFECTS
from palpd.cell.physics import Library, Physics, physics
from palpd.cell.span import Span
from palpd.cell.stages import (
    Reporting,
    add_other_loads,
    clip_and_round_mean,
    load_sensor,
    memory_copy,
    read_mean,
    round_as_stated,
    scattered_wrench,
    solve_contact,
    wrench_array,
)


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """Samples of a cell that lives step by step, as they were and as they were reported.

    Reported, with noise: `position_m` and `velocity_m_per_s` (n, 3), `wrench` (n, 6) in N and Nm, filtered, not rounded to the
    sensor's steps. True: `tip_m` (n, 3) and `contact_N` (n,).
    """

    position_m: Floats
    velocity_m_per_s: Floats
    tip_m: Floats
    contact_N: Floats
    wrench: Floats


class SteppedCell:
    """A cell that lives step by step: commanded tip positions in, reports of robot and sensor out.

    One `step_s` passes per row. Until `begin` is called, effects that count from the first row of a recording (a bias that the tare
    does not see, drift, warm-up, …) are absent; at `begin` the memories of all effects are empty.
    """

    def __init__(self, cell: CellFile, *, seed: int = 0, step_s: float = 0.001, library: Library = EFFECTS) -> None:
        self._cell, self._library, self._step_s = cell, library, step_s
        self._rng = np.random.default_rng(seed)
        self._places: list[Place | None] = list(cell.sites) or [None]
        self._where_m = np.array([(place.x_m, place.y_m) if place else (0.0, 0.0) for place in self._places])
        self._begun, self._rows = False, 0
        self._servo: Memory = {}
        self._common: Memory = {}
        self._local: list[Memory] = [{} for _ in self._places]
        self._motion_noise = np.array([cell.robot.position_noise_rms_m] * 3 + [cell.robot.velocity_noise_rms_m_per_s] * 3)
        self._build()

    def _build(self) -> None:
        self._physics = [physics(self._cell, place, self._library, begun=self._begun) for place in self._places]

    def begin(self) -> None:
        """A recording begins here: histories and clocks of effects start afresh; the filter goes on."""
        self._begun, self._rows = True, 0
        self._common = {name: value for name, value in self._common.items() if name.startswith("filtered ")}
        self._local = [{} for _ in self._places]
        self._build()

    def rest(self) -> None:
        """As before any `begin`: what counts from the start of a recording is absent again."""
        self._begun = False
        self._build()

    def shares_held(self) -> dict[str, float]:
        """Share of the samples since `begin` outside the range of each learned effect, where its curve was held."""
        counted: dict[str, list[int]] = {}
        for memory in (self._common, *self._local):
            for name, mine in memory.items():
                if isinstance(mine, dict) and "held" in mine:
                    samples, held = counted.setdefault(name, [0, 0])
                    counted[name] = [samples + mine["samples"], held + mine["held"]]
        return {name: held / samples for name, (samples, held) in counted.items() if samples}

    def set_filter(self, cutoff_Hz: float | None) -> None:
        """The sensor's filter is set to this cutoff, None for none, in place of the stated one."""
        sensor = self._cell.sensor.model_copy(update={"filter_cutoff_Hz": cutoff_Hz})
        self._cell = self._cell.model_copy(update={"sensor": sensor})
        self._common = {name: value for name, value in self._common.items() if not name.startswith("filtered ")}
        self._build()

    def place_wall(self, z_m: float, stiffness_N_per_m: float) -> None:
        """Replace the tissue by a linear wall from now on.

        Args:
            z_m: Height of the wall.
        """
        self._cell = self._cell.model_copy(update={"wall": Wall(z_m=z_m, stiffness_N_per_m=stiffness_N_per_m)})
        self._build()

    def step(self, target_m: Floats) -> SampleBlock:
        """Let n steps pass.

        Args:
            target_m: Commanded tip positions (n, 3) in m.

        Returns:
            The n samples, as they were and as they were reported.
        """
        n = len(target_m)
        place = self._nearest(target_m[-1])
        what, c = self._physics[place], self._physics[place].constants
        t_s: Floats = np.arange(self._rows, self._rows + n, dtype=np.float64) * self._step_s
        self._rows += n
        position, velocity, acceleration = servo(target_m, self._step_s, c.servo_natural_frequency_Hz, c.servo_damping_ratio, self._servo)
        s = Span(c, t_s, self._step_s, position[:, 2], velocity[:, 2], acceleration[:, 2])
        what.apply("robot", s, self._common)
        motion = np.concatenate((position, velocity), axis=1)
        motion[:, 2], motion[:, 5] = s.z_m, s.vz_m_per_s
        motion = _reported_late(s, motion, self._common)
        load_sensor(s, what, self._common, self._local[place])
        read_mean(s, what, self._common)
        tip_m = position.copy()
        tip_m[:, 2] = s.tip_m
        motion = motion + self._rng.standard_normal((n, 6)) * self._motion_noise
        wrench = scattered_wrench(wrench_array(s), s, self._rng, self._common)
        return SampleBlock(motion[:, :3], motion[:, 3:], tip_m, s.contact_N, wrench)

    def _nearest(self, at_m: Floats) -> int:
        if len(self._places) == 1:
            return 0
        return int(np.argmin(((self._where_m - at_m[:2]) ** 2).sum(axis=1)))


def _reported_late(s: Span, motion: Floats, memory: Memory) -> Floats:
    """The motion (n, columns) as the robot reports it: a wrench that comes early is a robot that reports late."""
    if s.constants.delay_s >= 0.0 and s.constants.skew <= 0.0:
        return motion
    s.lead_s = np.maximum(s.constants.skew * s.t_s - s.constants.delay_s, 0.0)
    return delayed(motion, s.t_s, s.t_s - s.lead_s, memory.setdefault("reported", {}))


class MovedCell:
    """A cell whose tip another simulator moves: per sample the contact force first, then what robot and sensor report.

    The other simulator may ask for a sample again, as long as its time is that of the last one; that changes no history.
    """

    def __init__(self, what: Physics, reporting: Reporting, *, noise_seed: int | None = None) -> None:
        """A cell at rest.

        Args:
            reporting: How it reports.
            noise_seed: Seed of noise and rounding; neither without one.
        """
        self.what, self.reporting = what, reporting
        self._seed = noise_seed
        self.restart()

    def restart(self) -> None:
        """A recording begins: all histories are empty, and the noise begins again."""
        self._rng = None if self._seed is None else np.random.default_rng(self._seed)
        self._memory: Memory = {"common": {}, "local": {}}
        self._before: Memory = memory_copy(self._memory)
        self._t_s = -np.inf

    def touch(self, t_s: float, dt_s: float, motion: tuple[float, float, float]) -> float:
        """The contact force of a sample, along z in N.

        Args:
            t_s: Time since the recording began.
            dt_s: Time since the sample before.
            motion: Height in m, speed in m/s and acceleration in m/s² of the robot.
        """
        if t_s > self._t_s:
            self._before = memory_copy(self._memory)
        else:
            self._memory = memory_copy(self._before)
        self._t_s = t_s
        c, common = self.what.constants, self._memory["common"]
        z, v, a = (np.array([x]) for x in motion)
        s = Span(c, np.array([t_s]), dt_s, z, v, a)
        self.what.apply("robot", s, common)
        self._reported = _reported_late(s, np.stack((s.z_m, s.vz_m_per_s), axis=1), common)[0]
        self._span = s
        self._inertial_N = -c.mass_kg * float(s.az_m_per_s2[0])
        self._beyond_servo_N = self._inertial_N + c.mass_kg * motion[2]
        solve_contact(s, self.what, self._memory["local"])
        return float(s.contact_N[0])

    @property
    def expected_fz_N(self) -> float:
        """What a force sensor shows of the last sample: contact and inertia, which a simulator with bodies has of its own."""
        return float(self._span.contact_N[0]) + self._inertial_N

    def read(self, fz_N: float | None = None) -> Floats:
        """What robot and sensor report of the sample that was touched last.

        Args:
            fz_N: Force of contact and inertia that the other simulator's own sensor shows; None where it has none.

        Returns:
            Height in m, speed in m/s, and the wrench in N and Nm (8,).
        """
        s, common = self._span, self._memory["common"]
        s.fz_N = np.array([self.expected_fz_N if fz_N is None else fz_N + self._beyond_servo_N])
        add_other_loads(s, self.what, common)
        read_mean(s, self.what, common)
        if self._rng is None:
            clip_and_round_mean(s)
            return np.concatenate((self._reported, wrench_array(s)[0]))
        wrench = round_as_stated(scattered_wrench(wrench_array(s), s, self._rng, common), self.reporting.steps, s.constants.step_N)
        noise = self._rng.standard_normal(2) * (self.reporting.position_noise_rms_m, self.reporting.velocity_noise_rms_m_per_s)
        return np.concatenate((self._reported + noise, wrench[0]))
