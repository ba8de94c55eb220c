"""What drivers of force sensors that send counts have in common: how counts become N and Nm, and how late a reading is."""

import math

from palpd.tick import Floats


class CountingSensor:
    """A sensor that sends counts. The driver sets `counts_per_unit` (6,), counts per N and per Nm, and the cutoff of the low-pass."""

    counts_per_unit: Floats
    filter_cutoff_Hz: float | None

    @property
    def delay_s(self) -> float:
        """Delay of a reading behind the force: 1 / (2π f_c) of a one-pole low-pass."""
        return 1 / (2 * math.pi * self.filter_cutoff_Hz) if self.filter_cutoff_Hz else 0.0

    @property
    def counts_per_N(self) -> Floats:
        """Counts per N (3,) that convert the readings."""
        return self.counts_per_unit[:3]

    @property
    def counts_per_Nm(self) -> Floats:
        """Counts per Nm (3,) that convert the readings."""
        return self.counts_per_unit[3:]
