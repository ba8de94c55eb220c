"""Scores of the blind check: each case against its truth, and the table over all of them.

Shares carry Wilson's 95 % interval, means and medians that of the bootstrap.
"""

import json
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import pi, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from palpd.gap.blind_cells import CHANNELS, KINDS, Kind
from palpd.gap.blind_laws import TWINS, Floats
from palpd.gap.commands import simulate_file
from palpd.samples import Samples, read_csv

Outcome = dict[str, Any]
LAWS: tuple[tuple[Kind, str], ...] = (("library", "library laws"), ("foreign", "foreign laws"))

# one case


def score_case(recordings: Path, sealed: Path, name: str) -> Outcome:
    """One case: what was planted, what was named, and whether each answer is right."""
    truth = json.loads((sealed / f"{name}.json").read_text(encoding="utf-8"))
    answer_file = recordings / f"{name}.json"
    planted = [e["id"] for e in truth["effects"]]
    snr = [e["snr"] for e in truth["effects"]]
    base: Outcome = {
        "case": name,
        "kind": truth["kind"],
        "planted": planted,
        "laws": [e["law"] for e in truth["effects"]],
        "variance": any(e["variance"] for e in truth["effects"]),
        "snr": min(snr) if snr and None not in snr else None,
        "snr_per_row_sigma": min((e["snr_per_row_sigma"] for e in truth["effects"] if e["snr"] is not None), default=None),
        "beside": min((e.get("snr_beside_the_other", np.inf) for e in truth["effects"]), default=None),
        "size": truth["size"],
        "mimic": truth["mimic"],
        "rate_Hz": truth["rate_Hz"],
        "robot_rate_Hz": truth["robot_rate_Hz"],
        "rows": truth["rows"],
        "duration_s": truth["duration_s"],
        "failed": None,
    }
    if not answer_file.exists():
        failed = recordings / f"{name}.failed"
        sentence = failed.read_text(encoding="utf-8") if failed.exists() else "no answer"
        return base | {"failed": sentence, "verdict": None, "named": [], "groups": [], "p": {}, "p_none": 0.0, "p_unknown": 0.0}
    found = json.loads(answer_file.read_text(encoding="utf-8"))
    named = [e["id"] for e in found["effects"]]
    groups = [sorted({e["id"], *e["indistinguishable_from"]}) for e in found["effects"]]
    where = found["where"]
    sizes = truth["sizes"]
    largest = max(max(row.values()) for row in sizes.values())
    closed: float | None = None
    strict: float | None = None
    if planted and not base["variance"]:
        closed, strict = _closing(truth, recordings / f"{name}.enriched.yaml", sealed / f"{name}.csv")
    return base | {
        "verdict": found["verdict"],
        "named": named,
        "groups": groups,
        "p": {c["id"]: c["probability"] for c in found["candidates"]},
        "p_none": found["p_none"],
        "p_unknown": found["p_unknown"],
        "where": where,
        "where_right": None if where is None or largest < 1.0 else bool(sizes[where["channel"]][where["phase"]] >= 0.5 * largest),
        "family": any(e.get("family") or e["indistinguishable_from"] for e in found["effects"]) or "family" in json.dumps(found["notes"]),
        "covered": _covered(truth, found),
        "closed": closed,
        "closed_without_floor": strict,
        "cost": found["cost"],
    }


def _covered(truth: dict[str, Any], found: dict[str, Any]) -> dict[str, bool]:
    """Which true parameters lie in their stated intervals; library laws only, since another law has no such truth."""
    out = {}
    for planted in truth["effects"]:
        if planted["law"] != "library":
            continue
        for effect in found["effects"]:
            if effect["id"] == planted["id"]:
                for name, p in effect["parameters"].items():
                    low, high = p["ci95"]
                    true = planted["parameters"][name]
                    turns = (-2.0 * pi, 0.0, 2.0 * pi) if name.endswith("_rad") else (0.0,)
                    out[f"{effect['id']} {name}"] = any(low <= true + turn <= high for turn in turns)
    return out


def _closing(truth: dict[str, Any], enriched: Path, second: Path) -> tuple[float | None, float]:
    """How far the gap closes on another motion of the same cell, noise-free, in the channel that the effects change most.

    First 1 - (after² - floor²)/(before² - floor²), the floor being what tolerances leave there, None where the gap does not rise
    above it; then the same with no floor taken off. `before` has the same fitted in-tolerance deviations and no effects.
    """
    floors, change, sigma = (truth["second"][name] for name in ("floor", "change", "sigma"))
    channel = max(CHANNELS, key=lambda c: change[c] / sqrt(floors[c] ** 2 + sigma[c] ** 2))
    true = _column(read_csv(second), channel)
    cell = yaml.safe_load(enriched.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        plain, out = Path(folder) / "plain.yaml", Path(folder) / "out.csv"
        plain.write_text(yaml.safe_dump(cell | {"effects": {}}, sort_keys=False), encoding="utf-8")
        left = []
        for file in (enriched, plain):
            simulated = simulate_file(second, file, out, from_commanded=channel == "z_m", overwrite=True)
            left.append(float(np.mean((_column(simulated, channel) - true) ** 2)))
    after, before = left
    floor = floors[channel] ** 2
    strict = float(np.clip(1.0 - after / max(before, 1e-300), -1.0, 1.0))
    if change[channel] ** 2 < floor or before < 2.0 * floor:
        return None, strict
    return float(np.clip(1.0 - (after - floor) / (before - floor), -1.0, 1.0)), strict


def _column(samples: Samples, channel: str) -> Floats:
    return samples.z_m if channel == "z_m" else np.asarray(samples.wrench[:, CHANNELS.index(channel) - 1])


# the table


@dataclass(frozen=True)
class Figure:
    """One line of the table: value with its 95 % interval, how many cases, and what is wanted."""

    what: str
    value: float | None
    low: float | None
    high: float | None
    n: int
    target: str
    share: bool = True

    def met(self) -> bool | None:
        """Whether the value reaches its target; None where there is none or no case."""
        wanted = self.target.split()
        if self.value is None or len(wanted) != 2:
            return None
        bound = float(wanted[1])
        return self.value >= bound if wanted[0] == "≥" else self.value <= bound


def wilson(right: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    if n == 0:
        return 0.0, 1.0
    z, p = 1.96, right / n
    middle, spread = p + z**2 / (2 * n), z * sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    return max(0.0, (middle - spread) / (1 + z**2 / n)), min(1.0, (middle + spread) / (1 + z**2 / n))


def _share(what: str, answers: Sequence[bool], target: str) -> Figure:
    n, right = len(answers), sum(answers)
    low, high = wilson(right, n)
    return Figure(what, right / n if n else None, low if n else None, high if n else None, n, target)


def _statistic(what: str, values: Sequence[float], of: Callable[[Floats], float], target: str) -> Figure:
    if not len(values):
        return Figure(what, None, None, None, 0, target, share=False)
    x, random = np.asarray(values, dtype=float), np.random.default_rng(0)
    drawn = [of(x[random.integers(0, len(x), len(x))]) for _ in range(500)]
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Figure(what, of(x), float(low), float(high), len(x), target, share=False)


def first_right(o: Outcome) -> bool:
    """The planted effect is named first."""
    return bool(o["named"]) and o["named"][0] == o["planted"][0]


def alone(o: Outcome) -> bool:
    """The planted effect is named and nothing else is."""
    return o["named"] == o["planted"]


def in_group(o: Outcome) -> bool:
    """The planted effect is in the group, of at most three, of what is named first."""
    return bool(o["groups"]) and o["planted"][0] in o["groups"][0] and len(o["groups"][0]) <= 3


def unknown_is_right(o: Outcome) -> bool:
    """The diagnosis was not given the effect, and nothing it was given comes near."""
    return o["kind"] in {"removed", "novel"} and o["mimic"] is not None and o["mimic"]["snr_left"] >= 10.0


def _between(outcomes: Sequence[Outcome], low: float, high: float = np.inf) -> list[Outcome]:
    return [o for o in outcomes if o["snr"] is not None and low <= o["snr"] < high]


def answered(o: Outcome) -> tuple[float, bool] | None:
    """The answer that the diagnosis holds most probable, as its probability and whether it is right; None where either would be."""
    if o["verdict"] is None or o["kind"] == "two" or (o["kind"] in {"removed", "novel"} and not unknown_is_right(o)):
        return None
    beliefs = {**o["p"], "none": o["p_none"], "unknown": o["p_unknown"]}
    # Listed effects may stand beside something unknown; the answer is then the latter.
    best = "unknown" if o["p_unknown"] > 0.5 else max(beliefs, key=lambda name: beliefs[name])
    true = "none" if o["kind"] == "healthy" else "unknown" if unknown_is_right(o) else o["planted"][0]
    return min(beliefs[best], 1.0), best == true


def calibration(outcomes: Sequence[Outcome], bins: int = 10) -> tuple[float, list[tuple[float, float, int]]]:
    """Expected calibration error of the most probable answer, and per bin mean probability, share right, number."""
    pairs = [pair for pair in map(answered, outcomes) if pair is not None]
    rows: list[tuple[float, float, int]] = []
    for k in range(bins):
        mine = [(p, right) for p, right in pairs if k / bins <= p < (k + 1) / bins or (k == bins - 1 and p >= 1.0)]
        if mine:
            rows.append((float(np.mean([p for p, _ in mine])), float(np.mean([right for _, right in mine])), len(mine)))
    total = sum(n for *_, n in rows) or 1
    return sum(n * abs(p - right) for p, right, n in rows) / total, rows


def figures(outcomes: Sequence[Outcome]) -> list[Figure]:
    """Every line of the table."""
    by = {kind: [o for o in outcomes if o["kind"] == kind] for kind in KINDS}
    out: list[Figure] = []
    singles = {name: [o for o in by[kind] if not o["variance"]] for kind, name in LAWS}
    own = {name: [o for o in mine if o["planted"][0] not in TWINS] for name, mine in singles.items()}
    wanted: dict[str, tuple[tuple[float, float, str], ...]] = {
        "library laws": ((6, 10, "≥ 0.90"), (10, 20, "≥ 0.98"), (20, np.inf, "≥ 0.995")),
        "foreign laws": ((6, 10, "≥ 0.80"), (10, 20, "≥ 0.95"), (20, np.inf, "≥ 0.98")),
    }
    for name, strata in wanted.items():
        for low, high, target in strata:
            label = f"SNR {low:g}-{high:g}" if np.isfinite(high) else f"SNR > {low:g}"
            out.append(_share(f"right cause first, {name}, {label}", [first_right(o) for o in _between(own[name], low, high)], target))
    for name, listed in own.items():
        loud = [o for o in listed if (o["snr_per_row_sigma"] or 0.0) >= 6.0]
        out.append(_share(f"  {name}, SNR ≥ 6 counted in sigmas of one row, not of a mean", [first_right(o) for o in loud], ""))
    for name, target in (("library laws", "≥ 0.97"), ("foreign laws", "≥ 0.93")):
        out.append(_share(f"right and nothing else named, {name}, SNR ≥ 10", [alone(o) for o in _between(own[name], 10)], target))
    for name, target in (("library laws", "≥ 0.99"), ("foreign laws", "≥ 0.96")):
        inside = [in_group(o) for o in _between(singles[name], 10)]
        out.append(_share(f"truth within the group, all effects, {name}, SNR ≥ 10", inside, target))
    both = _between(singles["library laws"] + singles["foreign laws"], 10)
    out.append(_statistic("mean size of the groups", [float(len(o["groups"][0])) for o in both if o["groups"]], _mean, "≤ 1.5"))
    scatter = [o for kind in ("library", "foreign") for o in by[kind] if o["variance"]]
    out.append(_share("noise, steps, dropouts: right cause first", [first_right(o) for o in scatter], ""))
    placed = [bool(o["where_right"]) for o in outcomes if o.get("where_right") is not None and o["kind"] in {"library", "foreign"}]
    out.append(_share("where: right (size ≥ 1)", placed, "≥ 0.95"))
    two = by["two"]
    out.append(_share("two effects: both named and nothing else", [set(o["named"]) == set(o["planted"]) for o in two], "≥ 0.85"))
    out.append(_share("two effects: at least one named", [bool(set(o["named"]) & set(o["planted"])) for o in two], "≥ 0.99"))
    out.append(_share("healthy cell kept silent", [o["verdict"] == "none" for o in by["healthy"]], "≥ 0.98"))
    strangers = [o for o in outcomes if unknown_is_right(o)]
    out.append(_share("never given, best mimic leaves SNR ≥ 10: called unknown", [o["verdict"] == "unknown" for o in strangers], "≥ 0.90"))
    for kind, name in (("removed", "left out of the library"), ("novel", "not in the library")):
        mine = [o["verdict"] == "unknown" for o in strangers if o["kind"] == kind]
        out.append(_share(f"  of these, {name}", mine, ""))
    known = by["library"] + by["foreign"] + two
    out.append(_share("known effect called unknown", [o["verdict"] == "unknown" for o in known], "≤ 0.03"))
    for kind, name in LAWS:
        out.append(_share(f"  of these, {name}", [o["verdict"] == "unknown" for o in by[kind]], ""))
    twins = [o for o in by["removed"] if o["planted"][0] in TWINS]
    said = [bool(set(o["named"]) & set(TWINS[o["planted"][0]])) for o in twins]
    family = [named and bool(o.get("family")) for named, o in zip(said, twins, strict=True)]
    out.append(_share("left out, with a twin: the twin named and said to be of a family", family, "≥ 0.90"))
    out.append(_share("  the twin named", said, ""))
    belief = [min(float(o["p"].get(o["planted"][0], 0.0)), 1.0) for name in own for o in own[name]]
    out.append(_statistic("mean probability on the true cause", belief, _mean, "≥ 0.85"))
    pairs = [pair for pair in map(answered, outcomes) if pair is not None]
    error = calibration(outcomes)[0] if pairs else None
    out.append(Figure("expected calibration error", error, None, None, len(pairs), "≤ 0.04", share=False))
    closed = [float(o["closed"]) for o in _between(singles["library laws"] + singles["foreign laws"], 6) if o.get("closed") is not None]
    out.append(_statistic("closed fraction on another motion, median", closed, _median, "≥ 0.95"))
    out.append(_share("closed fraction on another motion ≥ 0.8", [c >= 0.8 for c in closed], "≥ 0.90"))
    strict = [float(o["closed_without_floor"]) for o in both if o.get("closed_without_floor") is not None]
    out.append(_statistic("  SNR ≥ 10, no floor taken off, median", strict, _median, ""))
    covered = [hit for o in by["library"] for hit in o.get("covered", {}).values()]
    out.append(_share("parameter intervals cover (0.90 to 0.98)", covered, "≥ 0.90"))
    slow = [o for o in by["healthy"] if o["robot_rate_Hz"] < o["rate_Hz"]]
    out.append(_share("  healthy and silent where the robot reports slower than the sensor", [o["verdict"] == "none" for o in slow], ""))
    costs = [o["cost"] for o in outcomes if o.get("cost")]
    out.append(_statistic("CPU seconds per recording, median", [c["cpu_s"] for c in costs], _median, ""))
    out.append(_statistic("CPU seconds per recording, largest", [c["cpu_s"] for c in costs], lambda x: float(x.max()), ""))
    out.append(_statistic("peak memory of a process in MB, largest", [c["peak_MB"] for c in costs], lambda x: float(x.max()), ""))
    out.append(_share("recordings that failed", [o["failed"] is not None for o in outcomes], ""))
    return out


def _mean(x: Floats) -> float:
    return float(x.mean())


def _median(x: Floats) -> float:
    return float(np.median(x))


def table(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """The lines of the table as plain data."""
    return [
        {
            "what": f.what,
            "value": f.value,
            "ci95": None if f.low is None else [f.low, f.high],
            "n": f.n,
            "target": f.target or None,
            "met": f.met(),
            "share": f.share,
        }
        for f in figures(outcomes)
    ]


def as_markdown(rows: Sequence[dict[str, Any]]) -> str:
    """The table as text."""
    lines = ["| what | measured | 95 % interval | n | at least | |", "|---|---|---|---|---|---|"]
    for row in rows:
        share = bool(row["share"])
        value = "–" if row["value"] is None else _text(row["value"], share)
        interval = "–" if row["ci95"] is None else f"{_text(row['ci95'][0], share)} to {_text(row['ci95'][1], share)}"
        target = ""
        if row["target"]:
            sign, bound = row["target"].split()
            target = ("at most " if sign == "≤" else "") + _text(float(bound), share)
        met = {None: "", True: "met", False: "**missed**"}[row["met"]]
        lines.append(f"| {row['what']} | {value} | {interval} | {row['n']} | {target} | {met} |")
    return "\n".join(lines) + "\n"


def _text(value: float, share: bool) -> str:
    return f"{100 * value:.1f} %" if share else f"{value:.3g}"


def by_effect(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
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


def answer(o: Outcome) -> str:
    """What was answered, in a word: the first name, `none`, `unknown` or `failed`."""
    if o["verdict"] is None:
        return "failed"
    return str(o["verdict"]) if o["verdict"] in {"none", "unknown"} or not o["named"] else str(o["named"][0])
