"""Ticks as messages on the topics of a recording, for a file and for whoever looks on while they come.

/tick alone holds the whole row; the other topics show parts of it in standard messages of ROS 2.
"""

from collections.abc import Collection, Iterator

import numpy as np
from numpy.typing import NDArray

from palpd.recording import cdr
from palpd.recording.second_channel import SecondChannel
from palpd.recording.tick_rows import filled_slots
from palpd.tick import Floats

Rows = NDArray[np.void]

TICK_TOPIC = "/tick"
SECOND_TOPIC, SECOND_TYPE = "/wrench_injected", "geometry_msgs/msg/WrenchStamped"
"""The tared wrench with a planted effect, one message a frame; only in the recordings of `palpd inject`."""
SCHEMAS = {
    "geometry_msgs/msg/PoseStamped": cdr.POSE_STAMPED,
    "geometry_msgs/msg/TwistStamped": cdr.TWIST_STAMPED,
    "geometry_msgs/msg/WrenchStamped": cdr.WRENCH_STAMPED,
    "palpd_msgs/msg/Tick": cdr.TICK,
}
"""Message definitions by the name of their type."""
TOPICS = {
    "/tcp_pose": "geometry_msgs/msg/PoseStamped",
    "/tcp_twist": "geometry_msgs/msg/TwistStamped",
    "/target_pose": "geometry_msgs/msg/PoseStamped",
    "/wrench_raw": "geometry_msgs/msg/WrenchStamped",
    "/wrench": "geometry_msgs/msg/WrenchStamped",
    TICK_TOPIC: "palpd_msgs/msg/Tick",
}
"""Types of the topics."""
_POSES = {"/tcp_pose": "tcp_pose", "/target_pose": "target_pose"}
_NEAR_S = 10.0
"""Largest distance between a sample's own time and its tick: beyond it the tick's time counts, as for a robot that never answered."""
_LEAST_APART_S = 0.007
"""Least distance of robot states in the standard topics: at 500 Hz leaving states out saves 2.5 of 17 MB a minute."""


def compensated(rows: Rows, filled: NDArray[np.bool_]) -> Floats:
    """Take the inertial share from the tared wrench: what the tissue does to the probe.

    Args:
        rows: ticks (m,).
        filled: which of their frame slots (m, slots) count.

    Returns:
        Wrenches (n, 6) of these frames in base axes, N and Nm.
    """
    wrench: Floats = rows["tared"][filled]
    wrench[:, 2] -= rows["inertial_N"][filled]
    return wrench


class TopicMessages:
    """Turns ticks into messages.

    Robot states repeat in ticks faster than the controller, and stand in the standard topics once; so each series of ticks needs one of
    these. `epoch_offset_s` turns monotonic seconds into Unix time.
    """

    def __init__(self, epoch_offset_s: float, second: SecondChannel | None = None) -> None:
        self._offset_ns = round(epoch_offset_s * 1e9)
        self._second = second
        self._robot_t_s = float("nan")

    def of(self, rows: Rows, topics: Collection[str] = TOPICS) -> list[tuple[str, cdr.Nanoseconds, list[bytes]]]:
        """Pack ticks.

        Args:
            rows: ticks (n,) with the fields of ROW, in their order.
            topics: the topics that somebody wants.

        Returns:
            Each of these topics with Unix times (m,) and as many messages; nothing where there are no rows.
        """
        if not len(rows):
            return []
        with np.errstate(all="ignore"):  # a sensor that sends nonsense makes no warnings
            return list(self._packed(rows, topics))

    def _packed(self, rows: Rows, topics: Collection[str]) -> Iterator[tuple[str, cdr.Nanoseconds, list[bytes]]]:
        states = self._new_states(rows)
        stamp_ns = self._epoch_ns(states["robot_t_s"], states["now_s"])
        for topic, name in _POSES.items():
            if topic in topics:
                pose = np.hstack([states[name][:, :3], cdr.quaternion(states[name][:, 3:])])
                yield topic, stamp_ns, cdr.pack_stamped(stamp_ns, cdr.BASE_FRAME, pose)
        if "/tcp_twist" in topics:
            yield "/tcp_twist", stamp_ns, cdr.pack_stamped(stamp_ns, cdr.BASE_FRAME, states["tcp_speed"])
        filled = filled_slots(rows)
        stamp_ns = self._epoch_ns(rows["frame_t_s"][filled], np.repeat(rows["now_s"], rows["frames"]))
        if "/wrench_raw" in topics:
            yield "/wrench_raw", stamp_ns, cdr.pack_stamped(stamp_ns, cdr.SENSOR_FRAME, rows["wrench"][filled])
        if "/wrench" in topics:
            yield "/wrench", stamp_ns, cdr.pack_stamped(stamp_ns, cdr.BASE_FRAME, compensated(rows, filled))
        if self._second is not None:
            yield SECOND_TOPIC, stamp_ns, cdr.pack_stamped(stamp_ns, cdr.BASE_FRAME, self._second.wrench(rows, filled))
        if TICK_TOPIC in topics:
            stamp_ns = self._epoch_ns(rows["now_s"], rows["now_s"])
            yield TICK_TOPIC, stamp_ns, cdr.pack_ticks(stamp_ns, rows)

    def _new_states(self, rows: Rows) -> Rows:
        """The rows with a new state of the robot, of a controller faster than 125 Hz at about that rate."""
        new = []
        for number, t_s in enumerate(rows["robot_t_s"].tolist()):
            if not abs(t_s - self._robot_t_s) < _LEAST_APART_S:
                new.append(number)
                self._robot_t_s = t_s
        return rows[new]

    def _epoch_ns(self, t_s: Floats, tick_s: Floats) -> cdr.Nanoseconds:
        t_s = np.where(np.abs(t_s - tick_s) < _NEAR_S, t_s, tick_s)
        t_s = np.clip(np.nan_to_num(t_s), 0.0, 1e9)
        since_boot_ns: cdr.Nanoseconds = np.rint(t_s * 1e9).astype(np.int64)
        return np.maximum(since_boot_ns + self._offset_ns, 0)
