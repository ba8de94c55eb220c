"""How often, in a recorded run, a device was silent or this computer stood still."""

from collections.abc import Sequence
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from palpd.recording.header import RecordedStall
from palpd.tick import Floats

SILENT_S = 0.02
"""Age of a device's newest data that counts as a silence, as long as what the witness of this computer counts as a stall."""
SILENT_PERIODS = 2.5
"""The same in periods of the device, for one that sends slowly: its data is up to one period old, two where one was lost."""


class StallFigures(TypedDict):
    """Numbers and longest durations of what kept data from the loop: this computer stood still, sensor or robot was silent while it ran."""

    computer: int
    computer_longest_s: float
    sensor: int
    sensor_longest_s: float
    robot: int
    robot_longest_s: float


def stall_figures(rows: NDArray[np.void], stalls: Sequence[RecordedStall]) -> StallFigures:
    """Count the stalls of a run.

    Args:
        rows: Ticks (n,), with the fields of ROW of palpd.tick.
        stalls: What the witness of this computer reported; empty without one.

    Returns:
        The figures. A silence that overlaps a stall of this computer, or ticks that were missed, is none of the device's.
    """
    now_s = rows["now_s"]
    # one that held up the last tick is the run's, though the witness may wake only after it
    during = [stall for stall in stalls if len(now_s) and stall["begin_s"] < now_s[-1] and stall["end_s"] > now_s[0]]
    own = _merged([(stall["begin_s"], stall["end_s"]) for stall in during])
    late = rows["missed"] > 0
    blind = own + list(zip(np.roll(now_s, 1)[late].tolist(), now_s[late].tolist(), strict=True))
    heard = rows["frames"] > 0
    frames_s = rows["frame_t_s"]  # a run that was stopped before the first frame has none in any tick
    newest_s = frames_s.max(axis=1, initial=-np.inf, where=np.arange(frames_s.shape[1]) < rows["frames"][:, None])
    sensor = _silences(now_s, np.where(heard, newest_s, np.nan), blind)
    _, first, state = np.unique(rows["robot_timestamp_s"], return_index=True, return_inverse=True)
    robot = _silences(now_s, rows["robot_t_s"][first][state], blind)
    return {
        "computer": len(own),
        "computer_longest_s": max((end_s - begin_s for begin_s, end_s in own), default=0.0),
        "sensor": len(sensor),
        "sensor_longest_s": max(sensor, default=0.0),
        "robot": len(robot),
        "robot_longest_s": max(robot, default=0.0),
    }


def _silences(now_s: Floats, newest_s: Floats, blind: Sequence[tuple[float, float]]) -> list[float]:
    """Longest ages of data that was too old at a tick, one for each silence, in s.

    Args:
        now_s: Times (n,) of the ticks.
        newest_s: Times (n,) of the newest data, NaN where a tick brought none.
        blind: Spans in which this computer could not have read it.
    """
    known = np.flatnonzero(np.isfinite(newest_s))
    if not len(known):
        return []
    heard_s = newest_s[known[np.maximum(np.searchsorted(known, np.arange(len(newest_s)), side="right") - 1, 0)]]
    steps_s = np.diff(np.unique(heard_s))
    least_s = max(SILENT_S, SILENT_PERIODS * float(np.median(steps_s))) if len(steps_s) else SILENT_S
    ages_s = now_s - heard_s
    silences = []
    for at_s in np.unique(heard_s[ages_s > least_s]):
        longest_s = float(ages_s[heard_s == at_s].max())
        if not any(begin_s < at_s + longest_s and end_s > at_s for begin_s, end_s in blind):
            silences.append(longest_s)
    return silences


def _merged(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The same spans of time, with those that overlap as one: a stall of two processors is one stall."""
    merged: list[tuple[float, float]] = []
    for begin_s, end_s in sorted(spans):
        if merged and begin_s <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(end_s, merged[-1][1]))
        else:
            merged.append((begin_s, end_s))
    return merged


def stall_note(figures: StallFigures) -> str | None:
    """One sentence on the stalls of a run; None where there was none."""
    names = (("computer", "this computer stood still"), ("sensor", "the sensor was silent"), ("robot", "the robot was silent"))
    parts = [
        f"{what} {count} {'time' if count == 1 else 'times'} for more than {SILENT_S * 1e3:g} ms (at most {longest_s * 1e3:.0f} ms)"
        for name, what in names
        if (count := figures[name]) and (longest_s := figures[f"{name}_longest_s"])  # type: ignore[literal-required]
    ]
    return ", ".join(parts) if parts else None
