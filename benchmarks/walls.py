"""Force past the limit at a wall nobody announced: 1, 5, 20 N/mm at 2, 5, 10 mm/s, against what `palpd check-config` had printed.

`python benchmarks/walls.py [--stiffness N/m,…] [--speed m/s,…]` prints a markdown table.
"""

import argparse
import tempfile
from pathlib import Path

from palpd.testing.emulated_cell import EmulatedCell, WallOutcome, emulated_cell, press_into_wall

LIMIT_N = 12.0
ATTEMPTS = 5


def _met(base: EmulatedCell, folder: Path, stiffness_N_per_m: float, speed_m_per_s: float) -> WallOutcome:
    """The press; once more where the machine stood still for so long that the controller's watchdog ended it before the wall."""
    for _ in range(ATTEMPTS):
        cell = base.anew(Path(tempfile.mkdtemp(dir=folder)), safety={"contact_limit_N": LIMIT_N, "absolute_limit_N": 25.0})
        try:
            met = press_into_wall(cell, stiffness_N_per_m, speed_m_per_s)
        except AssertionError as error:
            if "watchdog" not in str(error):
                raise
            continue
        if met.report["trips"] or met.code == 0:
            return met
    raise SystemExit("the controller's watchdog ended every attempt; repeat on a quieter machine")


def main() -> None:
    """Measure and print, row by row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stiffness", default="1000,5000,20000")
    parser.add_argument("--speed", default="0.002,0.005,0.01")
    options = parser.parse_args()
    print("| wall | speed | end | true peak | seen by the daemon | past the limit | predicted | within 1.1 × |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder, emulated_cell(Path(folder), "ur5") as base:
        for stiffness in map(float, options.stiffness.split(",")):
            for speed in map(float, options.speed.split(",")):
                met = _met(base, Path(folder), stiffness, speed)
                end = ", ".join(trip["trip"].lower().replace("_", " ") for trip in met.report["trips"]) or "soft end"
                past_N = max(met.true_peak_N, met.seen_peak_N) - LIMIT_N
                kept = "yes" if past_N <= 1.1 * met.predicted_overshoot_N else "**no**"
                print(
                    f"| {stiffness / 1e3:g} N/mm | {speed * 1e3:g} mm/s | {end}, exit {met.code} | {met.true_peak_N:.2f} N "
                    f"| {met.seen_peak_N:.2f} N | {past_N:+.2f} N | {met.predicted_overshoot_N:.2f} N | {kept} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
