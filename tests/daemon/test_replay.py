"""Replaying a CSV: tare, contact and guard of the daemon's own loop on every row."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpd.cell.cell_file import CellFile
from palpd.config import Config, Plan
from palpd.daemon.motion_job import Job
from palpd.daemon.replay import replay, replay_samples
from palpd.daemon.simulated_run import run
from palpd.recording.reader import Recording
from palpd.recording.samples import Samples
from palpd.tick import Phase, Request

RATE_HZ = 1000.0


def samples(fz_N: np.ndarray, vz_m_per_s: float = 0.0, rate_Hz: float = RATE_HZ) -> Samples:
    """A probe at rest in the air with this force."""
    t_s = np.arange(len(fz_N)) / rate_Hz
    wrench = np.zeros((len(fz_N), 6))
    wrench[:, 2] = fz_N + np.random.default_rng(0).normal(0.0, 0.02, len(fz_N))
    return Samples(t_s=t_s, z_cmd_m=None, z_m=np.full(len(fz_N), 0.01), vz_m_per_s=np.full(len(fz_N), vz_m_per_s), wrench=wrench)


def test_the_first_rows_are_the_tare_of_all_others() -> None:
    fz_N = np.full(3000, 2.0)
    fz_N[2000:] = 6.0
    result = replay_samples(samples(fz_N), Config())
    assert (result["ticks"], result["verdict"], result["trips"]) == (3000, "done", [])
    assert result["tare"] == "from the first rows"
    assert result["peak_force_N"] == pytest.approx(4.0, abs=0.15)


def test_rows_that_are_no_tare_keep_the_zero_of_the_recording() -> None:
    result = replay_samples(samples(np.full(3000, 2.0), vz_m_per_s=0.005), Config())
    assert result["tare"].startswith("as recorded: the arm moved at 5.0 mm/s")
    assert result["peak_force_N"] == pytest.approx(2.0, abs=0.15)


def test_a_recording_shorter_than_a_tare_keeps_its_zero() -> None:
    assert replay_samples(samples(np.full(500, 2.0)), Config())["tare"] == "as recorded: the recording is shorter than a tare"


def test_every_row_is_judged_after_a_stop_and_each_trip_is_reported_once() -> None:
    fz_N = np.zeros(4000)
    fz_N[2000:2010] = 30.0
    fz_N[3000:3010] = 30.0
    result = replay_samples(samples(fz_N), Config())
    assert result["verdict"] == "stopped"
    assert [(trip["row"], trip["trip"]) for trip in result["trips"]] == [(2000, "ABSOLUTE_FORCE"), (3000, "ABSOLUTE_FORCE")]


def test_a_slow_rig_is_not_stale_at_its_own_rate() -> None:
    result = replay_samples(samples(np.zeros(200), rate_Hz=8.0), Config())
    assert result["trips"] == []


def recorded(job: Job, requests: dict[int, Request] | None = None, **header: Any) -> Recording:
    """A run of that job without wires, as a recording with this in its header."""
    done = run(job, CellFile(), requests=requests or {})
    whole = {
        **done.header,
        "kind": job.kind,
        "dry": False,
        "config": job.config.model_dump(mode="json"),
        "plan": job.plan.model_dump(mode="json"),
        "reference": [0.0, 0.0, -50.0, 0.0, 0.0, 0.0],
        "machine_stiffness_N_per_m": None,
        **header,
    }
    return Recording(Path("r.mcap"), done.rows, whole, {"verdict": "done"}, None)  # type: ignore[arg-type]


@pytest.mark.parametrize(("in_place", "header"), [(False, {"pauses_in_place": False}), (True, {})])
def test_a_replay_pauses_as_the_recording_did(in_place: bool, header: dict[str, bool]) -> None:
    plan = Plan.model_validate({"depths_m": [0.004], "mode": "static", "hold_s": 1.0})
    job = Job("palpation", Config(), plan, returns_to_start=False, pauses_in_place=in_place)
    pressing = int(np.flatnonzero(recorded(job).rows["phase"] == Phase.HOLD)[20])
    paused = recorded(job, requests={pressing: Request.PAUSE, pressing + 300: Request.RESUME}, **header)
    assert (Phase.PAUSE_RETRACT in paused.rows["phase"]) is not in_place
    assert replay(paused)["decisions_identical"], "as the header says; an old header says nothing, and its pauses stood still"
    assert not replay(replace(paused, header={**paused.header, "pauses_in_place": not in_place}))["decisions_identical"]


@pytest.mark.parametrize(("returns", "header"), [(True, {"returns_to_start": True}), (False, {})])
def test_a_replay_returns_to_the_start_where_the_recording_did(returns: bool, header: dict[str, bool]) -> None:
    plan = Plan.model_validate({"sites": [{"name": "B", "x_m": 0.02}], "depths_m": [0.004], "mode": "dynamic", "repeats": 1})
    recording = recorded(Job("palpation", Config(), plan, returns_to_start=returns), **header)
    assert recording.rows["target_pose"][-1, 0] == pytest.approx(0.0 if returns else 0.02, abs=1e-4)
    assert replay(recording)["decisions_identical"], "as the header says; an old header says nothing, and its run ended above the last site"
    other = recorded(Job("palpation", Config(), plan, returns_to_start=returns), returns_to_start=not returns)
    assert not replay(other)["decisions_identical"]
