"""A busy machine is no defect: examples may take as long as they take. Commands take signals also where the tests run in the background.

No command that a test runs looks into the library of the user who runs the tests, nor is any as narrow as the terminal of the runner:
readline states that terminal's size in COLUMNS, which the processes of pytest-xdist inherit and a cached console would keep.
"""

import os

from hypothesis import HealthCheck, settings

from benchmarks.terminal import take_signals

for size in ("COLUMNS", "LINES"):
    os.environ.pop(size, None)
os.environ["PALPD_EFFECTS_DIR"] = "/nowhere/effects"
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")
take_signals()
