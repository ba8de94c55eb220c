"""`palpd check`: press plate and puck, measure what they show, and compare with the days before.

It consists of runs that exist: presses of a plate, and a palpation with free strokes. So guard, tare, probe and consent are theirs.
"""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from palpd.config import Config, Plan
from palpd.daemon.motion_job import Kind
from palpd.daemon.program_host import ProgramHost
from palpd.daemon.required_check import PUCK, check_plan
from palpd.daemon.stored_state import LastCheck, State, now
from palpd.daemon.supervisor import Report
from palpd.errors import BadInput, PalpdError, Refused
from palpd.history.check_days import Baseline, MorningCheck, gone, judge_today, keep_check, kept_checks, since_baseline
from palpd.history.check_features import features_of
from palpd.history.control_charts import WATCHED, CheckedDay, judged
from palpd.recording.reader import Recording, samples_of
from palpd.recording.samples import Samples


def morning_check(host: ProgramHost, temperature_C: float | None, here: bool = False) -> tuple[Report, dict[str, Any] | None]:
    """Check the cell, and keep what was measured beside the recording.

    Args:
        host: Carries out the runs.
        temperature_C: Of the sensor or the room; None where nobody knows.
        here: The operator's word that the arm stands where a check begins, whatever palpation was not finished.

    Returns:
        The report of the last run, and the figures of the check; None where a run was stopped.

    Raises:
        Refused: Nothing was moved. The arm may stand elsewhere than above the plate.
        PalpdError: The devices refuse, or the recordings show no press.
    """
    config, state = host.config, State(host.config.paths.state)
    runs: list[tuple[Kind, Plan]] = [("palpation", check_plan(config))]
    if config.check.plate:
        if not here:
            _refuse_elsewhere(state)
        runs.insert(0, ("stiffness", Plan()))
    kept = kept_checks(config.paths.runs)  # what is damaged is said before a motion
    before = state.last_check()
    last = before.number if before is not None else 0
    state.keep("check", LastCheck(now(), "open", "It did not come to its end.", last))  # what a death of this program leaves behind
    recordings: list[Path] = []
    for kind, plan in runs:
        try:
            report = host.carry_out(kind, plan, here=here)
        except PalpdError as error:
            if not recordings and error.exit_code == 2:  # nothing was moved
                state.put_back("check", before)
            raise
        if report.exit_code or report.recording is None:
            _keep_unfinished(state, report.reason, last)
            return report, None
        recordings.append(report.recording)
    *plates, puck = recordings
    plate = plates[0] if plates else None
    try:
        features = features_of(Recording.load(puck), Recording.load(plate) if plate is not None else None)
    except PalpdError as error:
        _keep_unfinished(state, str(error), last)
        raise
    day = CheckedDay(now(), features, temperature_C)
    verdict, healthy, note = judge_today(kept, day, config.check.tolerances)
    number = 1 + max([last, *(earlier.number for _, earlier in kept)])
    check = MorningCheck(day, verdict, plate.name if plate is not None else None, note=note, number=number)
    first = since_baseline([*kept, (puck, check)])[0][1]
    check = replace(check, note=f"{note} {gone(first, config.paths.runs)}".strip())
    keep_check(puck, check)
    _keep_last(state, check)
    if verdict.changes and healthy:
        with host.display.waiting("comparing with the healthy recordings"):
            try:
                check = replace(check, diagnosis=compared([_samples(path) for path in healthy], _samples(puck)))
                keep_check(puck, check)
            except PalpdError as error:
                host.display.say(f"The recordings were not compared: {error}.")
    return report, figures_of(puck, check)


def renewed_baseline(config: Config, note: str) -> dict[str, Any]:
    """Say that what the last check shows is on purpose, and let it be the first of a new baseline. Moves nothing.

    Args:
        note: Why, for who looks at the charts later.

    Raises:
        BadInput: There is no check, the last one did not come to its end, the note is empty, or a file cannot be written.
    """
    if not note.strip():
        raise BadInput("the note of a new baseline is empty, expected what was changed; give it")
    checks = kept_checks(config.paths.runs)
    if not checks:
        raise BadInput(f"there is no check in {config.paths.runs}, expected the one that shows the change; run palpd check first")
    recording, last = checks[-1]
    state = State(config.paths.state)
    ended = state.last_check()
    if ended is not None and ended.date != last.day.date:
        dates = last.day.date[:16], ended.date[:16]
        raise BadInput(f"the last finished check is of {dates[0]}, and the one of {dates[1]} is not; repeat palpd check first")
    verdict = judged([last.day], config.check.tolerances)[0]
    check = replace(last, verdict=verdict, baseline=Baseline(now(), note.strip()), diagnosis=None, note="")
    keep_check(recording, check)
    _keep_last(state, check)
    return figures_of(recording, check)


def figures_of(recording: Path, check: MorningCheck) -> dict[str, Any]:
    """What `palpd check --json` holds."""
    verdict = check.verdict
    return {
        "recording": str(recording),
        "plate": check.plate,
        "date": check.day.date,
        "temperature_C": check.day.temperature_C,
        "level": verdict.level,
        "sentence": verdict.sentence,
        "note": check.note,
        "causes": list(verdict.causes),
        "features": asdict(check.day.features),
        "figures": [asdict(point) | {"words": WATCHED[point.figure].words, "unit": WATCHED[point.figure].unit} for point in verdict.points],
        "changes": [point.sentence for point in verdict.changes],
        "diagnosis": check.diagnosis,
        "named": list(check.named),
        "baseline": asdict(check.baseline) if check.baseline is not None else None,
    }


def compared(healthy: list[Samples], today: Samples) -> dict[str, Any]:
    """What `palpd diagnose --healthy` says of the puck's recording: the effects that it names, and its sentences.

    Args:
        healthy: Recordings of healthy days.
        today: Recording of the day that differs.

    Raises:
        RecordingError: The recordings cannot be judged.
    """
    from palpd.gap.commands import library, since_healthy
    from palpd.gap.diagnosis import diagnose

    nominal, known, simulators = since_healthy(healthy, None, library(None), [today])
    answer = diagnose([today], nominal, known, propose=False, simulators=simulators).to_json()
    return {name: answer[name] for name in ("verdict", "effects", "plain") if name in answer}


def _refuse_elsewhere(state: State) -> None:
    """Refuse to press a plate where the last palpation did not end where it began: the tip may stand above a specimen. Raises Refused."""
    last = state.place()
    if last is not None and not last.returned:
        raise Refused(
            f"nothing was moved: the run {last.run} of {last.date} was not finished, so the arm may not stand above the plate; move it "
            "there, and repeat the check with --here"
        )


def _keep_unfinished(state: State, reason: str, last: int) -> None:
    """A check that was stopped counts as no check, whatever the one before it gave."""
    state.keep("check", LastCheck(now(), "stop", f"It did not come to its end: {reason}.", last))


def _keep_last(state: State, check: MorningCheck) -> None:
    """Keep what a palpation asks for."""
    state.keep("check", LastCheck(check.day.date, check.verdict.level, check.verdict.sentence, check.number))


def _samples(recording: Path) -> Samples:
    return samples_of(Recording.load(recording), PUCK, at_reports=True)
