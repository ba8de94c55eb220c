"""A tick of the loop as a row (ROW of palpd.tick): in the ring, in a list, or beside a recorded one."""

import struct

import numpy as np
from numpy.typing import NDArray

from palpd.tick import ROW, TickRecord


class RowWriter:
    """Writes ticks into rows (n,) of ROW.

    Numbers go in as one packed block and arrays as slices of their columns: assigning forty fields one by one costs five times as much.
    """

    def __init__(self, rows: NDArray[np.void]) -> None:
        self._bytes = rows.view(np.uint8).data
        self._frame_t_s, self._counter, self._status = rows["frame_t_s"], rows["counter"], rows["status"]
        self._wrench, self._tared, self._inertial_N = rows["wrench"], rows["tared"], rows["inertial_N"]

    def fill(self, at: int, record: TickRecord) -> None:
        """Write a tick into a row.

        Args:
            at: number of the row.
            record: the tick.
        """
        observation, proposal, verdict, work_us = record
        timing, robot, frames, contact, request, _ = observation
        progress, proposed, command = proposal.progress, proposal.command, verdict.command
        n = len(frames)
        start = at * ROW.itemsize
        _HEAD.pack_into(
            self._bytes, start,
            timing.index, timing.planned_s, timing.now_s, timing.missed, work_us, robot.t_s, robot.timestamp_s,
            *robot.tcp_pose, *robot.tcp_speed, *robot.target_pose, *robot.target_speed, *robot.tool_acceleration_m_per_s2,
            robot.robot_mode, robot.safety_mode, robot.safety_status_bits, robot.runtime_state, robot.connected, request,
            frames.rejected, n,
        )  # fmt: skip
        self._frame_t_s[at, :n], self._counter[at, :n], self._status[at, :n] = frames.t_s[:n], frames.counter[:n], frames.status[:n]
        self._wrench[at, :n], self._tared[at, :n], self._inertial_N[at, :n] = (
            frames.wrench[:n], contact.tared[:n], contact.inertial_N[:n],
        )  # fmt: skip
        _TAIL.pack_into(
            self._bytes, start + _TAIL_AT,
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
_HEAD = _packing(_NAMES[: _NAMES.index("frame_t_s")])
_TAIL = _packing(_NAMES[_NAMES.index("inertial_N") + 1 :])
_TAIL_AT = ROW.itemsize - _TAIL.size
