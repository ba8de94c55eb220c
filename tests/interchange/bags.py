"""Bags with a known truth, written by the writers of rosbags."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

STORAGES = ("ros1", "sqlite3", "mcap")
BEGIN_NS = 1_700_000_000_123_456_789
STRAIGHT_DOWN = (1.0, 0.0, 0.0, 0.0)
"""Quaternion of a tool whose z points down."""


@dataclass(frozen=True)
class Truth:
    """What a bag was made of: stamps (n,) and (k,) in ns, base-frame wrench (n, 6), poses (k, 7), twists (k, 6)."""

    wrench_ns: np.ndarray
    wrench: np.ndarray
    pose_ns: np.ndarray
    pose: np.ndarray
    twist: np.ndarray


def truth(seconds: float = 2.0, *, pose_skew_ns: int = 0, turn_deg: float = 1.0) -> Truth:
    """Presses of 3 mm; sensor at 1 kHz, robot at 125 Hz; the tool turns slowly by `turn_deg`, and its quaternions flip their sign."""
    wrench_ns = BEGIN_NS + np.arange(int(seconds * 1000)) * 1_000_000
    pose_ns = BEGIN_NS + np.arange(int(seconds * 125)) * 8_000_000 + pose_skew_ns
    at_s, pose_s = (wrench_ns - BEGIN_NS) * 1e-9, (pose_ns - BEGIN_NS) * 1e-9
    rng = np.random.default_rng(4)

    def height_m(t_s: np.ndarray) -> np.ndarray:
        return 0.3 + 0.003 * np.cos(2.0 * np.pi * t_s)

    depth_m = np.maximum(0.3 - height_m(at_s), 0.0)
    wrench = rng.normal(0.0, 0.02, (len(at_s), 6)) * np.array([1, 1, 1, 0.02, 0.02, 0.02])
    wrench[:, 2] += 16.0 / 9.0 * 8e4 * 0.005**0.5 * depth_m**1.5
    angle = np.radians(turn_deg) * pose_s / pose_s[-1]
    turn = Rotation.from_rotvec(np.column_stack([angle, np.zeros((len(angle), 2))])) * Rotation.from_quat(STRAIGHT_DOWN)
    flips = rng.choice([-1.0, 1.0], len(pose_s))
    pose = np.column_stack([np.full(len(pose_s), 0.4), np.full(len(pose_s), -0.1), height_m(pose_s), turn.as_quat() * flips[:, None]])
    twist = np.zeros((len(pose_s), 6))
    twist[:, 2] = -0.003 * 2.0 * np.pi * np.sin(2.0 * np.pi * pose_s)
    return Truth(wrench_ns, wrench, pose_ns, pose, twist)


def in_tool_axes(one: Truth) -> np.ndarray:
    """The wrench (n, 6) as a sensor on the tool reads it; the tool stands still between two poses."""
    last = np.clip(np.searchsorted(one.pose_ns, one.wrench_ns, side="right") - 1, 0, len(one.pose) - 1)
    back = Rotation.from_quat(one.pose[last, 3:]).inv()
    return np.column_stack([back.apply(one.wrench[:, :3]), back.apply(one.wrench[:, 3:])])


def bag(
    folder: Path,
    storage: str,
    one: Truth,
    *,
    topics: Sequence[str] = ("/wrench", "/pose", "/twist"),
    frames: Mapping[str, str] | None = None,
    late_ns: int = 0,
) -> Path:
    """Write a bag; messages arrive up to `late_ns` after their stamps, so that some come out of order."""
    path = folder / (f"{storage}.bag" if storage == "ros1" else storage)
    store = get_typestore(Stores.ROS1_NOETIC if storage == "ros1" else Stores.ROS2_HUMBLE)
    frame = {"/wrench": "tool0", "/pose": "base", "/twist": "base", "/command": "base"} | dict(frames or {})
    rng = np.random.default_rng(7)
    pending: list[tuple[int, str, Any]] = []
    tool = in_tool_axes(one) if frame["/wrench"] != frame["/pose"] else one.wrench
    for topic, stamps_ns, rows in (("/wrench", one.wrench_ns, tool), ("/pose", one.pose_ns, one.pose), ("/twist", one.pose_ns, one.twist),
                                   ("/command", one.pose_ns, one.pose), ("/noise", one.pose_ns, one.twist)):  # fmt: skip
        if topic in topics:
            delays = rng.integers(0, late_ns + 1, len(stamps_ns))
            pending += [
                (int(stamp_ns + delay), topic, message(store, storage, topic, frame.get(topic, ""), int(stamp_ns), row))
                for stamp_ns, delay, row in zip(stamps_ns, delays, rows, strict=True)
            ]
    pending.sort(key=lambda each: each[0])
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer1(path) if storage == "ros1" else Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections = {topic: writer.add_connection(topic, kind_of(topic), typestore=store) for topic in topics}
        for arrived_ns, topic, content in pending:
            raw = store.serialize_ros1(content, kind_of(topic)) if storage == "ros1" else store.serialize_cdr(content, kind_of(topic))
            writer.write(connections[topic], arrived_ns, raw)
    return path


def kind_of(topic: str) -> str:
    """Type of the messages of a topic."""
    kinds = {"/wrench": "WrenchStamped", "/pose": "PoseStamped", "/command": "PoseStamped", "/twist": "TwistStamped", "/noise": "Vector3"}
    return f"geometry_msgs/msg/{kinds[topic]}"


def message(store: Any, storage: str, topic: str, frame: str, stamp_ns: int, row: np.ndarray) -> Any:
    """One message of a topic."""
    types = store.types
    vector, point, turn = (types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Point", "Quaternion"))
    x = row.tolist()
    if topic == "/noise":
        return vector(*x[:3])
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **({"seq": 0} if storage == "ros1" else {}))
    if topic == "/wrench":
        wrench = types["geometry_msgs/msg/Wrench"](force=vector(*x[:3]), torque=vector(*x[3:]))
        return types["geometry_msgs/msg/WrenchStamped"](header=header, wrench=wrench)
    if topic == "/twist":
        twist = types["geometry_msgs/msg/Twist"](linear=vector(*x[:3]), angular=vector(*x[3:]))
        return types["geometry_msgs/msg/TwistStamped"](header=header, twist=twist)
    pose = types["geometry_msgs/msg/Pose"](position=point(*x[:3]), orientation=turn(*x[3:]))
    return types["geometry_msgs/msg/PoseStamped"](header=header, pose=pose)
