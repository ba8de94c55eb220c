"""Writes the recording of a simulated run: three presses up to 8 mm at one site.

Run it as `python docs/examples/simulated_run.py run.mcap`, to try `palpd replay` and `palpd info` with.
"""

import sys
from pathlib import Path

from palpd.config import Plan
from palpd.testing.simulated_recording import write_simulated

PLAN = {"sites": [{"name": "A"}], "depths_m": [0.004, 0.006, 0.008], "mode": "dynamic", "repeats": 1, "press_speed_m_per_s": 0.005}

if __name__ == "__main__":
    out = Path(sys.argv[1])
    if out.exists():
        sys.exit(f"{out} exists; give another name")
    write_simulated(out, Plan.model_validate(PLAN))
