"""The programs that can be carried out in the foreground or as a job of the service: their names, arguments and figures.

The service reads this file, so each program imports what it computes with only when it runs.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, StrictBool, StrictFloat, StrictInt, ValidationError

from palpd.cell.effects.drivers import StrictBlock
from palpd.config import Plan, parse_plan
from palpd.daemon.program_host import ProgramHost
from palpd.documents import Document, nearest, refusal
from palpd.errors import BadInput, PalpdError

Length = Annotated[StrictFloat, Field(ge=0.005, le=0.5)]
Depth = Annotated[StrictFloat, Field(ge=0.0002, le=0.02)]


@dataclass(frozen=True, slots=True)
class ProgramEnd:
    """How a program ended: verdict, reason and exit code as of a run, and its figures, which JSON can hold."""

    verdict: str
    reason: str = ""
    exit_code: int = 0
    figures: dict[str, Any] = field(default_factory=dict)


class CalibrateArguments(StrictBlock):
    """Of `palpd calibrate`; `probe_free` is the operator's word that the probe is free."""

    temperature_C: StrictFloat | None = None
    probe_free: StrictBool = False


class FreeMotionArguments(StrictBlock):
    """Of `palpd free-motion`."""

    take_reference: StrictBool = False


class StiffnessArguments(StrictBlock):
    """Of `palpd stiffness`: none."""


class MapArguments(StrictBlock):
    """Of `palpd map` on a robot: the field, from where the arm stands, and the largest number of presses."""

    width_m: Length = 0.06
    height_m: Length = 0.06
    depth_m: Annotated[StrictFloat, Field(ge=0.001, le=0.02)] = 0.005
    inclusion_m: Annotated[StrictFloat, Field(ge=0.002, le=0.1)] = 0.01
    most_presses: Annotated[StrictInt, Field(ge=1, le=1000)] = 200
    here: StrictBool = False


class ResolveArguments(StrictBlock):
    """Of `palpd resolve`: plan of the first recording, content of a cell file, and recordings that exist, by absolute path."""

    plan: dict[str, Any] | None = None
    cell: dict[str, Any] | None = None
    recordings: tuple[str, ...] = ()
    rounds: Annotated[StrictInt, Field(ge=1, le=20)] = 4
    max_depth_m: Depth | None = None
    take_reference: StrictBool = False
    adopted: StrictBool = True
    here: StrictBool = False


class DoctorArguments(StrictBlock):
    """Of `palpd doctor` without a weight."""

    watch_s: Annotated[StrictFloat, Field(ge=1.0, le=600.0)] = 10.0


class CheckArguments(StrictBlock):
    """Of `palpd check`: the temperature of the sensor or the room, where it is known; `here`: the arm stands where a check begins."""

    temperature_C: Annotated[StrictFloat, Field(ge=-50.0, le=100.0)] | None = None
    here: StrictBool = False


class BaselineArguments(StrictBlock):
    """Of `palpd check --new-baseline`: what was changed on purpose."""

    note: str = Field(max_length=1000)


class RecoverArguments(StrictBlock):
    """Of the recovery of a recording that was cut off: its name in the service's runs, without ending."""

    name: str = Field(max_length=1000)


@dataclass(frozen=True)
class JobProgram:
    """One program.

    Attributes:
        name: Name of the command.
        arguments: What it can be given.
        carry_out: Carries it out, given its host, its arguments, and the file or folder that it keeps.
        most_runs: Largest number of runs, by its arguments.
        moves: Whether the arm moves, so that the service must be armed.
        command_arms: Whether its command is the operator's word to arm and to clear the latch of a stop; else both come before it.
        ending: Ending of the file that it keeps; empty for a folder.
    """

    name: str
    arguments: type[StrictBlock]
    carry_out: Callable[[ProgramHost, Any, Path], ProgramEnd]
    most_runs: Callable[[Any], int] = lambda _: 1
    moves: bool = True
    command_arms: bool = True
    ending: str = ""

    def validated(self, values: object) -> StrictBlock:
        """Make arguments of a request's data. Raises BadInput."""
        where = f"the arguments of {self.name}"
        if not isinstance(values, dict):
            raise BadInput(f"{where} are {type(values).__name__}, expected keys and values")
        try:
            return self.arguments.model_validate(values)
        except ValidationError as error:
            raise BadInput(refusal(error, self.arguments, Document(where, values))) from error


def program_named(name: object) -> JobProgram:
    """The program of that name. Raises BadInput."""
    if not isinstance(name, str) or name not in PROGRAMS:
        known = list(PROGRAMS)
        raise BadInput(f"{str(name)[:32]!r} is no program{nearest(str(name)[:32], known)}; expected one of {', '.join(known)}")
    return PROGRAMS[name]


def _calibrate(host: ProgramHost, arguments: CalibrateArguments, _: Path) -> ProgramEnd:
    from dataclasses import asdict

    from palpd.daemon.session import calibrate

    return ProgramEnd(
        "done", figures=asdict(calibrate(host, arguments.temperature_C, arguments.probe_free)) | {"state": str(host.config.paths.state)}
    )


def _free_motion(host: ProgramHost, arguments: FreeMotionArguments, recording: Path) -> ProgramEnd:
    report = host.carry_out("free_motion", Plan(), recording, arguments.take_reference)
    kept = str(report.recording) if report.recording else None
    return ProgramEnd(report.verdict, report.reason, report.exit_code, {"recording": kept, "last_ticks": list(report.last_ticks)})


def _stiffness(host: ProgramHost, _arguments: StiffnessArguments, _: Path) -> ProgramEnd:
    from palpd.daemon.machine_stiffness import measured_stiffness

    report, machine = measured_stiffness(host)
    figures: dict[str, Any] = {"recording": str(report.recording) if report.recording else None, "last_ticks": list(report.last_ticks)}
    if machine is None:
        return ProgramEnd(report.verdict, report.reason, report.exit_code or 3, figures)
    figures |= {"stiffness_N_per_m": machine.stiffness_N_per_m, "ci95_N_per_m": list(machine.ci95_N_per_m)}
    return ProgramEnd("done", figures=figures)


def _map(host: ProgramHost, arguments: MapArguments, picture: Path) -> ProgramEnd:
    from palpd.analysis.stiffness_map import Field as MapField
    from palpd.analysis.stiffness_map import draw
    from palpd.daemon.stiffness_survey import figures_of, on_the_robot, surveyed

    values = arguments.model_dump(exclude={"most_presses", "here"})
    where = MapField(**values)
    mapped = surveyed(on_the_robot(where, host, arguments.here), where, picture, host.display, arguments.most_presses)
    draw(mapped.survey, mapped.survey.map(), picture)
    figures = figures_of(mapped)
    return ProgramEnd(figures["verdict"], mapped.stop_reason, 3 if mapped.stop_reason else 0, {**figures, "picture": str(picture)})


def _resolve(host: ProgramHost, arguments: ResolveArguments, folder: Path) -> ProgramEnd:
    from palpd.cell.cell_file import parse_cell
    from palpd.cell.effects.adopted import user_folder
    from palpd.daemon import resolve
    from palpd.gap.commands import library

    known = library(None, adopted=user_folder() if arguments.adopted else None)
    plan = parse_plan(arguments.plan, "the plan of the first recording") if arguments.plan is not None else resolve.STANDARD
    if arguments.cell is not None:
        cell = parse_cell(arguments.cell, "the cell of the job", known)
    else:
        cell = host.config.cell.assumed_at_site(plan.sites[0].name)
    folder.mkdir(parents=True, exist_ok=True)
    setting = resolve.Setting(host, cell, folder, known, arguments.max_depth_m, arguments.take_reference, arguments.here)
    resolution = resolve.resolve(setting, plan, [Path(path) for path in arguments.recordings], arguments.rounds)
    return ProgramEnd(resolution["verdict"], resolution["reason"], 3 if resolution["verdict"] == "stopped" else 0, {**resolution})


def _doctor(host: ProgramHost, arguments: DoctorArguments, _: Path) -> ProgramEnd:
    from palpd.daemon.doctor import as_json, examined_without_devices
    from palpd.daemon.finding import Finding

    findings = examined_without_devices(host.config)
    try:
        findings += host.observe(arguments.watch_s)
    except PalpdError as error:
        findings.append(Finding("devices", "fail", str(error)))
    return ProgramEnd("done", figures={**as_json(findings)})


def _check(host: ProgramHost, arguments: CheckArguments, _: Path) -> ProgramEnd:
    from palpd.daemon.morning_check import morning_check

    report, figures = morning_check(host, arguments.temperature_C, arguments.here)
    if figures is None:
        return ProgramEnd(report.verdict, report.reason, report.exit_code or 3, {"last_ticks": list(report.last_ticks)})
    return ProgramEnd("done", figures=figures)


def _baseline(host: ProgramHost, arguments: BaselineArguments, _: Path) -> ProgramEnd:
    from palpd.daemon.morning_check import renewed_baseline

    return ProgramEnd("done", figures=renewed_baseline(host.config, arguments.note))


def _recover(host: ProgramHost, arguments: RecoverArguments, _: Path) -> ProgramEnd:
    from palpd.history.stored import unfinished_recordings
    from palpd.recording.recovery import recover

    folder = host.config.paths.runs
    part = unfinished_recordings(folder).get(arguments.name)
    if part is None:
        raise BadInput(f"no unfinished recording in {folder} is called {arguments.name[:80]!r}, or a run still writes it; reload the list")
    recovered = recover(part)
    return ProgramEnd("done", recovered.sentence, figures={"recording": str(recovered.path)})


PROGRAMS: Mapping[str, JobProgram] = {
    program.name: program
    for program in (
        JobProgram("calibrate", CalibrateArguments, _calibrate, moves=False),
        JobProgram("free-motion", FreeMotionArguments, _free_motion, ending=".mcap"),
        JobProgram("stiffness", StiffnessArguments, _stiffness),
        JobProgram("map", MapArguments, _map, lambda arguments: arguments.most_presses, ending=".png"),
        JobProgram("resolve", ResolveArguments, _resolve, lambda arguments: arguments.rounds),
        JobProgram("doctor", DoctorArguments, _doctor, moves=False),
        JobProgram("check", CheckArguments, _check, lambda _: 2, command_arms=False),
        JobProgram("baseline", BaselineArguments, _baseline, lambda _: 0, moves=False),
        JobProgram("recover", RecoverArguments, _recover, lambda _: 0, moves=False),
    )
}
"""All programs, by name."""
