"""A tick of the loop as a row (ROW of palpd.tick): in the ring, in a list, or beside a recorded one."""

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpd.tick import MAX_FRAMES, ROW, TickRecord


class RowWriter:
    """Writes ticks into rows (n,) of ROW.

    Everything goes in as bytes: the numbers as two packed blocks, each array as its own. Assigning forty fields one by one costs ten times
    as much. Arrays of another type than their field's are refused by their length.
    """

    def __init__(self, rows: NDArray[np.void]) -> None:
        self._bytes = rows.view(np.uint8).data

    def fill(self, at: int, record: TickRecord) -> None:
        """Write a tick into a row."""
        (timing, robot, frames, contact, request, _), _, _, work_us = record
        n = len(frames)
        start = at * ROW.itemsize
        _HEAD.pack_into(
            self._bytes, start,
            timing.index, timing.planned_s, timing.now_s, timing.missed, work_us, robot.t_s, robot.timestamp_s,
            *robot.tcp_pose, *robot.tcp_speed, *robot.target_pose, *robot.target_speed, *robot.tool_acceleration_m_per_s2,
            robot.robot_mode, robot.safety_mode, robot.safety_status_bits, robot.runtime_state, robot.connected, request,
            frames.rejected, n,
        )  # fmt: skip
        arrays: tuple[NDArray[Any], ...] = (
            frames.t_s,
            frames.counter,
            frames.status,
            frames.wrench,
            contact.tared[:n],
            contact.inertial_N[:n],
        )
        for (offset, width), array in zip(_ARRAYS, arrays, strict=True):
            begin = start + offset
            self._bytes[begin : begin + n * width] = array.tobytes()
        self._bytes[start + _DECISION_AT : start + ROW.itemsize] = decision(record)


def filled_slots(rows: NDArray[np.void]) -> NDArray[np.bool_]:
    """Which frame slots (n, slots) of rows (n,) hold a frame; the slots of a row are filled from the first on."""
    filled: NDArray[np.bool_] = np.arange(rows["frame_t_s"].shape[1]) < rows["frames"][:, None]
    return filled


def decision(record: TickRecord) -> bytes:
    """Pack what the daemon decided in a tick: the fields `DECISIONS` of ROW, as they stand in a row."""
    observation, proposal, verdict, _ = record
    contact, progress, proposed, command = observation.contact, proposal.progress, proposal.command, verdict.command
    return _DECISION.pack(
        contact.zero_N, contact.force_N, contact.absolute_N, progress.phase, progress.mode, progress.site, progress.repeat,
        progress.depth_m, progress.surface_z_m, progress.cut_short,
        *proposed.velocity_m_per_s, proposed.stop, *command.velocity_m_per_s, command.stop,
        verdict.action, verdict.trip, verdict.measured, verdict.limit,
    )  # fmt: skip


def _packing(names: tuple[str, ...]) -> struct.Struct:
    """The layout of neighbouring fields of ROW."""
    codes = {"u1": "B", "u2": "H", "i2": "h", "u4": "I", "i4": "i", "u8": "Q", "f4": "f", "f8": "d"}
    bases = [(ROW[name].base.str[1:], int(np.prod(ROW[name].shape, dtype=int))) for name in names]
    return struct.Struct("<" + "".join(f"{count}{codes[base]}" for base, count in bases))


_NAMES: tuple[str, ...] = ROW.names or ()
_FIELDS: Mapping[str, Any] = ROW.fields or {}
_ARRAYS = [
    (_FIELDS[name][1], ROW[name].itemsize // MAX_FRAMES) for name in ("frame_t_s", "counter", "status", "wrench", "tared", "inertial_N")
]
"""Where each array begins in a row, and how many bytes of it belong to a frame."""
_HEAD = _packing(_NAMES[: _NAMES.index("frame_t_s")])
DECISIONS = _NAMES[_NAMES.index("inertial_N") + 1 :]
"""The last fields of a row, which the daemon decided; it observed all others."""
_DECISION = _packing(DECISIONS)
_DECISION_AT = ROW.itemsize - _DECISION.size
