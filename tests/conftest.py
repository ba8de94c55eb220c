"""A busy machine is no defect: examples may take as long as they take. Commands take signals also where the tests run in the background."""

from hypothesis import HealthCheck, settings

from benchmarks.terminal import take_signals

settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")
take_signals()
