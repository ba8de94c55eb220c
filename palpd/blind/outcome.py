"""One case of the blind check, compared with its sealed truth."""

import json
import tempfile
from math import pi, sqrt
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np
import yaml

from palpd.blind.adoption import name_again, recorded
from palpd.blind.law_answers import LawOutcome, law_outcome, without_a_law
from palpd.blind.laws import Floats
from palpd.blind.stated_cell import CHANNELS
from palpd.blind.truth import CaseKind, CaseSpec, NearestLaw, SealedEffect, SecondMotion, Source, Truth
from palpd.cell.cell_file import load_cell
from palpd.gap.commands import simulate_file
from palpd.recording.samples import Samples, read_csv

LEAST_SNR_LEFT = 10.0
"""SNR of what the best listed effect leaves, from which something outside the list is needed."""


class Cost(TypedDict):
    """What one diagnosis took."""

    cpu_s: float
    wall_s: float
    peak_MB: float


class CaseOutcome(TypedDict):
    """One case and its answer, as in the JSON file. The keys that are not required need an answer."""

    source: Source
    extra: bool
    steps_over_noise: tuple[float, float, float] | None
    kind: CaseKind
    planted: list[str]
    host_causes: list[str]
    variance: bool
    snr: float | None
    snr_per_row_sigma: float | None
    mimic: NearestLaw | None
    rate_Hz: float
    robot_rate_Hz: float
    failed: str | None
    verdict: str | None
    named: list[str]
    groups: list[list[str]]
    p: dict[str, float]
    p_none: float
    p_unknown: float
    case: NotRequired[str]
    laws: NotRequired[list[str]]
    beside: NotRequired[float | None]
    size: NotRequired[float]
    rows: NotRequired[int]
    duration_s: NotRequired[float]
    where: NotRequired[dict[str, Any] | None]
    where_right: NotRequired[bool | None]
    family: NotRequired[bool]
    covered: NotRequired[dict[str, bool]]
    covered_nearest: NotRequired[dict[str, bool]]
    closed: NotRequired[float | None]
    closed_without_floor: NotRequired[float | None]
    cost: NotRequired[Cost]
    law: LawOutcome
    sufficient: NotRequired[bool]


def score_case(recordings: Path, sealed: Path, spec: CaseSpec) -> CaseOutcome:
    """Compare the answer to one case with its truth.

    Args:
        recordings: Where each case has its recording and its answer.
        sealed: Where each case has its truth.

    Returns:
        What was planted, what was named, and whether each answer is right.
    """
    name = spec.name
    truth: Truth = json.loads((sealed / f"{name}.json").read_text(encoding="utf-8"))
    answer_file = recordings / f"{name}.json"
    if answer_file.exists():
        return _answered_outcome(spec, truth, json.loads(answer_file.read_text(encoding="utf-8")), recordings, sealed)
    failed = recordings / f"{name}.failed"
    return _unanswered_outcome(spec, truth, failed.read_text(encoding="utf-8") if failed.exists() else "no answer")


def _unanswered_outcome(spec: CaseSpec, truth: Truth, failed: str | None) -> CaseOutcome:
    effects = truth["effects"]
    snrs = [e["snr"] for e in effects if e["snr"] is not None]
    per_row = [e["snr_per_row_sigma"] for e in effects if e["snr_per_row_sigma"] is not None]
    return {
        "case": spec.name,
        "source": truth["source"],
        "extra": spec.extra,
        "steps_over_noise": spec.steps_over_noise,
        "kind": truth["kind"],
        "planted": [e["id"] for e in effects],
        "host_causes": truth["host_causes"],
        "laws": [e["law"] for e in effects],
        "variance": any(e["variance"] for e in effects),
        "snr": min(snrs) if effects and len(snrs) == len(effects) else None,
        "snr_per_row_sigma": min(per_row, default=None),
        "beside": min((e.get("snr_beside_the_other", np.inf) for e in effects), default=None),
        "size": truth["size"],
        "mimic": truth["mimic"],
        "rate_Hz": truth["rate_Hz"],
        "robot_rate_Hz": truth["robot_rate_Hz"],
        "rows": truth["rows"],
        "duration_s": truth["duration_s"],
        "failed": failed,
        "verdict": None,
        "named": [],
        "groups": [],
        "p": {},
        "p_none": 0.0,
        "p_unknown": 0.0,
        "law": without_a_law(truth),
    }


def _answered_outcome(spec: CaseSpec, truth: Truth, diagnosis: dict[str, Any], recordings: Path, sealed: Path) -> CaseOutcome:
    """`diagnosis` is the content of its JSON file."""
    outcome = _unanswered_outcome(spec, truth, None)
    hosts, where, sizes = truth["host_causes"], diagnosis["where"], truth["sizes"]
    effects = [e for e in diagnosis["effects"] if e["id"] not in hosts]  # naming what the host has besides is right
    largest = max(max(row.values()) for row in sizes.values())
    outcome["verdict"] = diagnosis["verdict"]
    outcome["named"] = [e["id"] for e in effects]
    outcome["groups"] = [sorted({e["id"], *e["indistinguishable_from"]}) for e in effects]
    outcome["p"] = {c["id"]: c["probability"] for c in diagnosis["candidates"] if c["id"] not in hosts}
    outcome["p_none"], outcome["p_unknown"] = diagnosis["p_none"], diagnosis["p_unknown"]
    outcome["where"] = where
    outcome["where_right"] = None if where is None or largest < 1.0 else sizes[where["channel"]][where["phase"]] >= 0.5 * largest
    relatives = any(e.get("family") or e["indistinguishable_from"] for e in effects)
    outcome["family"] = relatives or "family" in json.dumps(diagnosis["notes"])
    outcome["covered"], outcome["covered_nearest"] = _covered(truth, diagnosis)
    outcome["closed"] = outcome["closed_without_floor"] = None
    if outcome["planted"] and not outcome["variance"] and truth["second"] is not None:
        closing = _closing(truth["second"], recordings / f"{spec.name}.enriched.yaml", sealed / f"{spec.name}.csv")
        outcome["closed"], outcome["closed_without_floor"] = closing
    outcome["cost"] = diagnosis["cost"]
    files = recordings / f"{spec.name}.learned.yaml", recordings / f"{spec.name}.enriched.yaml", sealed / f"{spec.name}.npz"
    outcome["law"] = law_outcome(truth, diagnosis, *files)
    if outcome["law"]["accepted"] and outcome["law"]["kind"] in ("law", "near") and truth["second"] is not None and not effects:
        outcome["law"]["named_again"] = _named_again(files[0], recordings / f"{spec.name}.yaml", sealed / f"{spec.name}.csv", spec.index)
    outcome["sufficient"] = _sufficient(truth)
    return outcome


def _named_again(learned: Path, cell_file: Path, second: Path, seed: int) -> bool:
    """Whether a learned law, once adopted, is named in a recording of another motion of the cell."""
    cell = load_cell(cell_file)
    return name_again(learned, recorded(read_csv(second), cell, seed), cell).in_group


def _sufficient(truth: Truth) -> bool:
    """Whether one listed effect explains the recording: its own law was planted, or leaves little of the planted one."""
    if truth["kind"] not in ("library", "foreign") or any(e["variance"] for e in truth["effects"]):
        return False
    return all(e["law"] == "library" or ("nearest" in e and e["nearest"]["snr_left"] < LEAST_SNR_LEFT) for e in truth["effects"])


def _covered(truth: Truth, diagnosis: dict[str, Any]) -> tuple[dict[str, bool], dict[str, bool]]:
    """Which true parameters lie in their stated intervals: of the listed law, and of the listed law nearest to another one."""
    exact: dict[str, bool] = {}
    nearest: dict[str, bool] = {}
    for planted in truth["effects"]:
        true, into = _true_parameters(planted), exact if planted["law"] == "library" else nearest
        for effect in diagnosis["effects"]:
            if effect["id"] == planted["id"]:
                for name in true.keys() & effect["parameters"].keys():
                    low, high = effect["parameters"][name]["ci95"]
                    turns = (-2.0 * pi, 0.0, 2.0 * pi) if name.endswith("_rad") else (0.0,)
                    into[f"{effect['id']} {name}"] = any(low <= true[name] + turn <= high for turn in turns)
    return exact, nearest


def _true_parameters(planted: SealedEffect) -> dict[str, float]:
    if planted["law"] == "library":
        return planted["parameters"]
    return planted["nearest"]["parameters"] if "nearest" in planted else {}


def _closing(motion: SecondMotion, enriched: Path, second: Path) -> tuple[float | None, float]:
    """How far the gap closes on another motion of the same cell, noise-free, in the channel that the effects change most.

    First 1 - (after² - floor²)/(before² - floor²), the floor being what tolerances leave there, None where the gap does not rise
    above it; then the same with no floor taken off. `before` has the same fitted in-tolerance deviations and no effects.
    """
    floors, change, sigma = motion["floor"], motion["change"], motion["sigma"]
    channel = max(CHANNELS, key=lambda c: change[c] / sqrt(floors[c] ** 2 + sigma[c] ** 2))
    true = _column(read_csv(second), channel)
    cell = yaml.safe_load(enriched.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        plain, out = Path(folder) / "plain.yaml", Path(folder) / "out.csv"
        plain.write_text(yaml.safe_dump(cell | {"effects": {}, "learned": []}, sort_keys=False), encoding="utf-8")
        residuals: list[float] = []
        for file in (enriched, plain):
            simulated = simulate_file(second, file, out, from_commanded=channel == "z_m")
            residuals.append(float(np.mean((_column(simulated, channel) - true) ** 2)))
    after, before = residuals
    floor = floors[channel] ** 2
    strict = float(np.clip(1.0 - after / max(before, 1e-300), -1.0, 1.0))
    if change[channel] ** 2 < floor or before < 2.0 * floor:
        return None, strict
    return float(np.clip(1.0 - (after - floor) / (before - floor), -1.0, 1.0)), strict


def _column(samples: Samples, channel: str) -> Floats:
    return samples.z_m if channel == "z_m" else np.asarray(samples.wrench[:, CHANNELS.index(channel) - 1])
