"""One job in the foreground: what `palpd run`, `calibrate`, `free-motion`, `stiffness` and the demo have in common."""

import signal
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from palpd import results
from palpd.config import Config, Plan, refuse_unsafe
from palpd.errors import BadInput, RecordingError, Refused, Stopped
from palpd.motion import Build, Job, Kind
from palpd.overshoot import refuse_overload
from palpd.record import Recording
from palpd.ring import Ring
from palpd.state import Calibration, State
from palpd.supervisor import Report, Run, now, recording_name, wait
from palpd.tick import Mode, Phase, Request

PHASES = {
    Phase.TARE: "taring",
    Phase.TRAVEL: "going there",
    Phase.BASELINE: "resting above",
    Phase.SEARCH: "looking for the surface",
    Phase.PRESS: "pressing",
    Phase.HOLD: "holding",
    Phase.RETRACT: "leaving",
    Phase.FREE_MOTION: "moving in free air",
    Phase.PAUSED: "paused",
    Phase.DONE: "done",
}


def job(kind: Kind, config: Config, plan: Plan, dry: bool = False, take_reference: bool = False) -> Job:
    """A job with what earlier steps have measured. Raises Refused where a reference tare is needed and missing."""
    state = State(config.paths.state)
    if kind == "palpation":
        refuse_unsafe(config, plan)
        refuse_overload(config, plan)
    calibration = state.calibration()
    if kind != "calibrate" and calibration is None and not take_reference:
        raise Refused(
            f"there is no reference tare in {config.paths.state.name}/; run palpd calibrate with the probe free and still, "
            "or palpd run with --take-reference"
        )
    stiffness = state.machine_stiffness()
    return Job(
        kind,
        config,
        plan,
        dry,
        reference=calibration.wrench if calibration and not take_reference else None,
        reference_serial=calibration.sensor_serial if calibration and not take_reference else None,
        machine_stiffness_N_per_m=config.machine.stiffness_N_per_m or (stiffness.stiffness_N_per_m if stiffness else None),
    )


def carry_out(work: Job, build: Build, console: Console, name: str | None = None) -> Report:
    """Do a job from opening the devices to the closed recording, showing how it goes; Ctrl-C and TERM abort it.

    Raises the error of the report's exit code, except for a run stopped by the guard, whose report is returned.
    """
    ring = Ring.create(work.config.robot.rate_Hz)
    try:
        run = Run(work, build, ring, State(work.config.paths.state), name or recording_name(work.kind))
        signal.signal(signal.SIGTERM, lambda *_: run.ask(Request.ABORT))
        signal.signal(signal.SIGHUP, lambda *_: run.ask(Request.ABORT))
        with Progress(
            TextColumn("{task.description:<34}"), BarColumn(), TextColumn("{task.fields[figures]}"), TimeElapsedColumn(),
            console=console, transient=True,
        ) as progress:  # fmt: skip
            shown = progress.add_task("opening robot and sensor", total=_steps(work), figures="")
            report = wait(run, lambda _: _show(progress, shown, ring, work))
    finally:
        ring.unlink()
        ring.close()
    if report.exit_code == 2:
        raise Refused(report.reason)
    return report


def calibrate(config: Config, build: Build, console: Console, temperature_C: float | None = None) -> Calibration:
    """Take the reference tare and keep it. Raises Refused or DeviceError."""
    report = carry_out(job("calibrate", config, Plan()), build, console)
    if report.reference is None:
        raise Stopped(report.reason or "no reference tare came back")
    calibration = Calibration(report.reference, now(), report.about.get("sensor_serial"), temperature_C)
    State(config.paths.state).keep("calibration", calibration)
    return calibration


def findings(report: Report) -> dict[str, Any]:
    """The JSON of a run: verdict, reason, trips, loop, sites, recording."""
    found: dict[str, Any] = {
        "verdict": report.verdict,
        "reason": report.reason,
        "trips": list(report.trips),
        "recording": str(report.recording) if report.recording else None,
        "notes": list(report.notes),
        "sites": [],
        "loop": {},
    }
    if report.recording is not None:
        try:
            recording = Recording.load(report.recording)
        except RecordingError as error:  # a run that ended before its first tick has a reason of its own, which must not be hidden
            found["notes"].append(str(error))
            return found
        found["loop"] = results.loop_figures(recording.rows)
        found["model_card"] = recording.header["model_card"]
        if recording.header["kind"] == "palpation":
            found["sites"] = results.sites(recording.rows, recording.header)
    return found


def kept_in(folder: Path, kind: str | None = None) -> Path:
    """The folder, made, which must be empty; or with `kind` a new one in it that is called so with the time. Raises BadInput."""
    folder = folder / f"{kind}-{datetime.now():%Y%m%d-%H%M%S}" if kind else folder
    if folder.is_dir() and any(folder.iterdir()):
        raise BadInput(f"{folder} is not empty; nothing is overwritten, so give another folder")
    folder.mkdir(parents=True, exist_ok=True)
    return folder.resolve()


def _steps(work: Job) -> int:
    plan = work.plan
    if work.kind == "free_motion":
        return 10
    if work.kind != "palpation":
        return 1
    static = len(plan.depths_m) if plan.mode in ("static", "both") else 0
    dynamic = len(plan.depths_m) * plan.repeats if plan.mode in ("dynamic", "both") else 0
    return len(plan.sites) * ((plan.free.strokes if plan.free else 0) + bool(plan.depths_m) + static + dynamic)


def _done(row: Any, work: Job) -> int:
    plan = work.plan
    if work.kind == "free_motion":
        return max(0, int(row["repeat"]))
    if work.kind != "palpation" or row["site"] < 0:
        return 0
    per_site = _steps(work) // len(plan.sites)
    static = len(plan.depths_m) if plan.mode in ("static", "both") else 0
    before = int(row["site"]) * per_site
    if row["mode"] == Mode.FREE_MOTION:
        return before + max(0, int(row["repeat"]))
    before += plan.free.strokes if plan.free else 0
    at = plan.depths_m.index(float(row["depth_m"])) if float(row["depth_m"]) in plan.depths_m else 0
    if row["mode"] == Mode.STATIC:
        return before + 1 + at
    if row["mode"] == Mode.DYNAMIC:
        return before + 1 + static + at * plan.repeats + max(0, int(row["repeat"]))
    return before


def _show(progress: Progress, shown: Any, ring: Ring, work: Job) -> None:
    if not ring.published:
        return
    rows, _, _ = ring.read(ring.published - 1)
    if not len(rows):
        return
    row = rows[-1]
    doing = PHASES.get(Phase(int(row["phase"])), "")
    where = f"site {work.plan.sites[int(row['site'])].name}: " if work.kind == "palpation" and row["site"] >= 0 else ""
    figures = f"{float(row['force_N']):6.2f} N  z {float(row['tcp_pose'][2]) * 1e3:7.2f} mm"
    progress.update(shown, description=where + doing, completed=_done(row, work), figures=figures)
