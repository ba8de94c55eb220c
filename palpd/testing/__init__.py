"""Emulated and simulated cells for tests and benchmarks: palpd's own, and those of who writes a sensor or a robot plug-in."""
