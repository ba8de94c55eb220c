"""What the command line does with recordings of cells: diagnose one or several jointly, simulate, estimate tolerances."""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpd.cell import simulate
from palpd.cell_file import CellFile, load_cell, save_cell
from palpd.effects import EFFECTS, Effect, load_effects
from palpd.errors import BadInput, RecordingError
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.tolerances import estimate_tolerances
from palpd.samples import COLUMNS, WRENCH_COLUMNS, Samples, read, write_csv


def library(effects: Path | None, without: Sequence[str] = ()) -> Mapping[str, Effect]:
    """The library, with a user's own effects from a Python file, and without those that are known not to be there."""
    known = EFFECTS if effects is None else load_effects(effects)
    if unknown := [name for name in without if name not in known]:
        raise BadInput(f"there is no effect {unknown[0]!r} to leave out; expected one of {', '.join(known)}")
    return {name: effect for name, effect in known.items() if name not in without}


def diagnose_files(
    recordings: Sequence[Path],
    cell: Path,
    *,
    json_out: Path | None = None,
    cell_out: Path | None = None,
    effects: Path | None = None,
    without: Sequence[str] = (),
    propose: bool = True,
) -> Diagnosis:
    """Diagnose recordings of one cell jointly; write out.json and the enriched cell where asked, and beside the JSON the motion of the
    next experiment where one is proposed."""
    known = library(effects, without)
    nominal = load_cell(cell, known)
    found = diagnose([read(path) for path in recordings], nominal, known, propose=propose)
    if json_out is not None:
        write_answer(json_out, found)
    if cell_out is not None:
        save_cell(cell_out, found.enriched_cell())
    return found


def write_answer(path: Path, found: Diagnosis) -> None:
    """Write out.json, and beside it the motion of the next experiment where one is proposed."""
    content = found.to_json()
    if found.proposal is not None:
        motion = path.with_name(f"{path.stem}.next.csv")
        found.proposal.write_motion(motion)
        content["next_experiment"]["motion_csv"] = motion.name
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def simulate_file(
    motion: Path,
    cell: Path,
    csv_out: Path,
    *,
    from_commanded: bool = False,
    noise_seed: int | None = None,
    effects: Path | None = None,
    overwrite: bool = False,
) -> Samples:
    """The recording that a cell gives on the motion of a file: driven by its `z_m`, or by `z_cmd_m` where that is absent or asked for.
    Without noise and rounding unless a seed is given."""
    known = library(effects)
    columns = read_motion(motion)
    measured = "z_m" in columns and not from_commanded
    if from_commanded and "z_cmd_m" not in columns:
        raise RecordingError(f"{motion.name} has no column z_cmd_m; it is needed to simulate from the command.")
    out = simulate(
        load_cell(cell, known),
        columns["t_s"],
        z_cmd_m=columns.get("z_cmd_m"),
        z_m=columns["z_m"] if measured else None,
        vz_m_per_s=columns.get("vz_m_per_s") if measured else None,
        noise_seed=noise_seed,
        library=known,
    )
    speed = out.get("vz_m_per_s")
    samples = Samples(
        columns["t_s"],
        columns.get("z_cmd_m"),
        out["z_m"],
        np.gradient(out["z_m"], columns["t_s"]) if speed is None else speed,
        np.column_stack([out[name] for name in WRENCH_COLUMNS]),
    )
    write_csv(csv_out, samples, overwrite=overwrite)
    return samples


def read_motion(path: Path) -> dict[str, Any]:
    """The columns of a motion: `t_s` and at least one of `z_cmd_m`, `z_m`; `vz_m_per_s` where present. Raises RecordingError."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path.name} cannot be read ({getattr(error, 'strerror', None) or 'not text'}); give a CSV.") from None
    header = [name.strip() for name in rows[0]] if rows else []
    if "t_s" not in header or not {"z_cmd_m", "z_m"} & set(header):
        raise RecordingError(f"{path.name}: column t_s and one of z_cmd_m, z_m are needed in row 0 (the header).")
    columns: dict[str, Any] = {}
    for name in [name for name in COLUMNS[:4] if name in header]:
        at = header.index(name)
        try:
            columns[name] = np.array([float(row[at]) for row in rows[1:]])
        except (ValueError, IndexError):
            raise RecordingError(f"{path.name}: {name} holds something that is not a number; every value must be finite.") from None
        if not np.isfinite(columns[name]).all():
            row = int(np.flatnonzero(~np.isfinite(columns[name]))[0]) + 1
            raise RecordingError(f"{path.name}: {name} is not finite in row {row}; every value must be finite.")
    backwards = np.flatnonzero(np.diff(columns["t_s"]) <= 0)
    if len(columns["t_s"]) < 2 or len(backwards):
        row = int(backwards[0]) + 2 if len(backwards) else 1
        raise RecordingError(f"{path.name}: t_s does not run forwards in row {row}; a motion needs two rows or more in the order of time.")
    return columns


def tolerances_of(recordings: Sequence[Path], cell: Path) -> dict[str, dict[str, float]]:
    """The blocks `tolerances` and `repeatability` as recordings of a healthy cell show them."""
    nominal: CellFile = load_cell(cell)
    return estimate_tolerances([read(path) for path in recordings], nominal)
