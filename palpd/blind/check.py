"""The blind check: cases sealed by hash, diagnosed in another process that sees recordings and cell files only, then scored.

The cases come from drawn_cases, which shares no physics with the library.
"""

import contextlib
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypedDict

import numpy as np
import yaml

from palpd.blind.drawn_cases import CASE_KINDS, STRATA, CannotDraw, CaseKind, DrawnCase, draw_case
from palpd.blind.laws import FOREIGN_LAWS, INDISTINGUISHABLE, LIBRARY_LAWS, NOVEL_LAWS
from palpd.blind.score import CaseOutcome, ScoreRow, score_case, table
from palpd.cell.cell_file import cell_from
from palpd.recording.samples import Samples, write_csv

SCHEMA = "palpd.blind/1"
BATCH = 40
"""Cases that are drawn, sealed and diagnosed before the next ones: their recordings fill some 200 MB of disk."""
Ablation = Literal["no tolerances", "no press scatter", "white noise", "fz only"]
ABLATIONS: tuple[Ablation, ...] = ("no tolerances", "no press scatter", "white noise", "fz only")
"""`white noise` takes tolerances and press scatter away together: what a fit by least squares believes of its residuals."""

SHARES: dict[CaseKind, float] = {"healthy": 0.2, "library": 0.27, "foreign": 0.2, "two": 0.09, "removed": 0.12, "novel": 0.12}
"""Share of each kind among the cases."""
SINGLE_STRATA = ("20-60", "6-10", "10-20", "20-60", "6-10", "10-20", "> 60")
"""Strata of single effects, in turn: most of them where a diagnosis is hard."""
LARGE_STRATA = ("20-60", "> 60")
"""Strata of effects that are not in the library: where there is enough to see that nothing listed fits."""


@dataclass(frozen=True)
class CaseSpec:
    """What a case shall be."""

    index: int
    kind: CaseKind
    effects: tuple[str, ...]
    stratum: str


class CheckResult(TypedDict):
    """The content of the JSON file of a check."""

    schema: str
    cases: int
    seed: int
    ablation: Ablation | None
    sealed_sha256: str
    table: list[ScoreRow]
    outcomes: list[CaseOutcome]


def plan(cases: int, seed: int) -> list[CaseSpec]:
    """Choose kind, effects and stratum of every case.

    Every kind has its share, every effect and stratum its turn, so a shorter check is a fair sample of a longer one.

    Args:
        cases: Number of cases.
        seed: Seed of the order of the effects.

    Returns:
        One specification a case.
    """
    random = np.random.default_rng([seed, 7])
    scatter = {law.effect for law in LIBRARY_LAWS if law.variance}
    library = _shuffled(random, sorted({law.effect for law in LIBRARY_LAWS}))
    foreign = _shuffled(random, sorted({law.effect for law in FOREIGN_LAWS}))
    novel = _shuffled(random, sorted({law.effect for law in NOVEL_LAWS}))
    means = [effect for effect in library if effect not in scatter]
    specs: list[CaseSpec] = []
    counts = dict.fromkeys(CASE_KINDS, 0)
    for index in range(cases):
        kind = min(CASE_KINDS, key=lambda k: (counts[k] + 0.5) / SHARES[k])
        n = counts[kind]
        counts[kind] += 1
        if kind == "healthy":
            specs.append(CaseSpec(index, kind, (), "20-60"))
        elif kind == "two":
            one = means[n % len(means)]
            free = [e for e in means if e != one and e not in INDISTINGUISHABLE.get(one, ())]
            specs.append(CaseSpec(index, kind, (one, free[int(random.integers(len(free)))]), ("10-20", "20-60")[n % 2]))
        elif kind in {"removed", "novel"}:
            names = means if kind == "removed" else novel
            specs.append(CaseSpec(index, kind, (names[n % len(names)],), LARGE_STRATA[n // len(names) % 2]))
        else:
            names = library if kind == "library" else foreign
            specs.append(CaseSpec(index, kind, (names[n % len(names)],), SINGLE_STRATA[(n + n // len(names)) % len(SINGLE_STRATA)]))
    return specs


def _shuffled(random: np.random.Generator, names: list[str]) -> list[str]:
    return [names[int(k)] for k in random.permutation(len(names))]


# sealing


def make_case(spec: CaseSpec, seed: int, recordings: Path, sealed: Path, ablation: Ablation | None = None) -> dict[str, str]:
    """Draw a case and write it: recording and cell file for the diagnosis, truth and second motion to be sealed.

    An effect that no cell shows at the wanted SNR is drawn at the next lower one.

    Args:
        spec: What the case shall be.
        seed: Seed of the check.
        recordings: Folder that the diagnosis sees.
        sealed: Folder that it does not see.
        ablation: What is taken away from the diagnosis.

    Returns:
        SHA-256 of every file, by `folder/name`.

    Raises:
        CannotDraw: No cell shows the effect at any SNR.
    """
    case, stratum = _draw_at_or_below(spec, seed)
    name = f"{spec.index:05d}"
    cell, samples = _ablated(case, ablation)
    write_csv(recordings / f"{name}.csv", samples)
    (recordings / f"{name}.yaml").write_text(yaml.safe_dump(cell, sort_keys=False), encoding="utf-8")
    if case.without:
        (recordings / f"{name}.without").write_text(" ".join(case.without), encoding="utf-8")
    write_csv(sealed / f"{name}.csv", case.second)
    (sealed / f"{name}.json").write_text(json.dumps(case.truth | {"stratum": stratum}), encoding="utf-8")
    files = [recordings / f"{name}.csv", recordings / f"{name}.yaml", sealed / f"{name}.csv", sealed / f"{name}.json"]
    return {f"{file.parent.name}/{file.name}": _digest(file) for file in files}


def _draw_at_or_below(spec: CaseSpec, seed: int) -> tuple[DrawnCase, str]:
    strata = list(STRATA)
    for stratum in strata[strata.index(spec.stratum) : 0 : -1]:
        with contextlib.suppress(CannotDraw):
            return draw_case(seed, spec.index, spec.kind, spec.effects, stratum), stratum
    return draw_case(seed, spec.index, spec.kind, spec.effects, strata[0]), strata[0]


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _ablated(case: DrawnCase, ablation: Ablation | None) -> tuple[dict[str, Any], Samples]:
    """What the diagnosis is shown when a part of what it rests on is taken away."""
    cell, s = dict(case.cell), case.samples
    if ablation in ("no tolerances", "white noise"):
        cell["tolerances"] = {name: 1e-4 * value for name, value in _tolerances(cell).items()}
    if ablation in ("no press scatter", "white noise"):
        cell["repeatability"] = {"surface_z_m": 1e-9, "stiffness": 1e-6}
    if ablation == "fz only":
        wrench = np.zeros_like(s.wrench)
        wrench[:, 2] = s.wrench[:, 2]
        s = Samples(s.t_s, None, s.z_m, s.vz_m_per_s, wrench)
    return cell, s


def _tolerances(cell: dict[str, Any]) -> dict[str, float]:
    """The tolerances of a cell file, stated or by default."""
    loaded = cell_from(cell, "cell").tolerances
    return {name: float(getattr(loaded, name)) for name in type(loaded).model_fields}


# the check


def run(
    cases: int,
    seed: int,
    *,
    jobs: int = 2,
    ablation: Ablation | None = None,
    keep: Path | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> CheckResult:
    """Draw, seal, diagnose and score cases, batch by batch. The diagnosis runs in another process, which sees the recordings only.

    Args:
        cases: Number of cases.
        seed: The same seed draws the same cases.
        jobs: Number of processes.
        ablation: What is taken away from the diagnosis.
        keep: New folder for recordings, answers and truths; None: they are removed.
        progress: Called with the number of scored cases.

    Returns:
        The content of the JSON file.

    Raises:
        RuntimeError: A sealed file has changed.
    """
    specs = plan(cases, seed)
    outcomes: list[CaseOutcome] = []
    seal = hashlib.sha256()
    folder = Path(tempfile.mkdtemp(prefix="palpd-blind-")) if keep is None else keep
    try:
        for first in range(0, len(specs), BATCH):
            batch = specs[first : first + BATCH]
            batch_folder = folder / f"batch-{first:05d}"
            digests = _seal_batch(batch, seed, batch_folder, ablation, jobs)
            for name in sorted(digests):
                seal.update(f"{digests[name]}  {name}\n".encode())
            # From here to the comparison of the digests nothing but the other process touches the recordings.
            command = [sys.executable, "-m", "palpd.blind.diagnose_case", str(batch_folder / "recordings"), str(jobs)]
            subprocess.run(command, check=True)
            outcomes += _score_batch(batch, batch_folder, digests, jobs)
            if keep is None:
                shutil.rmtree(batch_folder)
            progress(len(outcomes))
    finally:
        if keep is None:
            shutil.rmtree(folder, ignore_errors=True)
    return {
        "schema": SCHEMA,
        "cases": cases,
        "seed": seed,
        "ablation": ablation,
        "sealed_sha256": seal.hexdigest(),
        "table": table(outcomes),
        "outcomes": outcomes,
    }


def _seal_batch(batch: list[CaseSpec], seed: int, folder: Path, ablation: Ablation | None, jobs: int) -> dict[str, str]:
    recordings, sealed = folder / "recordings", folder / "sealed"
    recordings.mkdir(parents=True)
    sealed.mkdir()
    with ProcessPoolExecutor(jobs) as pool:
        each_case = pool.map(make_case, batch, *([x] * len(batch) for x in (seed, recordings, sealed, ablation)))
        return {name: digest for digests in each_case for name, digest in digests.items()}


def _score_batch(batch: list[CaseSpec], folder: Path, digests: dict[str, str], jobs: int) -> list[CaseOutcome]:
    for name, digest in digests.items():
        if _digest(folder / name) != digest:
            raise RuntimeError(f"{name} has changed since it was sealed; the check is void, run it again")
    with ProcessPoolExecutor(jobs) as pool:
        names = [f"{spec.index:05d}" for spec in batch]
        return list(pool.map(score_case, [folder / "recordings"] * len(batch), [folder / "sealed"] * len(batch), names))
