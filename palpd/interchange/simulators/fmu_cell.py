"""The cell of an FMU: a commanded height in, what robot and sensor report out.

Between two communication points the command is a straight line. Its end is not known yet when a step begins, so the step extrapolates
the last one, and the next step computes it again with the command that came. Nothing of a guess is kept.
"""

import copy
from pathlib import Path
from typing import Any

import numpy as np
from pythonfmu3 import Float64, Fmi3Causality, Fmi3Initial, Fmi3Slave, Fmi3Variability, Int32

from palpd.cell.dynamics import Memory, servo
from palpd.interchange.simulators.exported_cell import COLUMNS, cell_of, chosen, physics_of, read_cells

NO_NOISE = -1
"""Value of `noise_seed` that adds neither noise nor rounding."""


class PalpdCell(Fmi3Slave):  # type: ignore[misc]
    """A co-simulation slave; inputs, outputs and parameters bear the names of its attributes."""

    def __init__(self, **kwargs: Any) -> None:
        """A cell that waits for its parameters.

        Args:
            kwargs: What pythonfmu3 hands over.
        """
        super().__init__(**kwargs)
        self.author, self.license = "palpd", "MIT"
        self.description = "A probe on a robot that presses tissue, and its force sensor"
        # a second instance may have another folder, since a master unpacks the FMU again, and Python has imported this file already
        self._cells = read_cells(Path(self.resources) / "cells.json")
        self.time = 0.0
        self.z_cmd_m = float(self._cells[0]["start_z_m"])
        self.draw, self.noise_seed = 0, NO_NOISE
        for name in COLUMNS:
            setattr(self, name, 0.0)
        self.z_m = self.z_cmd_m
        continuous = Fmi3Variability.continuous
        self.register_variable(Float64("time", causality=Fmi3Causality.independent, variability=continuous))
        self.register_variable(
            Float64("z_cmd_m", causality=Fmi3Causality.input, variability=continuous, description="commanded height of the tip")
        )
        for name in COLUMNS:
            self.register_variable(Float64(name, causality=Fmi3Causality.output, variability=continuous, initial=Fmi3Initial.calculated))
        parameters = {"draw": "0: the exported cell, k: the k-th drawn one", "noise_seed": "seed of noise and rounding; -1: none"}
        for name, what in parameters.items():
            parameter = {"causality": Fmi3Causality.parameter, "variability": Fmi3Variability.fixed, "initial": Fmi3Initial.exact}
            self.register_variable(Int32(name, description=what, **parameter))

    def exit_initialization_mode(self) -> None:
        """Parameters are set: the probe rests at the commanded height."""
        numbers = chosen(self._cells, self.draw)
        self._what, self._step_s = physics_of(numbers), float(numbers["step_s"])
        self._cell = cell_of(numbers, self._what, None if self.noise_seed == NO_NOISE else self.noise_seed)
        self._servo: Memory = {}
        self._at = self._before = (0.0, self.z_cmd_m)
        self._begin_s: float | None = None
        self._show(self._sample(0.0, self._step_s, self.z_cmd_m))
        self._kept = copy.deepcopy((self._servo, self._cell))

    def do_step(self, current_time: float, step_size: float) -> bool:
        """One communication step.

        Args:
            current_time: Time at its beginning, in s.
            step_size: Its length in s.

        Returns:
            Whether it was done.
        """
        if self._begin_s is None:
            self._begin_s = current_time
        t_s = current_time - self._begin_s
        self._servo, self._cell = self._kept
        if t_s > self._at[0]:
            self._advance(self._at, (t_s, self.z_cmd_m))
            self._before = self._at
        self._at = (t_s, self.z_cmd_m)
        self._kept = copy.deepcopy((self._servo, self._cell))
        past_s = self._at[0] - self._before[0]
        speed = (self._at[1] - self._before[1]) / past_s if past_s > 0.0 else 0.0
        self._show(self._advance(self._at, (t_s + step_size, self.z_cmd_m + speed * step_size)))
        self.time = current_time + step_size
        return True

    def _advance(self, start: tuple[float, float], end: tuple[float, float]) -> np.ndarray:
        """From one time and command to another, in samples of the sensor at most; what is reported at the end."""
        count = max(round((end[0] - start[0]) / self._step_s), 1)
        dt_s = (end[0] - start[0]) / count
        for k in range(1, count + 1):
            share = k / count
            row = self._sample(start[0] + k * dt_s, dt_s, start[1] + share * (end[1] - start[1]))
        return row

    def _sample(self, t_s: float, dt_s: float, z_cmd_m: float) -> np.ndarray:
        c = self._what.constants
        motion = servo(np.array([z_cmd_m]), dt_s, c.servo_natural_frequency_Hz, c.servo_damping_ratio, self._servo)
        z, v, a = (float(x[0]) for x in motion)
        self._cell.touch(t_s, dt_s, (z, v, a))
        return self._cell.read()

    def _show(self, row: np.ndarray) -> None:
        for name, value in zip(COLUMNS, row.tolist(), strict=True):
            setattr(self, name, value)
