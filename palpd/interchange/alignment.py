"""One recording from a motion and a force: common times, common axes, and a tare.

The force is kept as it was measured; heights and speeds are interpolated at its times. A wrench in axes of the tool is turned by the
recorded pose.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from palpd.errors import BadInput, RecordingError
from palpd.tick import Floats

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
OrientationKind = Literal["quaternion", "rotation vector", "roll, pitch, yaw"]

MOST_TURN_RAD = np.radians(2.0)
"""Largest rotation of the tool in a recording: at 2° its weight moves by 3 % to the side, and the tare no longer holds."""
TURNS: dict[str, tuple[tuple[int, int, int], tuple[int, int, int]]] = {
    "x": ((1, 2, 0), (1, 1, 1)),
    "y": ((2, 0, 1), (1, 1, 1)),
    "z": ((0, 1, 2), (1, 1, 1)),
    "-x": ((2, 1, 0), (1, 1, -1)),
    "-y": ((0, 2, 1), (1, 1, -1)),
    "-z": ((1, 0, 2), (1, 1, -1)),
}
"""For each axis that points away from the tissue: which axes of the file become x, y, z, and their signs. All are rotations."""
ORIENTATIONS: tuple[tuple[tuple[str, ...], OrientationKind], ...] = (
    (("qx", "qy", "qz", "qw"), "quaternion"),
    (("rx", "ry", "rz"), "rotation vector"),
    (("pose_3", "pose_4", "pose_5"), "rotation vector"),
    (("roll", "pitch", "yaw"), "roll, pitch, yaw"),
)
"""Words in the names of columns that hold an orientation."""
SAME_S = 1e-9
"""Times that differ by less are the same: stamps have nanoseconds."""
STILL_SHARE = 0.01
"""Share of the stroke that the tip may move during a tare."""
LEAST_NORM = 0.5
"""Norm of a quaternion below which it is none: an unset one is zero."""


@dataclass(frozen=True)
class TipPath:
    """How the tip moved: times (n,) on some clock, height (n,), speed and commanded height (n,) or None, orientation (n, 4) or None."""

    t_s: Floats
    z_m: Floats
    vz_m_per_s: Floats | None = None
    z_cmd_m: Floats | None = None
    orientation: Floats | None = None
    frame: str = ""


@dataclass(frozen=True)
class Wrench:
    """What the sensor read: times (n,) on the same clock, wrench (n, 6) in N and Nm, and the frame of its axes.

    `frame` is empty where nothing tells it, and None where the columns already are those of the recording.
    """

    t_s: Floats
    wrench: Floats
    frame: str | None = ""


def turned(vectors: Floats, axis: Axis) -> Floats:
    """Vectors in axes whose z is a chosen axis of the file.

    Args:
        vectors: Vectors (n, 3), or wrenches and twists (n, 6).
        axis: Axis of the file that points away from the tissue.

    Returns:
        The same vectors in palpd's axes, in their shape.
    """
    order, signs = TURNS[axis]
    triples = vectors.reshape(len(vectors), -1, 3)[:, :, order] * np.array(signs, dtype=float)
    return np.ascontiguousarray(triples.reshape(vectors.shape))


def continuous(quaternions: Floats, what: str) -> Floats:
    """Unit quaternions without flips of their sign, which turn nothing.

    Args:
        quaternions: Quaternions x, y, z, w (n, 4).
        what: What an error calls them.

    Returns:
        The same rotations (n, 4).

    Raises:
        RecordingError: One has a norm near zero.
    """
    norms = np.linalg.norm(quaternions, axis=1)
    if norms.min() < LEAST_NORM:
        row = int(np.argmin(norms))
        raise RecordingError(
            f"{what}: the quaternion in row {row + 1} has the norm {norms[row]:.2g}, expected 1; the orientation was not recorded: give "
            "--wrench-in base if the wrench is in base axes"
        )
    unit = quaternions / norms[:, None]
    flips = np.where(np.sum(unit[1:] * unit[:-1], axis=1) < 0.0, -1.0, 1.0)
    return np.asarray(unit * np.concatenate(([1.0], np.cumprod(flips)))[:, None])


def refuse_turn(orientation: Floats, what: str) -> None:
    """Refuse a tool that turns during the recording.

    Args:
        orientation: Unit quaternions without flips (n, 4).
        what: What an error calls the pose.

    Raises:
        RecordingError: It turns by more than 2°.
    """
    angles = 2.0 * np.arccos(np.minimum(np.abs(orientation @ orientation[0]), 1.0))
    if angles.max() > MOST_TURN_RAD:
        row = int(np.argmax(angles))
        raise RecordingError(
            f"{what}: the tool turns by {np.degrees(angles[row]):.1f}° up to row {row + 1}, expected at most "
            f"{np.degrees(MOST_TURN_RAD):.0f}°; cut the recording to the part in which only its height changes"
        )


def orientations_in(columns: Sequence[str]) -> Iterator[tuple[list[str], OrientationKind]]:
    """Columns of a table that hold the orientation of its tool, by their names.

    Yields:
        The columns of each orientation, and what they are.
    """
    for words, kind in ORIENTATIONS:
        for name in columns:
            for match in re.finditer(rf"(?<![a-z]){words[0]}(?![a-z0-9])", name, re.IGNORECASE):
                spelled = [word.upper() if match.group().isupper() else word for word in words]
                names = [name[: match.start()] + word + name[match.end() :] for word in spelled]
                if set(names) <= set(columns):
                    yield names, kind


def quaternions_of(values: Floats, kind: OrientationKind, names: Sequence[str]) -> Floats:
    """Quaternions x, y, z, w (n, 4) of the columns of an orientation.

    Args:
        values: The columns (n, 3 or 4). Angles are in degrees where a name or their size says so, else in radians.
    """
    if kind == "quaternion":
        return values
    degrees = any("deg" in name.lower() or "°" in name for name in names) or float(np.abs(values).max(initial=0.0)) > 2.0 * np.pi + 0.01
    if kind == "rotation vector":
        return np.asarray(Rotation.from_rotvec(values, degrees=degrees).as_quat())
    return np.asarray(Rotation.from_euler("xyz", values, degrees=degrees).as_quat())


def rotated(vectors: Floats, orientation: Floats) -> Floats:
    """Turn vectors from axes of the tool to those of the pose.

    Args:
        vectors: Wrenches (n, 6).
        orientation: Unit quaternions x, y, z, w (n, 4).

    Returns:
        The wrenches (n, 6) in axes of the pose.
    """
    axis, w = orientation[:, None, :3], orientation[:, None, 3:]
    triples = vectors.reshape(len(vectors), 2, 3)
    once = 2.0 * np.cross(np.broadcast_to(axis, triples.shape), triples)
    return np.asarray(triples + w * once + np.cross(np.broadcast_to(axis, triples.shape), once)).reshape(vectors.shape)


def overlap(path: TipPath, wrench: Wrench, names: str) -> NDArray[np.bool_]:
    """Which samples of the force lie within the times of the motion.

    Args:
        names: What an error calls both.

    Returns:
        A mask (n,) of the samples of the force.

    Raises:
        BadInput: None do: the two have clocks of their own.
    """
    usable = (wrench.t_s >= path.t_s[0] - SAME_S) & (wrench.t_s <= path.t_s[-1] + SAME_S)
    if not usable.any():
        begin_s = path.t_s[0] - wrench.t_s[0]
        raise BadInput(
            f"{names}: the motion spans {path.t_s[0]:.9g} to {path.t_s[-1]:.9g} s and the force {wrench.t_s[0]:.9g} to "
            f"{wrench.t_s[-1]:.9g} s, "
            f"so they have two clocks; give --offset-s, which is added to the times of the force ({begin_s:.6g} lets both begin together)"
        )
    return usable


def tared(t_s: Floats, z_m: Floats, wrench: Floats, tare_s: float) -> Floats:
    """Take the mean of the first seconds from a wrench.

    Args:
        t_s: Times (n,).
        z_m: Heights (n,).
        wrench: Readings (n, 6).
        tare_s: Length of the stretch in which the probe is free and still.

    Returns:
        The tared readings (n, 6).

    Raises:
        BadInput: The stretch is empty or longer than the recording, or the tip moves in it.
    """
    first = t_s - t_s[0] <= tare_s
    if tare_s <= 0.0 or first.sum() < 2:
        raise BadInput(
            f"--tare-s {tare_s:g} holds {int(first.sum())} samples, expected 2 or more; give the seconds for which the probe is still"
        )
    if tare_s > t_s[-1] - t_s[0]:
        raise BadInput(
            f"--tare-s is {tare_s:g} s and the recording lasts {t_s[-1] - t_s[0]:.3g} s; give the seconds at its start for which the "
            "probe is free and still"
        )
    moved_m, stroke_m = float(np.ptp(z_m[first])), float(np.ptp(z_m))
    if moved_m > STILL_SHARE * stroke_m:
        raise BadInput(
            f"the tip moves by {moved_m:.3g} m in the first {tare_s:g} s, expected at most 1 % of its stroke of {stroke_m:.3g} m; give a "
            "shorter --tare-s, in which the probe is free and still"
        )
    return np.asarray(wrench - wrench[first].mean(axis=0))
