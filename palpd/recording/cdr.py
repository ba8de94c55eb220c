"""ROS 2 messages as numpy structures: array assignment packs the bytes of a whole batch, and reads them back.

CDR aligns every primitive to its own size, counted from behind the four bytes that name the encapsulation; a sequence is its
length (uint32) and its elements. So messages of equal sequence lengths have one fixed layout, a numpy dtype with offsets.
"""

from enum import IntEnum
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpd.errors import RecordingError
from palpd.tick import MAX_FRAMES, ROW, Action, Floats, Mode, Phase, Request, Trip

LITTLE_ENDIAN_CDR = np.frombuffer(b"\x00\x01\x00\x00", "<u4")[0]

BASE_FRAME = "base"
SENSOR_FRAME = "sensor"

Packed = NDArray[np.void]
Nanoseconds = NDArray[np.int64]

_Field = tuple[str, np.dtype[np.void] | np.dtype[np.generic], int]
"""Name, type of the elements, how many of them; the elements follow each other without gaps."""


def _layout(fields: list[_Field]) -> np.dtype[np.void]:
    offset, names, offsets = 4, ["encapsulation"], [0]
    formats: list[Any] = [np.dtype("<u4")]
    for name, element, count in fields:
        if count == 0:
            continue  # an empty sequence does not even pad
        alignment = 1 if element.kind == "S" else element.base.itemsize
        offset += -(offset - 4) % alignment
        names.append(name)
        formats.append(element if count == 1 else np.dtype((element, (count,))))
        offsets.append(offset)
        offset += element.itemsize * count
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": offset})


def _header(frame: str) -> list[_Field]:
    text = np.dtype(f"S{len(frame) + 1}")
    return [("sec", np.dtype("<i4"), 1), ("nanosec", np.dtype("<u4"), 1), ("frame_length", np.dtype("<u4"), 1), ("frame", text, 1)]


def _packed(layout: np.dtype[np.void], stamp_ns: Nanoseconds, frame: str) -> Packed:
    messages = np.zeros(len(stamp_ns), layout)
    messages["encapsulation"] = LITTLE_ENDIAN_CDR
    messages["sec"], messages["nanosec"] = np.divmod(stamp_ns, 1_000_000_000)
    messages["frame_length"] = len(frame) + 1
    messages["frame"] = frame.encode()
    return messages


@cache
def _stamped(frame: str, count: int) -> np.dtype[np.void]:
    return _layout([*_header(frame), ("values", np.dtype("<f8"), count)])


def pack_stamped(stamp_ns: Nanoseconds, frame: str, values: Floats) -> list[bytes]:
    """Pack messages of a Header and float64s.

    Args:
        stamp_ns: Unix times (n,) of the headers.
        values: PoseStamped (n, 7), TwistStamped (n, 6) or WrenchStamped (n, 6).

    Returns:
        One message for each row.
    """
    packed = _packed(_stamped(frame, values.shape[1]), stamp_ns, frame)
    packed["values"] = values
    return split(packed)


def unpack_wrenches(messages: list[bytes]) -> Floats:
    """Wrenches (n, 6) of WrenchStamped messages in base axes, N and Nm."""
    wrench: Floats = np.frombuffer(b"".join(messages), _stamped(BASE_FRAME, 6))["values"]
    return wrench


PER_FRAME = tuple(name for name in ROW.names or () if ROW[name].shape[:1] == (MAX_FRAMES,))
"""The fields of ROW that hold one entry for each sensor frame."""

_ONCE = tuple(name for name in ROW.names or () if name not in PER_FRAME)


LATER = {"zero_N": 0.0}
"""Fields that ticks did not always have, and what stands for them in recordings from before. A field that ROW gets joins them.

Before `zero_N` there was no running zero, so its share was 0."""


@cache
def tick_layout(frames: int, absent: tuple[str, ...] = ()) -> np.dtype[np.void]:
    """Lay out a Tick message: the fields held once, then the per-frame fields as sequences.

    Args:
        frames: Number of sensor frames in it.
        absent: Fields of LATER that it does not have.
    """
    fields = _header(BASE_FRAME)
    for name in _ONCE:
        if name not in absent:
            fields.append((name, ROW[name].base, int(np.prod(ROW[name].shape))))
    for name in PER_FRAME:
        width = int(np.prod(ROW[name].shape[1:]))
        fields += [(f"{name}_length", np.dtype("<u4"), 1), (name, ROW[name].base, frames * width)]
    return _layout(fields)


@cache
def _frames_of_length(absent: tuple[str, ...]) -> dict[int, int]:
    """Number of frames by the length of a Tick message in bytes."""
    return {tick_layout(frames, absent).itemsize: frames for frames in range(MAX_FRAMES + 1)}


def pack_ticks(stamp_ns: Nanoseconds, rows: NDArray[np.void]) -> list[bytes]:
    """Pack Tick messages.

    Args:
        stamp_ns: Unix times (n,) of the headers.
        rows: ticks (n,) of dtype ROW or `row_type`.

    Returns:
        One message for each row.
    """
    messages = [b""] * len(rows)
    counts = rows["frames"]
    for frames in np.unique(counts).tolist():
        at = np.flatnonzero(counts == frames)
        packed = _packed(tick_layout(frames), stamp_ns[at], BASE_FRAME)
        for name in _ONCE:
            packed[name] = rows[name][at]
        for name in PER_FRAME:
            width = int(np.prod(ROW[name].shape[1:]))
            packed[f"{name}_length"] = frames * width
            if frames:
                packed[name] = rows[name][at, :frames].reshape(packed[name].shape)
        for number, message in zip(at.tolist(), split(packed), strict=True):
            messages[number] = message
    return messages


def split(packed: Packed) -> list[bytes]:
    """Split a batch into the bytes of its messages."""
    content, size = packed.tobytes(), packed.dtype.itemsize
    return [content[start : start + size] for start in range(0, len(content), size)]


def row_type(slots: int) -> np.dtype[np.void]:
    """Return ROW with room for `slots` sensor frames instead of MAX_FRAMES."""
    return np.dtype(
        [(name, ROW[name].base, (slots, *ROW[name].shape[1:]) if name in PER_FRAME else ROW[name].shape) for name in ROW.names or ()]
    )


def unpack_ticks(messages: list[bytes], absent: tuple[str, ...] = ()) -> NDArray[np.void]:
    """Unpack Tick messages to rows with as many frame slots as the fullest needs; empty slots are zero.

    Args:
        messages: The messages (n).
        absent: Fields of LATER that they do not have.

    Returns:
        Their rows (n,).

    Raises:
        RecordingError: A message has a length that no tick has.
    """
    lengths = np.array([len(message) for message in messages], int)
    frames_of = {length: _frames_of_length(absent).get(length, -1) for length in np.unique(lengths).tolist()}
    for length, frames in frames_of.items():
        if frames < 0:
            raise RecordingError(f"the file holds a tick of {length} bytes, which no tick has; it was altered, give another copy")
    rows = np.zeros(len(messages), row_type(max(frames_of.values(), default=0)))
    for length, frames in frames_of.items():
        at = np.flatnonzero(lengths == length)
        packed = np.frombuffer(b"".join(messages[i] for i in at), tick_layout(frames, absent))
        for name in _ONCE:
            rows[name][at] = LATER[name] if name in absent else packed[name]
        for name in PER_FRAME if frames else ():
            rows[name][at, :frames] = packed[name].reshape(len(at), frames, *ROW[name].shape[1:])
    return rows


_SEPARATOR = "=" * 80 + "\n"
_HEADER = (
    f"{_SEPARATOR}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{_SEPARATOR}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
_VECTOR3 = f"{_SEPARATOR}MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"

POSE_STAMPED = (
    f"std_msgs/Header header\ngeometry_msgs/Pose pose\n{_HEADER}"
    f"{_SEPARATOR}MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    f"{_SEPARATOR}MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{_SEPARATOR}MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
)
TWIST_STAMPED = (
    f"std_msgs/Header header\ngeometry_msgs/Twist twist\n{_HEADER}"
    f"{_SEPARATOR}MSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n{_VECTOR3}"
)
WRENCH_STAMPED = (
    f"std_msgs/Header header\ngeometry_msgs/Wrench wrench\n{_HEADER}"
    f"{_SEPARATOR}MSG: geometry_msgs/Wrench\ngeometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n{_VECTOR3}"
)

_ROS_TYPES = {"u1": "uint8", "u2": "uint16", "i2": "int16", "u4": "uint32", "i4": "int32", "u8": "uint64", "f4": "float32", "f8": "float64"}
_CODED: dict[str, type[IntEnum]] = {"phase": Phase, "mode": Mode, "action": Action, "trip": Trip, "request": Request}


def _tick_schema() -> str:
    """Tick.msg: the fields of ROW under ROS's spelling (lower case), the codes as constants."""
    lines = ["# One tick of palpd: every input of a decision, and the decision. SI units; *_n is newtons, *_nm newton metres."]
    for name, codes in _CODED.items():
        lines += [f"uint8 {name.upper()}_{code.name}={code.value}" for code in codes]
    lines.append("std_msgs/Header header")
    for name in (*_ONCE, *PER_FRAME):
        ros = _ROS_TYPES[ROW[name].base.str[1:]]
        count = int(np.prod(ROW[name].shape))
        suffix = "[]" if name in PER_FRAME else f"[{count}]" if ROW[name].shape else ""
        lines.append(f"{ros}{suffix} {name.lower()}")
    return "\n".join(lines) + "\n" + _HEADER


TICK = _tick_schema()


def absent_fields(schema: str) -> tuple[str, ...] | None:
    """Find which fields of LATER the ticks of a recording do not have.

    Args:
        schema: Their message definition. Comments and constants do not count: a later palpd may know more codes.

    Returns:
        The names, or None where the ticks differ in any other field.
    """
    theirs, ours = (_fields_of(text) for text in (schema, TICK))
    absent = tuple(name for name in LATER if not any(line.endswith(f" {name.lower()}") for line in theirs))
    expected = [line for line in ours if line.rpartition(" ")[2] not in {name.lower() for name in absent}]
    return absent if theirs == expected else None


def absent_in(tick: bytes) -> tuple[str, ...] | None:
    """Find which fields of LATER a Tick message does not have, where the message definition is lost.

    Returns:
        The names, or None where it is no tick.
    """
    for known in range(len(LATER), -1, -1):
        absent = tuple(LATER)[known:]
        frames = _frames_of_length(absent).get(len(tick), -1)
        if frames >= 0 and np.frombuffer(tick, tick_layout(frames, absent))["frames"][0] == frames:
            return absent
    return None


def epoch_offset_s(tick: bytes, absent: tuple[str, ...]) -> float:
    """What turns monotonic seconds into Unix time, from the two times of a Tick message.

    Args:
        absent: Fields of LATER that it does not have.

    Returns:
        The offset in s, to a microsecond.
    """
    packed = np.frombuffer(tick, tick_layout(_frames_of_length(absent)[len(tick)], absent))[0]
    return float(packed["sec"] + 1e-9 * packed["nanosec"] - packed["now_s"])


def _fields_of(schema: str) -> list[str]:
    return [line for line in schema.splitlines() if "=" not in line and not line.startswith("#")]


QUATERNION_STEP = 2.0**-32
"""Resolution of recorded quaternions."""


def quaternion(rotation_vector_rad: Floats) -> Floats:
    """Convert rotation vectors to quaternions, rounded to 2⁻³²: finer than any robot, and half as long when compressed.

    Args:
        rotation_vector_rad: rotation vectors (n, 3).

    Returns:
        Quaternions (n, 4) as x, y, z, w.
    """
    angle_rad = np.linalg.norm(rotation_vector_rad, axis=1, keepdims=True)
    exact = np.hstack([rotation_vector_rad * (0.5 * np.sinc(angle_rad / (2 * np.pi))), np.cos(angle_rad / 2)])
    return np.rint(exact / QUATERNION_STEP) * QUATERNION_STEP
