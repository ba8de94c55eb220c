"""How long `palpd import` takes for a million rows: a table with points, and one with decimal commas and semicolons.

`python -m benchmarks.imports [--rows 1000000]` prints a markdown table. Times are those of the command, process start
included. Target: 10 s for a million rows of a table; ends with 1 where it is missed.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from palpd.testing.processes import timed

TARGET_S = 10.0
RATE_HZ = 1000.0


def table(path: Path, rows: int, *, decimal_comma: bool = False) -> None:
    """Write a table of slow presses in mm and mN."""
    t_s = np.arange(rows) / RATE_HZ
    height_mm = 5.0 * np.cos(0.5 * t_s)
    millinewtons = -1500.0 * np.maximum(-height_mm, 0.0)
    separator = ";" if decimal_comma else ","
    head = separator.join(("Time (s)", "Height (mm)", "Force (mN)"))
    with path.open("w") as file:
        file.write(head + "\n")
        for first in range(0, rows, 10_000):
            part = np.column_stack([t_s, height_mm, millinewtons])[first : first + 10_000]
            text = "".join(separator.join(f"{value:.6f}" for value in row) + "\n" for row in part.tolist())
            file.write(text.replace(".", ",") if decimal_comma else text)


def imported(source: Path, *options: str) -> tuple[float, float, int]:
    """Import a file. Returns processor time and wall time in s, and the rows of the recording."""
    target = source.with_name(f"{source.stem}-imported.csv")
    command = [sys.executable, "-m", "palpd", "import", str(source), "--csv", str(target), *options]
    processor_s, wall_s = timed(command)
    with target.open("rb") as file:
        rows = sum(not line.startswith(b"#") for line in file) - 1
    return processor_s, wall_s, rows


def main() -> None:
    """Write, import, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000)
    rows = parser.parse_args().rows
    columns = ["--force-column", "Force (mN)", "--height-column", "Height (mm)", "--time-column", "Time (s)"]
    columns += ["--compression-negative", "--units", "confirmed"]
    print("| a table of | rows read | processor time | wall time |\n|---|---|---|---|")
    kept = True
    with tempfile.TemporaryDirectory() as folder:
        for what, decimal_comma in (("commas and points", False), ("semicolons and decimal commas", True)):
            source = Path(folder) / f"{what.split()[0]}.csv"
            table(source, rows, decimal_comma=decimal_comma)
            processor_s, wall_s, read = imported(source, *columns)
            print(f"| {what} ({source.stat().st_size / 1e6:.0f} MB) | {read} | {processor_s:.1f} s | {wall_s:.1f} s |", flush=True)
            kept = kept and read == rows and wall_s <= TARGET_S
    sys.exit(not kept)


if __name__ == "__main__":
    main()
