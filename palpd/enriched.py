"""Young's modulus by a cell file that a diagnosis has enriched: what is known of the cell no longer passes for stiffness.

The reading is the cell's own prediction for the measured motion, in which the contact is proportional to the modulus; what is left
free besides is what a cell file calls tolerances, the height of the surface and a bias in each recording, held by them.

Modulus and sensor gain cannot be told apart by pressing; the calibration vouches for the gain. So a creep that has settled before a press
is over, which is nothing but a gain, counts as none.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from palpd.cell import equilibrium_force_N, true_surface_m, wrench_of
from palpd.cell_file import CellFile, Estimated
from palpd.errors import RecordingError
from palpd.kinematics import measured_motion
from palpd.record import Recording, samples_of
from palpd.samples import Samples, read
from palpd.tick import Floats
from palpd.young import correlated_sigmas, modulus_peak_Pa, student_t_95

SHIFT_M = 2e-5
"""Shift of the surface from which its slope is taken."""
PASSES = 6
SETTLED = 1e-4
CHANGE_AT_MOST = 3.0
FAST_CREEP = 0.1
"""Share of a press below which a creep's time makes it a gain."""


@dataclass(frozen=True, slots=True)
class EnrichedModulus:
    """A modulus with its 95 % interval, and the cell that it belongs to: `cell` predicts the recordings.

    `surface_z_m` is the height of the true surface, `surface_sigma_m` one standard deviation; `rms_N` of what is left, `gain` what the
    cell file makes of a force at rest beside its modulus.
    """

    youngs_modulus_Pa: float
    ci95_Pa: tuple[float, float]
    surface_z_m: float
    surface_sigma_m: float
    rms_N: float
    gain: float
    cell: CellFile

    def static_Pa(self, depths_m: Sequence[float], surface_z_m: float | None = None) -> float:
        """Mean over depths, below `surface_z_m` (the true one), of eq. 1 of Guo, Xiao, Ren 2019 on the force after a long hold."""
        tissue = self.cell.tissue
        assert tissue is not None
        above_m = true_surface_m(self.cell) - (self.surface_z_m if surface_z_m is None else surface_z_m)
        found = [
            modulus_peak_Pa(equilibrium_force_N(self.cell, d + above_m), d, self.cell.probe.tip_radius_m, tissue.poisson_ratio)
            for d in depths_m
        ]
        return float(np.mean(found)) * self.gain


def enriched_modulus(recordings: Sequence[Samples], cell: CellFile) -> EnrichedModulus:
    """Least squares of modulus, surface and a bias per recording over whole presses, everything else as the cell file has it.

    The surface may move by its tolerance (Gaussian prior). The interval holds noise, surface and bias, the tolerance of the gain and the
    scatter of presses by `repeatability`, not that of the effects' parameters. Raises RecordingError where no recording holds contact
    or the modulus does not settle.
    """
    if cell.tissue is None:
        raise RecordingError("the cell file has no tissue, so there is no modulus to estimate; give one with a tissue block")
    known = cell.estimated or Estimated()
    modulus = cell.tissue.youngs_modulus_Pa * (1.0 + known.youngs_modulus)
    cell = cell.with_estimated(known.model_copy(update={"youngs_modulus": 0.0}))
    motions = [measured_motion(cell, s.t_s, s.z_m, s.vz_m_per_s, s.z_cmd_m) for s in recordings]
    free = [wrench_of(cell.model_copy(update={"tissue": None}), motion)[:, 2] for motion in motions]
    which = np.repeat(np.arange(len(recordings)), [len(s) for s in recordings])
    measured_N = np.concatenate([s.wrench[:, 2] for s in recordings]) - np.concatenate(free)
    biases = (which[:, None] == np.arange(len(recordings))).astype(float)
    prior_m, shift_m = cell.tolerances.surface_z_m, 0.0

    def contact_N(modulus_Pa: float, by_m: float) -> Floats:
        with_it = _with(cell, modulus_Pa, by_m)
        return np.concatenate([wrench_of(with_it, motion)[:, 2] - still for motion, still in zip(motions, free, strict=True)])

    slopes, left_N = biases, measured_N
    for _ in range(PASSES):
        here_N = contact_N(modulus, shift_m)
        if not (here_N > cell.sensor.noise_rms_N).any():
            raise RecordingError("the tip never goes below the surface of the cell file; check tissue.surface_z_m and the recording")
        slope = (contact_N(modulus, shift_m + SHIFT_M) - here_N) / SHIFT_M
        slopes = np.column_stack([here_N, slope, biases])
        noise_N = max(float(np.std(left_N)), cell.sensor.noise_rms_N) if left_N is not measured_N else cell.sensor.noise_rms_N
        rows = np.vstack([slopes, np.eye(slopes.shape[1])[1] * noise_N / prior_m])
        step = np.linalg.lstsq(rows, np.append(measured_N, -shift_m * noise_N / prior_m + 0.0), rcond=None)[0]
        left_N = measured_N - slopes @ step
        change = float(np.clip(step[0], 1.0 / CHANGE_AT_MOST, CHANGE_AT_MOST))
        modulus, shift_m = modulus * change, shift_m + float(step[1])
        if abs(change - 1.0) < SETTLED and abs(step[1]) < 1e-6:
            break
    else:
        if abs(change - 1.0) > 0.01:
            raise RecordingError(
                f"the modulus still changes by {abs(change - 1.0):.1%} after {PASSES} passes; "
                "the cell file does not describe this recording"
            )
    held = np.vstack([slopes, np.eye(slopes.shape[1])[1] * float(np.std(left_N)) / prior_m])
    sigmas, n_effective = correlated_sigmas(held, np.append(left_N, 0.0))
    touching = contact_N(modulus, shift_m) > cell.sensor.noise_rms_N
    presses = max(int(np.sum(np.diff(touching.astype(int)) > 0)), 1)
    step_s = float(np.median(np.diff(recordings[0].t_s)))
    gain = _settled_gain(cell, FAST_CREEP * float(touching.sum()) * step_s / presses)
    relative = student_t_95(max(n_effective - slopes.shape[1], 1.0)) * float(sigmas[0])
    relative = float(np.hypot(relative, 1.96 * np.hypot(cell.tolerances.gain, cell.repeatability.stiffness / np.sqrt(presses))))
    found = _with(cell, modulus, shift_m)
    value = modulus * gain
    return EnrichedModulus(
        value,
        (value * (1.0 - relative), value * (1.0 + relative)),
        true_surface_m(found),
        float(sigmas[1]),
        float(np.sqrt(np.mean(left_N**2))),
        gain,
        found,
    )


def analysed(file: Path, cell: CellFile, site: str | None = None) -> dict[str, Any]:
    """Modulus, interval and contact point of a recording (.mcap, one of its sites or all; or CSV of one site), by this cell file.

    `bias_N`, `drift_N_per_min` and the effects that begin with a recording are that recording's; a free bias takes their place.
    """
    if file.suffix != ".mcap":
        return _told(enriched_modulus([read(file)], cell), site or file.stem)
    recording = Recording.load(file)
    names = [site] if site is not None else [each["name"] for each in recording.header["sites"]]
    found = [_told(enriched_modulus([samples_of(recording, name)], cell), name) for name in names]
    return {"sites": found, **(found[0] if len(found) == 1 else {})}


def _told(found: EnrichedModulus, name: str) -> dict[str, Any]:
    return {
        "name": name,
        "youngs_modulus_Pa": found.youngs_modulus_Pa,
        "ci95_Pa": list(found.ci95_Pa),
        "contact_point_m": found.surface_z_m,
        "contact_sigma_m": found.surface_sigma_m,
        "rms_N": found.rms_N,
        "warnings": [],
    }


def _settled_gain(cell: CellFile, within_s: float) -> float:
    creep = cell.effects.get("sensor.creep")
    return 1.0 + creep["ratio"] if creep is not None and creep["tau_s"] < within_s else 1.0


def _with(cell: CellFile, modulus_Pa: float, by_m: float) -> CellFile:
    assert cell.tissue is not None
    known = cell.estimated or Estimated()
    moved = known.model_copy(update={"surface_z_m": known.surface_z_m + by_m})
    tissue = cell.tissue.model_copy(update={"youngs_modulus_Pa": modulus_Pa})
    return cell.model_copy(update={"tissue": tissue, "estimated": moved})
