"""One job in the foreground: the common part of `palpd run`, `calibrate`, `free-motion`, `stiffness` and the demo."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from getpass import getuser
from pathlib import Path

from palpd.config import Config, Plan
from palpd.control.plan_place import Choice
from palpd.control.probe_state import MOST_MOVED_REFERENCE_N, ProbeAnswer, ProbeState, probe_state
from palpd.daemon.devices import Build
from palpd.daemon.display import Display, ShowProgress
from palpd.daemon.finding import Finding
from palpd.daemon.interrupts import Interrupted, held, leave_within, received, shielded, waited_s
from palpd.daemon.job_progress import JobMeter
from palpd.daemon.motion_job import BEGIN_LOADED, Job, Kind
from palpd.daemon.overshoot import refuse_together
from palpd.daemon.probe_record import probe_record
from palpd.daemon.program_host import ProgramHost, ProposedMotion
from palpd.daemon.required_check import refuse_unchecked
from palpd.daemon.stored_state import Basis, Calibration, State, now
from palpd.daemon.supervisor import JobRun, Report, recording_name, wait
from palpd.errors import Refused, Stopped
from palpd.files import check_folder
from palpd.recording.ring import Ring

GONE_S = 0.8
"""Longest time from a signal to the end of the process. The recording is closed by then; `palpd analyse` makes tables that were cut off."""
TABLES_S = 0.1
"""Shortest time for the tables of an interrupted run, where the end of the loop took longer."""


def job(kind: Kind, config: Config, plan: Plan, dry: bool = False, take_reference: bool = False, choice: Choice | None = None) -> Job:
    """A job with the reference tare and the stiffness that earlier steps have measured.

    Args:
        kind: What to do.
        config: The configuration of the cell.
        plan: The plan of a palpation; other kinds ignore it.
        dry: Whether to read the devices and command nothing.
        take_reference: Whether the run takes its own reference tare.
        choice: Where sites count from, where the palpation before was not finished.

    Raises:
        Refused: A reference tare is needed and missing, or the plan is unsafe for this cell.
        ConfigError: The limits let the expected stiffness overload the sensor.
    """
    if kind == "palpation":
        refuse_together(config, plan)
    state = State(config.paths.state)
    needs_reference = kind not in ("calibrate", "observe", "level_test", "retract") and not take_reference
    if needs_reference and state.calibration() is None:
        raise Refused(
            f"there is no reference tare in {config.paths.state}; run palpd calibrate with the same --config, the probe free and still, "
            "or palpd run with --take-reference"
        )
    return measured_job(kind, config, plan, dry, take_reference, choice)


def measured_job(
    kind: Kind, config: Config, plan: Plan, dry: bool = False, take_reference: bool = False, choice: Choice | None = None
) -> Job:
    """A job with what the state folder knows: reference tare, stiffness of the machine, and the contact that no run has finished.

    Args:
        kind: What to do.
        config: The configuration of the cell.
        dry: Whether to read the devices and command nothing.
        take_reference: Whether the run takes its own reference tare. In a state folder that has none, this is the operator's word for it.
        choice: Where sites count from, where the palpation before was not finished.

    Raises:
        Refused: A retract finds nothing to leave, or nothing to judge the force by; or a palpation lacks the check that it needs, or an
            unfinished one to return to.
        ConfigError: A file of the state folder is damaged.
    """
    state = State(config.paths.state)
    if kind == "palpation" and not dry:
        refuse_unchecked(config, plan, state.last_check(), datetime.now().astimezone())
    stated_N_per_m = config.machine.stiffness_N_per_m
    machine = state.machine_stiffness() if kind == "palpation" and stated_N_per_m is None else None  # no other kind counts with it
    known, calibration = probe_record(config, state), state.calibration()
    last = state.place() if kind == "palpation" else None
    back = last if choice == "return" and last is not None and not last.returned else None
    if choice == "return" and back is None:
        raise Refused(
            "no palpation is unfinished, so there is no start to return to; without this answer sites count from where the arm stands"
        )
    work = Job(
        kind,
        config,
        plan,
        dry,
        machine_stiffness_N_per_m=machine.stiffness_N_per_m if machine is not None else stated_N_per_m,
        machine_serial=machine.sensor_serial if machine is not None else None,
        lifts_first=kind in ("palpation", "free_motion", "stiffness"),
        probe=known,
        confirmed=take_reference and calibration is None,
        last=last,
        choice=choice,
        back_to_m=back.start_m if back is not None else None,
        top_z_m=back.top_z_m if back is not None else -math.inf,
    )
    if kind == "retract" and known.marker is not None:  # it trusts the marker: a reference that was taken since may be wrong
        return replace(work, reference=known.marker.reference, unfinished=True, clear_z_m=known.marker.clear_z_m)
    if kind == "retract" and calibration is None:
        raise Refused("there is no reference tare to judge the force by, and no run is unfinished; free the probe by hand at the pendant")
    if calibration is None or take_reference:
        return work
    if kind == "level_test" and known.marker is not None:
        return replace(work, reference=known.marker.reference)
    return replace(work, reference=calibration.wrench, reference_serial=calibration.sensor_serial, reference_date=calibration.date)


def carry_out(work: Job, build: Build, display: Display, name: str | None = None) -> Report:
    """Do a job from opening the devices to the closed recording. SIGINT, SIGTERM and SIGHUP abort it at any moment.

    It clears the latch of a stop once it has begun, but for a way out of the tissue; a job that is refused leaves it.

    Args:
        build: Opens robot and sensor.
        display: Shows the progress.
        name: File name of the recording without suffix; by default the time and the kind of the job.

    Returns:
        How the job ended; a run that the guard stopped is reported, not raised.

    Raises:
        Refused: The job was refused before anything moved.
        Interrupted: A signal came before anything moved, or after the last motion.
    """
    run: JobRun | None = None
    work = replace(work, clears_latch=work.moves and work.kind not in BEGIN_LOADED)

    def abort() -> None:
        if run is not None:
            run.interrupt(received())

    with held(abort):
        with shielded():
            ring = Ring.create(work.config.robot.rate_Hz)
        with contextlib.closing(ring):
            run = JobRun(work, build, ring, State(work.config.paths.state), name or recording_name(work.kind))
            if received():  # before there was a run
                abort()
            report = _watched(run, work, ring, display)
    if received() and report.exit_code == 0:
        kept = f"; {report.recording} is complete" if report.recording else ""
        raise Interrupted(f"interrupted by {received()} after the last motion{kept}")
    if received() and run.called_off:
        raise Interrupted(report.reason)
    if report.exit_code == 2:
        raise Refused(report.reason)
    if received():
        leave_within(max(TABLES_S, GONE_S - waited_s()), report.reason, report.exit_code)
    return report


def _watched(run: JobRun, work: Job, ring: Ring, display: Display) -> Report:
    """Show the progress until the run is over. A terminal that is gone hides nothing of how it ended."""
    reports: list[Report] = []
    meter = JobMeter(work, ring)
    shown: list[str] = []

    def show_newest(show: ShowProgress) -> None:
        if run.way_back and not shown:
            shown.append(run.way_back)
            display.say(f"{run.way_back[:1].upper()}{run.way_back[1:]}.")
        progress = meter.read()
        if progress is not None:
            show(progress)

    with contextlib.suppress(OSError), display.job(meter.steps) as show:
        reports.append(wait(run, lambda: show_newest(show)))
    return reports[0] if reports else wait(run)


def _declined(_: str) -> bool:
    """Nobody is there to agree."""
    return False


@dataclass(frozen=True, slots=True)
class ForegroundHost:
    """Carries out a program's runs in the foreground; `agree` asks whoever sits at the terminal."""

    config: Config
    build: Build
    display: Display
    agree: Callable[[str], bool] = _declined

    @property
    def operator(self) -> str:
        """Whoever sits at the terminal."""
        return getuser()

    def carry_out(self, kind: Kind, plan: Plan, recording: Path | None = None, take_reference: bool = False, here: bool = False) -> Report:
        """Carry out one run; `ProgramHost` says more.

        Args:
            kind: What to do.
            plan: The plan of a palpation.
            recording: File to record to; None: a name by time and kind.
            take_reference: Whether the run takes its own reference tare.
            here: The operator's word that sites count from where the arm stands.

        Returns:
            How the run ended.
        """
        config = self.config.with_runs(recording.parent) if recording is not None else self.config
        work = job(kind, config, plan, take_reference=take_reference, choice="here" if here else None)
        return carry_out(work, self.build, self.display, recording.stem if recording is not None else None)

    def observe(self, watch_s: float) -> tuple[Finding, ...]:
        """Read both devices for some seconds, and judge them. Raises PalpdError where one does not open."""
        work = replace(job("observe", self.config, Plan()), watch_s=watch_s)
        return carry_out(work, self.build, self.display).findings

    def approve(self, motion: ProposedMotion) -> bool:
        """Show what the motion does, and ask."""
        self.display.say(motion_sentence(motion))
        return self.agree("Record it?")


def motion_sentence(motion: ProposedMotion) -> str:
    """Say what a proposed motion does to the cell."""
    return (
        f"  rehearsed without wires: {motion.duration_s:.0f} s, at most {motion.expected_peak_N:.1f} N of the guard's {motion.limit_N:g} N"
    )


def calibrate(host: ProgramHost, temperature_C: float | None = None, probe_free: bool = False) -> Calibration:
    """Take the reference tare and keep it, where the probe is known to be free.

    Args:
        host: Carries out the run.
        temperature_C: Temperature of the sensor, if known.
        probe_free: The operator's word that the probe is free, where nothing else shows it.

    Returns:
        The tare, as it is kept.

    Raises:
        Refused: A device is absent, or the probe is not free and still, or may not be.
        Stopped: The motion process died.
    """
    report = host.carry_out("calibrate", Plan())
    if report.evidence is None:
        raise Stopped(report.reason or "no reference tare came back")
    state = State(host.config.paths.state)
    before, evidence = state.calibration(), report.evidence
    answer = probe_state(probe_record(host.config, state), evidence)
    basis = _basis(answer, before, probe_free)
    kept_first = basis in ("free", "yes") and before is not None and not before.identity.differences(evidence.identity)
    first = (before.first or before.wrench) if kept_first and before is not None else evidence.wrench
    moved_N = math.dist(first[:3], evidence.wrench[:3])
    if moved_N > MOST_MOVED_REFERENCE_N:
        raise Refused(
            f"the force is {moved_N:.1f} N off the first reference tare of this sensor with this probe, expected at most "
            f"{MOST_MOVED_REFERENCE_N:g} N; palpd level-test goes 5 mm up and shows whether the probe is free"
        )
    identity = evidence.identity
    calibration = Calibration(
        evidence.wrench, now(), identity.sensor_serial, temperature_C,
        probe=identity.probe, tcp=identity.tcp, tilt_rad=evidence.tilt_rad, first=first, basis=basis,
        by=host.operator, away_N=answer.away_N,
    )  # fmt: skip
    state.keep("calibration", calibration)
    return calibration


def _basis(answer: ProbeAnswer, before: Calibration | None, probe_free: bool) -> Basis:
    """Why a reference may be kept. Raises Refused where it may not."""
    if answer.state == ProbeState.FREE:
        return "level" if answer.reasons else "free"
    if "confirm" not in answer.ways:
        raise Refused(f"no reference tare was kept: {answer.sentence}")
    if before is None:
        return "yes" if probe_free else "unconfirmed"  # the first of a state folder: asking for it is the yes
    if not probe_free:
        raise Refused(f"no reference tare was kept: {answer.sentence}")
    return "yes"


def kept_in(folder: Path, kind: str | None = None) -> Path:
    """Make the folder that a command keeps its files in.

    Args:
        folder: The folder, which must be empty unless force is given; with `kind` its parent.
        kind: Name of the command: the folder is then called so, with the time. None: `folder` itself.

    Returns:
        The absolute path.

    Raises:
        BadInput: The folder is not empty.
    """
    folder = folder / f"{kind}-{datetime.now():%Y%m%d-%H%M%S}" if kind else folder
    check_folder(folder, empty=True)
    folder.mkdir(parents=True, exist_ok=True)
    return folder.resolve()
