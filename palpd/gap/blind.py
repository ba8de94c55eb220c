"""The blind check: cases sealed by hash, diagnosed in another process that sees recordings and cell files only, then scored.

The cases come from blind_cells, which shares no physics with the library.
"""

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
from typing import Any, Literal

import numpy as np
import yaml

from palpd.cell_file import cell_from
from palpd.gap.blind_cells import KINDS, STRATA, CannotDraw, Case, Kind, draw_case
from palpd.gap.blind_laws import FOREIGN_LAWS, LIBRARY_LAWS, NOVEL_LAWS, TWINS
from palpd.gap.blind_score import Outcome, score_case, table
from palpd.samples import Samples, write_csv

SCHEMA = "palpd.blind/1"
BATCH = 40
Ablation = Literal["no tolerances", "no press scatter", "white noise", "fz only"]
ABLATIONS: tuple[Ablation, ...] = ("no tolerances", "no press scatter", "white noise", "fz only")
"""`white noise` takes tolerances and press scatter away together: what a fit by least squares believes of its residuals."""

SHARES: dict[Kind, float] = {"healthy": 0.2, "library": 0.27, "foreign": 0.2, "two": 0.09, "removed": 0.12, "novel": 0.12}
SINGLE_STRATA = ("20-60", "6-10", "10-20", "20-60", "6-10", "10-20", "> 60")
LARGE_STRATA = ("20-60", "> 60")


@dataclass(frozen=True)
class Order:
    """What a case is to be."""

    index: int
    kind: Kind
    effects: tuple[str, ...]
    stratum: str


def plan(cases: int, seed: int) -> list[Order]:
    """Stratified: every kind its share, every effect and stratum in turn, so that a shorter check is a fair sample of a longer one."""
    random = np.random.default_rng([seed, 7])
    scatter = {law.effect for law in LIBRARY_LAWS if law.variance}
    listed = _shuffled(random, sorted({law.effect for law in LIBRARY_LAWS}))
    foreign = _shuffled(random, sorted({law.effect for law in FOREIGN_LAWS}))
    novel = _shuffled(random, sorted({law.effect for law in NOVEL_LAWS}))
    means = [effect for effect in listed if effect not in scatter]
    orders: list[Order] = []
    counts = dict.fromkeys(KINDS, 0)
    for index in range(cases):
        kind = min(KINDS, key=lambda k: (counts[k] + 0.5) / SHARES[k])
        n = counts[kind]
        counts[kind] += 1
        if kind == "healthy":
            orders.append(Order(index, kind, (), "20-60"))
        elif kind == "two":
            one = means[n % len(means)]
            free = [e for e in means if e != one and e not in TWINS.get(one, ())]
            orders.append(Order(index, kind, (one, free[int(random.integers(len(free)))]), ("10-20", "20-60")[n % 2]))
        elif kind in {"removed", "novel"}:
            names = means if kind == "removed" else novel
            orders.append(Order(index, kind, (names[n % len(names)],), LARGE_STRATA[n // len(names) % 2]))
        else:
            names = listed if kind == "library" else foreign
            orders.append(Order(index, kind, (names[n % len(names)],), SINGLE_STRATA[(n + n // len(names)) % len(SINGLE_STRATA)]))
    return orders


def _shuffled(random: np.random.Generator, names: list[str]) -> list[str]:
    return [names[int(k)] for k in random.permutation(len(names))]


# sealing


def make_case(order: Order, seed: int, recordings: Path, sealed: Path, ablation: Ablation | None = None) -> dict[str, str]:
    """Draw a case and write it: the recording and the cell file for the diagnosis, the truth and the second motion to be sealed.

    An effect that no cell shows at the wanted SNR is drawn at the next lower one. Returns the SHA-256 of every file.
    """
    names = list(STRATA)
    for stratum in reversed(names[: names.index(order.stratum) + 1]):
        try:
            case = draw_case(seed, order.index, order.kind, order.effects, stratum)
            break
        except CannotDraw:
            if stratum == names[0]:
                raise
    name = f"{order.index:05d}"
    shown = _ablated(case, ablation)
    write_csv(recordings / f"{name}.csv", shown[1])
    (recordings / f"{name}.yaml").write_text(yaml.safe_dump(shown[0], sort_keys=False), encoding="utf-8")
    if case.without:
        (recordings / f"{name}.without").write_text(" ".join(case.without), encoding="utf-8")
    write_csv(sealed / f"{name}.csv", case.second)
    (sealed / f"{name}.json").write_text(json.dumps(case.truth | {"stratum": stratum}), encoding="utf-8")
    files = [recordings / f"{name}.csv", recordings / f"{name}.yaml", sealed / f"{name}.csv", sealed / f"{name}.json"]
    return {f"{file.parent.name}/{file.name}": _digest(file) for file in files}


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _ablated(case: Case, ablation: Ablation | None) -> tuple[dict[str, Any], Samples]:
    """What the diagnosis is shown when a part of what it rests on is taken away."""
    cell, s = dict(case.cell), case.samples
    if ablation in ("no tolerances", "white noise"):
        told = _tolerances(cell)
        cell["tolerances"] = {name: 1e-4 * value for name, value in told.items()}
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
    progress: Callable[[int], None] = lambda done: None,
) -> dict[str, Any]:
    """Draw, seal, diagnose and score that many cases, in batches; `keep` is a folder that stays, else everything is removed.

    The diagnosis runs in another process that is given the folder of recordings only. Returns the content of the JSON file.
    """
    orders = plan(cases, seed)
    outcomes: list[Outcome] = []
    seal = hashlib.sha256()
    folder = Path(tempfile.mkdtemp(prefix="palpd-blind-")) if keep is None else keep
    try:
        for k in range(0, len(orders), BATCH):
            batch = orders[k : k + BATCH]
            recordings, sealed = folder / f"batch-{k:05d}" / "recordings", folder / f"batch-{k:05d}" / "sealed"
            recordings.mkdir(parents=True)
            sealed.mkdir()
            with ProcessPoolExecutor(jobs) as pool:
                made = pool.map(make_case, batch, *([x] * len(batch) for x in (seed, recordings, sealed, ablation)))
                digests = {name: digest for each in made for name, digest in each.items()}
            for name in sorted(digests):
                seal.update(f"{digests[name]}  {name}\n".encode())
            # From here to the comparison of the digests nothing but the other process touches the recordings.
            subprocess.run([sys.executable, "-m", "palpd.gap.blind_run", str(recordings), str(jobs)], check=True)
            for name, digest in digests.items():
                if _digest(folder / f"batch-{k:05d}" / name) != digest:
                    raise RuntimeError(f"{name} has changed since it was sealed; the check is void, run it again")
            with ProcessPoolExecutor(jobs) as pool:
                names = [f"{order.index:05d}" for order in batch]
                outcomes += pool.map(score_case, [recordings] * len(batch), [sealed] * len(batch), names)
            if keep is None:
                shutil.rmtree(recordings.parent)
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
