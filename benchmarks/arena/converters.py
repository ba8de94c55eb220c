"""How original files become recordings, for sources that give more than one rig; each rig's convert.py says which files and parts."""

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.signal import resample_poly

RAD_PER_COUNT = 2 * np.pi / 8192
"""Encoder of the back end of a da Vinci tool, README of the source."""
NM_PER_COUNT = 0.000039811
"""Torque sensor of the back end, README of the source."""
DAMPER_TARE_N = 132.0
"""Mean of both directions of the magnetorheological damper without current; the same for all recordings."""


def folders(script: str) -> tuple[Path, Path]:
    """The checkout that the command line names, and the recordings of the rig to which a convert.py belongs."""
    return Path(sys.argv[1]), Path(script).parent / "recordings"


def davinci_tool(source: Path, out: Path, recordings: Mapping[str, tuple[str, int, int, float]]) -> None:
    """Convert logs of github.com/MRDLab/mis-tool-characterization.

    Args:
        recordings: By name: file, first and last period of the sine, frequency in Hz.
    """
    for name, (file, first, last, frequency_Hz) in recordings.items():
        lines = (source / "data" / file).read_text(errors="replace").splitlines()
        rows = np.array([line.split(",") for line in lines if not line.startswith(("%", "B")) and line.count(",") == 9], dtype=float)
        t_s, counts = rows[:, 0], (rows[:, 1] * RAD_PER_COUNT, rows[:, 2] * NM_PER_COUNT, rows[:, 9] * RAD_PER_COUNT)
        even_s = np.arange(0, t_s[-1], 0.001)  # a few lines of the logs are lost
        table = [resample_poly(np.interp(even_s, t_s, values), 1, 10, padtype="line") for values in counts]
        part = slice(round(first / frequency_Hz * 100), round(last / frequency_Hz * 100))
        _save(out / name, 0.01, [values[part] for values in table], "t_s,angle_rad,torque_Nm,angle_cmd_rad", "%.2f %.5f %.5f %.5f")


def double_pendulum(source: Path, out: Path, recordings: Mapping[str, str], *, joint: int, rate_Hz: int, every: int) -> None:
    """Convert trajectories of github.com/dfki-ric-underactuated-lab/double_pendulum.

    Args:
        recordings: File by name.
        joint: The joint that has a motor, 1 or 2; the other one swings freely.
        rate_Hz: Of the original, whose steps are nearly even.
        every: Of this number of rows one is kept, behind a filter against aliasing.
    """
    for name, file in recordings.items():
        column = _table(source / "leaderboard" / file)
        t_s = column["time"] - column["time"][0]
        even_s = np.arange(0, t_s[-1], 1 / rate_Hz)
        table = [column[f"pos_meas{joint}"], -column[f"tau_meas{joint}"], column[f"pos_meas{3 - joint}"]]
        table = [np.interp(even_s, t_s, values) for values in table]
        if every > 1:
            table = [resample_poly(values, 1, every, padtype="line") for values in table]
        _save(out / name, every / rate_Hz, table, "t_s,angle_rad,torque_Nm,other_angle_rad", "%.4f %.5f %.4f %.4f")


def mr_damper(source: Path, out: Path, recordings: Mapping[str, tuple[str, int, int]]) -> None:
    """Convert runs of github.com/labcontrol-data/mr-damper.

    Args:
        recordings: By name: file, first and last second.
    """
    for name, (file, first_s, last_s) in recordings.items():
        data = loadmat(source / "data" / file)
        step_s = data["Ts"].item()
        part = slice(round(first_s / step_s), round(last_s / step_s))
        table = [-data["dist"].ravel()[part] / 1000, data["forc"].ravel()[part] - DAMPER_TARE_N]
        _save(out / name, step_s, table, "t_s,z_m,fz_N", "%.2f %.6f %.2f")


def pneumatic_seal(source: Path, out: Path, recordings: Mapping[str, tuple[str, float, int, int]], *, pressure_bar: float) -> None:
    """Convert runs of github.com/EvaZillen/3D-printed-pneumatic-actuator.

    Args:
        recordings: By name: file, bore in mm, first stroke, number of strokes.
    """
    for name, (file, bore_mm, first, number) in recordings.items():
        # The makers drop the first 15 rows too.
        t, _, _, _, laser, _, force = np.loadtxt(source / "results_pneumatic-actuator" / "data" / file)[15:].T
        t_s = (t - t[0]) / 1000 if t[-1] > 1000 else t - t[0]  # some files hold ms, others s
        even_s = np.arange(0, t_s[-1], 0.01)  # a few gaps of up to 0.3 s are bridged
        laser_mm, force_N = np.interp(even_s, t_s, laser), np.interp(even_s, t_s, force)
        # A stroke begins where the laser falls through its lower fifth.
        low_mm = laser_mm.min() + 0.2 * (laser_mm.max() - laser_mm.min())
        rows = np.flatnonzero((laser_mm[:-1] >= low_mm) & (laser_mm[1:] < low_mm))
        cut = np.r_[0, rows[np.r_[True, np.diff(rows) > 100]]]
        part = slice(cut[first], cut[min(first + number, len(cut) - 1)])
        tare_N = pressure_bar * 1e5 * np.pi * (bore_mm / 2000) ** 2
        _save(out / name, 0.01, [-laser_mm[part] / 1000, force_N[part] - tare_N], "t_s,z_m,fz_N", "%.2f %.6f %.2f")


def silicone_press(source: Path, out: Path, recordings: Mapping[str, str], *, last_s: int) -> None:
    """Convert compression tests of github.com/abubakardawood/tissue-phantom-material-database.

    Args:
        recordings: File by name.
        last_s: End of the part that is kept.
    """
    for name, file in recordings.items():
        lines = (source / "data" / file).read_text().splitlines()
        first = next(row for row, line in enumerate(lines) if line.startswith("Time")) + 1  # nine or ten lines of metadata
        t_s, compression_mm, load_N = np.array([line.split(",")[:3] for line in lines[first:]], dtype=float).T
        even_s = np.arange(10 * last_s) / 10  # some files hold more rows, at steps of the load
        table = [0.0 - np.interp(even_s, t_s, compression_mm) / 1000, np.interp(even_s, t_s, load_N)]
        _save(out / name, 0.1, table, "t_s,z_m,fz_N", "%.1f %.8f %.5f")


def torque_ramp(source: Path, out: Path, recordings: Mapping[str, tuple[str, int, int]]) -> None:
    """Convert torque ramps of github.com/JelmerV/Anti-Backlash-Cycloidal-Actuator.

    Args:
        recordings: By name: file, first and last second, from the first ramp to 40 Nm on.
    """
    for name, (file, first_s, last_s) in recordings.items():
        column = _table(source / "Code" / "test_data" / file)
        angle_rad = (column["POSITION"] - column["POSITION"].mean()) * 2 * np.pi  # the makers take off the mean too
        t_s = column["TIME"] - column["TIME"][column["test_nr"] >= 100][0]
        part = (t_s >= first_s) & (t_s <= last_s)
        tick_s, tick = np.unique(t_s[part], return_inverse=True)  # six or seven rows share a tick of the clock
        even_s = np.arange(tick_s[0], tick_s[-1], 1 / 64)
        table = [np.bincount(tick, values[part]) / np.bincount(tick) for values in (angle_rad, -column["TORQUE"])]
        _save(out / name, 1 / 64, [np.interp(even_s, tick_s, values) for values in table], "t_s,angle_rad,torque_Nm", "%.6f %.6f %.3f")


def _table(path: Path) -> dict[str, NDArray[np.float64]]:
    with path.open() as file:
        names = file.readline().strip().split(",")
    return dict(zip(names, np.genfromtxt(path, delimiter=",", skip_header=1).T, strict=False))


def _save(path: Path, step_s: float, table: list[NDArray[np.float64]], header: str, formats: str) -> None:
    path.parent.mkdir(exist_ok=True)
    t_s = np.arange(len(table[0])) * step_s
    np.savetxt(path, np.column_stack([t_s, *table]), fmt=formats.split(), delimiter=",", header=header, comments="")
