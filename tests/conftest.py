"""A busy machine is no defect: examples may take as long as they take. Commands take signals also where the tests run in the background.

No command that a test runs reads the effects that the user has adopted. None takes its width from the terminal of the tests: readline
writes that width into COLUMNS, the processes of pytest-xdist inherit it, and a cached console keeps it.
"""

import os

from hypothesis import HealthCheck, settings

from palpd.testing.processes import take_signals

for size in ("COLUMNS", "LINES"):
    os.environ.pop(size, None)
os.environ["PALPD_EFFECTS_DIR"] = "/nowhere/effects"
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")
take_signals()
