import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hw.emulators.process import Emulated, started
from palpd.cli.at_once import position
from palpd.config import Config, Plan, load_config, parse_config
from palpd.control.probe_state import ContactMarker, ProbeAnswer, ProbeIdentity, ProbeState
from palpd.daemon.control_socket import Later
from palpd.daemon.install import UNITS, installed, unit_python
from palpd.daemon.motion_job import Job
from palpd.daemon.robot_stops import ProtectiveStops
from palpd.daemon.service import Service
from palpd.daemon.session import job as session_job
from palpd.daemon.socket_client import ask
from palpd.daemon.stored_state import Calibration, Latch, State
from palpd.daemon.supervisor import Report
from palpd.errors import ConfigError, Refused
from palpd.recording.reader import Recording
from palpd.recording.recovery import recover
from palpd.testing.fixtures import skip_without_ur_rtde
from palpd.testing.operator import Operator
from palpd.testing.processes import command_of, family, until
from palpd.tick import ROW, Phase, Request
from tests.paths import ROOT

HOST = "127.0.9.72"
PHANTOM = ROOT / "palpd" / "cell" / "phantom.yaml"
TARE = Calibration((0.0,) * 6, "2026-01-01", "PRE00042")
PLAN = {"sites": [{"name": "A"}], "depths_m": [0.004], "mode": "static", "hold_s": 20.0, "search": {"speed_m_per_s": 0.02}}
SLOW = {**PLAN, "search": {"speed_m_per_s": 0.001}}

# --- who may do what, without devices -----------------------------------------------------------------------------------------


class ScriptedRun:
    """Stands for a run under way; `ends_with` is what the next poll reports."""

    def __init__(self, job: Job, *_: Any) -> None:
        self.job, self.ends_with, self.asked, self.recording, self.unkept = job, None, [], None, ""  # type: ignore[var-annotated]

    def poll(self) -> Report | None:
        return self.ends_with

    def ask(self, request: Request) -> None:
        self.asked.append(request)


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    monkeypatch.setattr("palpd.daemon.run_under_way.JobRun", ScriptedRun)
    service = Service(settings(tmp_path), lambda *_: pytest.fail("nothing is opened here"))
    yield service
    service._ring.close()


def settings(folder: Path, **more: Any) -> Config:
    return parse_config({"paths": {"state": str(folder / "state"), "runs": str(folder / "runs")}, **more}, "the test's configuration")


def end(service: Service, report: Report) -> None:
    service._run.current.ends_with = report  # type: ignore[union-attr]
    service._poll_run()


def refusal(service: Service, **request: Any) -> str:
    answer = service.answer(request)
    assert isinstance(answer, dict)
    assert not answer["ok"]
    return str(answer["error"])


def armed(service: Service) -> None:
    service._state.keep("calibration", TARE)
    later = service.answer({"do": "arm"})
    end(service, Report("done"))
    assert isinstance(later, Later)
    assert later.answer == {"ok": True, "state": "armed"}


def status(service: Service) -> dict[str, Any]:
    answer = service.answer({"do": "status"})
    assert isinstance(answer, dict)
    return answer


def test_it_begins_disarmed_and_does_not_start(service: Service) -> None:
    assert status(service)["state"] == "disarmed"
    assert "disarmed" in refusal(service, do="start", plan=PLAN)


@pytest.mark.parametrize("written", [True, False])
def test_the_recording_of_a_run_that_is_over_waits_for_its_report(service: Service, tmp_path: Path, written: bool) -> None:
    service._config = settings(tmp_path, paths={"state": str(tmp_path / "state"), "runs": str(tmp_path), "write_reports": written})
    armed(service)
    assert not service._reports._waiting, "a check of the devices has no report"
    assert service.answer({"do": "start", "plan": PLAN})["ok"]  # type: ignore[index]
    assert not service._reports._waiting
    end(service, Report("stopped", "force", 3, recording=tmp_path / "a.mcap"))
    assert list(service._reports._waiting) == [tmp_path / "a.mcap"] * written


def test_nothing_is_armed_without_a_reference_tare(service: Service) -> None:
    assert "palpd calibrate" in refusal(service, do="arm")


def test_arming_waits_for_a_check_of_the_devices_that_commands_nothing(service: Service) -> None:
    service._state.keep("calibration", TARE)
    later = service.answer({"do": "arm"})
    assert isinstance(later, Later)
    assert later.answer is None
    assert status(service)["state"] == "checking"
    assert service._run.current is not None
    assert service._run.current.job.dry
    assert service._run.current.job.reference == TARE.wrench
    end(service, Report("done"))
    assert later.answer == {"ok": True, "state": "armed"}
    assert status(service)["state"] == "armed"


def test_a_check_that_finds_something_refuses_with_its_sentence(service: Service) -> None:
    service._state.keep("calibration", TARE)
    later = service.answer({"do": "arm"})
    end(service, Report("refused", "the sensor is silent", 2))
    assert isinstance(later, Later)
    assert later.answer == {"ok": False, "error": "not armed: the sensor is silent"}
    assert status(service)["state"] == "disarmed"
    assert status(service)["cell"]["reason"] == "the sensor is silent"


def test_an_abort_during_the_check_leaves_it_disarmed_whatever_the_check_says(service: Service) -> None:
    service._state.keep("calibration", TARE)
    later = service.answer({"do": "arm"})
    run = service._run.current
    service.answer({"do": "abort"})
    assert isinstance(later, Later)
    assert later.answer is not None
    assert not later.answer["ok"]
    assert run.asked == [Request.ABORT]  # type: ignore[union-attr]
    end(service, Report("done"))
    assert status(service)["state"] == "disarmed"


def test_who_no_longer_waits_for_the_answer_has_armed_nothing(service: Service) -> None:
    service._state.keep("calibration", TARE)
    later = service.answer({"do": "arm"})
    assert isinstance(later, Later)
    later.abandoned = True
    end(service, Report("done"))
    assert status(service)["state"] == "disarmed"


def test_two_cannot_arm_at_once(service: Service) -> None:
    service._state.keep("calibration", TARE)
    service.answer({"do": "arm"})
    assert "another client" in refusal(service, do="arm")


def test_a_start_spends_the_arming(service: Service) -> None:
    armed(service)
    assert service.answer({"do": "start", "plan": PLAN}) == {"ok": True, "state": "running"}
    assert "running" in refusal(service, do="arm")
    end(service, Report("done"))
    assert status(service)["state"] == "disarmed"
    assert "disarmed" in refusal(service, do="start", plan=PLAN)


@pytest.mark.parametrize(
    "plan",
    [None, [], {"depths_m": [4]}, {"press_speed_m_per_s": 0.05, "search": {"speed_m_per_s": 0.9}}, {"sites": []}, {"unknown": 1}],
)
def test_a_wrong_plan_starts_nothing_and_leaves_it_armed(service: Service, plan: Any) -> None:
    armed(service)
    refusal(service, do="start", plan=plan)
    assert status(service)["state"] == "armed"


def test_a_latch_is_cleared_by_an_operator_only(service: Service) -> None:
    service._state.keep("calibration", TARE)
    service._state.keep("latch", Latch("the lateral force was 9 N", "yesterday"))
    assert "lateral" in refusal(service, do="arm")
    again = Service(service._config, service._run._build)  # a restart
    try:
        assert "lateral" in refusal(again, do="arm")
    finally:
        again._ring.close()
    service.answer({"do": "clear"})
    assert isinstance(service.answer({"do": "arm"}), Later)


@pytest.mark.parametrize("text", ["{half", '{"reason": 5, "date": null}'])
def test_a_latch_that_cannot_be_read_is_one(service: Service, text: str) -> None:
    service._state.keep("calibration", TARE)
    (service._state.folder / "latch.json").write_text(text)
    assert "cannot be read" in refusal(service, do="arm")
    assert "cannot be read" in str(status(service)["now"]["sentence"])
    service.answer({"do": "clear"})
    assert isinstance(service.answer({"do": "arm"}), Later)


def test_a_latch_that_cannot_be_written_holds_all_the_same(service: Service) -> None:
    armed(service)
    service.answer({"do": "start", "plan": PLAN})
    service._run.current.unkept = why = "state/latch.json cannot be written (no space left)"  # type: ignore[union-attr]
    end(service, Report("stopped", why, 3))
    assert "no space left" in refusal(service, do="arm")
    service.answer({"do": "clear"})
    assert isinstance(service.answer({"do": "arm"}), Later)


def test_a_run_that_fails_is_held_by_nobody_so_that_its_motion_process_stops_the_arm(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pipe between the two closes when the object is gone; the motion process then stops the arm by itself."""
    armed(service)
    service.answer({"do": "start", "plan": PLAN})
    run = weakref.ref(service._run.current)  # type: ignore[arg-type]

    def failing(_: ScriptedRun) -> Report:
        return Report("stopped", "state/contact.json cannot be written (no space left)", 3)

    monkeypatch.setattr(ScriptedRun, "poll", failing)
    later = service.answer({"do": "pause"})
    service._poll_run()
    assert run() is None
    service._pausing.poll(service._run)
    assert isinstance(later, Later)
    assert later.answer == {"ok": False, "error": "the run ended meanwhile; see palpd status"}


def test_a_second_protective_stop_within_a_minute_is_armed_over_only_with_a_cause_which_a_restart_keeps(service: Service) -> None:
    service._state.keep("calibration", TARE)
    stops = ProtectiveStops().begin("2026-07-14T10:00:00+02:00", moved=True).end("2026-07-14T10:03:00+02:00")
    service._state.keep("protective", stops.begin("2026-07-14T10:03:50+02:00", moved=True))
    assert "its cause must be written down" in refusal(service, do="arm")
    assert "palpd clear --cause TEXT" in refusal(service, do="clear")
    for cause in ("", " ", "x" * 501, "two\nlines", 7):
        assert "a cause has 1 to 500" in refusal(service, do="clear", cause=cause)
    again = Service(service._config, service._run._build)  # a restart
    try:
        assert "its cause must be written down" in refusal(again, do="arm")
        assert status(again)["now"]["next"] == "clear"
        assert again.answer({"do": "clear", "cause": " the tool touched the frame "}) == {"ok": True, "state": "disarmed"}
    finally:
        again._ring.close()
    kept = status(service)["protective"]
    assert [stop["cause"] for stop in kept] == ["the tool touched the frame", ""]
    assert kept[0]["by"] == "a client without the controls"
    assert kept[0]["written"]
    assert isinstance(service.answer({"do": "arm"}), Later)


@pytest.mark.parametrize("date", ["{half", "yesterday", "", "2026-07-14T12:00:00"])
def test_protective_stops_that_cannot_be_read_ask_for_a_cause(service: Service, date: str) -> None:
    service._state.keep("calibration", TARE)
    stops = json.dumps({"stops": [{"date": "2026-07-14T12:00:00+02:00"}, {"date": date}]})
    (service._state.folder / "protective.json").write_text(date if date == "{half" else stops)
    assert "cannot be read" in refusal(service, do="arm")
    assert service.answer({"do": "clear", "cause": "a full disk"})["ok"]  # type: ignore[index]
    assert isinstance(service.answer({"do": "arm"}), Later)


@pytest.mark.parametrize("wrench", [[1, 2, 3], ["x"] * 6, None, [float("nan")] * 6])
def test_a_damaged_reference_tare_is_refused(service: Service, wrench: Any) -> None:
    service._state.keep("calibration", TARE)
    path = service._state.folder / "calibration.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "wrench": wrench}))
    assert "palpd calibrate" in refusal(service, do="arm")
    with pytest.raises(ConfigError, match="delete it, and run palpd calibrate again"):  # a calibration reads the same file
        session_job("calibrate", service._config, Plan())


def test_a_retract_needs_neither_arming_nor_a_cleared_latch_and_leaves_the_latch(service: Service) -> None:
    service._state.keep("calibration", TARE)
    service._state.keep("latch", Latch("the lateral force was 9 N", "yesterday"))
    answer = service.answer({"do": "retract"})
    assert answer == {"ok": True, "state": "running", "id": service._jobs.current.id}  # type: ignore[union-attr]
    assert service._run.current is not None
    assert service._run.current.job.kind == "retract"
    assert service._run.current.job.reference == TARE.wrench
    assert "running" in refusal(service, do="retract")
    end(service, Report("done"))
    assert "lateral" in refusal(service, do="arm")


def test_a_retract_without_a_reference_tare_is_left_to_hands(service: Service) -> None:
    assert "by hand" in refusal(service, do="retract")


def test_a_pause_answers_where_the_arm_stopped_once_a_tick_shows_it(service: Service) -> None:
    armed(service)
    service.answer({"do": "start", "plan": PLAN})
    later = service.answer({"do": "pause"})
    assert isinstance(later, Later)
    assert "another client" in refusal(service, do="resume")
    service._pausing.poll(service._run)
    assert later.answer is None
    row = np.zeros(1, ROW)
    row["phase"], row["site"], row["force_N"], row["surface_z_m"] = Phase.PAUSED, 0, 3.25, 0.004
    service._ring.write(row)
    service._pausing.poll(service._run)
    assert later.answer is not None
    assert (later.answer["state"], later.answer["force_N"], later.answer["depth_m"]) == ("paused", 3.25, 0.004)
    assert position(later.answer) == "paused: palpation, site A: paused, 0 of 2 steps done, force 3.25 N, 4.0 mm deep"


def test_a_pause_in_the_tissue_says_that_the_arm_leaves_first(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    armed(service)
    service.answer({"do": "start", "plan": PLAN})
    now_s = time.monotonic()
    for wish, expected in (("pause", "pausing"), ("resume", "resuming")):
        monkeypatch.setattr("palpd.daemon.pausing.time.monotonic", lambda at_s=now_s: at_s)
        later = service.answer({"do": wish})
        row = np.zeros(1, ROW)
        row["phase"], row["site"], row["force_N"], row["surface_z_m"] = Phase.PAUSE_RETRACT, 0, 3.25, 0.004
        service._ring.write(row)
        service._pausing.poll(service._run)
        assert isinstance(later, Later)
        assert later.answer is None
        now_s += 2.0
        monkeypatch.setattr("palpd.daemon.pausing.time.monotonic", lambda at_s=now_s: at_s)
        service._pausing.poll(service._run)
        assert later.answer is not None
        assert later.answer["ok"]
        assert later.answer["state"] == expected
        assert later.answer["activity"] == "site A: leaving for a pause"


def test_what_does_not_press_cannot_be_paused(service: Service) -> None:
    service._state.keep("calibration", TARE)
    service.answer({"do": "retract"})
    assert "leaves the tissue already" in refusal(service, do="pause")


def test_a_pause_that_no_tick_shows_is_refused_after_a_second(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    armed(service)
    service.answer({"do": "start", "plan": PLAN})
    later = service.answer({"do": "pause"})
    now_s = time.monotonic()
    monkeypatch.setattr("palpd.daemon.pausing.time.monotonic", lambda: now_s + 2.0)
    service._pausing.poll(service._run)
    assert isinstance(later, Later)
    assert later.answer is not None
    assert "not paused within 1 s" in later.answer["error"]


def test_the_status_says_what_is_next_and_refusals_say_the_same(service: Service) -> None:
    """Through an abort in the tissue: the terminal is refused with what the page shows."""
    assert (status(service)["now"]["state"], status(service)["now"]["next"]) == ("untared", "calibrate")
    armed(service)
    assert (status(service)["now"]["state"], status(service)["now"]["next"]) == ("armed", "start")
    service.answer({"do": "start", "plan": PLAN})
    assert status(service)["now"]["state"] == "running"
    pressed = ProbeAnswer(ProbeState.PRESSED, ("the run is unfinished",), frozenset(("retract",)), 2.1)
    end(service, Report("stopped", "the operator aborted the run", 3, probe=pressed))
    now = status(service)["now"]
    assert (now["state"], now["next"]) == ("pressed", "retract")
    for request in ({"do": "start", "plan": PLAN}, {"do": "level-test"}, {"do": "clear"}, {"do": "begin", "program": "recover"}):
        obstacle = now["obstacles"][request.get("program", request["do"])]
        assert refusal(service, **request) == f"{obstacle['reason']}; palpd retract leaves the tissue"
    assert service.answer({"do": "retract"})["ok"]  # type: ignore[index]


def test_an_arm_looks_again_before_it_believes_an_old_answer(service: Service) -> None:
    """Somebody may have freed the probe by hand since."""
    service._state.keep("calibration", TARE)
    service._known._probe = ProbeAnswer(ProbeState.PRESSED, ("it was",), frozenset(("retract",))), "an hour ago"
    assert "arm" in status(service)["now"]["obstacles"]
    later = service.answer({"do": "arm"})
    end(service, Report("done", probe=ProbeAnswer(ProbeState.FREE)))
    assert isinstance(later, Later)
    assert later.answer == {"ok": True, "state": "armed"}
    assert status(service)["now"]["next"] == "start"


def test_a_look_before_a_run_in_the_foreground_no_longer_says_that_the_probe_is_free(service: Service) -> None:
    """`palpd run` beside the idle service was aborted in the tissue: "The probe is free, and nothing moves." """
    service._state.keep("calibration", TARE)
    service.answer({"do": "check"})
    end(service, Report("done", probe=ProbeAnswer(ProbeState.FREE)))
    assert "The probe is free" in status(service)["now"]["sentence"]
    pose, own = (0.1, 0.2, 0.3, 0.0, 3.1, 0.0), ProbeIdentity("PRE00042", None, None)
    service._state.keep("contact", ContactMarker("2026-11-28", "20261128-palpation", pose, pose, 0.01, TARE.wrench, own))
    now = status(service)
    assert (now["now"]["state"], now["now"]["next"], now["probe"]["state"]) == ("unknown", "retract", "unknown")
    assert "20261128-palpation of 2026-11-28 is unfinished" in now["now"]["sentence"]
    service._state.forget("contact")
    assert status(service)["probe"]["state"] == "free"


def test_a_check_looks_at_the_devices_and_arms_nothing(service: Service) -> None:
    armed(service)
    later = service.answer({"do": "check"})
    assert isinstance(later, Later)
    assert status(service)["now"]["state"] == "checking"
    end(service, Report("refused", "the sensor is silent", 2))
    assert later.answer is not None
    assert later.answer["ok"]
    now = status(service)["now"]
    assert (now["state"], now["sentence"], now["next"]) == ("unready", "The sensor is silent.", "check")
    assert "arm" not in now["obstacles"], "an arm looks at the devices itself"


def test_a_pause_can_be_resumed_before_a_tick_has_shown_it(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    armed(service)
    service.answer({"do": "start", "plan": PLAN})
    assert "is not paused" in refusal(service, do="resume")
    now_s = time.monotonic()
    service.answer({"do": "pause"})
    monkeypatch.setattr("palpd.daemon.pausing.time.monotonic", lambda: now_s + 2.0)
    service._pausing.poll(service._run)
    assert status(service)["now"]["next"] == "resume"
    assert "is paused; palpd resume goes on" in refusal(service, do="pause")
    assert isinstance(service.answer({"do": "resume"}), Later)


def test_a_state_file_that_is_damaged_leaves_the_status_alive(service: Service) -> None:
    service._state.keep("calibration", TARE)
    for name in ("contact", "place"):
        (service._state.folder / f"{name}.json").write_text("{half")
    now = status(service)["now"]
    assert now["state"] == "unknown"
    assert "contact.json" in now["sentence"]
    assert now["next"] == "check"


def test_an_unknown_command_is_told_what_there_is(service: Service) -> None:
    assert "clear" in refusal(service, do="dance")


# --- installation -------------------------------------------------------------------------------------------------------------


def test_installed_files_fit_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("palpd.daemon.install.UNSEEN", ())
    assert len(installed(tmp_path)) == 7
    unit = (tmp_path / "etc/systemd/system/palpd.service").read_text()
    assert f"ExecStart={sys.executable} -m palpd serve --config /etc/palpd/config.yaml" in unit
    paths = load_config(tmp_path / "etc/palpd/config.yaml").paths
    assert (str(paths.state), str(paths.control_socket)) == ("/var/lib/palpd", "/run/palpd/palpd.sock")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
@pytest.mark.parametrize("name", UNITS)
def test_the_units_are_clean_and_their_exposure_is_low(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr("palpd.daemon.install.UNSEEN", ())
    installed(tmp_path)
    unit = str(tmp_path / "etc/systemd/system" / name)
    verified = subprocess.run(["systemd-analyze", "verify", "--man=no", unit], capture_output=True, text=True, check=False)
    assert (verified.returncode, verified.stdout + verified.stderr) == (0, "")
    command = ["systemd-analyze", "security", "--offline=true", "--threshold=15", "--no-pager", unit]
    judged = subprocess.run(command, capture_output=True, text=True, check=False)
    assert judged.returncode == 0, judged.stdout


def test_an_existing_configuration_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("palpd.daemon.install.UNSEEN", ())
    installed(tmp_path)
    config = tmp_path / "etc/palpd/config.yaml"
    config.write_text("mine: 1\n")
    assert len(installed(tmp_path)) == 6
    assert config.read_text() == "mine: 1\n"


def test_a_python_that_the_service_could_not_see_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("palpd.daemon.install.UNSEEN", (str(Path(sys.executable).parents[2]),))
    with pytest.raises(Refused, match="hidden from the service"):
        unit_python(Path("/"))


def test_a_build_root_takes_the_python_of_opt_where_the_service_could_not_see_this_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("palpd.daemon.install.UNSEEN", (str(Path(sys.executable).parents[2]),))
    assert len(installed(tmp_path)) == 7
    unit = (tmp_path / "etc/systemd/system/palpd.service").read_text()
    assert "ExecStart=/opt/palpd/.venv/bin/python -m palpd serve" in unit


# --- the real thing over emulated wires ---------------------------------------------------------------------------------------


class Daemon:
    """`palpd serve` as a process of its own."""

    def __init__(self, folder: Path, emulated: Emulated) -> None:
        self.folder, self.emulated = folder, emulated
        self.config = folder / "config.yaml"
        self.notices = folder / "notices.jsonl"
        self.config.write_text(
            f"robot: {{host: {emulated.host}, watchdog_Hz: 5}}\nsensor: {{port: {emulated.sensor}}}\n"
            "safety: {robot_stale_s: 0.4, sensor_stale_s: 0.4, max_stall_s: 0.4}\n"  # a shared machine; timing is tested elsewhere
        )
        self.begin()

    def begin(self) -> None:
        command = [sys.executable, "-m", "palpd", "serve", "--config", str(self.config)]
        with self.notices.open("ab") as log:
            self.process = subprocess.Popen(command, stderr=log, cwd=self.folder, start_new_session=True)
        until(lambda: (self.folder / "state/palpd.sock").exists() and self.state() != "away", "it answers", 30.0)

    def do(self, what: str, **more: Any) -> dict[str, Any]:
        return ask(self.folder / "state/palpd.sock", {"do": what, **more}, 60.0)

    def state(self) -> str:
        try:
            return str(self.do("status")["state"])
        except Refused:
            return "away"

    def events(self, name: str) -> list[dict[str, Any]]:
        lines = [line for line in self.notices.read_text().splitlines() if line.startswith("{")]
        return [event for event in map(json.loads, lines) if event["event"] == name]

    def run(self, plan: dict[str, Any], phase: str) -> None:
        """Armed, started, and as far as that phase."""
        Operator(self.do).start(plan, lambda now: now.get("phase") == phase, phase)

    def retract(self) -> None:
        """Out of what a run left behind: until then nothing else may move."""
        with pytest.raises(Refused, match="is unfinished"):
            Operator(self.do).arm()
        Operator(self.do).retract()

    def recordings(self, suffix: str) -> set[Path]:
        return set((self.folder / "runs").glob(f"*{suffix}"))


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    folder = tmp_path_factory.mktemp("daemon")
    skip_without_ur_rtde()
    with started(folder, "ur5", PHANTOM, HOST) as emulated:
        served = Daemon(folder, emulated)
        yield served
        served.process.kill()
        served.process.wait()


def at_rest(emulated: Emulated, since_s: float) -> bool:
    return bool(emulated.ask("log", since_s=since_s)["samples"][-1][1] == 0.0)


@pytest.mark.hil
def test_the_cell_is_looked_at_once_at_the_start_and_found_uncalibrated(daemon: Daemon) -> None:
    until(lambda: daemon.events("checked"), "the cell was looked at", 30.0)
    (checked,) = daemon.events("checked")
    assert "palpd calibrate" in checked["reason"]
    calibrate = [sys.executable, "-m", "palpd", "calibrate", "--config", str(daemon.config)]
    subprocess.run(calibrate, check=True, capture_output=True, timeout=60)
    assert State(daemon.folder / "state").calibration() is not None


@pytest.mark.hil
def test_arming_is_refused_while_the_sensor_is_dead_and_others_are_served_meanwhile(daemon: Daemon) -> None:
    daemon.emulated.ask("silent", s=60.0)
    command = [sys.executable, "-m", "palpd", "arm", "--config", str(daemon.config)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as arming:
        until(lambda: daemon.state() == "checking", "it checks the devices", 30.0)
        assert daemon.state() == "checking"
        assert arming.poll() is None
        _, stderr = arming.communicate(timeout=60)
    daemon.emulated.ask("silent", s=0.0)
    assert "not armed: sensor" in stderr
    assert daemon.state() == "disarmed"


@pytest.mark.hil
def test_arming_is_refused_while_the_robot_is_off(daemon: Daemon) -> None:
    daemon.emulated.ask("protective_stop")
    try:
        with pytest.raises(Refused, match=r"not armed: .*safety mode"):
            daemon.do("arm")
    finally:
        # a controller unlocks only some seconds after the stop
        until(lambda: "releasing" in dashboard(daemon.emulated.host, "unlock protective stop"), "the stop is unlocked", 15.0, 0.05)
    until(lambda: daemon.do("status")["now"]["stop"] is None, "the stop is over", 15.0)


@pytest.mark.hil
def test_killed_in_mid_run_nothing_of_it_survives_the_arm_rests_and_the_recording_is_restored(daemon: Daemon) -> None:
    until(lambda: daemon.state() == "disarmed", "it is disarmed", 30.0)
    daemon.run(SLOW, "search")
    began_s = daemon.emulated.ask("stats")["now_s"]
    daemon.process.kill()
    daemon.process.wait()
    until(lambda: at_rest(daemon.emulated, began_s), "the arm rests", 2.0)
    until(lambda: not family(daemon.process.pid), "nothing of it lives on", 10.0)
    (part,) = daemon.recordings(".part")
    restored = recover(part)
    assert restored.ticks > 100
    assert Recording.load(restored.path).rows["phase"].max() > 0
    daemon.begin()
    assert daemon.state() in ("checking", "disarmed")
    until(lambda: daemon.state() == "disarmed", "it is disarmed", 30.0)
    daemon.retract()


@pytest.mark.hil
def test_a_motion_process_that_dies_in_mid_run_latches_over_a_restart(daemon: Daemon) -> None:
    until(lambda: daemon.state() == "disarmed", "it is disarmed", 30.0)
    daemon.run(SLOW, "search")
    motion = [pid for pid in family(daemon.process.pid) if "spawn_main" in command_of(pid)]
    began_s = daemon.emulated.ask("stats")["now_s"]
    for pid in motion:
        os.kill(pid, signal.SIGSEGV)
    until(lambda: daemon.state() == "disarmed", "it is disarmed", 20.0)
    until(lambda: at_rest(daemon.emulated, began_s), "the arm rests", 2.0)
    assert "signal 11" in daemon.do("status")["latched"]
    daemon.process.terminate()
    assert daemon.process.wait(20.0) == 0
    daemon.begin()
    with pytest.raises(Refused, match="signal 11"):
        daemon.do("arm")
    daemon.do("clear")
    assert daemon.do("status")["latched"] is None
    until(lambda: daemon.state() == "disarmed", "it is disarmed", 30.0)
    daemon.retract()


@pytest.mark.hil
def test_terminated_in_mid_press_it_rests_closes_the_recording_and_ends_with_0(daemon: Daemon) -> None:
    daemon.run(PLAN, "hold")
    before, began_s = daemon.recordings(".mcap"), daemon.emulated.ask("stats")["now_s"]
    daemon.process.send_signal(signal.SIGTERM)
    assert daemon.process.wait(20.0) == 0
    assert at_rest(daemon.emulated, began_s)
    until(lambda: not family(daemon.process.pid), "nothing of it lives on", 10.0)
    (recording,) = daemon.recordings(".mcap") - before
    assert Recording.load(recording).footer["verdict"] == "stopped"


@pytest.mark.hil
def test_it_serves_where_no_device_is_there(tmp_path: Path) -> None:
    nobody = Emulated("127.0.9.79", str(tmp_path / "no-sensor"), 0, tmp_path / "no-control")
    daemon = Daemon(tmp_path, nobody)
    try:
        until(lambda: daemon.events("checked"), "the cell was looked at", 30.0)
        assert not daemon.events("checked")[0]["ready"]
        assert daemon.state() == "disarmed"
    finally:
        daemon.process.terminate()
        assert daemon.process.wait(20.0) == 0


def dashboard(host: str, words: str) -> str:
    with socket.create_connection((host, 29999), 5.0) as connection, connection.makefile("rb") as lines:
        lines.readline()
        connection.sendall(words.encode() + b"\n")
        return lines.readline().decode()
