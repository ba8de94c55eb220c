"""Recordings of the emulated cell as the paper's laboratory would have made them: its sensor, its motion, its phantom.

A whole recording is computed in one piece by the cell's physics, so an hour of palpation takes seconds. The true contact force, which
a real cell does not show, stands beside it.
"""

import math
from dataclasses import dataclass

import numpy as np

from palpd.cell.cell_file import PHANTOM, CellFile
from palpd.cell.dynamics import lowpass, servo
from palpd.cell.stepped import SteppedCell
from palpd.control.sequence import CLEAR_SHARE
from palpd.recording.samples import Samples
from palpd.tick import Floats

COUNT_FZ_N = 0.131
"""One count of Fz of a 200 N HEX-70."""
CUTOFF_Hz = 15.0
"""The sensor's filter as delivered."""
STEP_S = 0.002
"""Step of the sensor at 500 Hz."""
ROBOT_EVERY = 4
"""Sensor samples per robot state: 500 Hz against 125 Hz."""
TARE_S = 2.0
"""Time over which the tare is averaged, as in the daemon."""
UNZEROED_N = -50.0
"""An un-zeroed sensor reads tens of newtons; where between two counts is drawn for each tare."""
ACCELEROMETER_NOISE_M_PER_S2 = 0.1
ACCELEROMETER_OFFSET_M_PER_S2 = 0.05
"""One sigma each of the tool accelerometer; assumed, the controller's manual gives none."""


@dataclass(frozen=True, slots=True)
class Take:
    """One emulated recording: sensor samples (n,) and robot states (k,).

    Attributes:
        t_s: Times (n,).
        z_cmd_m: Commanded heights (n,).
        z_m: Reported heights (n,), interpolated between robot states.
        vz_m_per_s: Reported speeds (n,), interpolated likewise.
        fz_N: Forces (n,), tared and rounded to counts.
        robot_t_s: Times (k,) of the robot states.
        robot_vz_m_per_s: Reported speeds (k,).
        target_vz_m_per_s: Commanded speeds (k,).
        tool_az_m_per_s2: Tool acceleration (k,).
        contact_N: Force (n,) of the tissue as the sensor's filter shows it; only the emulator knows it.
        clear_z_m: Height above which nothing is touched, as far as the operator knows.
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


def take(cell: CellFile, z_cmd_m: Floats, seed: int) -> Take:
    """Tare the sensor at rest where the motion begins, then follow the commanded heights at 500 Hz.

    Above tissue whose surface is believed at 0, the upper half of the way to where the motion begins counts as clear, as in the daemon.

    Args:
        z_cmd_m: Commanded heights (n,) in m.
        seed: Seed of noise and tare.

    Returns:
        The recording.
    """
    rng = np.random.default_rng([seed, 1])
    count_N, sensor = cell.sensor.resolution_fz_N, cell.sensor
    physics = SteppedCell(cell, seed=seed, step_s=STEP_S)
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
    """The cell of one site of a phantom, with the paper's sensor: counts of 131 mN and a filter of 15 Hz.

    Returns:
        A cell with the tissue and effects of that site only.
    """
    sensor = cell.sensor.model_copy(update={"resolution_fz_N": COUNT_FZ_N, "filter_cutoff_Hz": CUTOFF_Hz})
    return cell.at_site(name).model_copy(update={"sensor": sensor})


def free_cell(cell: CellFile, effects: dict[str, dict[str, float]]) -> CellFile:
    """The same robot, probe and sensor with nothing in reach.

    Args:
        effects: Effects that it has instead of its own, by id.

    Returns:
        A cell without tissue.
    """
    return cell.model_copy(update={"tissue": None, "sites": (), "effects": effects})


def _rounded(values: Floats, count_N: float) -> Floats:
    return np.rint(values / count_N) * count_N if count_N > 0 else values
