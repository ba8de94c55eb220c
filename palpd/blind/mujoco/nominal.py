"""The nominal physics of docs/reference/contract.md (§3), to subtract a motion's own share from a reading and to name phases (§4)."""

import numpy as np
from numpy.typing import NDArray

from palpd.blind.mujoco.sensor import low_pass
from palpd.blind.mujoco.setup import Array, PressPath, StatedCell
from palpd.recording.samples import Samples


def normal_force(samples: Samples, cell: StatedCell, path: PressPath | None = None) -> Array:
    """The force along z that the nominal cell reads for a recorded motion.

    Args:
        samples: gives times, heights and speeds.
        path: where given, its press scatter applies.

    Returns:
        (n,) force, N.
    """
    press = path.press_of(samples.t_s) if path else np.zeros(len(samples), dtype=np.intp)
    shift, ratio = (path.surface_m[press], path.stiffness[press]) if path else (0.0, 0.0)
    depth = np.maximum(0.0, cell.surface_z_m + shift - samples.z_m)
    force = cell.hertz_N_per_m15 * (1 + ratio) * depth**1.5 - cell.mass_kg * np.gradient(samples.vz_m_per_s, samples.t_s)
    return low_pass(force, cell.filter_cutoff_Hz, 1 / cell.rate_Hz)


def force_residual(samples: Samples, cell: StatedCell, path: PressPath) -> Array:
    """Height and wrench of a reading, less the force that its own motion explains.

    Args:
        samples: the noise-free reading.
        path: its press scatter.

    Returns:
        (n, 7) in the order of CHANNELS; the height stands as it is.
    """
    out = np.column_stack([samples.z_m, samples.wrench])
    out[:, 3] -= normal_force(samples, cell, path)
    return out


def phase_of(samples: Samples, cell: StatedCell) -> NDArray[np.intp]:
    """The number of the phase (contract §4) of every row.

    Args:
        samples: a recording with the commanded height.
        cell: gives the surface.

    Returns:
        (n,) index into PHASES.

    Raises:
        ValueError: the commanded height is missing.
    """
    if samples.z_cmd_m is None:
        raise ValueError("the recording has no z_cmd_m, and the phases of a drawn case come from it; draw the case again")
    speed = np.gradient(samples.z_cmd_m, samples.t_s)
    moving = np.abs(speed) > min(1e-3, 0.05 * float(np.percentile(np.abs(speed), 95)))
    contact = samples.z_m < cell.surface_z_m
    return np.where(contact, np.where(moving, np.where(speed < 0, 2, 4), 3), moving.astype(int))
