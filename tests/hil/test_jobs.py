"""Jobs of the service on wires: calibrate, a map that is cancelled, a proposed motion, a pause, an abort while a worker computes."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from palpd.errors import Refused
from palpd.recording.reader import Recording
from palpd.testing.emulated_cell import PATIENT, EmulatedCell
from palpd.testing.processes import command_of, until
from palpd.testing.served_cell import ServedCell, served
from palpd.tick import Phase

pytestmark = pytest.mark.hil

FIELD = {"width_m": 0.01, "height_m": 0.01, "depth_m": 0.004, "most_presses": 3}


def worker_of(service: ServedCell) -> int:
    """The worker's process."""
    children = Path(f"/proc/{service.process.pid}/task/{service.process.pid}/children").read_text().split()
    return next(int(pid) for pid in children if "palpd.daemon.job_worker" in command_of(int(pid)))


def ended(service: ServedCell, job_id: str) -> dict[str, Any]:
    """The job, when it is over."""
    until(lambda: service.do("job", id=job_id)["ended"] is not None, f"the job {job_id} is over", 120.0, every_s=0.05)
    return service.do("job", id=job_id)


def test_calibrate_is_a_job_where_the_service_runs(cell: Callable[..., EmulatedCell]) -> None:
    with served(cell(**PATIENT)) as service:
        kept = service.cell.folder / "state" / "calibration.json"
        before = kept.stat().st_mtime_ns
        done = service.cell.palpd("calibrate", "--config", service.cell.config, "--temperature-C", "21.5")
        assert done.returncode == 0, done.stderr
        assert "-calibrate of the service makes at most 1 run." in done.stdout
        assert "Reference tare (" in done.stdout
        assert kept.stat().st_mtime_ns > before
        assert json.loads(kept.read_text())["temperature_C"] == 21.5
        (job,) = service.do("jobs")["jobs"]
        assert (job["program"], job["verdict"], job["runs"]) == ("calibrate", "done", 1)
        assert "with palpd calibrate" in job["by"]
        assert service.do("status")["controls"] is None, "the command lets the controls go"


def test_the_doctor_of_the_service_reads_the_devices_and_moves_nothing(cell: Callable[..., EmulatedCell]) -> None:
    with served(cell(**PATIENT)) as service:
        out = service.cell.folder / "doctor.json"
        service.cell.truth(reset=True)
        done = service.cell.palpd("doctor", "--config", service.cell.config, "--watch-s", "2", "--json", out)
        findings = {finding["name"]: finding["verdict"] for finding in json.loads(out.read_text())["findings"]}
        assert "-doctor of the service" in done.stdout
        assert {"sensor", "sensor frames", "sensor noise", "robot", "RTDE jitter", "clock"} <= set(findings)
        assert findings["robot"] == findings["sensor"] == "ok"
        assert not any(sample.speed_m_per_s for sample in service.cell.log(0.0)[-100:])


def test_a_map_is_cancelled_in_its_second_press_and_keeps_the_first(cell: Callable[..., EmulatedCell]) -> None:
    with served(cell(**PATIENT)) as service:
        with pytest.raises(Refused, match="disarmed"):
            service.do("begin", program="map", arguments=FIELD)
        service.arm()
        begun = service.do("begin", program="map", arguments=FIELD)
        assert begun["most_runs"] == 3
        until(lambda: service.do("status").get("active", {})["runs"] == 2, "the second press", 120.0, every_s=0.05)
        service.until_phase("press")
        worker = worker_of(service)
        assert service.do("cancel", id=begun["id"])["state"] == "aborting"
        job = ended(service, begun["id"])
        assert job["verdict"] == "stopped"
        assert "the operator aborted the run" in job["reason"]
        assert job["result"]["presses"] == 1
        assert job["result"]["moduli_Pa"][0] > 0.0
        assert Path(job["result"]["picture"]).exists()
        until(lambda: not Path(f"/proc/{worker}").exists(), "the worker is gone", 2.0)
        assert service.cell.log(0.0)[-1].speed_m_per_s == 0.0
        assert service.do("status")["state"] == "disarmed"
        with pytest.raises(Refused, match="no job is running"):
            service.do("cancel", id=begun["id"])


def test_a_command_that_is_interrupted_stops_the_arm_of_its_job(cell: Callable[..., EmulatedCell]) -> None:
    with served(cell(**PATIENT)) as service:
        command = [sys.executable, "-m", "palpd", "free-motion", "--config", str(service.cell.config), "--out", "free.mcap"]
        client = subprocess.Popen(command, cwd=service.cell.folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        until(lambda: service.do("status").get("phase") == "free_motion", "the arm moves", every_s=0.02)
        began_s = float(service.cell.truth()["t_s"])
        client.send_signal(signal.SIGINT)
        _, stderr = client.communicate(timeout=20.0)
        assert (client.returncode, stderr) == (130, "palpd: interrupted by SIGINT\n")
        assert service.cell.rest_after_s(began_s, settle_s=1.5) < 1.0
        (job,) = service.do("jobs")["jobs"]
        assert ended(service, job["id"])["verdict"] == "stopped"
        assert not (service.cell.folder / "free.mcap").exists()


def test_a_pause_in_the_tissue_retracts_and_a_resume_begins_the_press_again(cell: Callable[..., EmulatedCell]) -> None:
    with served(cell(**PATIENT)) as service:
        service.press()
        assert service.do("pause")["state"] in ("paused", "pausing")
        until(lambda: service.do("status")["phase"] == "paused", "the arm waits")
        assert service.cell.truth()["contact_N"] == 0.0
        assert service.do("resume")["state"] == "running"
        until(lambda: service.cell.truth()["contact_N"] > 1.0, "the press begins again")
        last = service.until_disarmed()
        assert last["verdict"] == "done", last
        assert last["notes"][-1] == "site A, dynamic press to 10 mm: a pause interrupted it, and it was begun again from its start"
        rows = Recording.load(Path(last["recording"])).rows
        assert Phase.PAUSE_RETRACT in rows["phase"]
        replayed = service.cell.palpd("replay", last["recording"], "--json", service.cell.folder / "replay.json")
        assert replayed.returncode == 0, replayed.stderr
        assert json.loads((service.cell.folder / "replay.json").read_text())["decisions_identical"]


def proposing(service: ServedCell, recording: Path) -> dict[str, Any]:
    """A resolve of one recording, up to its proposal."""
    service.arm()
    stated = {"tissue": {"youngs_modulus_Pa": 72e3}}  # a modulus that nobody states is not known, and what hides in it no gap
    arguments = {"recordings": [str(recording)], "rounds": 1, "adopted": False, "cell": stated}
    begun = service.do("begin", program="resolve", arguments=arguments)
    until(lambda: service.do("status")["state"] != "running", "a motion is proposed", 180.0, every_s=0.1)
    return begun


@pytest.fixture(scope="module")
def ambiguous(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a cell whose gain or modulus is off: one standard plan does not tell which."""
    from palpd.cell.cell_file import nominal
    from palpd.config import Config
    from palpd.daemon.motion_job import Job
    from palpd.daemon.resolve import STANDARD
    from palpd.daemon.simulated_run import run
    from palpd.recording.reader import export

    done = run(Job("palpation", Config(), STANDARD), nominal().with_effects({"sensor.gain": {"error": 0.15}}))
    header = {**done.header, "kind": "palpation", "dry": False, "plan": STANDARD.model_dump(mode="json")}
    path = tmp_path_factory.mktemp("ambiguous") / "a.csv"
    export(Recording(Path("a.mcap"), done.rows, header, {"verdict": "done"}, None), path, "A")  # type: ignore[arg-type]
    return path


def test_a_proposed_motion_waits_for_consent_and_is_recorded_only_with_it(cell: Callable[..., EmulatedCell], ambiguous: Path) -> None:
    with served(cell(**PATIENT)) as service:
        begun = proposing(service, ambiguous)
        status = service.do("status")
        assert status["state"] == "waiting", service.do("job", id=begun["id"])
        proposal = status["active"]["proposal"]
        assert proposal["number"] == 1
        assert 0.0 <= proposal["expected_peak_N"] < proposal["limit_N"]
        assert proposal["duration_s"] > 1.0
        assert "sensor.gain" in proposal["decides"]
        moved = service.cell.log(0.0)
        assert not any(sample.speed_m_per_s for sample in moved[-50:]), "nothing moves while it waits"
        with pytest.raises(Refused, match="number 1, not 2"):
            service.do("decide", id=begun["id"], number=2, agree=True)
        service.do("decide", id=begun["id"], number=1, agree=True)
        service.until_phase("free_motion")
        service.do("abort")
        job = ended(service, begun["id"])
        assert job["verdict"] == "stopped"
        assert job["runs"] == 1


def test_an_abort_while_a_worker_computes_ends_it_and_moves_nothing(cell: Callable[..., EmulatedCell], ambiguous: Path) -> None:
    with served(cell(**PATIENT)) as service:
        service.arm()
        begun = service.do("begin", program="resolve", arguments={"recordings": [str(ambiguous)], "adopted": False})
        until(lambda: service.do("status")["active"]["activity"] == "diagnosing", "the worker computes", every_s=0.05)
        worker = worker_of(service)
        service.do("abort")
        assert service.do("status")["state"] == "disarmed"
        until(lambda: not Path(f"/proc/{worker}").exists(), "the worker is gone", 2.0)
        job = service.do("job", id=begun["id"])
        assert (job["verdict"], job["reason"]) == ("cancelled", "aborted while no run was under way; nothing moved")


def test_when_the_service_is_killed_its_worker_dies_and_the_arm_stops(cell: Callable[..., EmulatedCell]) -> None:
    with served(cell(**PATIENT)) as service:
        service.arm()
        service.do("begin", program="map", arguments=FIELD)
        service.until_phase("press")
        worker = worker_of(service)
        killed_s = float(service.cell.truth()["t_s"])
        os.kill(service.process.pid, signal.SIGKILL)
        assert service.cell.rest_after_s(killed_s, settle_s=1.5) < 1.0
        until(lambda: not command_of(worker), "the worker is gone", 2.0)


def test_after_a_restart_nothing_moves_and_no_job_is_known(cell: Callable[..., EmulatedCell]) -> None:
    wired = cell(**PATIENT)
    with served(wired) as service:
        service.press()
        service.process.send_signal(signal.SIGTERM)
        service.process.wait(30.0)
    with served(wired, calibrate=False) as again:
        status = again.do("status")
        assert status["probe"]["state"] == "pressed"
        assert (status["state"], status["active"], again.do("jobs")["jobs"]) == ("disarmed", None, [])
        assert not any(sample.speed_m_per_s for sample in wired.log(float(wired.truth()["t_s"]) - 2.0))
