"""Rigid motions, as URScript writes them: (x, y, z) in m and a rotation vector in rad."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def rotation(vector: Sequence[float] | Floats) -> Floats:
    """Compute the rotation matrix of a rotation vector (Rodrigues' formula).

    Args:
        vector: rotation vector (3,) in rad.

    Returns:
        Rotation matrix (3, 3).
    """
    v = np.asarray(vector, dtype=float)
    angle = float(np.linalg.norm(v))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = v / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)


def rotation_vector(matrix: Floats) -> Floats:
    """Compute the rotation vector of a rotation matrix.

    Args:
        matrix: rotation matrix (3, 3).

    Returns:
        Rotation vector (3,) in rad, at most pi long.
    """
    twice_sine = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    cosine = float(np.clip((np.trace(matrix) - 1.0) / 2.0, -1.0, 1.0))
    sine = float(np.linalg.norm(twice_sine)) / 2.0
    angle = float(np.arctan2(sine, cosine))
    if sine > 1e-7:
        axis: Floats = twice_sine / (2.0 * sine)
        return axis * angle
    if cosine > 0.0:
        return twice_sine / 2.0
    # Half a turn: the axis is the column of R + 1 that is largest, its sign free.
    columns = matrix + np.eye(3)
    column: Floats = columns[:, int(np.argmax(np.diag(matrix)))]
    return column / np.linalg.norm(column) * angle


def composed(first: Sequence[float] | Floats, second: Sequence[float] | Floats) -> Floats:
    """Compose two poses (URScript's pose_trans).

    Args:
        first: pose (6,) in m and rad.
        second: pose (6,) in the frame of `first`.

    Returns:
        Pose (6,) of `second` in the frame in which `first` is given.
    """
    turn = rotation(first[3:])
    place = np.asarray(first[:3], dtype=float) + turn @ np.asarray(second[:3], dtype=float)
    return np.concatenate([place, rotation_vector(turn @ rotation(second[3:]))])


def inverse(pose: Sequence[float] | Floats) -> Floats:
    """Invert a pose (URScript's pose_inv).

    Args:
        pose: pose (6,) in m and rad.

    Returns:
        Pose (6,) that undoes it.
    """
    back = rotation(pose[3:]).T
    return np.concatenate([-back @ np.asarray(pose[:3], dtype=float), -np.asarray(pose[3:], dtype=float)])


def displacement(start: Floats, end: Floats) -> Floats:
    """Compute the way from one pose to another.

    Args:
        start: pose (6,) in m and rad.
        end: pose (6,) in m and rad.

    Returns:
        Displacement (6,): m, and a rotation vector in base axes in rad.
    """
    if np.array_equal(start[3:], end[3:]):
        return np.concatenate([end[:3] - start[:3], np.zeros(3)])
    return np.concatenate([end[:3] - start[:3], rotation_vector(rotation(end[3:]) @ rotation(start[3:]).T)])
