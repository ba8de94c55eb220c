"""Joint angles and tip poses of the emulated UR5."""

import numpy as np

from hw.emulators.pose import Floats, displacement, rotation, rotation_vector

BASE_JOINTS_RAD = np.array([0.0, -1.75, -1.95, -1.01, 1.5708, 0.0])
"""Posture of the emulated arm: elbow up, tool straight down."""
JOINT_ROWS = (  # Denavit-Hartenberg d, a, alpha of the UR5 (UR's article "DH parameters")
    (0.089159, 0.0, np.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.39225, 0.0),
    (0.10915, 0.0, np.pi / 2),
    (0.09465, 0.0, -np.pi / 2),
    (0.0823, 0.0, 0.0),
)


def jacobian(joints_rad: Floats) -> Floats:
    """Compute the geometric Jacobian of the UR5's flange.

    Args:
        joints_rad: joint angles (6,).

    Returns:
        Jacobian (6, 6): m/s and rad/s in base axes per rad/s.
    """
    frame, frames = np.eye(4), [np.eye(4)]
    for q, (d, a, alpha) in zip(joints_rad, JOINT_ROWS, strict=True):
        cq, sq, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
        step = np.array([[cq, -sq * ca, sq * sa, a * cq], [sq, cq * ca, -cq * sa, a * sq], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]])
        frame = frame @ step
        frames.append(frame)
    tip = frames[-1][:3, 3]
    columns = [np.concatenate([np.cross(f[:3, 2], tip - f[:3, 3]), f[:3, 2]]) for f in frames[:-1]]
    return np.array(columns).T


class ArmKinematics:
    """Maps tip poses to joint angles by the UR5's Jacobian at one posture.

    A cell may place its tissue anywhere in the base frame, also out of a UR5's reach. So the posture is fixed, and only the
    displacements are the arm's.
    """

    def __init__(self, tip_pose: Floats) -> None:
        self._origin = tip_pose.copy()
        self._jacobian = jacobian(BASE_JOINTS_RAD)
        self._inverse = np.linalg.inv(self._jacobian)

    def joints(self, tip_pose: Floats) -> Floats:
        """Compute the joint angles of a tip pose.

        Args:
            tip_pose: pose (6,) in m and rad.

        Returns:
            Joint angles (6,) in rad.
        """
        return BASE_JOINTS_RAD + self._inverse @ displacement(self._origin, tip_pose)

    def pose(self, joints_rad: Floats) -> Floats:
        """Compute the tip pose of joint angles.

        Args:
            joints_rad: joint angles (6,).

        Returns:
            Pose (6,) in m and rad.
        """
        moved = self._jacobian @ (joints_rad - BASE_JOINTS_RAD)
        turn = rotation(moved[3:]) @ rotation(self._origin[3:])
        return np.concatenate([self._origin[:3] + moved[:3], rotation_vector(turn)])

    def joint_speed(self, tip_speed: Floats) -> Floats:
        """Compute the joint speeds of a tip speed.

        Args:
            tip_speed: tip speed (6,) in m/s and rad/s.

        Returns:
            Joint speeds (6,) in rad/s.
        """
        return self._inverse @ tip_speed

    def tip_speed(self, joint_speed_rad_per_s: Floats) -> Floats:
        """Compute the tip speed of joint speeds.

        Args:
            joint_speed_rad_per_s: joint speeds (6,).

        Returns:
            Tip speed (6,) in m/s and rad/s.
        """
        return self._jacobian @ joint_speed_rad_per_s
