"""Rigid motions, as URScript writes them: (x, y, z) in m and a rotation vector in rad."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def rotation(vector: Sequence[float] | Floats) -> Floats:
    """Rotation matrix (3, 3) of a rotation vector (Rodrigues)."""
    v = np.asarray(vector, dtype=float)
    angle = float(np.linalg.norm(v))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = v / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)


def rotation_vector(matrix: Floats) -> Floats:
    """Rotation vector (3,) of a rotation matrix; its length is at most pi."""
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
    half_turn: Floats = column / np.linalg.norm(column) * angle
    return half_turn


def composed(first: Sequence[float] | Floats, second: Sequence[float] | Floats) -> Floats:
    """Pose (6,) of `second`, given in the frame of `first` (URScript's pose_trans)."""
    turn = rotation(first[3:])
    place = np.asarray(first[:3], dtype=float) + turn @ np.asarray(second[:3], dtype=float)
    return np.concatenate([place, rotation_vector(turn @ rotation(second[3:]))])


def inverse(pose: Sequence[float] | Floats) -> Floats:
    """Pose (6,) that undoes `pose` (URScript's pose_inv)."""
    back = rotation(pose[3:]).T
    return np.concatenate([-back @ np.asarray(pose[:3], dtype=float), -np.asarray(pose[3:], dtype=float)])
