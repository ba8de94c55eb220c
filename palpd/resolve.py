"""`palpd resolve`: diagnose a running cell, propose the motion that decides what is open, run it if the operator agrees, diagnose jointly,
until nothing is open or nothing more can be gained."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import log
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from palpd import sim
from palpd.cell_file import CellFile, save_cell
from palpd.config import Config, Plan, Site, parse_plan
from palpd.effects import Effect
from palpd.errors import BadInput
from palpd.gap.attribute import Attribution
from palpd.gap.commands import write_answer
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.experiment import Advice, Limits, advise
from palpd.gap.report import write as write_report
from palpd.motion import Build, Job
from palpd.record import Recording, export
from palpd.samples import Samples, read
from palpd.session import carry_out, job

STANDARD = Plan(sites=(Site(name="A"),), depths_m=(0.004, 0.006), hold_s=3.0, repeats=2)
"""The first recording, where none is given: the search, two holds, four presses in motion, with the way down from the start and back."""

FORCE_SHARE = 0.75
"""Of the contact limit a proposed press may be expected to need so much after a long hold; the guard stands above it."""

LEAST_SHARE = 1e-6
"""An explanation that a diagnosis has dropped had less than this."""


@dataclass(frozen=True)
class Round:
    """One recording more: what is open after it, what it was expected to bring, and what it brought.

    `gained` is the change of the log odds between the `pair` that it was to tell apart, counted for the one that was ahead before, a lower
    bound where one of them is out of the question since (`settled`); a `reversal` is a pair whose order has changed.
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


@dataclass
class Setting:
    """What a loop is carried out with: the daemon's configuration and devices, the nominal cell, and the operator's word."""

    config: Config
    build: Build
    cell: CellFile
    folder: Path
    console: Console
    agree: Callable[[str], bool]
    library: Mapping[str, Effect]
    max_depth_m: float | None = None
    take_reference: bool = False


def resolve(setting: Setting, plan: Plan = STANDARD, recordings: Sequence[Path] = (), rounds: int = 4) -> dict[str, Any]:
    """Carry out the loop; at most `rounds` recordings besides those that are given. Returns what `--json` holds.

    Raises BadInput for a plan of several sites, Refused as `palpd run` does.
    """
    if len(plan.sites) != 1:
        raise BadInput(f"the plan has {len(plan.sites)} sites; a cell is judged at one, so give a plan with one site")
    say = setting.console.print
    samples = [read(path) for path in recordings]
    names = [path.name for path in recordings]
    told: list[Round] = []
    advice: Advice | None = None
    before: Attribution | None = None
    made, reason, wanted = 0, "", plan
    while True:
        if not samples or advice is not None:
            if advice is None:
                _written(setting, wanted, made + 1)
            report_reason, recorded = _record(setting, wanted, made + 1)
            made += 1
            if recorded is None:
                return _found(setting, told, "stopped", report_reason)
            samples.append(recorded)
            names.append(f"round-{made}.csv")
        with setting.console.status("diagnosing"):
            found = diagnose(samples, setting.cell, setting.library, propose=False)
            new = advise(found.problem, found.attribution, _limits(setting, found))
        found = replace(found, proposal=new.proposal)
        told.append(_round(made, names[-1], samples[-1], found, new, advice, before))
        _tell(say, told[-1])
        _keep(setting, found, made, names)
        reason = _end(found, new, made, rounds)
        if reason:
            say(reason, highlight=False)
            return _found(setting, told, "done", reason, found)
        advice, before = new, found.attribution
        wanted = _plan_of(advice, plan.sites[0])
        say(f"Next: {advice.sentence}", highlight=False)
        say(f"  the plan: {_written(setting, wanted, made + 1)}", highlight=False, soft_wrap=True)
        refusal = _rehearsed(setting, found, wanted)
        if refusal:
            return _found(setting, told, "stopped", refusal, found)
        if not setting.agree("Record it?"):
            say(f"Not recorded; still open: {_odds_text(advice)}.", highlight=False)
            return _found(setting, told, "declined", "the operator did not want the proposed motion", found)


def _end(found: Diagnosis, advice: Advice, made: int, rounds: int) -> str:
    """Why the loop is over; empty while it is not."""
    if found.verdict == "none":
        return f"Resolved: no gap beyond the cell's own tolerances (probability {found.p_none:.2f})."
    if found.resolved:
        return f"Resolved: {' and '.join(e.id for e in found.effects)}."
    if advice.proposal is None:
        return advice.sentence
    return f"The {rounds} recordings that were allowed are made; still open: {_odds_text(advice)}." if made >= rounds else ""


def _limits(setting: Setting, found: Diagnosis) -> Limits:
    """The guard's limits; never deeper than recorded before unless that is allowed, and never higher than the workspace."""
    safety, known = setting.config.safety, Limits.of(found.problem)
    surface_m = setting.cell.tissue.surface_z_m if setting.cell.tissue is not None else 0.0
    home_m = max(float(s.z_m.max()) for s in (run.samples for run in found.problem.runs)) - surface_m
    room_m = safety.workspace_m[2][1] - surface_m - home_m if safety.workspace_m is not None else known.stroke_m
    return replace(
        known,
        depth_m=setting.max_depth_m or known.depth_m,
        force_N=FORCE_SHARE * safety.contact_limit_N,
        home_m=home_m,
        stroke_m=min(0.02, max(room_m, 0.001)),
        press_speed_m_per_s=min(known.press_speed_m_per_s, safety.max_speed_m_per_s, 0.05),
        free_speed_m_per_s=safety.max_speed_m_per_s,
        acceleration_m_per_s2=setting.config.robot.acceleration_m_per_s2,
    )


def _plan_of(advice: Advice, site: Site) -> Plan:
    assert advice.proposal is not None
    return parse_plan({"sites": [site.model_dump()]} | advice.proposal.plan, "the proposed plan")


def _record(setting: Setting, plan: Plan, number: int) -> tuple[str, Samples | None]:
    """Carry out a plan with the daemon and export its site; the reason if it did not come to its end."""
    work = job("palpation", setting.config, plan, take_reference=setting.take_reference)
    report = carry_out(work, setting.build, setting.console, f"round-{number}")
    if report.exit_code or report.recording is None:
        return report.reason or "nothing was recorded", None
    return "", export(Recording.load(report.recording), setting.folder / f"round-{number}.csv", plan.sites[0].name)


def _written(setting: Setting, plan: Plan, number: int) -> Path:
    """Keep a plan; `palpd run` takes it too."""
    path = setting.folder / f"plan-{number}.yaml"
    path.write_text(yaml.safe_dump(plan.model_dump(mode="json", exclude_none=True), sort_keys=False), encoding="utf-8")
    return path


def _rehearsed(setting: Setting, found: Diagnosis, plan: Plan) -> str:
    """Do the plan without wires on the cell as far as it is known; why it must not be done on the real one, or nothing."""
    with setting.console.status("rehearsing without wires"):
        job_there = Job("palpation", setting.config, plan)
        done = sim.run(job_there, found.enriched_cell(), home_above_m=_limits(setting, found).home_m, library=setting.library)
    if done.outcome.verdict != "done":
        return f"the proposed motion was rehearsed without wires and stopped there ({done.outcome.reason}); it is not carried out"
    rows = done.rows[done.rows["site"] >= 0]
    peak_N = float(rows["force_N"].max())
    duration_s = len(done.rows) / setting.config.robot.rate_Hz
    allowed = f"{peak_N:.1f} N of the guard's {setting.config.safety.contact_limit_N:g} N"
    setting.console.print(f"  rehearsed without wires: {duration_s:.0f} s, at most {allowed}", highlight=False)
    return ""


def _round(
    number: int, name: str, samples: Samples, found: Diagnosis, new: Advice, advice: Advice | None, before: Attribution | None
) -> Round:
    shares = {n: float(p) for n, p in zip(new.names, new.shares, strict=True)}
    one = Round(number, name, samples.duration_s, found.verdict, found.sentence, shares)
    if advice is None or advice.proposal is None or advice.pair is None or before is None:
        return one
    old, now = log_odds(before, advice.pair), log_odds(found.attribution, advice.pair)
    ahead = 1.0 if old >= 0 else -1.0
    settled = min(_share(found.attribution, name) for name in advice.pair) < LEAST_SHARE
    gained, expected = ahead * (now - old), advice.proposal.expected_gain
    return replace(one, pair=advice.pair, expected_gain=expected, gained=gained, reversal=old * now < 0, settled=settled)


def log_odds(attribution: Attribution, pair: tuple[str, str]) -> float:
    """Log odds of the first explanation (as Advice names it) against the second."""
    first, second = (max(_share(attribution, name), LEAST_SHARE) for name in pair)
    return log(first / second)


def _share(attribution: Attribution, name: str) -> float:
    """What an explanation holds, nothing where it has been dropped."""
    return next((w.share for w in attribution.weighed if w.name == name), 0.0)


def _tell(say: Callable[..., None], one: Round) -> None:
    say(f"\n[bold]Recording {one.recording}[/] ({one.duration_s:.0f} s): {one.sentence}", highlight=False)
    if one.pair is not None and one.gained is not None:
        turned = ", and the order of the two has changed" if one.reversal else ""
        between = f"{one.pair[0]} and {one.pair[1]}, expected at least {one.expected_gain:.1f}{turned}"
        say(f"  gained {'at least ' * one.settled}{one.gained:+.1f} nats between {between}", highlight=False)
    if len(one.open) > 1:
        say(f"  still open: {', '.join(f'{name} {share:.2f}' for name, share in one.open.items())}", highlight=False)


def _odds_text(advice: Advice) -> str:
    return ", ".join(f"{name} {share:.2f}" for name, share in zip(advice.names, advice.shares, strict=True))


def _keep(setting: Setting, found: Diagnosis, number: int, names: Sequence[str]) -> None:
    """The newest answer, its page and the enriched cell."""
    write_answer(setting.folder / f"diagnosis-{number}.json", found)
    write_report(setting.folder / "gap.html", found, ", ".join(names))
    save_cell(setting.folder / "enriched.yaml", found.enriched_cell())


def _found(setting: Setting, told: Sequence[Round], verdict: str, reason: str, found: Diagnosis | None = None) -> dict[str, Any]:
    resolved = verdict == "done" and reason.startswith("Resolved")
    last = found.to_json() if found is not None else None
    return {
        "verdict": verdict,
        "reason": reason,
        "resolved": resolved,
        "rounds": [asdict(one) for one in told],
        "diagnosis": last,
        "folder": str(setting.folder),
    }

