"""The JSON of a run, with and without wires."""

from typing import Any, NotRequired

from palpd.analysis import results
from palpd.analysis.modulus_notes import give_notes, modulus_notes
from palpd.analysis.results import DryFigures, LoopFigures, SiteResult, cut_short_notes, dry_figures
from palpd.analysis.stalls import stall_figures, stall_note
from palpd.daemon.motion_process import trip_report
from palpd.daemon.simulated_run import SimulatedRecording
from palpd.daemon.socket_client import LastRun
from palpd.daemon.supervisor import LAST_TICKS, Report, last_ticks_of
from palpd.errors import RecordingError
from palpd.history.course import as_columns, points_of, window
from palpd.recording.header import RecordedTrip
from palpd.recording.reader import Recording

NO_WIRES = "the cell was simulated without wires: bytes, timing and faults were not part of it"


class RunResult(LastRun):
    """How a run ended and what it measured. `trips` and `last_ticks` are empty where nothing stopped it.

    A simulated run has its duration, its largest contact force and its `course` too, as `palpd.history.course` gives it.
    """

    trips: list[RecordedTrip]
    sites: list[SiteResult]
    loop: LoopFigures
    model_card: NotRequired[dict[str, Any] | None]
    diagnosis: NotRequired[dict[str, Any]]
    dry: NotRequired[DryFigures | None]
    duration_s: NotRequired[float]
    peak_force_N: NotRequired[float]
    course: NotRequired[dict[str, list[float | None]]]


def run_result(report: Report) -> RunResult:
    """The result of a run: its report, and what its recording says of the loop and of each site."""
    result = RunResult(
        verdict=report.verdict,
        reason=report.reason,
        trips=list(report.trips),
        recording=str(report.recording) if report.recording else None,
        notes=list(report.notes),
        sites=[],
        loop=LoopFigures(ticks=0, missed=0),
        last_ticks=list(report.last_ticks),
    )
    if report.recording is None:
        return result
    try:
        recording = Recording.load(report.recording)
    except RecordingError as error:  # a run that ended before its first tick has a reason of its own, which must not be hidden
        result["notes"].append(str(error))
        return result
    result["loop"] = results.loop_figures(recording.rows)
    stalls = result["loop"]["stalls"] = stall_figures(recording.rows, recording.footer.get("stalls", []))
    if note := stall_note(stalls):
        result["notes"].append(note)
    result["model_card"] = recording.header["model_card"]
    if recording.header["dry"]:
        result["dry"] = dry_figures(recording.rows)
    elif recording.header["kind"] == "palpation":
        result["sites"] = results.sites(recording.rows, recording.header)
        result["notes"] += cut_short_notes(result["sites"], recording.header["config"]["safety"]["contact_limit_N"])
        result["notes"] += modulus_notes(recording.rows, recording.header)
        result["notes"] += give_notes(result["sites"], recording.header["body"]["machine_stiffness_N_per_m"])
    return result


def simulated_result(simulated: SimulatedRecording) -> RunResult:
    """The same of a run without wires."""
    outcome, sites, course = simulated.outcome, results.sites(simulated.rows, simulated.header), points_of(simulated.rows)
    course["t_s"] -= course["t_s"][0]
    return RunResult(
        verdict=outcome.verdict,
        reason=outcome.reason,
        trips=[trip_report(trip) for trip in outcome.trips],
        recording=None,
        notes=[
            NO_WIRES,
            *cut_short_notes(sites, simulated.header["config"]["safety"]["contact_limit_N"]),
            *modulus_notes(simulated.rows, simulated.header),
            *outcome.notes,
        ],
        sites=sites,
        loop={"ticks": outcome.ticks, "missed": outcome.missed},
        last_ticks=list(last_ticks_of(simulated.rows[-LAST_TICKS:])) if outcome.verdict != "done" else [],
        model_card=simulated.header["model_card"],
        duration_s=float(course["t_s"][-1]),
        peak_force_N=float(course["force_high_N"].max()),
        course=as_columns(window(course, 0.0, float(course["t_s"][-1]))),
    )
