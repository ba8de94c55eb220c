"""A run from cold: what a run imports or reads from the disk is in memory before the watchdog is armed."""

import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from palpd.config import Config, Plan
from palpd.control.running_zero import RunningZero
from palpd.daemon.motion_job import Job, Kind, explainer_of
from palpd.daemon.motion_process import RingWriter, rehearse_job
from palpd.daemon.realtime import populate
from palpd.recording.ring import Ring
from palpd.tick import Request

IMPORTS = """
import sys
from palpd.config import Config, Plan
from palpd.daemon import wiring
from palpd.daemon.motion_job import Job, explainer_of
from palpd.daemon.motion_process import rehearse_job
from palpd.daemon.simulated_run import RowList, run
from palpd.cell.cell_file import nominal

import numpy.random
job = Job("palpation", Config(), Plan(depths_m=(0.004, 0.006), repeats=2, hold_s=0.1), reference=(0.0,) * 6)
if "rehearsed" in sys.argv:
    rehearse_job(job, explainer_of(job, {}, 0.001), RowList())
before = set(sys.modules)
assert run(job, nominal(), home_above_m=0.005).outcome.verdict == "done"
print(*sorted(set(sys.modules) - before))
"""
"""A run without wires, and the names of the modules that it imports under way."""


def imported_under_way(*arguments: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", IMPORTS, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_a_run_that_was_rehearsed_imports_nothing_under_way() -> None:
    assert "numpy.fft" in imported_under_way(), "else this test shows nothing"
    assert imported_under_way("rehearsed") == []


@pytest.mark.parametrize("kind", ["palpation", "free_motion", "stiffness", "retract"])
def test_a_rehearsal_of_any_job_leaves_no_trace_in_ring_explainer_and_zero(kind: Kind) -> None:
    with closing(Ring.create(125.0)) as ring:
        workspace = {"workspace_m": [[0.3, 0.6], [0.3, 0.6], [0.1, 0.6]], "min_z_m": 0.1}
        job = Job(kind, Config.model_validate({"safety": workspace}), Plan(), reference=tuple(range(6)))
        explainer = explainer_of(job, {}, 0.001)
        explainer.zero = RunningZero(limit_N=0.5)
        tare, zero = explainer.tare, repr(explainer.zero)
        outcome = rehearse_job(job, explainer, RingWriter(ring))
        assert outcome.trips == []
        assert outcome.ticks > 100
        assert ring.published == 0
        assert explainer.tare is tare
        np.testing.assert_array_equal(explainer.reference, range(6))
        assert repr(explainer.zero) == zero


def test_a_rehearsal_ends_with_an_abort_and_leaves_it_to_the_loop() -> None:
    with closing(Ring.create(125.0)) as ring:
        job = Job("palpation", Config(), Plan(), reference=(0.0,) * 6)
        assert not ring.abort_waits
        ring.ask(Request.ABORT)
        assert rehearse_job(job, explainer_of(job, {}, 0.001), RingWriter(ring), lambda: ring.abort_waits).ticks == 0
        assert ring.request() == Request.ABORT
        assert not ring.abort_waits


def test_a_rehearsed_palpation_comes_to_its_end() -> None:
    with closing(Ring.create(125.0)) as ring:
        job = Job(
            "palpation", Config(), Plan.model_validate({"free": {"strokes": 30}, "origin": {"x_m": 0.7, "y_m": 0.1}}), reference=(0.0,) * 6
        )
        assert rehearse_job(job, explainer_of(job, {}, 0.001), RingWriter(ring)).verdict == "done"
        assert job.plan.sites[0].x_m == 0.0


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="Linux only")
def test_code_of_a_loaded_library_can_be_brought_into_memory() -> None:
    assert populate(["libc.so", "libc-"]) > 1_000_000
    assert populate(["no such library"]) == 0
