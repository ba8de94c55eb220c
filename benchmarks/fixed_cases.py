"""A fixed set of recordings to diagnose, drawn by seed from all sources of the blind check and written once.

It holds healthy cells, single effects, pairs, effects that the list lacks, laws and events, and coarse steps. Some recordings are cut in
two and diagnosed jointly, some have a simulator of their own, and between them stand the X.csv with X.yaml of a folder.
"""

import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from palpd.blind.plans import plan, plan_coarse
from palpd.blind.sources import Hosts, draw
from palpd.blind.truth import SOURCES, CaseSpec, Source
from palpd.cell.cell_file import cell_from
from palpd.cell.simulation import simulate
from palpd.recording.samples import Samples, write_csv

SEED, PLANNED = 250_000_025, 400
"""Seed of the cases, and number of them for each source; the order of the effects depends on both."""
DATA_EVERY, VARIED_EVERY, COARSE_EVERY = 11, 10, 4
"""Drawn cases between two recordings of the folder, between two that are cut or simulated, and of one source between coarse steps."""
VARIANTS = ("halves", "simulated")
"""Cut in two and diagnosed jointly; compared with the output of another simulator."""


@dataclass(frozen=True)
class Case:
    """What is diagnosed: a case to draw, or a recording that exists. `variant` is empty or one of VARIANTS."""

    name: str
    spec: CaseSpec | None = None
    csv: Path = Path()
    variant: str = ""


def fixed_cases(data: Path, count: int) -> list[Case]:
    """The first cases; a smaller number is a fair sample of a larger one.

    Args:
        data: Folder of recordings with cell files; it may be absent.
        count: Number of cases.

    Returns:
        The cases, the same ones each time.
    """
    return list(itertools.islice(_all_cases(data), count))


def _all_cases(data: Path) -> Iterator[Case]:
    recordings = iter([path for path in sorted(data.rglob("*.csv")) if path.with_suffix(".yaml").exists()])
    for number, spec in enumerate(itertools.chain.from_iterable(zip(*map(_planned, SOURCES), strict=True)), 1):
        variant = VARIANTS[number // VARIED_EVERY % len(VARIANTS)] if number % VARIED_EVERY == 0 else ""
        yield Case("-".join(filter(None, (spec.name, spec.kind, variant))), spec, variant=variant)
        if number % DATA_EVERY == 0 and (path := next(recordings, None)) is not None:
            yield Case(path.stem, csv=path)


def _planned(source: Source) -> Iterator[CaseSpec]:
    coarse = iter(plan_coarse(source, PLANNED, SEED))
    for number, spec in enumerate(plan(source, PLANNED, SEED), 1):
        yield replace(spec, extra=True)  # nobody asks for its truth, and the nearest law takes longest to find
        if number % COARSE_EVERY == 0:
            yield next(coarse)


def arguments_of(case: Case, folder: Path) -> dict[str, Any]:
    """Draw a case and write its files, unless they are there.

    Args:
        case: The case.
        folder: Where drawn files stand.

    Returns:
        `recordings`, `cell` and `simulated` as files, and the effects to leave out as `without`.
    """
    if case.spec is None:
        return {"recordings": [str(case.csv)], "simulated": [], "cell": str(case.csv.with_suffix(".yaml")), "without": []}
    written = folder / f"{case.name}.json"
    if not written.exists():
        drawn = draw(case.spec, SEED, Hosts())
        half = len(drawn.samples) // 2
        parts = [slice(half), slice(half, None)] if case.variant == "halves" else [slice(None)]
        csvs, cell = [folder / f"{case.name}.{number}.csv" for number in range(len(parts))], folder / f"{case.name}.yaml"
        for path, part in zip(csvs, parts, strict=True):
            write_csv(path, _rows(drawn.samples, part))
        cell.write_text(yaml.safe_dump(drawn.cell, sort_keys=False), encoding="utf-8")
        simulated = [folder / f"{case.name}.simulated.csv"] if case.variant == "simulated" else []
        for path in simulated:
            path.write_text(_other_simulator(drawn.samples, drawn.cell), encoding="utf-8")
        files = {"recordings": [*map(str, csvs)], "simulated": [*map(str, simulated)], "cell": str(cell), "without": drawn.without}
        written.write_text(json.dumps(files), encoding="utf-8")
    content: dict[str, Any] = json.loads(written.read_text(encoding="utf-8"))
    return content


def _rows(s: Samples, chosen: slice) -> Samples:
    z_cmd_m = None if s.z_cmd_m is None else s.z_cmd_m[chosen]
    return Samples(s.t_s[chosen], z_cmd_m, s.z_m[chosen], s.vz_m_per_s[chosen], s.wrench[chosen])


def _other_simulator(s: Samples, cell: dict[str, Any]) -> str:
    """The output of a simulator whose forces are 2 % larger than palpd's, as a CSV."""
    forces_N = simulate(cell_from(cell, "cell"), s.t_s, z_cmd_m=s.z_cmd_m, z_m=s.z_m, vz_m_per_s=s.vz_m_per_s)["fz_N"]
    return "t_s,fz_N\n" + "".join(f"{t:.9g},{1.02 * force:.9g}\n" for t, force in zip(s.t_s, forces_N, strict=True))
