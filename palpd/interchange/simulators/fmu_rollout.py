"""Roll a motion out with the FMU of this folder, and write a recording. It needs fmpy and numpy.

python rollout.py motion.csv --csv rollout.csv
"""

from pathlib import Path
from typing import Any

import numpy as np

from palpd.interchange.simulators.exported_cell import (
    COLUMNS,
    at_rows,
    chosen,
    read_cells,
    roll_out_file,
    row_times,
)

HERE = Path(__file__).resolve().parent


def rollout(t_s: np.ndarray, z_cmd_m: np.ndarray, *, draw: int = 0, noise_seed: int | None = None) -> np.ndarray:
    """What a cell of this folder reports while it follows commanded heights.

    Args:
        t_s: Times (n,) in s, from 0.
        z_cmd_m: Commanded heights (n,) in m, straight between their times.
        draw: 0 for the exported cell, k for the k-th drawn one.
        noise_seed: Seed of noise and rounding; neither without one.

    Returns:
        Values (n, 8) of COLUMNS.
    """
    from fmpy import simulate_fmu  # here, so that a question for help needs no fmpy

    numbers = chosen(read_cells(HERE / "cells.json"), draw)
    rows_s = row_times(t_s, numbers)
    step_s = float(numbers["step_s"])
    end_s = step_s * np.ceil(rows_s[-1] / step_s - 1e-6)
    rows = [*zip(t_s, z_cmd_m, strict=True), (max(end_s, t_s[-1]) + step_s, z_cmd_m[-1])]
    command = np.array(rows, [("time", float), ("z_cmd_m", float)])
    parameters: dict[str, Any] = {"draw": draw, "noise_seed": -1 if noise_seed is None else noise_seed, "z_cmd_m": float(z_cmd_m[0])}
    done = simulate_fmu(
        str(HERE / "PalpdCell.fmu"),
        stop_time=end_s,
        output_interval=step_s,
        input=command,
        output=list(COLUMNS),
        start_values=parameters,
        fmi_type="CoSimulation",
    )
    return at_rows(rows_s, done["time"], np.column_stack([done[name] for name in COLUMNS]), noisy=noise_seed is not None)


if __name__ == "__main__":
    roll_out_file(rollout)
