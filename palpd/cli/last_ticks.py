"""The ticks before a stop as plain lines: `palpd status` prints them too, and must not wait for rich."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from palpd.daemon.socket_client import LastTick

COLUMNS = ("time", "force", "z", "vertical speed", "commanded", "phase")


def print_last_ticks(ticks: "Sequence[LastTick]") -> None:
    """Print the ticks before a stop, where there was one."""
    for line in last_ticks_lines(ticks):
        print(line)


def last_ticks_lines(ticks: "Sequence[LastTick]") -> list[str]:
    """A title, a header and a line a tick: force, height, speed, and what was commanded; nothing without ticks."""
    rows = [COLUMNS, *map(_cells, ticks)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  " + "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return ["The last ticks before the stop:", *lines] if ticks else []


def _cells(tick: "LastTick") -> tuple[str, ...]:
    return (
        f"{0.0 - tick['before_end_s'] * 1e3:.0f} ms",
        f"{tick['force_N']:.2f} N",
        f"{tick['z_m'] * 1e3:.3f} mm",
        f"{tick['vz_m_per_s'] * 1e3:+.1f} mm/s",
        "stop" if tick["command_stop"] else f"{tick['command_m_per_s'][2] * 1e3:+.1f} mm/s",
        tick["phase"],
    )
