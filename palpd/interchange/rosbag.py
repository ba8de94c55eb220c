"""Bags of ROS 1 and ROS 2 (sqlite3 and MCAP), through `rosbags`.

The messages of one topic that have the same length have the same layout, so their numbers are taken out of all of them at once: a
million messages are not a million objects.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpd.errors import RecordingError
from palpd.files import opened
from palpd.interchange.channels import Channel, ChannelData, Kind, library, listing, refuse_empty, refuse_many, understanding
from palpd.recording.mcap_file import HEADER
from palpd.tick import Floats

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Bag1
    from rosbags.rosbag2 import Reader as Bag2

KIND = "a ROS bag"
MCAP_HEAD_BYTES = 1_000_000
"""First bytes of an MCAP file, in which palpd's own files have their header."""
TRANSFORMS = "tf2_msgs/msg/TFMessage"
BETWEEN = ":"
"""Between the topic of transforms and the frame whose pose is meant: /tf:tool0."""


class MessageLayout(NamedTuple):
    """Where the numbers of a message stand: how many, and how many doubles before its end they begin; and whether it has a stamp."""

    kind: Kind
    numbers: int
    from_end: int
    stamped: bool


TYPES = {
    "geometry_msgs/msg/WrenchStamped": MessageLayout("wrench", 6, 6, True),
    "geometry_msgs/msg/Wrench": MessageLayout("wrench", 6, 6, False),
    "geometry_msgs/msg/PoseStamped": MessageLayout("pose", 7, 7, True),
    "geometry_msgs/msg/Pose": MessageLayout("pose", 7, 7, False),
    "geometry_msgs/msg/TransformStamped": MessageLayout("pose", 7, 7, True),
    "geometry_msgs/msg/PoseWithCovarianceStamped": MessageLayout("pose", 7, 43, True),
    "nav_msgs/msg/Odometry": MessageLayout("pose", 7, 85, True),
    "geometry_msgs/msg/TwistStamped": MessageLayout("twist", 6, 6, True),
    "geometry_msgs/msg/Twist": MessageLayout("twist", 6, 6, False),
}
"""Messages that hold a wrench, a pose or a twist; behind the numbers of two of them stand covariances."""
STAMP = slice(4, 12)
"""Bytes of the stamp: behind the sequence number in ROS 1, behind the encapsulation in ROS 2."""


class RosbagReader:
    """Reads bags: .bag, .db3, .mcap, and the folder of a ROS 2 bag."""

    name = "a ROS bag (.bag, .db3, .mcap, or the folder with metadata.yaml)"

    def reads(self, path: Path) -> bool:
        """Whether a file has the ending of a bag and is no recording of palpd."""
        if path.is_dir():
            return (path / "metadata.yaml").is_file()
        return path.suffix in (".bag", ".db3") or (path.suffix == ".mcap" and not _is_ours(path))

    def channels(self, path: Path) -> Sequence[Channel]:
        """List the topics of a bag."""
        with ExitStack() as stack, understanding(path, KIND):
            return _listed(path, _opened(stack, path))

    def columns(self, path: Path, names: Sequence[str]) -> dict[str, ChannelData]:
        """Read topics; a topic of transforms is named with its frame, /tf:tool0. All times have one origin.

        Args:
            names: Names of channels.

        Raises:
            RecordingError: A topic is absent, empty, of another type or damaged.
        """
        with ExitStack() as stack, understanding(path, KIND):
            bag = _opened(stack, path)
            topics = _topics(path, _listed(path, bag), names)
            connections = [each for each in bag.connections if each.topic in topics.values()]
            messages: dict[str, list[bytes]] = {topic: [] for topic in topics.values()}
            received: dict[str, list[int]] = {topic: [] for topic in topics.values()}
            # of ROS 1 each connection by itself: to merge the indices of several takes a quarter of the time
            for together in [[each] for each in connections] if _is_ros1(path) else [connections]:
                for connection, stamp_ns, raw in bag.messages(connections=together):
                    messages[connection.topic].append(raw)
                    received[connection.topic].append(stamp_ns)
            types = {connection.topic: connection for connection in connections}
            parsed = {
                name: _parsed(path, name, topic, messages[topic], received[topic], types.get(topic)) for name, topic in topics.items()
            }
        origin_ns = min(int(stamps[0]) for stamps, *_ in parsed.values())
        return {
            name: ChannelData(values, (stamps - origin_ns).astype(np.float64) * 1e-9, origin_ns, frame, messages=True, notes=notes)
            for name, (stamps, values, frame, notes) in parsed.items()
        }


READER = RosbagReader()


def _is_ours(path: Path) -> bool:
    with opened(path, most_bytes=1 << 50, error=RecordingError) as stream:
        return HEADER.encode() in stream.read(MCAP_HEAD_BYTES)


def _opened(stack: ExitStack, path: Path) -> "Bag1 | Bag2":
    refuse_empty(path)
    bags = library(path, KIND, "rosbags", f"rosbags.rosbag{1 if _is_ros1(path) else 2}")
    return stack.enter_context(bags.Reader(path))


def _is_ros1(path: Path) -> bool:
    return path.suffix == ".bag" and path.is_file()


def _listed(path: Path, bag: "Bag1 | Bag2") -> list[Channel]:
    """The topics of an open bag."""
    duration_s = max(bag.duration, 1) * 1e-9
    refuse_many(path, len(bag.topics))
    return [
        Channel(
            topic,
            "transforms" if info.msgtype == TRANSFORMS else TYPES[info.msgtype].kind if info.msgtype in TYPES else "other",
            rate_Hz=info.msgcount / duration_s if info.msgcount > 1 else None,
            samples=info.msgcount,
            type=info.msgtype or "several types",
        )
        for topic, info in sorted(bag.topics.items())
    ]


def _topics(path: Path, channels: list[Channel], names: Sequence[str]) -> dict[str, str]:
    """The topic of each name; one that is absent, or holds nothing that an import could use, is refused."""
    listed = {channel.name: channel for channel in channels}
    topics = {name: name.partition(BETWEEN)[0] if name not in listed else name for name in names}
    for topic in topics.values():
        if topic not in listed:
            raise RecordingError(f"{path.name} has no topic {topic}; it holds {listing(channels)}")
        if listed[topic].kind == "other":
            raise RecordingError(
                f"{path.name}: {topic} is {listed[topic].type}, expected a wrench, a pose or a twist; the bag holds {listing(channels)}"
            )
    return topics


Parsed = tuple[NDArray[np.int64], Floats, str, tuple[str, ...]]
"""Stamps (n,) in ns, values (n, k), frame, notes."""


def _parsed(path: Path, name: str, topic: str, messages: list[bytes], received: list[int], connection: "Connection | None") -> Parsed:
    """The numbers of the messages of a topic, in the order of their stamps."""
    if not messages or connection is None:
        raise RecordingError(f"{path.name}: {topic} holds no message; record it again or name another topic")
    ros1 = _is_ros1(path)
    at_ns = np.array(received, dtype=np.int64)
    if connection.msgtype == TRANSFORMS:
        stamps, values, frame = _transforms(path, name, messages, ros1)
        notes: tuple[str, ...] = ()
    else:
        stamps, values, frame = _numbers(path, topic, messages, TYPES[connection.msgtype], ros1)
        notes = ()
        if not stamps.any():
            stamps, notes = at_ns, (f"{topic} has no stamps of its own, so the times at which the bag received it count.",)
        elif not stamps.all():
            raise RecordingError(f"{path.name}: {int((stamps == 0).sum())} messages of {topic} have the stamp 0; record it with stamps")
    order = np.argsort(stamps, kind="stable")
    if (np.diff(order) < 0).any():
        notes = (*notes, f"{topic}: {int((np.diff(order) < 0).sum())} messages came out of order and were sorted by their stamps.")
    stamps, values = stamps[order], values[order]
    fresh = np.concatenate(([True], np.diff(stamps) > 0))
    if not fresh.all():
        notes = (*notes, f"{topic}: {int((~fresh).sum())} messages repeat a stamp and were left out.")
    if not np.isfinite(values[fresh]).all():
        row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
        raise RecordingError(f"{path.name}: message {row + 1} of {topic} holds a number that is not finite; leave that part out")
    return stamps[fresh], values[fresh], frame, notes


def _numbers(path: Path, topic: str, messages: list[bytes], layout: MessageLayout, ros1: bool) -> tuple[NDArray[np.int64], Floats, str]:
    """Stamps (n,), numbers (n, k) and frame of messages of a fixed layout; messages of one length are read together."""
    lengths = np.fromiter(map(len, messages), dtype=np.int64, count=len(messages))
    least = layout.from_end * 8 + (16 if layout.stamped else 0)
    if lengths.min() < least:
        row = int(np.argmin(lengths))
        raise RecordingError(f"{path.name}: message {row + 1} of {topic} has {lengths[row]} bytes, expected {least} or more; it is damaged")
    stamps = np.zeros(len(messages), np.int64)
    values = np.empty((len(messages), layout.numbers))
    frames: set[str] = set()
    for length in np.unique(lengths):
        these = np.flatnonzero(lengths == length)
        block = np.frombuffer(b"".join([messages[number] for number in these.tolist()]), np.uint8).reshape(len(these), length)
        if not ros1 and (block[:, 1] & 1 == 0).any():
            raise RecordingError(f"{path.name}: {topic} was written by a big-endian machine; convert it with rosbags-convert")
        begin = int(length) - 8 * layout.from_end
        values[these] = np.ascontiguousarray(block[:, begin : begin + 8 * layout.numbers]).view("<f8")
        if layout.stamped:
            seconds = np.ascontiguousarray(block[:, STAMP]).view("<u4").astype(np.int64)
            stamps[these] = seconds[:, 0] * 1_000_000_000 + seconds[:, 1]
            letters = int(block[0, 12:16].view("<u4")[0])
            names = block[:, 16 : 16 + letters]
            different = names[:1] if (names == names[0]).all() else np.unique(names, axis=0)
            frames |= {bytes(each).rstrip(b"\0").decode("utf-8", "replace") for each in different}
    if len(frames) > 1:
        raise RecordingError(f"{path.name}: {topic} comes in the frames {', '.join(sorted(frames))}, expected one; record each in a topic")
    return stamps, values, next(iter(frames), "")


def _transforms(path: Path, name: str, messages: list[bytes], ros1: bool) -> tuple[NDArray[np.int64], Floats, str]:
    """Stamps (n,), poses (n, 7) and parent frame of one frame in a topic of transforms."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    read = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    topic, _, child = name.partition(BETWEEN)
    stamps, values, parents, children = [], [], set(), set()
    for raw in messages:
        for each in read(raw, TRANSFORMS).transforms:  # type: ignore[attr-defined]
            children.add(each.child_frame_id)
            if each.child_frame_id == child:
                move, turn = each.transform.translation, each.transform.rotation
                stamps.append(each.header.stamp.sec * 1_000_000_000 + each.header.stamp.nanosec)
                values.append((move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w))
                parents.add(each.header.frame_id)
    if not stamps:
        what = f"no frame {child}" if child else "several frames"
        raise RecordingError(
            f"{path.name}: {topic} holds {what}; give --pose {topic}{BETWEEN}FRAME with one of {', '.join(sorted(children)[:20]) or 'none'}"
        )
    if len(parents) > 1:
        raise RecordingError(f"{path.name}: {child} in {topic} has the parents {', '.join(sorted(parents))}, expected one")
    return np.array(stamps, np.int64), np.array(values), parents.pop()
