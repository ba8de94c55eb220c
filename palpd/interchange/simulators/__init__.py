"""A cell in other simulators: MuJoCo models and co-simulation FMUs that step palpd's own laws, in files that do not need palpd."""
