"""Many recordings of many cells: a task for each recording, over processes or a Dask cluster, and a table by cell."""

import re
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from palpd.errors import BadInput, PalpdError, RecordingError
from palpd.gap.commands import diagnose_files
from palpd.workers import pool

COMMON_CELL = "cell.yaml"
"""In a folder of a cell's recordings this cell file counts for all recordings without a cell file of their own."""


@dataclass(frozen=True)
class FleetRow:
    """A recording: its verdict and the named effects with parameters (value, low, high), or a sentence on what is wrong with it.

    Attributes:
        verdict: None where the recording could not be diagnosed.
        probability: Of the most probable named effect, of no gap where no effect is named; None where it could not be diagnosed.
        closed: Share of the gap that the named effects close; None where no effect is named, or it could not be diagnosed.
    """

    name: str
    cell: str
    verdict: str | None
    effects: dict[str, dict[str, tuple[float, float, float]]]
    probability: float | None
    closed: float | None
    sentence: str


@dataclass(frozen=True)
class CellRow:
    """A cell over its recordings in order: the last verdict, the recording since which it holds, and the trend.

    Attributes:
        failed: Number of recordings that could not be diagnosed.
        verdict: None where none could be diagnosed.
        since: Name of that recording; None where only one could be diagnosed, or none.
        trend: In words; the sentence of the last recording where none could be diagnosed.
    """

    cell: str
    recordings: int
    failed: int
    verdict: str | None
    effects: tuple[str, ...]
    since: str | None
    trend: str


def recordings_in(folder: Path) -> list[Path]:
    """The recordings of a folder in order of name; where it has none, those of the folders in it.

    Raises:
        BadInput: There are none.
    """
    for places in ([folder], sorted(p for p in folder.iterdir() if p.is_dir())):
        inside = [p for place in places for p in sorted(place.iterdir())]
        recordings = [p for p in inside if p.suffix in {".csv", ".parquet"} and not p.name.endswith(".next.csv")]
        if recordings:
            return recordings
    raise BadInput(f"{folder} holds no recording; expected X.csv files, each with its X.yaml, or folders of them.")


def cell_of(recording: Path, folder: Path) -> str:
    """The cell of a recording: its folder, else its name without the number or date at the end.

    Args:
        folder: The folder of the fleet.
    """
    if recording.parent != folder:
        return recording.parent.name
    return re.sub(r"[-_.]?\d[\d\-_T.:]*$", "", recording.stem) or recording.stem


def _cell_file(recording: Path) -> Path:
    for file in (recording.with_suffix(".yaml"), recording.with_name(COMMON_CELL)):
        if file.exists():
            return file
    raise RecordingError(f"{recording.name} has no {recording.stem}.yaml or {COMMON_CELL} beside it; give every recording its cell file.")


def diagnose_one(recording: Path, cell: str, effects: Path | None = None, adopted: Path | None = None) -> FleetRow:
    """Diagnose a recording X.csv by its cell file, and write X.json next to it.

    Args:
        effects: A file with user effects; None: no such file.
        adopted: The folder of a user's adopted effects; None: without these.

    Returns:
        The row; a recording that cannot be diagnosed is a row, too, with a sentence on what is wrong.
    """
    try:
        diagnosis = diagnose_files(
            [recording], _cell_file(recording), json_out=recording.with_suffix(".json"), effects=effects, adopted=adopted
        )
    except Exception as error:  # the end of this recording, whatever it is, and not of the others
        return _failed(recording, cell, error)
    named = {e.id: e.parameters for e in diagnosis.effects}
    probability = max((e.probability for e in diagnosis.effects), default=diagnosis.decision.p_none)
    closed, sentence = diagnosis.gap.shrink.closed, diagnosis.sentence
    return FleetRow(recording.stem, cell, diagnosis.verdict, named, probability=probability, closed=closed, sentence=sentence)


def _failed(recording: Path, cell: str, error: BaseException) -> FleetRow:
    expected = isinstance(error, PalpdError)
    return FleetRow(recording.stem, cell, None, {}, None, None, str(error) if expected else f"{type(error).__name__}: {error}")


def diagnose_folder(
    folder: Path, *, jobs: int = 1, scheduler: str | None = None, effects: Path | None = None, adopted: Path | None = None
) -> Iterator[FleetRow]:
    """Diagnose every recording of a folder, each as a task of its own.

    Args:
        folder: The workers of a cluster must see it under the same path.
        jobs: Number of processes.
        scheduler: Address of a Dask cluster; None: processes of this machine.
        effects: A file with user effects; None: no such file.
        adopted: The folder of a user's adopted effects; None: without these.

    Yields:
        Rows in the order in which tasks end. A task that fails, or a worker that dies, is a row.

    Raises:
        BadInput: There is no recording or no cluster.
    """
    recordings = recordings_in(folder)
    with _executor(jobs, scheduler) as executor:
        waiting = {executor.submit(diagnose_one, path, cell_of(path, folder), effects, adopted): path for path in recordings}
        for done in as_completed(waiting):
            error, path = done.exception(), waiting[done]
            yield done.result() if error is None else _failed(path, cell_of(path, folder), error)


@contextmanager
def _executor(jobs: int, scheduler: str | None) -> Iterator[Executor]:
    """Processes of this machine, or the workers of a Dask cluster at that address, by the same interface."""
    if scheduler is None:
        with pool(jobs) as workers:
            yield workers
        return
    try:
        from distributed import Client
    except ImportError:
        raise BadInput("--scheduler needs Dask, which is not installed; install palpd[cluster].") from None
    try:
        client = Client(scheduler, timeout=10.0)
    except (OSError, ValueError) as error:
        raise BadInput(f"there is no Dask scheduler at {scheduler} ({error}); start one with `dask scheduler`.") from None
    with client, client.get_executor() as workers:
        yield cast(Executor, workers)


def by_cell(rows: Sequence[FleetRow]) -> list[CellRow]:
    """The cells of a fleet, each from its recordings in order of name."""
    out = []
    for cell in sorted({row.cell for row in rows}):
        mine = sorted((row for row in rows if row.cell == cell), key=lambda row: row.name)
        good = [row for row in mine if row.verdict is not None]
        if not good:
            trend = mine[-1].sentence
            out.append(CellRow(cell, len(mine), len(mine), verdict=None, effects=(), since=None, trend=trend))
            continue
        last = good[-1]
        named = tuple(last.effects)
        since = last.name
        for row in reversed(good):
            if (set(named) <= set(row.effects)) if named else row.verdict == last.verdict:
                since = row.name
            else:
                break
        trends = "; ".join(filter(None, (_trend(good, name) for name in named)))
        shown = since if len(good) > 1 else None
        out.append(CellRow(cell, len(mine), len(mine) - len(good), verdict=last.verdict, effects=named, since=shown, trend=trends))
    return out


def _trend(rows: Sequence[FleetRow], effect: str) -> str:
    """How the first parameter of an effect changed over the recordings that name it.

    A straight line over their order, weighted by the intervals, or by the scatter if that is larger; steady if its slope is within two
    standard deviations.
    """
    there = [(k, row.effects[effect]) for k, row in enumerate(rows) if row.effects.get(effect)]
    if len(there) < 3:
        return ""
    name = next(iter(there[-1][1]))
    x = np.array([float(k) for k, _ in there])
    value, low, high = (np.array([p[name][i] for _, p in there]) for i in range(3))
    sigma = np.maximum((high - low) / 3.92, 1e-6 * np.abs(value).max() + 1e-300)
    w = sigma**-2 / float((sigma**-2).sum())
    away = x - float(w @ x)
    slope = float((w * away) @ value / ((w * away) @ away))
    residual = value - float(w @ value) - slope * away
    misfit = max(1.0, float(np.sqrt(np.sum((residual / sigma) ** 2) / (len(x) - 2))))
    sure = abs(slope) > 2.0 * misfit * float(np.sum((away / sigma) ** 2)) ** -0.5
    word = "steady" if not sure else "growing" if slope * value[-1] > 0 else "shrinking"
    return f"{effect} {name} {value[0]:.3g} → {value[-1]:.3g}, {word}"
