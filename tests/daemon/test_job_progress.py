"""How far a job is: read from the ring, drawn by the terminal, ignored without a display."""

import io
from collections.abc import Iterator

import numpy as np
import pytest
from rich.console import Console

from palpd.cli.terminal import TerminalDisplay
from palpd.config import Config, Plan
from palpd.daemon.display import JobProgress, NoDisplay
from palpd.daemon.job_progress import job_progress, job_steps
from palpd.daemon.motion_process import Job, Kind
from palpd.recording.ring import Ring
from palpd.tick import ROW, Mode, Phase

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
    ring = Ring.create(125.0)
    yield ring
    ring.unlink()
    ring.close()


def job(kind: Kind = "palpation") -> Job:
    return Job(kind, Config(), PLAN)


def progress_at(ring: Ring, work: Job, **fields: float) -> JobProgress:
    row = np.zeros(1, ROW)
    row["depth_m"] = np.nan
    for name, value in fields.items():
        row[name] = value
    ring.write(row[0])
    progress = job_progress(work, ring)
    assert progress is not None
    return progress


def test_nothing_is_known_before_the_first_tick(ring: Ring) -> None:
    assert job_progress(job(), ring) is None


@pytest.mark.parametrize(("kind", "steps"), [("palpation", 22), ("free_motion", 10), ("calibrate", 1), ("stiffness", 1)])
def test_a_job_counts_its_steps(kind: Kind, steps: int) -> None:
    assert job_steps(job(kind)) == steps


@pytest.mark.parametrize(
    ("fields", "steps_done"),
    [
        ({"site": -1, "phase": Phase.TARE}, 0),
        ({"site": 0, "mode": Mode.FREE_MOTION, "repeat": 1, "phase": Phase.FREE_MOTION}, 1),
        ({"site": 0, "repeat": -1, "phase": Phase.SEARCH}, 2),
        ({"site": 0, "mode": Mode.STATIC, "depth_m": 0.006, "repeat": -1, "phase": Phase.HOLD}, 4),
        ({"site": 0, "mode": Mode.DYNAMIC, "depth_m": 0.004, "repeat": 0, "phase": Phase.PRESS}, 5),
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
