"""How far a job is: read from the ring, drawn by the terminal, ignored without a display."""

import io
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from palpd.cli.terminal import TerminalDisplay
from palpd.config import Config, Plan
from palpd.daemon.display import JobProgress, NoDisplay
from palpd.daemon.job_progress import JobMeter
from palpd.daemon.motion_job import Job, Kind
from palpd.daemon.simulated_run import run as simulated
from palpd.recording.ring import Ring
from palpd.tick import ROW, Mode, Phase, Request
from tests.simulated import cell_file

PLAN = Plan.model_validate(
    {
        "sites": [{"name": "A"}, {"name": "B", "x_m": 0.03}],
        "depths_m": [0.004, 0.006],
        "repeats": 3,
        "free": {"strokes": 2, "height_m": 0.01, "speed_m_per_s": 0.02},
    }
)
"""Each site has 2 strokes, the search, 2 holds and 6 presses in motion: 11 steps."""


@pytest.fixture
def ring() -> Iterator[Ring]:
    with closing(Ring.create(125.0)) as ring:
        yield ring


def job(kind: Kind = "palpation") -> Job:
    return Job(kind, Config(), PLAN)


def progress_at(ring: Ring, work: Job, **fields: float) -> JobProgress:
    meter = JobMeter(work, ring)
    row = np.zeros(1, ROW)
    row["depth_m"] = np.nan
    for name, value in fields.items():
        row[name] = value
    ring.write(row[0])
    progress = meter.read()
    assert progress is not None
    return progress


def followed(ring: Ring, work: Job, rows: NDArray[np.void]) -> list[JobProgress]:
    """What the meter says at each row of a run."""
    meter, progress_seen = JobMeter(work, ring), []
    for row in rows:
        ring.write(row)
        progress = meter.read()
        assert progress is not None
        progress_seen.append(progress)
    return progress_seen


def test_nothing_is_known_before_the_first_tick_of_the_run_itself(ring: Ring) -> None:
    ring.write(np.zeros(1, ROW)[0])
    assert JobMeter(job(), ring).read() is None, "the ring still holds the ticks of the run before"


@pytest.mark.parametrize(("kind", "steps"), [("palpation", 22), ("free_motion", 10), ("calibrate", 1), ("stiffness", 1)])
def test_a_job_counts_its_steps(ring: Ring, kind: Kind, steps: int) -> None:
    assert JobMeter(job(kind), ring).steps == steps


@pytest.mark.parametrize("pause", [False, True])
def test_over_a_whole_run_progress_never_goes_back_and_the_time_left_is_honest(ring: Ring, pause: bool) -> None:
    plan = Plan.model_validate(
        {"sites": [{"name": "A"}, {"name": "B", "x_m": 0.03}], "depths_m": [0.003, 0.005], "hold_s": 2.0, "repeats": 2, "mode": "both"}
    )
    requests = {2500: Request.PAUSE, 3500: Request.RESUME} if pause else {}
    work = replace(job(), plan=plan, lifts_first=True)
    rows = simulated(work, cell_file(), requests=requests).rows
    progress_seen = followed(ring, work, rows)
    steps = [progress.steps_done for progress in progress_seen]
    assert steps == sorted(steps)
    assert (steps[0], steps[-1], set(steps)) == (0, 14, set(range(15)))
    assert [progress.site for progress in progress_seen if progress.site] == sorted(
        progress.site for progress in progress_seen if progress.site
    )
    left_s = [progress.left_s or 0.0 for progress in progress_seen]
    moving = np.cumsum(~np.isin(rows["phase"], (Phase.PAUSED, Phase.PAUSE_RETRACT))) / 125.0
    to_come_s = moving[-1] - moving
    at_site = [k for k, progress in enumerate(progress_seen) if progress.site is not None]
    wrong_s = np.abs(np.array(left_s) - to_come_s)[at_site]
    assert wrong_s.max() < to_come_s[0] / 8.0, "within an eighth of the run, also where a pause costs half a press"
    assert left_s[-1] == 0.0


def test_a_return_to_the_start_of_an_unfinished_run_is_no_progress(ring: Ring) -> None:
    """Its phase is that of the way home at the end."""
    assert progress_at(ring, job(), site=-1, phase=Phase.RETURN).steps_done == 0


@pytest.mark.parametrize(
    ("fields", "steps_done"),
    [
        ({"site": -1, "phase": Phase.TARE}, 0),
        ({"site": 0, "mode": Mode.FREE_MOTION, "repeat": 1, "phase": Phase.FREE_MOTION}, 1),
        ({"site": 0, "mode": Mode.SEARCH, "repeat": -1, "phase": Phase.SEARCH}, 2),
        ({"site": 0, "mode": Mode.STATIC, "depth_m": 0.006, "repeat": -1, "phase": Phase.HOLD}, 4),
        ({"site": 0, "mode": Mode.DYNAMIC, "depth_m": 0.004, "repeat": 0, "phase": Phase.PRESS}, 5),
        ({"site": 0, "repeat": 2, "phase": Phase.RETRACT}, 11),
        ({"site": 1, "repeat": -1, "phase": Phase.TRAVEL}, 11),
        ({"site": 1, "mode": Mode.DYNAMIC, "depth_m": 0.006, "repeat": 2, "phase": Phase.PRESS}, 21),
    ],
)
def test_every_row_says_how_many_steps_are_done(ring: Ring, fields: dict[str, float], steps_done: int) -> None:
    assert progress_at(ring, job(), **fields).steps_done == steps_done


def test_the_activity_names_the_site_and_the_phase(ring: Ring) -> None:
    progress = progress_at(ring, job(), site=1, phase=Phase.HOLD, force_N=2.5)
    assert (progress.activity, progress.force_N) == ("site B: holding", 2.5)
    assert progress_at(ring, job("free_motion"), repeat=4, phase=Phase.FREE_MOTION).steps_done == 4


def test_the_terminal_prints_a_sentence_as_it_is_and_draws_a_job() -> None:
    console = Console(width=100, force_terminal=True, color_system=None)
    with console.capture() as capture:
        display = TerminalDisplay(console)
        display.say("kept in runs/[demo] with a path longer than the terminal is wide " + "x" * 60)
        with display.job(4) as show:
            show(JobProgress("site [/A]: pressing", 2, 1.25, -0.004))
        with display.waiting("diagnosing [/b]"):
            pass
    text = capture.get()
    assert "runs/[demo] with a path longer than the terminal is wide " + "x" * 60 in text
    assert "site [/A]: pressing" in text
    assert "1.25 N" in text
    assert "-4.00 mm" in text


def test_without_a_display_nothing_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    display = NoDisplay()
    display.say("a sentence")
    with display.waiting("diagnosing"), display.job(4) as show:
        show(JobProgress("pressing", 2, 1.25, -0.004))
    assert capsys.readouterr().out == ""


def test_without_a_terminal_a_job_prints_a_line_for_each_step() -> None:
    console = Console(file=io.StringIO(), force_terminal=False, width=200)
    with TerminalDisplay(console).job(11) as show:
        for activity, steps_done in (("taring", 0), ("site A: pressing", 3), ("site A: leaving", 3), ("site A: pressing", 4)):
            show(JobProgress(activity, steps_done, 1.5, 0.02))
    assert console.file.getvalue().splitlines() == [  # type: ignore[attr-defined]
        "0/11  taring  (1.50 N, z 20.00 mm)",
        "3/11  site A: pressing  (1.50 N, z 20.00 mm)",
        "4/11  site A: pressing  (1.50 N, z 20.00 mm)",
    ]
