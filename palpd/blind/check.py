"""The blind check: cases sealed by hash, diagnosed in another process that sees recordings and cell files only, then scored.

The cases come from `sources`, which share no physics with the library.
"""

import hashlib
import json
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, TypedDict

import numpy as np
import yaml

from palpd.blind.diagnose_case import ENGINE
from palpd.blind.injected_cells import hosts_in
from palpd.blind.law_answers import write_true_change
from palpd.blind.outcome import CaseOutcome, score_case
from palpd.blind.plans import plan, plan_coarse, plan_large, plan_unlisted
from palpd.blind.score import ScoreRow, tables_by_source
from palpd.blind.sources import Hosts, draw
from palpd.blind.truth import CaseSpec, SealedCase, Source
from palpd.cell.cell_file import cell_from
from palpd.documents import parse_json
from palpd.errors import BadInput
from palpd.files import read_text, write_text
from palpd.gap.calibration import ProbabilityMap, stored_map
from palpd.recording.samples import Samples, write_csv
from palpd.workers import beside, pool

SCHEMA = "palpd.blind/5"
BATCH = 50
"""Cases that are drawn, sealed and diagnosed before the next ones: their recordings fill some 250 MB of disk, and an interrupted check
loses at most that work."""
MOST_RESUME_BYTES = 2**28
"""Largest file to resume from: some 100 000 cases."""
Ablation = Literal["no tolerances", "no press scatter", "white noise", "fz only"]
ABLATIONS: tuple[Ablation, ...] = ("no tolerances", "no press scatter", "white noise", "fz only")
"""`white noise` takes tolerances and press scatter away together: what a fit by least squares believes of its residuals."""


class CheckResult(TypedDict):
    """The content of the JSON file of a check: `cases` of each source, and a table by source and one over `all`."""

    schema: str
    cases: int
    large: int
    unlisted: int
    coarse: int
    sources: list[Source]
    recordings: str | None
    seed: int
    ablation: Ablation | None
    probability_map: dict[str, Any]
    sealed_sha256: str
    tables: dict[str, list[ScoreRow]]
    outcomes: list[CaseOutcome]


class ScoredBatch(TypedDict):
    """One line of the file that an interrupted check continues from."""

    batch: str
    digests: dict[str, str]
    outcomes: list[CaseOutcome]


# sealing


def make_case(
    spec: CaseSpec, seed: int, recordings: Path, sealed: Path, hosts: Hosts | None = None, ablation: Ablation | None = None
) -> dict[str, str]:
    """Draw a case and write it: recording and cell file for the diagnosis, truth and second motion to be sealed.

    Args:
        spec: What the case shall be.
        seed: Seed of the check.
        recordings: Folder that the diagnosis sees.
        sealed: Folder that it does not see.
        hosts: Where injected cases find their recordings.
        ablation: What is taken away from the diagnosis; None: nothing.

    Returns:
        SHA-256 of every file, by `folder/name`.

    Raises:
        CannotDraw: No cell shows the effect at any SNR.
    """
    case = draw(spec, seed, hosts or Hosts())
    cell, samples = _ablated(case, ablation)
    files = [recordings / f"{spec.name}.csv", recordings / f"{spec.name}.yaml", sealed / f"{spec.name}.json"]
    write_csv(files[0], samples)
    files[1].write_text(yaml.safe_dump(cell, sort_keys=False), encoding="utf-8")
    files[2].write_text(json.dumps(case.truth), encoding="utf-8")
    if case.without:
        files.append(recordings / f"{spec.name}.without")
        files[-1].write_text(" ".join(case.without), encoding="utf-8")
    if case.second is not None:
        files.append(sealed / f"{spec.name}.csv")
        write_csv(files[-1], case.second)
    if case.true_change is not None:
        files.append(sealed / f"{spec.name}.npz")
        write_true_change(files[-1], case.true_change)
    return {f"{file.parent.name}/{file.name}": _digest(file) for file in files}


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _ablated(case: SealedCase, ablation: Ablation | None) -> tuple[dict[str, Any], Samples]:
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
    sources: Sequence[Source] = ("drawn",),
    hosts: Hosts | None = None,
    large: int = 0,
    unlisted: int = 0,
    coarse: int = 0,
    jobs: int = 2,
    ablation: Ablation | None = None,
    keep: Path | None = None,
    resume: Path | None = None,
    calibrated: bool = True,
    progress: Callable[[int], None] = lambda _: None,
) -> CheckResult:
    """Draw, seal, diagnose and score cases, batch by batch. The diagnosis runs in another process, which sees the recordings only.

    Args:
        cases: Number of cases of each source.
        seed: The same seed draws the same cases.
        sources: Where the cases come from.
        hosts: Where injected cases find their recordings; None: MuJoCo simulates them.
        large: Number of further drawn cases with one effect of SNR > 20.
        unlisted: Number of further cases of each source with an effect outside the list.
        coarse: Number of further cases of each source with coarse steps.
        jobs: Number of processes.
        ablation: What is taken away from the diagnosis; None: nothing.
        keep: New folder for recordings, answers and truths; None: they are removed.
        resume: File that takes every scored batch; batches that it holds are not run again. None: no such file.
        calibrated: Whether the answers state probabilities by the fitted map; the engine's own otherwise.
        progress: Called with the number of scored cases.

    Returns:
        The content of the JSON file.

    Raises:
        RuntimeError: A sealed file has changed.
        BadInput: The file to resume from is of another check.
    """
    hosts = hosts or Hosts()
    by = stored_map() if calibrated else ProbabilityMap()
    result = CheckResult(
        schema=SCHEMA, cases=cases, large=large, unlisted=unlisted, coarse=coarse, sources=list(sources),
        recordings=None if hosts.folder is None else hosts.folder.name, seed=seed, ablation=ablation,
        probability_map=asdict(by), sealed_sha256="", tables={}, outcomes=[],
    )  # fmt: skip
    begun = {"seed": seed, "recordings": result["recordings"], "ablation": ablation, "probability_map": asdict(by)}
    done = _batches_in(resume, begun)
    seal = hashlib.sha256()
    folder = Path(tempfile.mkdtemp(prefix="palpd-blind-")) if keep is None else keep
    try:
        for batch in _batches(cases, seed, sources, large, unlisted, coarse, hosts):
            scored = done.get(_batch_name(batch)) or _run_batch(batch, seed, folder / _batch_name(batch), hosts, ablation, jobs, calibrated)
            if resume is not None and scored["batch"] not in done:
                done[scored["batch"]] = scored
                write_text(resume, "".join(json.dumps(line) + "\n" for line in (begun, *done.values())), own=True)
            for name in sorted(scored["digests"]):
                seal.update(f"{scored['digests'][name]}  {name}\n".encode())
            result["outcomes"] += scored["outcomes"]
            if keep is None:
                shutil.rmtree(folder / scored["batch"], ignore_errors=True)
            progress(len(result["outcomes"]))
    finally:
        if keep is None:
            shutil.rmtree(folder, ignore_errors=True)
    result["sealed_sha256"] = seal.hexdigest()
    result["tables"] = tables_by_source(result["outcomes"])
    return result


def together(checks: Sequence[CheckResult]) -> CheckResult:
    """Checks of different sources as one: all outcomes, a table by source and one over all. Its number of cells is that of the first."""
    outcomes = [outcome for check in checks for outcome in check["outcomes"]]
    sources = [source for check in checks for source in check["sources"]]
    return {**checks[0], "sources": sources, "outcomes": outcomes, "tables": tables_by_source(outcomes)}


def _batches(
    cases: int, seed: int, sources: Sequence[Source], large: int, unlisted: int, coarse: int, hosts: Hosts
) -> Iterator[list[CaseSpec]]:
    """Batches of the sources in turn, so that an interrupted check has some of each; the extra cases come last."""
    recordings = len(hosts_in(hosts.folder, hosts.causes))
    plans = [plan(source, cases, seed, recordings if source == "injected" else 0) for source in sources]
    for first in range(0, cases, BATCH):
        yield from (specs[first : first + BATCH] for specs in plans)
    extra = plan_large(large, seed)
    yield from (extra[first : first + BATCH] for first in range(0, large, BATCH))
    for count, plan_further in ((unlisted, plan_unlisted), (coarse, plan_coarse)):
        further = [plan_further(source, count, seed) for source in sources]
        for first in range(0, count, BATCH):
            yield from (specs[first : first + BATCH] for specs in further)


def _batch_name(batch: Sequence[CaseSpec]) -> str:
    return f"{batch[0].name}-{len(batch)}"


def _batches_in(resume: Path | None, begun: dict[str, Any]) -> dict[str, ScoredBatch]:
    """The batches of a file to resume from; none where there is no file yet."""
    if resume is None or not resume.exists():
        return {}
    first, *lines = [parse_json(line, resume.name) for line in read_text(resume, most_bytes=MOST_RESUME_BYTES).splitlines()] or [None]
    if first != begun:
        raise BadInput(f"{resume} holds the check {first}, and this one is {begun}; name another file")
    return {batch["batch"]: batch for batch in lines}


def _run_batch(
    batch: list[CaseSpec], seed: int, folder: Path, hosts: Hosts, ablation: Ablation | None, jobs: int, calibrated: bool
) -> ScoredBatch:
    digests = _seal_batch(batch, seed, folder, hosts, ablation, jobs)
    # From here to the comparison of the digests nothing but the other process touches the recordings.
    options = [] if calibrated else [ENGINE]
    subprocess.run(beside("palpd.blind.diagnose_case", str(folder / "recordings"), str(jobs), *options), check=True)
    return {"batch": _batch_name(batch), "digests": digests, "outcomes": _score_batch(batch, folder, digests, jobs)}


def _seal_batch(batch: list[CaseSpec], seed: int, folder: Path, hosts: Hosts, ablation: Ablation | None, jobs: int) -> dict[str, str]:
    recordings, sealed = folder / "recordings", folder / "sealed"
    if folder.exists():
        raise BadInput(f"{folder} exists already; name a new folder with --keep, or remove the batch that was interrupted")
    recordings.mkdir(parents=True)
    sealed.mkdir()
    with pool(jobs) as workers:
        each_case = workers.map(make_case, batch, *([x] * len(batch) for x in (seed, recordings, sealed, hosts, ablation)))
        return {name: digest for digests in each_case for name, digest in digests.items()}


def _score_batch(batch: list[CaseSpec], folder: Path, digests: dict[str, str], jobs: int) -> list[CaseOutcome]:
    for name, digest in digests.items():
        if _digest(folder / name) != digest:
            raise RuntimeError(f"{name} has changed since it was sealed; the check is void, run it again")
    with pool(jobs) as workers:
        return list(workers.map(score_case, [folder / "recordings"] * len(batch), [folder / "sealed"] * len(batch), batch))
