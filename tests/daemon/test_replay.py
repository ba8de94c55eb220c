"""Replaying: tare, contact and guard of the daemon's own loop on every row of a CSV; a recording under its own and other configurations."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpd.cell.cell_file import CellFile
from palpd.config import Config, Plan
from palpd.daemon.motion_job import Job
from palpd.daemon.other_config import DifferentCommand
from palpd.daemon.replay import ReplayResult, replay, replay_samples
from palpd.daemon.simulated_run import run
from palpd.errors import ConfigError
from palpd.recording.reader import Recording
from palpd.recording.samples import Samples
from palpd.tick import Phase, Request, Trip

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


def recorded(job: Job, requests: dict[int, Request] | None = None, cell: CellFile | None = None, **header: Any) -> Recording:
    """A run of that job without wires, as a recording with this in its header."""
    done = run(job, cell or CellFile(), requests=requests or {})
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
    footer = {"verdict": done.outcome.verdict, "reason": done.outcome.reason}
    return Recording(Path("r.mcap"), done.rows, whole, footer, None)  # type: ignore[arg-type]


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


@pytest.mark.parametrize("fits", [True, False])
def test_a_replay_seeks_the_surface_as_the_recording_did(fits: bool) -> None:
    plan = Plan.model_validate({"depths_m": [0.004], "mode": "dynamic", "repeats": 1})
    drifting = CellFile.model_validate({"effects": {"sensor.drift": {"rate_N_per_s": 0.005}}})
    recording = recorded(Job("palpation", Config(), plan, returns_to_start=False, fits_slope=fits), cell=drifting)
    surface_m = float(np.nanmax(recording.rows["surface_z_m"]))
    assert abs(surface_m) < 5e-5 if fits else surface_m > 5e-5
    old = {key: value for key, value in recording.header.items() if key != "fits_slope"}
    assert replay(recording if fits else replace(recording, header=old))["decisions_identical"], "an old header says nothing"  # type: ignore[arg-type]
    assert not replay(replace(recording, header={**recording.header, "fits_slope": not fits}))["decisions_identical"]


WALL = CellFile.model_validate({"wall": {"z_m": 0.0, "stiffness_N_per_m": 50_000.0}})
"""In one tick of the search its force goes beyond a limit of 1.5 N, so the guard ends the run."""


@pytest.fixture(scope="module")
def pressed() -> Recording:
    """Three slow presses, up to 5.5 N."""
    plan = Plan.model_validate({"sites": [{"name": "A"}], "depths_m": [0.004, 0.006, 0.008], "mode": "dynamic", "repeats": 1})
    return recorded(Job("palpation", Config(), plan.model_copy(update={"press_speed_m_per_s": 0.004})), returns_to_start=True)


@pytest.fixture(scope="module")
def stopped() -> Recording:
    """A search that the guard ended at 1.5 N."""
    return recorded(Job("palpation", Config.model_validate({"safety": {"contact_limit_N": 1.5}})), cell=WALL, returns_to_start=True)


def other(recording: Recording, **blocks: dict[str, Any]) -> ReplayResult:
    """The replay under the recording's configuration with these keys."""
    own = recording.header["config"]
    return replay(recording, Config.model_validate(own | {name: own[name] | keys for name, keys in blocks.items()}))


def assert_known_up_to(recording: Recording, at: int, result: ReplayResult) -> DifferentCommand:
    """All figures are those of the rows up to this one, and of the recorded rows from it on."""
    rows, command = recording.rows, result["first_different_command"]
    peak_at = at + int(np.argmax(rows["force_N"][at:]))
    assert command is not None
    assert (result["ticks"], command["tick"]) == (at + 1, rows["index"][at])
    assert command["t_s"] == rows["now_s"][at] - rows["now_s"][0]
    assert (command["force_N"], result["peak_force_N"]) == (rows["force_N"][at], rows["force_N"][: at + 1].max())
    assert command["recorded_peak_N"] == rows["force_N"][at:].max()
    assert command["recorded_peak_t_s"] == rows["now_s"][peak_at] - rows["now_s"][0]
    assert command["recorded_more_N"] == rows["force_N"][peak_at] - rows["force_N"][at]
    assert not result["decisions_identical"]
    return command


def test_another_decision_with_the_same_commands_leaves_the_motion_known_to_the_end(stopped: Recording) -> None:
    result = other(stopped, safety={"contact_limit_N": 2.0})
    assert (result["would_have"], result["first_different_command"]) == ("moved_the_same", None)
    assert (result["ticks"], result["verdict"]) == (len(stopped.rows), "stopped")
    assert result["reason"] == stopped.footer["reason"].replace("1.5 N", "2 N"), "the guard acts in the same tick, by another limit"
    assert result["first_difference"] is not None
    assert "trip_limit: recorded 1.5, replayed 2.0" in result["first_difference"]


def test_a_stop_of_the_other_configuration_is_known_and_what_the_recorded_run_went_on_to(pressed: Recording) -> None:
    result = other(pressed, safety={"min_z_m": -0.005})
    command = assert_known_up_to(pressed, int(np.argmax(pressed.rows["tcp_pose"][:, 2] < -0.005)), result)
    assert (result["would_have"], result["verdict"], command["given_m_per_s"]) == ("ended", "stopped", None)
    assert result["reason"].endswith("below safety.min_z_m of -0.005 m")
    assert (command["site"], command["phase"]) == ("A", "press")
    assert f"{command['recorded_more_N']:.2f} N more" in result["sentences"][1]
    assert command["recorded_more_N"] > 2.0


def test_a_lower_contact_limit_ends_the_press_where_the_force_reaches_its_share(pressed: Recording) -> None:
    result = other(pressed, safety={"contact_limit_N": 4.0})
    rows = pressed.rows
    mean_N = rows["tared"][:, :, 2].sum(axis=1) / np.maximum(rows["frames"], 1)
    command = assert_known_up_to(pressed, int(np.argmax((rows["phase"] == Phase.PRESS) & (mean_N >= 0.9 * 4.0))), result)
    assert (result["would_have"], result["verdict"]) == ("ended_press", "unknown")
    assert (command["given_m_per_s"], result["reason"]) == ([0.0, 0.0, 0.004], "it reached 3.6 N, 0.9 of the contact limit")
    assert result["changed_settings"] == [{"key": "safety.contact_limit_N", "recorded": 12.0, "given": 4.0, "tested": True}]


def test_where_only_the_recorded_run_ended_the_margin_is_known_and_the_verdict_is_not(stopped: Recording) -> None:
    result = other(stopped, safety={"contact_limit_N": 12.0})
    at = int(np.argmax(stopped.rows["trip"] == Trip.CONTACT_FORCE))
    command = assert_known_up_to(stopped, at, result)
    assert (result["would_have"], result["verdict"], result["reason"]) == ("gone_on", "unknown", stopped.footer["reason"])
    assert command["margin_N"] == 12.0 - stopped.rows["force_N"][at]
    assert command["recorded_m_per_s"] == [0.0, 0.0, 0.02], "the retract of the guard"


def test_another_speed_is_another_motion_from_its_first_command_on(pressed: Recording) -> None:
    result = other(pressed, safety={"max_speed_m_per_s": 0.03})
    speeds_m_per_s = np.abs(pressed.rows["command_m_per_s"]).max(axis=1)
    command = assert_known_up_to(pressed, int(np.argmax(speeds_m_per_s > 0.03)), result)
    assert (result["would_have"], result["verdict"], command["margin_N"]) == ("moved_otherwise", "unknown", None)
    assert (command["given_m_per_s"], command["recorded_m_per_s"]) == ([0.0, 0.0, 0.03], [0.0, 0.0, 0.05])


def test_settings_of_the_devices_are_named_as_not_tested_and_change_no_verdict(pressed: Recording) -> None:
    result = other(pressed, robot={"model": "ur5e", "watchdog_Hz": 60.0}, sensor={"filter_cutoff_Hz": 15.0}, paths={"runs": "elsewhere"})
    assert (result["would_have"], result["verdict"], result["decisions_identical"]) == ("moved_the_same", "done", True)
    untested = [setting["key"] for setting in result["changed_settings"] if not setting["tested"]]
    assert untested == ["robot.model", "robot.watchdog_Hz", "sensor.filter_cutoff_Hz"]


def test_a_configuration_that_refuses_the_plan_of_the_run_is_refused(pressed: Recording) -> None:
    with pytest.raises(ConfigError, match="refused before it moved: the plan's press_speed_m_per_s is"):
        other(pressed, safety={"max_speed_m_per_s": 0.003})
