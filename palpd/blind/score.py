"""Scores of the blind check: the table over all cases.

Shares carry Wilson's 95 % interval, means and medians that of the bootstrap.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import numpy as np
from scipy.stats import bootstrap

from palpd.blind.laws import INDISTINGUISHABLE, Floats
from palpd.blind.outcome import LEAST_SNR_LEFT, CaseOutcome
from palpd.blind.truth import CASE_KINDS, SOURCES, CaseKind, Source
from palpd.quantities import wilson

LAWS: tuple[tuple[CaseKind, str], ...] = (("library", "library laws"), ("foreign", "other laws"))
RESAMPLES = 500
"""Number of resamples of a bootstrap interval: the table of a thousand cases then takes seconds."""
BINS = 10
"""Number of equal bins of the probability in which it is compared with the share of right answers."""


LEAST_N = 50
"""Least number of cases for a verdict on a target, where its line states no other."""
EVERY_SOURCE = "all"
"""Name of the table over all sources."""


SOURCE_TITLES: Mapping[str, str] = {
    "drawn": "Drawn cells",
    "mujoco": "Cells that MuJoCo simulates",
    "injected": "Effects planted into recordings",
    EVERY_SOURCE: "All sources together",
}


class ScoreRow(TypedDict):
    """One line of the table, as in the JSON file. `least_n` cases are needed for a verdict on the target."""

    what: str
    value: float | None
    ci95: list[float] | None
    n: int
    target: str | None
    least_n: int
    met: bool | None
    share: bool


class EffectRow(TypedDict):
    """How often one planted effect was named, and what was named instead."""

    effect: str
    n: int
    first: int
    alone: int
    in_group: int
    unknown: int
    instead: dict[str, int]


OutcomesByKind = Mapping[CaseKind, list[CaseOutcome]]


@dataclass(frozen=True)
class Score:
    """One line of the table: value with its 95 % interval, number of cases, and target."""

    what: str
    value: float | None
    ci95: tuple[float, float] | None
    n: int
    target: str = ""
    share: bool = True
    least_n: int = LEAST_N

    def met(self) -> bool | None:
        """Whether the estimate reaches its target; None where there is no target, or where there are too few cases for a verdict."""
        shortfall = self.shortfall()
        return None if shortfall is None or self.n < self.least_n else shortfall == 0.0

    def shortfall(self) -> float | None:
        """By how much the estimate misses its target, however few the cases; None where there is no target or no case."""
        sign, _, bounds = self.target.partition(" ")
        if self.value is None or not bounds:
            return None
        low, _, high = bounds.partition(" to ")
        below = 0.0 if sign == "≤" else max(float(low) - self.value, 0.0)
        above = 0.0 if sign == "≥" else max(self.value - float(high or low), 0.0)
        return below + above


def _share(what: str, answers: Sequence[bool], target: str = "", least_n: int = LEAST_N) -> Score:
    n, right = len(answers), sum(answers)
    return Score(what, right / n if n else None, wilson(right, n) if n else None, n, target, least_n=least_n)


def _statistic(what: str, values: Sequence[float], of: Callable[..., Any], target: str = "", *, share: bool = False) -> Score:
    x, n = np.asarray(values, dtype=float), len(values)
    interval = None
    if n > 1:  # a single value has no spread
        drawn = bootstrap((x,), of, n_resamples=RESAMPLES, method="percentile", rng=np.random.default_rng(0)).confidence_interval
        interval = float(drawn.low), float(drawn.high)
    return Score(what, float(of(x)) if n else None, interval, n, target, share=share)


def first_right(o: CaseOutcome) -> bool:
    """The planted effect is named first."""
    return bool(o["named"]) and o["named"][0] == o["planted"][0]


def alone(o: CaseOutcome) -> bool:
    """The planted effect is named and nothing else is."""
    return o["named"] == o["planted"]


def in_group(o: CaseOutcome) -> bool:
    """The planted effect is in the group, of at most three, of what is named first."""
    return bool(o["groups"]) and o["planted"][0] in o["groups"][0] and len(o["groups"][0]) <= 3


def unknown_is_right(o: CaseOutcome) -> bool:
    """The diagnosis was not given the effect, and nothing it was given comes near."""
    return o["kind"] in {"removed", "novel"} and o["mimic"] is not None and o["mimic"]["snr_left"] >= LEAST_SNR_LEFT


def _between(outcomes: Sequence[CaseOutcome], low: float, high: float = np.inf) -> list[CaseOutcome]:
    return [o for o in outcomes if o["snr"] is not None and low <= o["snr"] < high]


def answered(o: CaseOutcome) -> tuple[float, bool] | None:
    """The answer that the diagnosis holds most probable, as its probability and whether it is right; None where either would be."""
    if o["verdict"] is None or o["kind"] == "two" or (o["kind"] in {"removed", "novel"} and not unknown_is_right(o)):
        return None
    beliefs = {**o["p"], "none": o["p_none"], "unknown": o["p_unknown"]}
    # Listed effects may stand beside something unknown; the answer is then the latter.
    best = "unknown" if o["p_unknown"] > 0.5 else max(beliefs, key=lambda name: beliefs[name])
    true = "none" if o["kind"] == "healthy" else "unknown" if unknown_is_right(o) else o["planted"][0]
    return min(beliefs[best], 1.0), best == true


def calibration(pairs: Sequence[tuple[float, bool]], bins: int = BINS) -> list[tuple[float, float, int]]:
    """How stated probabilities compare with the share of right answers.

    Args:
        pairs: Probability of the most probable answer, and whether it is right, of every case.
        bins: Number of equal bins of the probability.

    Returns:
        For each bin that holds a case: mean probability, share right, number of cases.
    """
    rows: list[tuple[float, float, int]] = []
    for k in range(bins):
        mine = [(p, right) for p, right in pairs if k / bins <= p < (k + 1) / bins or (k == bins - 1 and p >= 1.0)]
        if mine:
            rows.append((float(np.mean([p for p, _ in mine])), float(np.mean([right for _, right in mine])), len(mine)))
    return rows


def calibration_error(pairs: Sequence[tuple[float, bool]]) -> float:
    """Expected calibration error: the mean over the cases of the distance between probability and share right in their bin."""
    return sum(n * abs(p - right) for p, right, n in calibration(pairs)) / max(len(pairs), 1)


def error_of_a_calibrated_forecaster(pairs: Sequence[tuple[float, bool]]) -> float:
    """Mean calibration error of a forecaster whose probabilities are exact, on as many cases with the same ones: it is not zero.

    Args:
        pairs: Probability of the most probable answer, and whether it is right, of every case.

    Returns:
        The mean over RESAMPLES drawn sets of answers.
    """
    p = np.array([stated for stated, _ in pairs])
    bins = np.eye(BINS)[np.minimum((p * BINS).astype(int), BINS - 1)]
    right = np.random.default_rng(0).random((RESAMPLES, len(p))) < p
    return float(np.abs((right - p) @ bins).sum(axis=1).mean()) / len(p)


def scores(outcomes: Sequence[CaseOutcome]) -> list[Score]:
    """Every line of the table. Extra cases count in the line of their class alone."""
    usual = [o for o in outcomes if not o["extra"]]
    by = {kind: [o for o in usual if o["kind"] == kind] for kind in CASE_KINDS}
    coarse = [o for o in outcomes if o["steps_over_noise"]]
    return [
        *_attribution_scores(by, [o for o in outcomes if o["extra"] and o["kind"] == "library" and not o["steps_over_noise"]]),
        *_place_scores(by),
        *_two_effect_scores(by["two"]),
        *_unknown_scores(by),
        *_coarse_step_scores(coarse),
        *_law_scores(by, outcomes),
        *_probability_scores(by, usual),
        *_closing_scores(by),
        *_cost_scores(by, usual),
    ]


def _singles(by: OutcomesByKind) -> dict[str, list[CaseOutcome]]:
    """Cases with one effect that changes the mean, by the name of their laws."""
    return {name: [o for o in by[kind] if not o["variance"]] for kind, name in LAWS}


def _distinct(by: OutcomesByKind) -> dict[str, list[CaseOutcome]]:
    """Those of them whose effect can be told from all others."""
    return {name: [o for o in mine if o["planted"][0] not in INDISTINGUISHABLE] for name, mine in _singles(by).items()}


def _attribution_scores(by: OutcomesByKind, extra: Sequence[CaseOutcome]) -> Iterator[Score]:
    distinct, singles = _distinct(by), _singles(by)
    targets: dict[str, tuple[tuple[float, float, str, int], ...]] = {
        "library laws": ((6, 10, "≥ 0.92", LEAST_N), (10, 20, "≥ 0.98", LEAST_N), (20, np.inf, "≥ 0.995", 600)),
        "other laws": ((6, 10, "≥ 0.85", LEAST_N), (10, 20, "≥ 0.95", LEAST_N), (20, np.inf, "≥ 0.98", LEAST_N)),
    }
    for name, strata in targets.items():
        for low, high, target, least_n in strata:
            label = f"SNR {low:g}-{high:g}" if np.isfinite(high) else f"SNR > {low:g}"
            mine = [*distinct[name], *(extra if name == "library laws" else [])]
            yield _share(f"right cause first, {name}, {label}", [first_right(o) for o in _between(mine, low, high)], target, least_n)
    for name, mine in distinct.items():
        loud = [o for o in mine if (o["snr_per_row_sigma"] or 0.0) >= 6.0]
        yield _share(f"  {name}, SNR ≥ 6 counted in sigmas of one row, not of a mean", [first_right(o) for o in loud])
    for name, target in (("library laws", "≥ 0.97"), ("other laws", "≥ 0.93")):
        yield _share(f"right and nothing else named, {name}, SNR ≥ 10", [alone(o) for o in _between(distinct[name], 10)], target)
    for name, mine in singles.items():
        yield _share(f"truth within the group, all effects, {name}, SNR ≥ 10", [in_group(o) for o in _between(mine, 10)])
    sizes = [float(len(o["groups"][0])) for mine in singles.values() for o in _between(mine, 10) if o["groups"]]
    yield _statistic("mean size of the groups", sizes, np.mean, "≤ 1.5")
    scatter = [o for kind, _ in LAWS for o in by[kind] if o["variance"]]
    yield _share("noise, steps, dropouts: right cause first", [first_right(o) for o in scatter])


def _place_scores(by: OutcomesByKind) -> Iterator[Score]:
    placed = [bool(o["where_right"]) for kind, _ in LAWS for o in by[kind] if o.get("where_right") is not None]
    yield _share("where: right (size ≥ 1)", placed, "≥ 0.95")


def _two_effect_scores(two: Sequence[CaseOutcome]) -> Iterator[Score]:
    loud = _between(two, 10)
    yield _share("two effects, both SNR ≥ 10: both named and nothing else", [set(o["named"]) == set(o["planted"]) for o in loud], "≥ 0.85")
    yield _share("two effects, both SNR ≥ 10: at least one named", [bool(set(o["named"]) & set(o["planted"])) for o in loud], "≥ 0.99")


def silent(o: CaseOutcome) -> bool:
    """Nothing is named but what the host has, and nothing is called unknown."""
    return o["verdict"] is not None and not o["named"] and o["verdict"] != "unknown"


def _unknown_scores(by: OutcomesByKind) -> Iterator[Score]:
    yield _share("healthy cell kept silent", [silent(o) for o in by["healthy"]], "≥ 0.98", 200)
    strangers = {kind: [o["verdict"] == "unknown" for o in by[kind] if unknown_is_right(o)] for kind in ("removed", "novel")}
    both = strangers["removed"] + strangers["novel"]
    yield _share("outside the list, best mimic leaves SNR ≥ 10: called unknown", both, "≥ 0.85")
    yield _share("  of these, left out of the library", strangers["removed"])
    yield _share("  of these, not in the library", strangers["novel"])
    known = by["library"] + by["foreign"] + by["two"]
    yield _share("known effect called unknown", [o["verdict"] == "unknown" for o in known], "≤ 0.03")
    for kind, name in LAWS:
        yield _share(f"  of these, {name}", [o["verdict"] == "unknown" for o in by[kind]])
    removed = [o for o in by["removed"] if o["planted"][0] in INDISTINGUISHABLE]
    relative = [bool(set(o["named"]) & set(INDISTINGUISHABLE[o["planted"][0]])) for o in removed]
    family = [named and bool(o.get("family")) for named, o in zip(relative, removed, strict=True)]
    yield _share("left out, an indistinguishable effect listed: it is named with its family", family, "≥ 0.90")
    yield _share("  it is named", relative)


def _coarse_step_scores(coarse: Sequence[CaseOutcome]) -> Iterator[Score]:
    planted = [o for o in coarse if o["planted"]]
    yield _share("coarse steps: healthy cell kept silent", [silent(o) for o in coarse if not o["planted"]], "≥ 0.98")
    yield _share("  one effect of these: truth within the group", [in_group(o) for o in planted])
    yield _share("  one effect of these: right and nothing else named", [alone(o) for o in planted])
    yield _share("  one effect of these: called unknown", [o["verdict"] == "unknown" for o in planted])


def _law_scores(by: OutcomesByKind, outcomes: Sequence[CaseOutcome]) -> Iterator[Score]:
    """Lines on learned laws. Those on effects outside the list count the extra cases too."""
    novel = [(o, o["law"]) for o in outcomes if o["kind"] == "novel"]
    stated = [(o, law) for o, law in novel if law["kind"] == "law"]
    for low, high, target in ((20.0, 60.0, "≥ 0.85"), (10.0, 20.0, "≥ 0.7"), (60.0, np.inf, "")):
        mine = [law for o, law in stated if o["snr"] is not None and low <= o["snr"] < high]
        label = f"SNR {low:g}-{high:g}" if np.isfinite(high) else f"SNR > {low:g}"
        yield _share(f"law outside the list: factor and driver right and accepted, {label}", [law["right"] for law in mine], target)
        yield _share("  right itself, or one of those that fit as well is", [law["right_alike"] for law in mine])
    accepted = [(o, law) for o, law in novel if law["accepted"] and law["kind"] in ("law", "near")]
    wrong = "accepted law outside the list: factor or driver wrong, also of those that fit as well"
    yield _share(wrong, [not law["right_alike"] for _, law in accepted], "≤ 0.05")
    yield _share("  its own factor or driver wrong", [not law["right"] for _, law in accepted])
    yield _share("  it has two terms", [law["terms"] > 1 for _, law in accepted])
    yield _share("events outside the list: accepted as a law", [law["accepted"] for _, law in novel if law["kind"] == "event"], "≤ 0.05")
    yield _share("healthy cell: a law accepted", [o["law"]["accepted"] for o in by["healthy"]], "≤ 0.02")
    listed = [o for kind, _ in LAWS for o in by[kind] if o.get("sufficient")]
    yield _share("listed cause that is sufficient: replaced by a law or by events", [replaced(o) for o in listed], "≤ 0.03")
    closed = [c for o, _ in accepted if (c := o.get("closed")) is not None]
    yield _share("accepted law closes ≥ 0.8 of the gap on another motion", [c >= 0.8 for c in closed], "≥ 0.8")
    yield _statistic("  closed, median", closed, np.median)
    bands = [law["covered"] for _, law in accepted if law["covered"] is not None]
    again = [law["named_again"] for _, law in accepted if law["named_again"] is not None]
    yield _share("accepted alone and adopted: named in another recording, itself or in a group", again, "≥ 0.9")
    yield _statistic("band of a right law covers its true change, mean share of rows", bands, np.mean, "in 0.9 to 0.98", share=True)


def replaced(o: CaseOutcome) -> bool:
    """Something outside the list takes the place of the planted cause, or stands without it."""
    law = o["law"]
    if not (law["accepted"] or law["events"]):
        return False
    return law["replaces"] or (o["verdict"] == "unknown" and not set(o["named"]) & set(o["planted"]))


def _probability_scores(by: OutcomesByKind, outcomes: Sequence[CaseOutcome]) -> Iterator[Score]:
    belief = [min(float(o["p"].get(o["planted"][0], 0.0)), 1.0) for mine in _distinct(by).values() for o in mine]
    yield _statistic("mean probability on the true cause", belief, np.mean, "≥ 0.85")
    pairs = [pair for pair in map(answered, outcomes) if pair is not None]
    yield _calibration_score(pairs)
    by_chance = error_of_a_calibrated_forecaster(pairs) if pairs else None
    yield Score("  of a calibrated forecaster on as many cases", by_chance, None, len(pairs), share=False)


def _calibration_score(pairs: Sequence[tuple[float, bool]]) -> Score:
    """The calibration error with its interval by resampling cases."""
    interval = None
    if len(pairs) > 1:
        random = np.random.default_rng(0)
        drawn = [calibration_error([pairs[k] for k in random.integers(len(pairs), size=len(pairs))]) for _ in range(RESAMPLES)]
        interval = float(np.quantile(drawn, 0.025)), float(np.quantile(drawn, 0.975))
    value = calibration_error(pairs) if pairs else None
    return Score("expected calibration error", value, interval, len(pairs), "≤ 0.04", share=False)


def _closing_scores(by: OutcomesByKind) -> Iterator[Score]:
    singles = [o for mine in _singles(by).values() for o in mine]
    closed = [c for o in _between(singles, 6) if (c := o.get("closed")) is not None]
    yield _statistic("closed fraction on another motion, median", closed, np.median, "≥ 0.98")
    yield _share("closed fraction on another motion ≥ 0.9", [c >= 0.9 for c in closed], "≥ 0.95")
    strict = [c for o in _between(singles, 10) if (c := o.get("closed_without_floor")) is not None]
    yield _statistic("  SNR ≥ 10, no floor taken off, median", strict, np.median)
    covered = [hit for o in by["library"] for hit in o.get("covered", {}).values()]
    yield _share("parameter intervals cover, library laws", covered, "in 0.93 to 0.97")
    nearest = [hit for o in by["foreign"] for hit in o.get("covered_nearest", {}).values()]
    yield _share("parameter intervals cover, other laws", nearest, "≥ 0.88")


def _cost_scores(by: OutcomesByKind, outcomes: Sequence[CaseOutcome]) -> Iterator[Score]:
    slow = [o for o in by["healthy"] if o["robot_rate_Hz"] < o["rate_Hz"]]
    yield _share("  healthy and silent where the robot reports slower than the sensor", [silent(o) for o in slow])
    costs = [o["cost"] for o in outcomes if "cost" in o]
    yield _statistic("CPU seconds per recording with the search for laws, median", [c["cpu_s"] for c in costs], np.median, "≤ 10")
    yield _statistic("CPU seconds per recording with the search for laws, 95th percentile", [c["cpu_s"] for c in costs], _p95, "≤ 20")
    yield _statistic("peak memory of a process in MB, largest", [c["peak_MB"] for c in costs], np.max)
    yield _share("recordings that failed", [o["failed"] is not None for o in outcomes])


def _p95(values: Floats, axis: int = -1) -> Floats:
    return np.asarray(np.quantile(values, 0.95, axis=axis))


def tables_by_source(outcomes: Sequence[CaseOutcome]) -> dict[str, list[ScoreRow]]:
    """The table of every source, the worst first, and after them one over all; one table alone where there is one source.

    The worst source is the one that misses its targets by the most: the mean shortfall over all lines with a target.
    """
    by = {source: [o for o in outcomes if o["source"] == source] for source in SOURCES}
    by = {source: mine for source, mine in by.items() if mine}
    names: list[Source] = sorted(by, key=lambda source: -_mean_shortfall(scores(by[source])))
    tables = {str(name): table(by[name]) for name in names}
    return tables | {EVERY_SOURCE: table(outcomes)} if len(names) > 1 else tables


def _mean_shortfall(lines: Sequence[Score]) -> float:
    missed = [shortfall for line in lines if (shortfall := line.shortfall()) is not None]
    return float(np.mean(missed)) if missed else 0.0


def table(outcomes: Sequence[CaseOutcome]) -> list[ScoreRow]:
    """The lines of the table as plain data."""
    return [
        {
            "what": score.what,
            "value": score.value,
            "ci95": None if score.ci95 is None else list(score.ci95),
            "n": score.n,
            "target": score.target or None,
            "least_n": score.least_n,
            "met": score.met(),
            "share": score.share,
        }
        for score in scores(outcomes)
    ]


def as_markdown(rows: Sequence[ScoreRow]) -> str:
    """The table as text; lines without a case are left out."""
    lines = ["| what | measured | 95 % interval | n | target | |", "|---|---|---|---|---|---|"]
    for row in rows:
        if row["n"] == 0:
            continue
        share = row["share"]
        value = "–" if row["value"] is None else _text(row["value"], share)
        interval = "–" if row["ci95"] is None else f"{_text(row['ci95'][0], share)} to {_text(row['ci95'][1], share)}"
        few = f"n < {row['least_n']}" if row["target"] else ""
        met = {None: few, True: "met", False: "**missed**"}[row["met"]]
        lines.append(f"| {row['what']} | {value} | {interval} | {row['n']} | {_target_text(row['target'], share)} | {met} |")
    return "\n".join(lines) + "\n"


def _target_text(target: str | None, share: bool) -> str:
    if not target:
        return ""
    sign, _, bounds = target.partition(" ")
    word = {"≥": "at least ", "≤": "at most ", "in": ""}[sign]
    return word + " to ".join(_text(float(bound), share) for bound in bounds.split(" to "))


def tables_as_markdown(tables: Mapping[str, list[ScoreRow]]) -> str:
    """The tables of all sources, each below its name."""
    return "\n".join(f"### {SOURCE_TITLES[name]}\n\n{as_markdown(rows)}" for name, rows in tables.items())


def cases_as_markdown(outcomes: Sequence[CaseOutcome]) -> str:
    """Case by case what was planted and what was answered: of few cases a rate says nothing."""
    lines = ["| case | planted | SNR | answer | probability of what was planted | gap closed |", "|---|---|---|---|---|---|"]
    for o in outcomes:
        planted = ", ".join(o["planted"]) or "nothing"
        snr = "–" if o["snr"] is None else f"{o['snr']:.1f}"
        named = ", ".join(o["named"]) if o["verdict"] == "effects" else answer(o)
        beliefs = [o["p"].get(name, 0.0) for name in o["planted"]] or [o["p_none"]]
        probability = ", ".join(f"{belief:.2f}" for belief in beliefs) if o["verdict"] is not None else "–"
        closed = o.get("closed")
        share = "–" if closed is None else _text(closed, True)
        lines.append(f"| {o.get('case', o['source'])} | {planted} | {snr} | {named} | {probability} | {share} |")
    return "\n".join(lines) + "\n"


def _text(value: float, share: bool) -> str:
    return f"{100 * value:.1f} %" if share else f"{value:.3g}"


def by_effect(outcomes: Sequence[CaseOutcome]) -> Iterator[EffectRow]:
    """For every planted effect: how often it was named first, alone, within its group, and what was named instead."""
    names = sorted({o["planted"][0] for o in outcomes if o["kind"] in {"library", "foreign", "novel"}})
    for name in names:
        mine = [o for o in outcomes if o["kind"] in {"library", "foreign", "novel"} and o["planted"] == [name]]
        instead = Counter(answer(o) for o in mine if not first_right(o))
        yield {
            "effect": name,
            "n": len(mine),
            "first": sum(map(first_right, mine)),
            "alone": sum(map(alone, mine)),
            "in_group": sum(map(in_group, mine)),
            "unknown": sum(o["verdict"] == "unknown" for o in mine),
            "instead": dict(instead.most_common(3)),
        }


def answer(o: CaseOutcome) -> str:
    """What was answered, in a word: the first name, `none`, `unknown` or `failed`."""
    if o["verdict"] is None:
        return "failed"
    return str(o["verdict"]) if o["verdict"] in {"none", "unknown"} or not o["named"] else str(o["named"][0])
