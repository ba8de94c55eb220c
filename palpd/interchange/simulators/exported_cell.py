"""A cell from its numbers, where palpd is not at hand: exports carry this file, with the laws of the cell."""

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from palpd.cell.dynamics import Memory
from palpd.cell.effects.effect import Site, Values
from palpd.cell.physics import ActingLaw, Physics
from palpd.cell.span import Constants, Span
from palpd.cell.stages import Reporting
from palpd.cell.stepped import MovedCell

COLUMNS = ("z_m", "vz_m_per_s", "fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")
"""What robot and sensor report, in the order of a recording of palpd."""

Law = Callable[[Span, Values, Memory], None]
LAWS: dict[str, tuple[Site, Law]] = {}
"""The laws that a cell of this export may have, by effect, in the order in which they act."""

NO_LIMIT = ("cutoff_Hz", "limit_N")
"""Numbers that are null where there is no filter, and no limit to the force."""


def read_cells(path: Path) -> list[dict[str, Any]]:
    """The cells of an export: the exported one first, then the drawn ones.

    Args:
        path: The file `cells.json`.
    """
    cells: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return cells


def chosen(cells: list[dict[str, Any]], draw: int) -> dict[str, Any]:
    """One of the cells.

    Args:
        cells: The cells of an export.
        draw: 0 for the exported cell, k for the k-th drawn one.

    Raises:
        ValueError: There is no such draw.
    """
    if not 0 <= draw < len(cells):
        raise ValueError(f"there is no draw {draw}; expected 0 (the exported cell) to {len(cells) - 1}")
    return cells[draw]


def physics_of(numbers: Mapping[str, Any]) -> Physics:
    """The physics of a cell from its numbers.

    Args:
        numbers: One cell of `cells.json`.

    Returns:
        Numbers and laws, ready to compute.
    """
    values: dict[str, Any] = {key: np.inf if value is None and key in NO_LIMIT else value for key, value in numbers["constants"].items()}
    constants = Constants(**values)
    laws: dict[Site, list[ActingLaw]] = {}
    for name, (site, law) in LAWS.items():
        if name in numbers["laws"]:
            laws.setdefault(site, []).append(ActingLaw(name, law, numbers["laws"][name]))
    return Physics(constants, {site: tuple(listed) for site, listed in laws.items()})


def cell_of(numbers: Mapping[str, Any], what: Physics, noise_seed: int | None = None) -> MovedCell:
    """A cell at rest.

    Args:
        numbers: One cell of `cells.json`.
        noise_seed: Seed of noise and rounding; neither without one.
    """
    return MovedCell(what, Reporting(**numbers["reporting"]), noise_seed=noise_seed)


def row_times(t_s: np.ndarray, numbers: Mapping[str, Any]) -> np.ndarray:
    """When a simulation reports the rows of a recording: later than they are where its sensor is ahead of its robot.

    Args:
        t_s: Times (n,) of the rows, in s.
        numbers: One cell of `cells.json`.

    Returns:
        Times (n,) in s.
    """
    delay_s, skew = numbers["constants"]["delay_s"], numbers["constants"]["skew"]
    return np.maximum(t_s, (t_s - delay_s) / (1.0 - skew)) if delay_s < 0.0 or skew > 0.0 else t_s


def at_rows(rows_s: np.ndarray, t_s: np.ndarray, values: np.ndarray, *, noisy: bool) -> np.ndarray:
    """Values of a simulation at the rows of a recording.

    Args:
        rows_s: Times (n,) of the rows, in s.
        t_s: Times (k,) of the simulation, in s.
        values: Its values (k, m).
        noisy: Takes the nearest sample in place of the line between two, which would average noise.

    Returns:
        Values (n, m).
    """
    if noisy:
        return values[np.clip(np.rint(np.interp(rows_s, t_s, np.arange(len(t_s)))).astype(int), 0, len(t_s) - 1)]
    return np.column_stack([np.interp(rows_s, t_s, column) for column in values.T])


def read_motion(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times and commanded heights of a motion.

    Args:
        path: A CSV with the columns `t_s` and `z_cmd_m`.

    Returns:
        Times (n,) in s from 0, and heights (n,) in m.

    Raises:
        SystemExit: The file is no such motion.
    """
    try:
        table = np.genfromtxt(path, delimiter=",", names=True)
    except (OSError, ValueError) as error:
        raise SystemExit(f"{path} cannot be read ({error}); give a CSV with the columns t_s and z_cmd_m") from None
    if missing := [name for name in ("t_s", "z_cmd_m") if name not in (table.dtype.names or ())]:
        raise SystemExit(f"{path} has no column {missing[0]}; give a CSV with the columns t_s and z_cmd_m")
    t_s, z_cmd_m = np.atleast_1d(table["t_s"]), np.atleast_1d(table["z_cmd_m"])
    if len(t_s) < 2 or not (np.isfinite(t_s).all() and np.isfinite(z_cmd_m).all() and (np.diff(t_s) > 0.0).all()):
        raise SystemExit(f"{path} is no motion: expected two rows or more, finite numbers, and times that grow")
    return t_s - t_s[0], z_cmd_m


def roll_out_file(rollout: Callable[..., np.ndarray]) -> None:
    """The command of an export: roll a motion out and write a recording as palpd reads it.

    Args:
        rollout: Gives the values (n, 8) of COLUMNS for times (n,), commanded heights (n,), `draw` and `noise_seed`.

    Raises:
        SystemExit: The motion is none, there is no such draw, or the recording exists or cannot be written.
    """
    parser = argparse.ArgumentParser(description="Roll a motion out with the cell of this folder, and write a recording.")
    parser.add_argument("motion", type=Path, help="CSV with the columns t_s and z_cmd_m")
    parser.add_argument("--csv", type=Path, required=True, help="recording to write; it must not exist")
    parser.add_argument("--draw", type=int, default=0, help="0: the exported cell (default), k: the k-th drawn one")
    parser.add_argument("--noise", type=int, default=None, help="seed: add noise and rounding")
    asked = parser.parse_args()
    t_s, z_cmd_m = read_motion(asked.motion)
    if asked.noise is not None and asked.noise < 0:
        raise SystemExit(f"--noise is {asked.noise}, expected a seed of 0 or more")
    if asked.csv.exists():
        raise SystemExit(f"{asked.csv} exists; give another --csv")
    try:
        rows = rollout(t_s, z_cmd_m, draw=asked.draw, noise_seed=asked.noise)
        with asked.csv.open("x", encoding="utf-8") as stream:
            header = ",".join(("t_s", "z_cmd_m", *COLUMNS))
            np.savetxt(stream, np.column_stack((t_s, z_cmd_m, rows)), "%.9g", ",", header=header, comments="")
    except ValueError as error:
        raise SystemExit(str(error)) from None
    except OSError as error:
        raise SystemExit(f"{asked.csv} cannot be written ({error.strerror}); give another --csv") from None
    print(f"{asked.csv}: {len(t_s)} rows, {t_s[-1]:.1f} s.")
