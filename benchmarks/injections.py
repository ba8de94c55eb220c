"""`palpd inject` on emulated wires: from which size on the diagnosis of an emulated cell names an effect of its sensor.

`python -m benchmarks.injections [--times 40] [--kept FOLDER]` starts the phantom of the paper behind emulated wires, tares, and
carries out that many runs of one command. Prints what the command says; ends with its exit code.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import yaml

from palpd.history.injections import injection_report
from palpd.testing.emulated_cell import PATIENT, EmulatedCell, emulated_cell

PLAN = {
    "sites": [{"name": "A"}],
    "mode": "both",
    "depths_m": [0.004],
    "press_speed_m_per_s": 0.01,
    "repeats": 3,
    "hold_s": 4.0,
    "safe_height_m": 0.004,
    "free": {"strokes": 1},
    "search": {"speed_m_per_s": 0.01, "max_travel_m": 0.04},
}
"""Free strokes, a hold and three presses: the diagnosis needs each of them to tell the effects apart."""
CELL = {"sites": [{"name": "A", "tissue": {"youngs_modulus_Pa": 62.5e3}}]}
"""What the configuration states of the phantom. Without the modulus of the site a gain would only be another modulus."""
STOPS = 5
"""Most runs that the guard may stop, since this PC stood still."""
REFUSED, GUARD = 2, 3
"""Exit codes."""
PATIENCE_S = 120.0
"""Longest time for one run with its diagnosis."""


def main() -> int:
    """Print what the injections say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=40)
    parser.add_argument("--kept", type=Path, help="a new folder that keeps the runs")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, emulated_cell(Path(name)) as wired:
        folder = arguments.kept or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        plan = folder / "plan.yaml"
        plan.write_text(yaml.safe_dump(PLAN))
        cell = EmulatedCell(wired.wires, wired.model, folder, {**PATIENT, "cell": CELL})

        def palpd(*words: str | Path) -> int:
            ended = cell.palpd(*words, "--config", cell.config, patience_s=arguments.times * PATIENCE_S)
            print(ended.stdout, ended.stderr, flush=True)
            return ended.returncode

        code = palpd("calibrate")
        for _ in range(STOPS + 1):
            left = arguments.times - injection_report(folder / "runs")["judged"]
            if code or not left:
                break
            code = palpd("inject", "--plan", plan, "--times", str(left), "--here")
            if code == GUARD:
                code = {REFUSED: 0}.get(left_tissue := palpd("retract"), left_tissue)  # it refuses where the probe is clear already
        return code or palpd("inject", "--report")


if __name__ == "__main__":
    sys.exit(main())
