"""`palpd resolve`: diagnose a running cell, propose the motion that separates the open explanations, and run it if the operator agrees.

It diagnoses all recordings jointly, and repeats this until one explanation is left or no motion promises a gain.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import log
from pathlib import Path
from typing import Any, TypedDict

import yaml

from palpd.cell.cell_file import CellFile, save_cell
from palpd.cell.effects import Effect
from palpd.config import Plan, PlanSite, parse_plan
from palpd.daemon import simulated_run
from palpd.daemon.motion_job import Job
from palpd.daemon.program_host import ProgramHost, ProposedMotion
from palpd.errors import BadInput
from palpd.files import write_yaml
from palpd.gap.advise.motions import MotionLimits
from palpd.gap.advise.next_experiment import Advice, advise
from palpd.gap.commands import write_answer
from palpd.gap.decide import BeyondList
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.infer.posterior import Attribution
from palpd.gap.report.page import write as write_report
from palpd.recording.reader import Recording, export
from palpd.recording.samples import Samples, common_site, read

STANDARD = Plan(sites=(PlanSite(name="A"),), depths_m=(0.004, 0.006), hold_s=3.0, repeats=2)
"""The first recording where none is given: the way down, the search, two holds, four presses in motion, and the way back."""

FORCE_SHARE = 0.75
"""Share of the contact limit that a proposed press may be expected to reach after a long hold. The rest is a margin below the guard."""

LEAST_SHARE = 1e-6
"""Probability of an explanation that a diagnosis has dropped: an upper bound."""


@dataclass(frozen=True)
class Round:
    """One recording and its diagnosis: the explanations that are still open, the expected gain and the gain.

    `gained` is the change of the log odds of the `pair` that the motion should separate, positive if the leading explanation gained.
    It is a lower bound if one of the two was dropped (`settled`). In a `reversal` the other explanation leads now.
    """

    number: int
    recording: str
    duration_s: float
    verdict: str
    sentence: str
    open: dict[str, float]
    pair: tuple[str, str] | None = None
    expected_gain: float | None = None
    gained: float | None = None
    reversal: bool = False
    settled: bool = False


class Resolution(TypedDict):
    """How `palpd resolve` ended: each round, the last diagnosis (out.json), and the folder of all files."""

    verdict: str
    reason: str
    resolved: bool
    rounds: list[dict[str, Any]]
    diagnosis: dict[str, Any] | None
    folder: str


@dataclass
class Setting:
    """Everything that the rounds share: the host that carries out runs, the nominal cell, the folder, and the known effects.

    `here` is the operator's word that the site counts from where the arm stands, whatever palpation was not finished.
    """

    host: ProgramHost
    cell: CellFile
    folder: Path
    library: Mapping[str, Effect]
    max_depth_m: float | None = None
    take_reference: bool = False
    here: bool = False


@dataclass(frozen=True)
class Rehearsal:
    """A proposed plan, carried out without wires on the enriched cell. `refusal` says why the real cell must not do it, if so."""

    duration_s: float = 0.0
    peak_N: float = 0.0
    refusal: str = ""


def resolve(setting: Setting, plan: Plan = STANDARD, recordings: Sequence[Path] = (), rounds: int = 4) -> Resolution:
    """Record and diagnose until one explanation is left, or no motion promises a gain.

    Args:
        setting: Host, cell and folder.
        plan: Plan of the first recording, with one site; not carried out if there are recordings.
        recordings: Recordings that exist already.
        rounds: Largest number of recordings to make.

    Returns:
        The rounds and the last diagnosis.

    Raises:
        BadInput: The plan has several sites.
        Refused: The cell is not ready for a run.
    """
    if len(plan.sites) != 1:
        raise BadInput(f"the plan has {len(plan.sites)} sites; a cell is judged at one, so give a plan with one site")
    say = setting.host.display.say
    samples = [read(path) for path in recordings]
    if (named := common_site(samples)) is not None and named != plan.sites[0].name:
        if plan != STANDARD:
            raise BadInput(f"the recordings are of site {named}, and the plan presses {plan.sites[0].name}; give a plan of site {named}")
        plan = plan.model_copy(update={"sites": (PlanSite(name=named),)})
    names = [path.name for path in recordings]
    history: list[Round] = []
    advice: Advice | None = None
    before: Attribution | None = None
    number, next_plan = 0, plan
    while True:
        if not samples or advice is not None:
            number += 1
            if advice is None:
                _written(setting, next_plan, number)
            stop_reason, recorded = _record(setting, next_plan, number)
            if recorded is None:
                return _resolution(setting, history, "stopped", stop_reason)
            samples.append(recorded)
            names.append(f"round-{number}.csv")
        with setting.host.display.waiting("diagnosing"):
            diagnosis = diagnose(samples, setting.cell, setting.library, propose=False)
            new = advise(diagnosis.problem, diagnosis.attribution, _limits(setting, diagnosis), _beyond_list(diagnosis))
        diagnosis = replace(diagnosis, proposal=new.proposal)
        history.append(_round(number, names[-1], samples[-1], diagnosis, new, advice, before))
        for line in _lines_of(history[-1]):
            say(line)
        _keep(setting, diagnosis, number, names)
        end = _end(diagnosis, new, number, rounds)
        if end:
            say(end)
            return _resolution(setting, history, "done", end, diagnosis)
        advice, before = new, diagnosis.attribution
        next_plan = _plan_of(advice, plan.sites[0])
        say(f"Next: {advice.sentence}")
        say(f"  the plan: {_written(setting, next_plan, number + 1)}")
        rehearsal = _rehearsed(setting, diagnosis, next_plan)
        if rehearsal.refusal:
            return _resolution(setting, history, "stopped", rehearsal.refusal, diagnosis)
        if not setting.host.approve(_proposed(setting, diagnosis, advice, next_plan, rehearsal)):
            say(f"Not recorded; still open: {_odds_text(advice)}.")
            return _resolution(setting, history, "declined", "the operator declined the proposed motion", diagnosis)


def _end(diagnosis: Diagnosis, advice: Advice, recorded: int, rounds: int) -> str:
    """Why the loop is over; empty while it is not."""
    if diagnosis.verdict == "none":
        return f"Resolved: no gap beyond the cell's own tolerances (probability {diagnosis.decision.p_none:.2f})."
    if diagnosis.resolved:
        return f"Resolved: {' and '.join(effect.id for effect in diagnosis.effects)}."
    beyond = _beyond_list(diagnosis)
    if advice.proposal is None and advice.pair is None and beyond is not None and beyond.law is not None:
        return f"Resolved: {beyond.law.learned.id}, a law outside the list, which holds in all recordings."
    if advice.proposal is None:
        return advice.sentence
    return f"All {rounds} allowed recordings were made; still open: {_odds_text(advice)}." if recorded >= rounds else ""


def _beyond_list(diagnosis: Diagnosis) -> BeyondList | None:
    """What the search for laws found, where that is the verdict."""
    return diagnosis.decision.beyond if diagnosis.verdict == "unknown" else None


def _limits(setting: Setting, diagnosis: Diagnosis) -> MotionLimits:
    """The guard's limits. A motion goes no deeper than recorded before, unless that is allowed, and no higher than the workspace."""
    safety, known = setting.host.config.safety, MotionLimits.of(diagnosis.problem)
    surface_m = setting.cell.tissue.surface_z_m if setting.cell.tissue is not None else 0.0
    home_m = max(float(s.z_m.max()) for s in (one.samples for one in diagnosis.problem.recordings)) - surface_m
    room_m = safety.workspace_m[2][1] - surface_m - home_m if safety.workspace_m is not None else known.stroke_m
    return replace(
        known,
        depth_m=setting.max_depth_m or known.depth_m,
        force_N=FORCE_SHARE * safety.contact_limit_N,
        home_m=home_m,
        stroke_m=min(0.02, max(room_m, 0.001)),
        press_speed_m_per_s=min(known.press_speed_m_per_s, safety.max_speed_m_per_s, 0.05),
        free_speed_m_per_s=safety.max_speed_m_per_s,
        acceleration_m_per_s2=setting.host.config.robot.acceleration_m_per_s2,
    )


def _plan_of(advice: Advice, site: PlanSite) -> Plan:
    assert advice.proposal is not None
    return parse_plan({"sites": [site.model_dump()]} | advice.proposal.plan, "the proposed plan")


def _record(setting: Setting, plan: Plan, number: int) -> tuple[str, Samples | None]:
    """Carry out a plan with the daemon and export its site. Returns the reason where the run was stopped, and the samples."""
    recording = setting.folder / f"round-{number}.mcap"
    report = setting.host.carry_out("palpation", plan, recording, setting.take_reference, setting.here)
    if report.exit_code or report.recording is None:
        return report.reason or "nothing was recorded", None
    return "", export(Recording.load(report.recording), setting.folder / f"round-{number}.csv", plan.sites[0].name)


def _written(setting: Setting, plan: Plan, number: int) -> Path:
    """Write a plan to a file that `palpd run` also takes."""
    path = setting.folder / f"plan-{number}.yaml"
    write_yaml(path, yaml.safe_dump(plan.model_dump(mode="json", exclude_none=True), sort_keys=False))
    return path


def _rehearsed(setting: Setting, diagnosis: Diagnosis, plan: Plan) -> Rehearsal:
    """Carry out the plan without wires on the enriched cell."""
    config = setting.host.config
    with setting.host.display.waiting("rehearsing without wires"):
        rehearsal = simulated_run.run(
            Job("palpation", config, plan),
            diagnosis.enriched_cell(),
            home_above_m=_limits(setting, diagnosis).home_m,
            library=setting.library,
        )
    if rehearsal.outcome.verdict != "done":
        reason = rehearsal.outcome.reason
        return Rehearsal(refusal=f"the proposed motion was rehearsed without wires and stopped there ({reason}); it is not carried out")
    peak_N = float(rehearsal.rows["force_N"][rehearsal.rows["site"] >= 0].max())
    return Rehearsal(len(rehearsal.rows) / config.robot.rate_Hz, peak_N)


def _proposed(setting: Setting, diagnosis: Diagnosis, advice: Advice, plan: Plan, rehearsal: Rehearsal) -> ProposedMotion:
    return ProposedMotion(
        gap=diagnosis.sentence,
        decides=f"{advice.sentence} Still open: {_odds_text(advice)}.",
        duration_s=rehearsal.duration_s,
        expected_peak_N=rehearsal.peak_N,
        limit_N=setting.host.config.safety.contact_limit_N,
        plan=plan.model_dump(mode="json", exclude_none=True),
    )


def _round(
    number: int, name: str, samples: Samples, diagnosis: Diagnosis, new: Advice, advice: Advice | None, before: Attribution | None
) -> Round:
    shares = {name: float(share) for name, share in zip(new.names, new.shares, strict=True)}
    this = Round(number, name, samples.duration_s, diagnosis.verdict, diagnosis.sentence, shares)
    if advice is None or advice.proposal is None or advice.pair is None or before is None:
        return this
    if not {one.name for one in before.hypotheses}.issuperset(advice.pair):
        return this  # laws outside the list have no odds in that table
    old, now = log_odds(before, advice.pair), log_odds(diagnosis.attribution, advice.pair)
    towards_leader = 1.0 if old >= 0 else -1.0
    settled = min(_share(diagnosis.attribution, explanation) for explanation in advice.pair) < LEAST_SHARE
    gained, expected = towards_leader * (now - old), advice.proposal.expected_gain
    return replace(this, pair=advice.pair, expected_gain=expected, gained=gained, reversal=old * now < 0, settled=settled)


def log_odds(attribution: Attribution, pair: tuple[str, str]) -> float:
    """Log odds of two explanations.

    Args:
        attribution: The probabilities of a diagnosis.
        pair: The two explanations, as Advice names them.

    Returns:
        The natural logarithm of the first probability over the second.
    """
    first, second = (max(_share(attribution, name), LEAST_SHARE) for name in pair)
    return log(first / second)


def _share(attribution: Attribution, name: str) -> float:
    """Probability of an explanation; zero where it was dropped."""
    return next((w.share for w in attribution.hypotheses if w.name == name), 0.0)


def _lines_of(this: Round) -> list[str]:
    lines = ["", f"Recording {this.recording} ({this.duration_s:.0f} s): {this.sentence}"]
    if this.pair is not None and this.gained is not None:
        reversal = "; the other explanation leads now" if this.reversal else ""
        pair = f"{this.pair[0]} and {this.pair[1]}, expected at least {this.expected_gain:.1f}{reversal}"
        lines.append(f"  gained {'at least ' * this.settled}{this.gained:+.1f} nats between {pair}")
    if len(this.open) > 1:
        lines.append(f"  still open: {', '.join(f'{name} {share:.2f}' for name, share in this.open.items())}")
    return lines


def _odds_text(advice: Advice) -> str:
    return ", ".join(f"{name} {share:.2f}" for name, share in zip(advice.names, advice.shares, strict=True))


def _keep(setting: Setting, diagnosis: Diagnosis, number: int, names: Sequence[str]) -> None:
    """Write the newest answer, its page and the enriched cell."""
    write_answer(setting.folder / f"diagnosis-{number}.json", diagnosis)
    write_report(setting.folder / "gap.html", diagnosis, ", ".join(names))
    save_cell(setting.folder / "enriched.yaml", diagnosis.cell_with_uncertainty())


def _resolution(setting: Setting, history: Sequence[Round], verdict: str, reason: str, diagnosis: Diagnosis | None = None) -> Resolution:
    return {
        "verdict": verdict,
        "reason": reason,
        "resolved": verdict == "done" and reason.startswith("Resolved"),
        "rounds": [asdict(each) for each in history],
        "diagnosis": diagnosis.to_json() if diagnosis is not None else None,
        "folder": str(setting.folder),
    }
