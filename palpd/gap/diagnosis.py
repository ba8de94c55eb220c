"""The diagnosis of a cell from its recordings: where the gap lies, which effects explain it, how far it shrinks, what to do next."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from palpd.cell_file import CellFile, EffectValues
from palpd.effects import EFFECTS, Effect
from palpd.errors import RecordingError
from palpd.gap.attribute import Attribution, attribute
from palpd.gap.experiment import Proposal, next_experiment
from palpd.gap.hypothesis import Fit
from palpd.gap.localise import Gap, bands, change_sizes, gap_table, most_excess, residuals, trend
from palpd.gap.noise import CHANNELS, FZ
from palpd.gap.phases import PHASES
from palpd.gap.problem import Linearisation, Problem, make_problem
from palpd.gap.shrink import Shrink, held_out
from palpd.gap.variance import coarse_step_N, rounding_of, scatter_effects, without_held, without_tails
from palpd.samples import Samples
from palpd.tick import Floats

SCHEMA = "palpd.diagnosis/1"
NONE_ABOVE = 0.25
"""A cell is only accused when the probability of there being no gap is below this."""

FEW = 4
"""So many samples make a phase in which a gap can lie."""

CREEPS = {"tissue.viscoelastic", "sensor.creep"}
"""What shows as a force that changes while nothing moves."""


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the diagnosis names: parameters as (value, low, high), and what it cannot be told from."""

    id: str
    probability: float
    parameters: dict[str, tuple[float, float, float]]
    indistinguishable_from: list[str]
    family: str | None
    at_bound: list[str]


@dataclass(frozen=True)
class Diagnosis:
    """The answer. `attribution` and `problem` hold what it rests on, for reports and for the next experiment."""

    verdict: str
    where: dict[str, str] | None
    gap: list[Gap]
    effects: list[NamedEffect]
    candidates: dict[str, float]
    p_none: float
    p_unknown: float
    shrink: Shrink | None
    before_rms: tuple[str, float, float]
    unexplained: dict[str, Any] | None
    notes: list[str]
    bands: list[dict[str, float | str]]
    trend: list[dict[str, float | int | str]]
    problem: Problem
    attribution: Attribution
    named_fit: Fit
    proposal: Proposal | None = None

    @property
    def resolved(self) -> bool:
        """Whether effects are named, and none that another could stand in for."""
        return self.verdict == "effects" and not any(e.indistinguishable_from for e in self.effects)

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        if self.verdict == "none":
            known = self.problem.cell.tolerances.modulus_known
            fitted = "" if known else f", once the modulus, which was not known, is fitted{self._modulus}"
            return f"No gap beyond the cell's own tolerances (probability {self.p_none:.2f}){fitted}."
        named = " and ".join(f"{e.id} ({e.probability:.2f})" for e in self.effects) or "no effect of the list"
        at = f" in {self.where['channel']} while {self.where['phase']}" if self.where else ""
        if self.verdict == "unknown":
            return f"Something outside the list is at work{at} (probability {self.p_unknown:.2f}); nearest in the list: {named}."
        families = {e.family: None for e in self.effects if e.family}
        kind = "".join(f"; of its kind is whatever does this: {family}" for family in families)
        groups = [f"{e.id} cannot be told from {', '.join(e.indistinguishable_from)}" for e in self.effects if e.indistinguishable_from]
        told = (f"; by this recording {'; '.join(groups)}" if groups else "") + kind
        if self.verdict == "ambiguous":
            return f"There is a gap{at}, but this recording does not say which effect it is: {named}{told}."
        closed = f", which closes {100 * self.shrink.closed:.0f} % of the gap" if self.shrink else ""
        return f"The gap{at} comes from {named}{closed}{told}."

    @property
    def _modulus(self) -> str:
        """What a modulus that was not known came out at, and what else would come out as it."""
        estimated = self.enriched_cell().estimated
        tissue = self.problem.cell.tissue
        if estimated is None or tissue is None:
            return ""
        value_Pa = tissue.youngs_modulus_Pa * (1.0 + estimated.youngs_modulus)
        return f" (E = {value_Pa:.3g} Pa; sensor.gain, robot.compliance or tissue.thickness would have been taken into it)"

    def to_json(self) -> dict[str, Any]:
        """The content of out.json, palpd.diagnosis/1."""
        channel, before, floor = self.before_rms
        shrink: dict[str, Any] = {
            "channel": channel,
            "before_rms": before,
            "after_rms": before,
            "noise_floor": floor,
            "closed": None,
            "ci95": None,
            "on": "cycles not used for the fit",
        }
        if self.shrink is not None:
            s = self.shrink
            shrink = {
                "channel": s.channel,
                "before_rms": s.before_rms,
                "after_rms": s.after_rms,
                "noise_floor": s.noise_floor,
                "closed": s.closed,
                "ci95": list(s.ci95),
                "on": s.on,
            }
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "where": self.where,
            "gap": [
                {"channel": g.channel, "phase": g.phase, "rms": g.rms, "noise_floor": g.noise_floor, "excess": g.excess} for g in self.gap
            ],
            "effects": [
                {
                    "id": e.id,
                    "probability": e.probability,
                    "parameters": {n: {"value": v, "ci95": [low, high]} for n, (v, low, high) in e.parameters.items()},
                    "indistinguishable_from": e.indistinguishable_from,
                    "family": e.family,
                    "at_bound": e.at_bound,
                }
                for e in self.effects
            ],
            "candidates": [
                {"id": name, "probability": p}
                for name, p in sorted(self.candidates.items(), key=lambda item: (-item[1], item[0]))
                if p > 1e-3
            ],
            "p_none": self.p_none,
            "p_unknown": self.p_unknown,
            "shrink": shrink,
            "unexplained": self.unexplained,
            "next_experiment": None if self.proposal is None else self.proposal.to_json(),
            "bands": self.bands,
            "trend": self.trend,
            "notes": self.notes,
        }

    def enriched_cell(self) -> CellFile:
        """The cell with the named effects and the in-tolerance deviations that were fitted with them."""
        effects: EffectValues = {e.id: {n: v for n, (v, _, _) in e.parameters.items()} for e in self.effects}
        best = self.named_fit
        around = best.linearisation
        coefficients = around.space.coefficients(best.residual)
        shared = coefficients[: len(around.eta)]
        estimated = self.problem.estimated(shared)
        bias, drift = _bias_and_drift(self.problem, around, coefficients)
        estimated = estimated.model_copy(update={"bias_N": bias, "drift_N_per_min": drift})
        return self.problem.cell.with_effects(effects).with_estimated(estimated)


def _bias_and_drift(problem: Problem, around: Linearisation, coefficients: Floats) -> tuple[float, float]:
    """Mean over the recordings of the fz bias and drift, which stand first among each recording's own columns."""
    first = len(around.eta)
    found = [c for c in around.index.own if c[0] == FZ]
    bias = [coefficients[first + k] * problem.cell.tolerances.bias_N for _, k, kind in found if kind == "bias"]
    drift = [coefficients[first + k] * problem.cell.tolerances.drift_N_per_min for _, k, kind in found if kind == "drift"]
    return (float(np.mean(bias)) if bias else 0.0), (float(np.mean(drift)) if drift else 0.0)


def diagnose(
    recordings: Sequence[Samples], cell: CellFile, effects: Mapping[str, Effect] = EFFECTS, *, max_bins: int = 4500, propose: bool = True
) -> Diagnosis:
    """Diagnose the recordings of one cell jointly. Deterministic. Raises RecordingError where nothing can be judged."""
    if not recordings:
        raise RecordingError("no recording was given; at least one is needed")
    # The matrices are small: threads cost more than they bring, and add up in another order each time.
    with threadpool_limits(1):
        return _diagnosed(recordings, cell, effects, max_bins, propose)


def _diagnosed(recordings: Sequence[Samples], cell: CellFile, effects: Mapping[str, Effect], max_bins: int, propose: bool) -> Diagnosis:
    notes = _check(recordings, cell)
    bridged = [without_held(s) for s in recordings]
    steps_N = [coarse_step_N(s, cell) for s in recordings]
    judged = [without_tails(samples, cell) for samples, *_ in bridged]
    problem = make_problem(judged, cell, effects, max_bins, rounding_of(recordings, steps_N, cell))
    problem.noisy = any(nearer is not samples for nearer, (samples, *_) in zip(judged, bridged, strict=True))
    notes += _channel_notes(problem)
    scatter, lone_noise = scatter_effects(problem.runs, [b[0] for b in bridged], steps_N, cell, [(b[1], b[2]) for b in bridged])
    scatter = [s for s in scatter if s.id in effects]
    attribution = attribute(problem)
    nominal = next(w.fit for w in attribution.weighed if not w.fit.names)
    start = nominal.linearisation if not cell.tolerances.modulus_known else problem.linearise({}, np.zeros(len(problem.shared_sd)))
    left = residuals(problem, start)
    table = gap_table(problem, start, left)
    none_of_scatter = float(np.prod([1.0 - s.probability for s in scatter]))
    p_unknown = 1.0 - (1.0 - attribution.p_unknown) * (1.0 - lone_noise)
    p_none = attribution.p_none * (1.0 - lone_noise) * none_of_scatter
    candidates = attribution.marginal | {s.id: s.probability for s in scatter}
    best = attribution.best
    named = _named(problem, best.fit, attribution) if best.fit.names else []
    if p_none > NONE_ABOVE:
        named = []
    fit = best.fit if named else nominal
    named += [NamedEffect(s.id, s.probability, s.parameters, [], None, []) for s in scatter if s.probability > 0.5]
    verdict = _verdict(p_none, p_unknown, named)
    if verdict == "none":
        named = []
    shrink = held_out(problem, best.fit) if fit.names and verdict != "none" else None
    long = [g for g in table if g.samples >= FEW] or table  # fewer are an accident of noise near a border between phases
    top = most_excess(long, change_sizes(problem, fit.change, long)) if long else None
    where = {"channel": top.channel, "phase": top.phase} if top is not None and verdict != "none" else None
    if CREEPS & {name for e in named for name in (e.id, *e.indistinguishable_from)}:
        notes.append(
            "Force that decays while the height is held is what relaxing tissue gives, and a creeping machine too (frame, grip, load "
            "cell): this recording alone cannot tell them apart. Press something rigid and hold: what decays then is the machine's creep."
        )
    found = Diagnosis(
        verdict,
        where,
        table,
        named,
        candidates,
        p_none,
        p_unknown,
        shrink,
        _before(table, where["channel"] if where else "fz_N"),
        _unexplained(problem, best.fit) if verdict != "none" else None,
        notes,
        bands(problem, left),
        trend(problem, left),
        problem,
        attribution,
        fit,
    )
    return replace(found, proposal=next_experiment(problem, attribution, verdict)) if propose else found


def _verdict(p_none: float, p_unknown: float, named: list[NamedEffect]) -> str:
    if p_none > NONE_ABOVE:
        return "none"
    if p_unknown > 0.5 or not named:
        return "unknown" if p_unknown > p_none else "none"
    if any(len(e.indistinguishable_from) > 2 for e in named):
        return "ambiguous"
    return "effects"


def _before(table: list[Gap], channel: str) -> tuple[str, float, float]:
    mine = [g for g in table if g.channel == channel] or table
    n = sum(g.samples for g in mine) or 1
    rms = float(np.sqrt(sum(g.rms**2 * g.samples for g in mine) / n))
    floor = float(np.sqrt(sum(g.noise_floor**2 * g.samples for g in mine) / n))
    return (mine[0].channel if mine else channel), rms, floor


def _named(problem: Problem, best: Fit, attribution: Attribution) -> list[NamedEffect]:
    out = []
    spread = 1.96 * np.sqrt(np.maximum(np.diag(best.covariance), 0.0))
    for name in best.names:
        parameters, bound = {}, []
        for k, c in enumerate(best.where):
            if c.effect != name:
                continue
            value = best.values[name][c.parameter.name]
            if c.angle:
                low, high = value - spread[k] * c.scale, value + spread[k] * c.scale
            else:
                low, high = sorted((c.back(float(best.u[k] - spread[k])), c.back(float(best.u[k] + spread[k]))))
                if (value <= c.lower * (1 + 1e-9) and c.lower != 0) or value >= c.upper * (1 - 1e-9):
                    bound.append(c.parameter.name)
            parameters[c.parameter.name] = (value, min(low, value), max(high, value))
        out.append(NamedEffect(name, attribution.marginal[name], parameters, attribution.groups[name], problem.library[name].family, bound))
    return sorted(out, key=lambda e: (-e.probability, e.id))


def _unexplained(problem: Problem, best: Fit) -> dict[str, Any] | None:
    """The channel and phase in which most is left, and how much in its unit; None where what is left is noise."""
    phase = np.concatenate([run.bin_phase for run in problem.runs])
    count = np.concatenate([run.bins.count for run in problem.runs])
    left = best.residual - best.linearisation.space.explained(best.linearisation.space.coefficients(best.residual))
    rms = problem.noise.rms
    worst: tuple[float, dict[str, Any] | None] = (0.0, None)
    for channel, name in enumerate(CHANNELS):
        for p, label in enumerate(PHASES):
            mine = (phase == p) & (rms[channel] > 0)
            n = int(mine.sum())
            if n < 4:
                continue
            energy = float((left[channel, mine] ** 2).sum()) - n
            if energy < 4.0 * np.sqrt(2.0 * n):
                continue
            excess = ((left[channel, mine] ** 2 - 1.0) * rms[channel, mine] ** 2 * count[mine]).sum() / count[mine].sum()
            if energy > worst[0] and excess > 0:
                worst = (energy, {"channel": name, "phase": label, "rms": float(np.sqrt(excess))})
    return worst[1]


def _check(recordings: Sequence[Samples], cell: CellFile) -> list[str]:
    """What is odd about the recordings before any simulation; raises where they cannot be judged."""
    notes = []
    for number, samples in enumerate(recordings):
        label = f"recording {number + 1}: " if len(recordings) > 1 else ""
        stroke_m = float(np.ptp(samples.z_m))
        integrated = float(np.sum(np.abs(samples.vz_m_per_s[1:]) * np.diff(samples.t_s)))
        if stroke_m > 5.0:
            raise RecordingError(
                f"{label}z_m spans {stroke_m:.3g} m, expected a stroke of millimetres to decimetres; it looks like mm, divide by 1000."
            )
        if stroke_m <= 6.0 * cell.robot.position_noise_rms_m and integrated < 3.0 * stroke_m + 1e-9:
            notes.append(f"{label}nothing moves (z_m spans {stroke_m:.2g} m): only bias, drift, warm-up and noise can be judged.")
        if stroke_m == 0.0 and samples.vz_m_per_s.any():
            raise RecordingError(f"{label}z_m is {samples.z_m[0]:g} m throughout and vz_m_per_s moves: z_m is dead; record it.")
        slope = _slope_ratio(samples)
        if slope is not None and not 0.5 < slope < 2.0:
            near = min((1e3, 1e-3, 1e6, 1e-6, -1.0), key=lambda k: abs(np.log(abs(slope) / abs(k))) + (slope * k < 0) * 9)
            said = {1e3: "z_m looks like mm", 1e-3: "vz_m_per_s looks like mm/s", -1.0: "their signs disagree"}
            unit = said.get(near, "their units disagree")
            sentence = f"{label}z_m changes {slope:.3g} times as fast as vz_m_per_s says, expected 1; {unit}."
            if 0.5 < abs(slope) / abs(near) < 2.0:
                raise RecordingError(f"{sentence} Correct the unit or sign and diagnose again.")
            notes.append(sentence)
        if cell.tissue is None:
            continue
        depth_m = cell.tissue.surface_z_m - float(samples.z_m.min())
        if depth_m > 20.0 * cell.probe.tip_radius_m and depth_m > 0.2:
            raise RecordingError(
                f"{label}the probe is {depth_m:.3g} m below the surface with a tip of {cell.probe.tip_radius_m:.3g} m radius; "
                "z_m looks like mm read as m, divide by 1000 or correct tissue.surface_z_m."
            )
        if depth_m > 20.0 * cell.probe.tip_radius_m:
            notes.append(
                f"{label}the deepest press is {depth_m / cell.probe.tip_radius_m:.0f} tip radii below the stated surface; "
                "check the unit of z_m and tissue.surface_z_m."
            )
        if depth_m <= 0:
            notes.append(f"{label}the probe never comes below the stated surface: nothing of the tissue can be judged.")
        elif bool((samples.z_m < cell.tissue.surface_z_m).all()):
            notes.append(f"{label}there is no free motion: inertia, cable and bias can hardly be told from the tissue.")
    return notes


def _slope_ratio(samples: Samples) -> float | None:
    """How fast z_m changes over how fast vz_m_per_s says it does; None where neither says anything."""
    path = np.concatenate([[0.0], np.cumsum(0.5 * (samples.vz_m_per_s[1:] + samples.vz_m_per_s[:-1]) * np.diff(samples.t_s))])
    z = samples.z_m - samples.z_m.mean()
    path = path - path.mean()
    if not path.any() or not z.any():
        return None
    correlation = float(z @ path) / float(np.sqrt((z @ z) * (path @ path)))
    if abs(correlation) < 0.9:
        return None
    return float(np.sign(correlation) * np.sqrt((z @ z) / (path @ path)))


def _channel_notes(problem: Problem) -> list[str]:
    notes = []
    first = problem.runs[0]
    if all(run.samples.z_cmd_m is None for run in problem.runs):
        notes.append("z_cmd_m is absent: how the robot follows its command is not judged.")
    dead = [channel for channel in range(1, 7) if not any(run.judged[channel] for run in problem.runs)]
    if dead:
        names = ", ".join(f"{CHANNELS[channel]} (always {first.samples.wrench[0, channel - 1]:g})" for channel in dead)
        notes.append(f"{names}: never changes, so it is dead or not measured, and is not judged.")
    for run in problem.runs:
        fz = run.samples.wrench[:, 2]
        top = float(fz.max())
        if run.judged[FZ] and top > 0 and float(np.mean(fz == top)) > 0.02 and top > 10 * problem.cell.sensor.noise_rms_N:
            share = 100 * float(np.mean(fz == top))
            notes.append(f"fz_N stands at its largest value {top:g} N in {share:.0f} % of the samples: it looks saturated.")
    if not problem.cell.tolerances.modulus_known:
        notes.append(
            "The modulus is not known, it was fitted: a wrong gain, or anything else in proportion to the contact force, cannot be told "
            "from it, and what bends the force curve (surface height, thickness, inclusion, compliance of the machine) only by its shape."
        )
    return notes
