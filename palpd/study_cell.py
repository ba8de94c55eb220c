"""Recordings of the emulated cell as the paper's laboratory would have made them: its sensor, its motion, its phantom.

A whole recording is computed in one piece by the cell's physics, so an hour of palpation takes seconds. What a real cell would not
tell stands beside it: the true contact force.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpd.cell import Cell
from palpd.cell_file import PHANTOM, CellFile
from palpd.dynamics import lowpass, servo
from palpd.samples import Samples
from palpd.sequence import CLEAR_SHARE
from palpd.tick import Floats

COUNT_FZ_N = 0.131
"""One count of Fz of a 200 N HEX-70."""
CUTOFF_Hz = 15.0
"""The sensor's filter as delivered."""
STEP_S = 0.002
ROBOT_EVERY = 4
"""Sensor samples per robot state: 500 Hz against 125 Hz."""
TARE_S = 2.0
UNZEROED_N = -50.0
"""An un-zeroed sensor reads tens of newtons; where between two counts is drawn for each tare."""
ACCELEROMETER_NOISE_M_PER_S2 = 0.1
ACCELEROMETER_OFFSET_M_PER_S2 = 0.05
"""One sigma each of the tool accelerometer; assumed, the controller's manual gives none."""
ACCELERATION_M_PER_S2 = 0.5


@dataclass(frozen=True, slots=True)
class Move:
    """Go to a height at a speed, then rest there."""

    z_m: float
    speed_m_per_s: float
    rest_s: float = 0.0
    acceleration_m_per_s2: float = ACCELERATION_M_PER_S2


@dataclass(frozen=True, slots=True)
class Take:
    """One emulated recording. Sensor samples (n,): `t_s`, `z_cmd_m`, `z_m` and `vz_m_per_s` (reported, interpolated between robot
    states), `fz_N` (tared, rounded to counts). Robot states (k,): `robot_t_s`, `robot_vz_m_per_s`, `target_vz_m_per_s`,
    `tool_az_m_per_s2`. Known to the emulator only: `contact_N` (n,), the force of the tissue on the tip as the sensor's filter shows it.
    Above `clear_z_m` nothing is touched, as far as who drives knows.
    """

    t_s: Floats
    z_cmd_m: Floats
    z_m: Floats
    vz_m_per_s: Floats
    fz_N: Floats
    robot_t_s: Floats
    robot_vz_m_per_s: Floats
    target_vz_m_per_s: Floats
    tool_az_m_per_s2: Floats
    contact_N: Floats
    clear_z_m: float = -math.inf

    def samples(self) -> Samples:
        """The same as a recording that training and diagnosis take; the five other axes are zero."""
        wrench = np.zeros((len(self.t_s), 6))
        wrench[:, 2] = self.fz_N
        return Samples(self.t_s, self.z_cmd_m, self.z_m, self.vz_m_per_s, wrench)


def ramps(start_z_m: float, moves: Sequence[Move], step_s: float = STEP_S) -> tuple[Floats, list[tuple[int, int]]]:
    """Commanded heights (n,) of moves with trapezoids of speed, and for each move the samples [first, last) that it and its rest take."""
    pieces: list[Floats] = []
    spans: list[tuple[int, int]] = []
    at_m, count = start_z_m, 0
    for move in moves:
        way_m, acceleration = move.z_m - at_m, move.acceleration_m_per_s2
        speed = min(move.speed_m_per_s, np.sqrt(abs(way_m) * acceleration))
        ramp_s, cruise_s = speed / acceleration, abs(way_m) / max(speed, 1e-12) - speed / acceleration
        along_s = np.arange(1, round((2 * ramp_s + cruise_s + move.rest_s) / step_s) + 1) * step_s
        late_s = np.clip(2 * ramp_s + cruise_s - along_s, 0.0, ramp_s)
        travelled_m = np.where(
            along_s < ramp_s,
            0.5 * acceleration * along_s**2,
            np.minimum(speed * (along_s - ramp_s / 2), abs(way_m) - 0.5 * speed * ramp_s),
        )
        braking = along_s > ramp_s + cruise_s
        travelled_m[braking] = abs(way_m) - 0.5 * acceleration * late_s[braking] ** 2
        pieces.append(at_m + np.sign(way_m) * travelled_m)
        spans.append((count, count + len(along_s)))
        at_m, count = move.z_m, count + len(along_s)
    return np.concatenate(pieces), spans


def take(cell: CellFile, z_cmd_m: Floats, seed: int) -> Take:
    """Tare the sensor at rest where the motion begins, then follow the commanded heights (n,) at 500 Hz.

    Above tissue whose surface is believed at 0, the upper half of the way to where the motion begins counts as clear, as in the daemon.
    """
    rng = np.random.default_rng([seed, 1])
    count_N, sensor = cell.sensor.resolution_fz_N, cell.sensor
    physics = Cell(cell, seed=seed, step_s=STEP_S)
    rest = np.zeros((round(TARE_S / STEP_S), 3))
    rest[:, 2] = z_cmd_m[0]
    target = np.zeros((len(z_cmd_m), 3))
    target[:, 2] = z_cmd_m
    unzeroed_N = UNZEROED_N + rng.uniform(0.0, max(count_N, 1e-9))
    tare_N = float(_rounded(physics.step(rest).wrench[:, 2] + unzeroed_N, count_N).mean())
    physics.begin()
    block = physics.step(target)
    t_s = np.arange(len(z_cmd_m), dtype=np.float64) * STEP_S
    states = slice(0, None, ROBOT_EVERY)
    robot_t_s = t_s[states]
    _, _, acceleration = servo(z_cmd_m, STEP_S, cell.robot.servo_natural_frequency_Hz, cell.robot.servo_damping_ratio, {})
    scatter = rng.standard_normal(len(robot_t_s)) * ACCELEROMETER_NOISE_M_PER_S2
    tool = acceleration[states] + rng.normal(0.0, ACCELEROMETER_OFFSET_M_PER_S2) + scatter
    seen_N = block.contact_N
    if sensor.filter_cutoff_Hz is not None:
        seen_N = lowpass(seen_N, STEP_S, -2.0 * np.pi * sensor.filter_cutoff_Hz, {})
    reported_z_m, reported_speed = block.position_m[states, 2], block.velocity_m_per_s[states, 2]
    return Take(
        t_s,
        z_cmd_m,
        np.interp(t_s, robot_t_s, reported_z_m),
        np.interp(t_s, robot_t_s, reported_speed),
        _rounded(block.wrench[:, 2] + unzeroed_N, count_N) - tare_N,
        robot_t_s,
        reported_speed,
        np.gradient(z_cmd_m, STEP_S)[states],
        tool,
        seen_N,
        CLEAR_SHARE * float(z_cmd_m[0]) if cell.tissue is not None else -math.inf,
    )


def setup(name: str, cell: CellFile = PHANTOM) -> CellFile:
    """The cell of one site of a phantom, with the paper's sensor: counts of 131 mN and its filter of 15 Hz."""
    site = next(each for each in cell.sites if each.name == name)
    sensor = cell.sensor.model_copy(update={"resolution_fz_N": COUNT_FZ_N, "filter_cutoff_Hz": CUTOFF_Hz})
    return cell.model_copy(update={"tissue": site.tissue, "effects": cell.effects | site.effects, "sites": (), "sensor": sensor})


def free_cell(cell: CellFile, effects: dict[str, dict[str, float]]) -> CellFile:
    """The same robot, probe and sensor with nothing in reach, and these effects."""
    return cell.model_copy(update={"tissue": None, "sites": (), "effects": effects})


def _rounded(values: Floats, count_N: float) -> Floats:
    return np.rint(values / count_N) * count_N if count_N > 0 else values
