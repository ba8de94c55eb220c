"""From the sensor byte that crosses a limit to the end of motion: how soon a status word of the sensor stops the arm.

The emulated sensor sets a status bit at an instant it knows; the controller knows when its target speed was zero. Both run in one
process on one clock, so the difference is the daemon's way, a wait for the next tick, and the controller's own two cycles.

`python benchmarks/reaction.py [--repeats 5]` prints a markdown table.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from tests.hil.faults import CYCLE_S, suffered
from tests.hil.wired import wired


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    times_ms = []
    with tempfile.TemporaryDirectory() as folder, wired(Path(folder), "ur5") as base:
        for _ in range(repeats):
            cell = base.anew(Path(tempfile.mkdtemp(dir=folder)), safety={"contact_limit_N": 16.0})
            came = suffered(lambda cell=cell: cell, "sensor status bits")  # type: ignore[misc]
            assert came.ticks is not None, came.reason
            times_ms.append(came.ticks * CYCLE_S * 1e3)
    print(f"| sensor byte to target at rest, UR5 at 125 Hz, {repeats} times | ms |")
    print("|---|---|")
    print(f"| median | {np.median(times_ms):.1f} |")
    print(f"| worst | {max(times_ms):.1f} |")
    print(f"| allowed: a tick, two controller cycles, the ramp, 2 ms | {8 + 16 + 1 + 2} |")


if __name__ == "__main__":
    main()
