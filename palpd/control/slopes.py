"""Two slopes of Fz: a HEX may give more counts a newton when it is pulled than when it is pressed.

Its registers hold both slopes. Whether they part where the sensor carries nothing, or where it reads zero before any tare, no document
says (`sensor.fz_slopes`; `palpd doctor --weight-N` measures it). In the first case a hanging probe is tared on one slope and the contact
is read on the other, so every contact would be over-read by (ratio - 1) × weight of the probe: 0.16 N of 2 N.
"""

from collections.abc import Sequence
from dataclasses import dataclass

GRAVITY_N_PER_KG = 9.81

FZ = 2
"""Place of Fz in a wrench; in the sensor's axes a press is negative."""


@dataclass(frozen=True, slots=True)
class FzSlopes:
    """The two slopes of one sensor, parting where it carries nothing.

    Attributes:
        pulled_over_pressed: Counts per N when pulled, over those when pressed.
        hanging_N: Weight that pulls on the sensor when it is tared.
    """

    pulled_over_pressed: float
    hanging_N: float

    def corrected(self, wrench: Sequence[float], zero: Sequence[float]) -> list[float]:
        """Correct the Fz of a wrench that was converted with the slope for pressing.

        Args:
            wrench: wrench (6,) in the sensor's axes.
            zero: its zero (6,), taken while the weight hung.

        Returns:
            The wrench (6,); less its zero, it is linear in the force.
        """
        tared_at_N = self._read(-self.hanging_N)
        load_N = self._load(zero[FZ] - wrench[FZ] + tared_at_N)
        return [*wrench[:FZ], zero[FZ] - (load_N + self.hanging_N), *wrench[FZ + 1 :]]

    def _read(self, load_N: float) -> float:
        """Reading at a load, both positive when pressed, with the slope for pressing."""
        return load_N if load_N > 0.0 else self.pulled_over_pressed * load_N

    def _load(self, reading_N: float) -> float:
        """Load at a reading: the inverse of `_read`."""
        return reading_N if reading_N > 0.0 else reading_N / self.pulled_over_pressed
