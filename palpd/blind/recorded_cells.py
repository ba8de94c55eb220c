"""A recorded cell in the physics of the blind check: its motion as it was recorded, its force as the nominal law and the rest beside it.

Any law can then be planted into the recording, and any change be measured in its noise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.signal import butter, sosfiltfilt

from palpd.blind.detectability import FINE_HZ, Detectability
from palpd.blind.drawn_cells import NOMINAL, CellRealisation, Departure, no_deviations, tolerances_of
from palpd.blind.laws import Floats, Ints
from palpd.blind.simulated_run import rows, simulate
from palpd.blind.stated_cell import BLOCKS
from palpd.recording.samples import Samples

MOTION_HZ = 20.0
"""Cutoff of the recorded motion: a robot moves slower, and the noise of its reports is faster."""
FORCE_HZ = 5.0
"""Cutoff of the force that the nominal law does not give; what is faster stays in the recording as noise."""
MIN_FREE_S = 0.2
"""Shortest time out of contact that ends a press."""


def cell_of(content: Mapping[str, Any], samples: Samples) -> CellRealisation:
    """The numbers of a cell file, with the defaults of docs/reference/cell-file.md, and of the recording where the file states no noise.

    Args:
        content: The keys of cell.yaml.

    Returns:
        The cell. Channels that do not change in the recording count as not recorded.
    """

    def block(name: str) -> dict[str, Any]:
        return dict(content.get(name) or {})

    given = {key: value for name, keys in BLOCKS.items() for key, value in block(name).items() if key in keys}
    if content.get("tissue", {}) is None:
        given |= {"surface_z_m": float(samples.z_m.min()) - 1.0, "youngs_modulus_Pa": 0.0}
    numbers = NOMINAL | {
        **given,
        "rate_Hz": samples.rate_Hz,
        "noise_rms_N": given.get("noise_rms_N") or row_noise(samples.wrench[:, 2]),
        "noise_rms_Nm": given.get("noise_rms_Nm") or row_noise(samples.wrench[:, 3]),
        "position_noise_rms_m": given.get("position_noise_rms_m", NOMINAL["position_noise_rms_m"]) or row_noise(samples.z_m),
        **{name: given.get(name) or 0.0 for name in BLOCKS["sensor"] if name.startswith("resolution_")},
    }
    numbers = {name: number if number is None else float(number) for name, number in numbers.items()}
    stated = block("tolerances")
    crosstalk = stated.pop("crosstalk", 0.003)
    tolerances = tolerances_of(numbers["noise_rms_N"], numbers["mass_kg"], numbers["tip_radius_m"])
    tolerances |= stated | {name: crosstalk for name in tolerances if name.startswith("crosstalk_")}
    scatter = {"surface_z_m": 0.004 * numbers["tip_radius_m"], "stiffness": 0.01} | block("repeatability")
    still = [k + 1 for k in range(6) if np.ptp(samples.wrench[:, k]) == 0.0]
    return CellRealisation(
        **numbers,
        tolerances=tolerances,
        scatter_surface_z_m=float(scatter["surface_z_m"]),
        scatter_stiffness=float(scatter["stiffness"]),
        silent=(*([0] if samples.z_cmd_m is None else []), *still),
    )


def row_noise(values: Floats) -> float:
    """White noise of a channel from its second differences, which a slow signal hardly reaches.

    Args:
        values: The channel (n,).

    Returns:
        One standard deviation, in the unit of the channel.
    """
    second = np.diff(values, 2)
    return float(np.median(np.abs(second - np.median(second))) / 0.6745 / 6.0**0.5)


@dataclass(frozen=True)
class RecordedMotion:
    """The motion of a recording, as the blind check's physics is given it. Its time begins at 0.

    `noise_free`: the recording holds no noise, and nothing in it is smoothed.
    """

    cell: CellRealisation
    samples: Samples
    noise_free: bool = False
    _grids: dict[float, tuple[Floats, Floats, Ints]] = field(default_factory=dict, repr=False, compare=False)
    _departures: dict[float, Departure] = field(default_factory=dict, repr=False, compare=False)

    @property
    def t_s(self) -> Floats:
        """Times of the rows from 0 (m,)."""
        return self.samples.t_s - self.samples.t_s[0]

    @property
    def press_begin_s(self) -> Floats:
        """When each press begins; one that never happens where nothing is touched."""
        t_s, touches = self.t_s, self._smooth(self.samples.z_m, MOTION_HZ) < self.cell.surface_z_m
        begins = [float(t) for t in t_s[1:][touches[1:] & ~touches[:-1]]]
        ends = [float(t) for t in t_s[1:][touches[:-1] & ~touches[1:]]]
        kept = [t for t in begins if not any(0.0 <= t - end < MIN_FREE_S for end in ends)]
        if touches[0]:
            kept.insert(0, 0.0)
        return np.array(kept or [0.0])

    @property
    def presses(self) -> int:
        """Number of presses."""
        return len(self.press_begin_s)

    def at(self, t_s: Floats) -> Floats:
        """Commanded height, or the reported one where no command was recorded.

        Args:
            t_s: Times in s (n,).

        Returns:
            Heights in m (n,).
        """
        s = self.samples
        return np.interp(t_s, self.t_s, self._smooth(s.z_m, MOTION_HZ) if s.z_cmd_m is None else s.z_cmd_m)

    def on_grid(self, dt_s: float) -> tuple[Floats, Floats, Ints]:
        """Times, commanded heights and presses (n,) at even steps over the whole motion."""
        if dt_s not in self._grids:
            t = np.arange(0.0, self.t_s[-1] + dt_s, dt_s)
            self._grids[dt_s] = (t, self.at(t), np.searchsorted(self.press_begin_s, t, side="right") - 1)
        return self._grids[dt_s]

    def departure(self, dt_s: float) -> Departure:
        """What the recorded cell does besides the nominal one: the motion that its servo does not make, the force that Hertz does not."""
        if dt_s not in self._departures:
            t = self.on_grid(dt_s)[0]
            bare = replace(self, _departures={dt_s: _nothing(len(t))})
            still = no_deviations(self.presses)
            nominal = simulate(self.cell, still, bare, dt_s=dt_s)
            z, v = (np.interp(t, self.t_s, self._smooth(x, MOTION_HZ)) for x in (self.samples.z_m, self.samples.vz_m_per_s))
            a = np.gradient(v, dt_s)
            moved = Departure(z - nominal.z_m, v - nominal.vz_m_per_s, a - nominal.az_m_per_s2, np.zeros((len(t), 6)))
            bare = replace(bare, _departures={dt_s: moved})
            own = self.samples.wrench - rows(simulate(self.cell, still, bare, dt_s=dt_s), self.t_s)[:, 1:]
            wrench = np.column_stack([np.interp(t, self.t_s, self._smooth(column, FORCE_HZ)) for column in own.T])
            self._departures[dt_s] = Departure(moved.z_m, moved.vz_m_per_s, moved.az_m_per_s2, wrench)
        return self._departures[dt_s]

    def _smooth(self, values: Floats, cutoff_Hz: float) -> Floats:
        rate_Hz = self.samples.rate_Hz
        if self.noise_free or cutoff_Hz > 0.2 * rate_Hz:
            return values
        return np.asarray(sosfiltfilt(butter(2, cutoff_Hz, fs=rate_Hz, output="sos"), values))


def _nothing(n: int) -> Departure:
    return Departure(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((n, 6)))


def detectability_of(content: Mapping[str, Any], samples: Samples, fine_Hz: float = FINE_HZ, *, noise_free: bool = False) -> Detectability:
    """What can be seen in a recorded cell on its motion.

    Args:
        content: The keys of cell.yaml.
        fine_Hz: Least rate of the grid.
        noise_free: Whether the recording holds no noise.
    """
    cell = cell_of(content, samples)
    motion = RecordedMotion(cell, samples, noise_free)
    return Detectability(cell, no_deviations(motion.presses), motion, motion.t_s, fine_Hz)
