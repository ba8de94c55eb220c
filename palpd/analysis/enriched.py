"""Young's modulus by a cell file that a diagnosis has enriched: known effects of the cell no longer pass for stiffness.

The cell predicts the reading for the measured motion, and its contact force is proportional to the modulus. Modulus, height of the
surface (held by its tolerance) and a bias in each recording are free.

Presses cannot separate the modulus from the sensor's gain; the calibration gives the gain. So a creep that has settled before a press
is over, which is only a gain, counts as none.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np

from palpd.analysis.intervals import correlated_sigmas, student_t_95
from palpd.analysis.young import modulus_peak_Pa, refuse_undetermined, undithered_N
from palpd.cell.cell_file import CellFile, Estimated
from palpd.cell.effects import EFFECTS
from palpd.cell.effects.tissue import MODULUS
from palpd.cell.physics import true_surface_m
from palpd.cell.simulation import equilibrium_force_N, wrench_of
from palpd.cell.span import TipMotion
from palpd.cell.tip_motion import estimate_tip_motion
from palpd.errors import RecordingError
from palpd.recording.oddities import refuse_dead, refuse_turned
from palpd.recording.reader import Recording, holds_ticks, refuse_site, samples_of
from palpd.recording.samples import Samples, common_site, read, refuse_mixed_sites, runs_of_true
from palpd.recording.stated_geometry import with_stated_machine
from palpd.tick import Floats

SHIFT_M = 2e-5
"""Shift of the surface for the finite difference: small beside a depth, large beside rounding."""
PASSES = 6
"""Largest number of Gauss-Newton steps; the model is nearly linear, so three or four are usual."""
SETTLED, SETTLED_M = 1e-4, 1e-6
"""Relative change of the modulus and change of the surface below which the steps end: far below any interval."""
ACCEPTED = 0.01
"""Relative change of the modulus that is still accepted after the last step."""
CHANGE_AT_MOST = 3.0
"""Largest factor on the modulus in one step, so that a bad start does not throw it away."""
UNEXPLAINED = 3.0
"""Misfit, in what noise and scatter make, above which the cell file does not describe the recording."""
FAST_CREEP = 0.1
"""Share of a press below which a creep's time makes it a gain."""


@dataclass(frozen=True, slots=True)
class EnrichedModulus:
    """A modulus with its 95 % interval, and the cell that it belongs to.

    Attributes:
        ci95_Pa: Its 95 % interval.
        surface_z_m: Height of the true surface.
        surface_sigma_m: One standard deviation of that height.
        rms_N: Rms of the residual.
        expected_rms_N: Rms that noise, rounding and the scatter of presses would leave.
        gain: Factor of a force at rest that the cell file holds beside its modulus.
        cell: The cell that predicts the recordings.
        notes: A sentence for each value that cell file and recordings state differently.
    """

    youngs_modulus_Pa: float
    ci95_Pa: tuple[float, float]
    surface_z_m: float
    surface_sigma_m: float
    rms_N: float
    expected_rms_N: float
    gain: float
    cell: CellFile
    notes: tuple[str, ...] = ()

    def static_Pa(self, depths_m: Sequence[float], surface_z_m: float | None = None) -> float:
        """Static modulus by eq. 1 of Guo, Xiao, Ren 2019 on the force after a long hold.

        Args:
            depths_m: Depths to average over, in m.
            surface_z_m: Height from which the depths count, or None for the true surface.

        Returns:
            Mean modulus over the depths in Pa.
        """
        tissue = self.cell.tissue
        assert tissue is not None
        above_m = true_surface_m(self.cell) - (self.surface_z_m if surface_z_m is None else surface_z_m)
        moduli_Pa = [
            modulus_peak_Pa(equilibrium_force_N(self.cell, d + above_m), d, self.cell.probe.tip_radius_m, tissue.poisson_ratio)
            for d in depths_m
        ]
        return float(np.mean(moduli_Pa)) * self.gain


def enriched_modulus(recordings: Sequence[Samples], cell: CellFile) -> EnrichedModulus:
    """Least squares of modulus, surface and a bias per recording over whole presses; the cell file gives everything else.

    The surface may move by its tolerance (Gaussian prior). The interval holds noise, surface and bias, rounding that no noise dithers,
    the tolerance of the gain and the scatter of presses by `repeatability`, not that of the effects' parameters.

    Args:
        recordings: Recordings of one cell.
        cell: The enriched cell, with a tissue. Where it states no `robot.compliance`, that of the recordings counts.

    Returns:
        The modulus and the cell that belongs to it.

    Raises:
        RecordingError: The cell has no tissue, no recording holds contact, a force is dead or has the wrong sign, or the modulus does not
            settle or may be zero.
    """
    if cell.tissue is None:
        raise RecordingError("the cell file has no tissue, so there is no modulus to estimate; give one with a tissue block")
    for samples in recordings:
        refuse_dead(samples)
        refuse_turned(samples)
    cell, notes = with_stated_machine(cell, recordings)
    contact = _Contact.of(recordings, cell)
    fit = _converged(contact)
    force_N = contact.force_N(fit.modulus_Pa, fit.shift_m)
    touching = force_N > cell.sensor.noise_rms_N
    presses = max(sum(int(first > 0) for first in runs_of_true(touching)[0]), 1)
    step_s = float(np.median(np.diff(recordings[0].t_s)))
    gain = _settled_gain(contact.cell, FAST_CREEP * float(touching.sum()) * step_s / presses)
    weighted = np.vstack([fit.slopes, _surface_row(fit.slopes, float(np.std(fit.residual_N)) / contact.prior_m)])
    rounding_N = undithered_N(np.concatenate([samples.wrench[:, 2] for samples in recordings]), fit.residual_N[~touching])
    shared = np.append(np.where(touching, rounding_N, 0.0), 0.0)
    sigmas, n_effective = correlated_sigmas(weighted, np.append(fit.residual_N, 0.0), shared)
    relative = student_t_95(max(n_effective - fit.slopes.shape[1], 1.0)) * float(sigmas[0])
    relative = float(np.hypot(relative, 1.96 * np.hypot(cell.tolerances.gain, cell.repeatability.stiffness / np.sqrt(presses))))
    estimated = _with(contact.cell, fit.modulus_Pa, fit.shift_m)
    value = fit.modulus_Pa * gain
    ci95_Pa = (value * (1.0 - relative), value * (1.0 + relative))
    refuse_undetermined(value, ci95_Pa)
    return EnrichedModulus(
        youngs_modulus_Pa=value,
        ci95_Pa=ci95_Pa,
        surface_z_m=true_surface_m(estimated),
        surface_sigma_m=float(sigmas[1]),
        rms_N=float(np.sqrt(np.mean(fit.residual_N**2))),
        expected_rms_N=math.hypot(
            cell.sensor.noise_rms_N,
            cell.sensor.resolution_fz_N / math.sqrt(12.0),
            cell.repeatability.stiffness * float(np.sqrt(np.mean(force_N**2))),
        ),
        gain=gain,
        cell=estimated,
        notes=tuple(notes),
    )


@dataclass(frozen=True)
class _Contact:
    """The contact of a cell in some recordings: measured forces (n,) less what the cell reads without tissue, and their prediction."""

    cell: CellFile
    motions: list[TipMotion]
    free_N: list[Floats]
    measured_N: Floats
    biases: Floats

    @classmethod
    def of(cls, recordings: Sequence[Samples], cell: CellFile) -> "_Contact":
        """The contact in recordings; a modulus that differs moves from `estimated` and `effects` into the modulus itself.

        Args:
            recordings: Recordings of one cell.
            cell: The cell, with a tissue.

        Returns:
            Measured forces and all that their prediction needs.
        """
        assert cell.tissue is not None
        known = cell.estimated or Estimated()
        ratio = cell.effects.get(MODULUS.id, {}).get("ratio", 1.0)
        modulus_Pa = cell.tissue.youngs_modulus_Pa * (1.0 + known.youngs_modulus) * ratio
        cell = cell.with_effects({name: values for name, values in cell.effects.items() if name != MODULUS.id})
        cell = _with(cell.with_estimated(known.model_copy(update={"youngs_modulus": 0.0})), modulus_Pa, 0.0)
        motions = [estimate_tip_motion(cell, s.t_s, s.z_m, s.vz_m_per_s, s.z_cmd_m) for s in recordings]
        free_N = [wrench_of(cell.model_copy(update={"tissue": None}), motion)[:, 2] for motion in motions]
        which = np.repeat(np.arange(len(recordings)), [len(s) for s in recordings])
        measured_N = np.concatenate([s.wrench[:, 2] for s in recordings]) - np.concatenate(free_N)
        return cls(cell, motions, free_N, measured_N, (which[:, None] == np.arange(len(recordings))).astype(float))

    @property
    def prior_m(self) -> float:
        """One sigma of the height of the surface."""
        return self.cell.tolerances.surface_z_m

    def force_N(self, modulus_Pa: float, shift_m: float) -> Floats:
        """Predicted contact force.

        Args:
            modulus_Pa: Young's modulus.
            shift_m: Shift of the surface, up positive.

        Returns:
            Forces (n,) in N over all recordings.
        """
        moved = _with(self.cell, modulus_Pa, shift_m)
        return np.concatenate([wrench_of(moved, motion)[:, 2] - free_N for motion, free_N in zip(self.motions, self.free_N, strict=True)])


class _Fit(NamedTuple):
    """Modulus and shift of the surface that fit, the slopes (n, p) by share of modulus, surface and biases, and the residual (n,)."""

    modulus_Pa: float
    shift_m: float
    slopes: Floats
    residual_N: Floats


def _surface_row(slopes: Floats, weight: float) -> Floats:
    """The row (1, p) by which the prior holds the surface."""
    return np.eye(slopes.shape[1])[1:2] * weight


def _converged(contact: _Contact) -> _Fit:
    """Gauss-Newton steps until modulus and surface settle. Raises RecordingError where they do not, or nothing touches."""
    tissue, noise_N, prior_m = contact.cell.tissue, contact.cell.sensor.noise_rms_N, contact.prior_m
    assert tissue is not None
    modulus_Pa, shift_m, rms_N = tissue.youngs_modulus_Pa, 0.0, noise_N
    for number in range(PASSES):
        here_N = contact.force_N(modulus_Pa, shift_m)
        if not (here_N > noise_N).any():
            if number:
                break  # a step led away from the tissue
            raise RecordingError("the tip never goes below the surface of the cell file; check tissue.surface_z_m and the recording")
        slope = (contact.force_N(modulus_Pa, shift_m + SHIFT_M) - here_N) / SHIFT_M
        slopes = np.column_stack([here_N, slope, contact.biases])
        rows = np.vstack([slopes, _surface_row(slopes, 1.0) * rms_N / prior_m])
        step = np.linalg.lstsq(rows, np.append(contact.measured_N, -shift_m * rms_N / prior_m + 0.0), rcond=None)[0]
        residual_N = contact.measured_N - slopes @ step
        rms_N = max(float(np.std(residual_N)), noise_N)
        change = float(np.clip(step[0], 1.0 / CHANGE_AT_MOST, CHANGE_AT_MOST))
        modulus_Pa, shift_m = modulus_Pa * change, shift_m + float(step[1])
        if abs(change - 1.0) < SETTLED and abs(step[1]) < SETTLED_M:
            return _Fit(modulus_Pa, shift_m, slopes, residual_N)
    if abs(change - 1.0) > ACCEPTED or not (here_N > noise_N).any():
        raise RecordingError(
            f"the modulus still changes by {abs(change - 1.0):.1%} after {number + 1} passes; check the units of force and height: the "
            "cell file does not describe this recording"
        )
    return _Fit(modulus_Pa, shift_m, slopes, residual_N)


class EnrichedResult(TypedDict):
    """The modulus of one recorded site, with the keys of the command line's JSON."""

    name: str
    youngs_modulus_Pa: float
    ci95_Pa: list[float]
    contact_point_m: float
    contact_sigma_m: float
    rms_N: float
    warnings: list[str]


def analysed(file: Path, cell: CellFile, site: str | None = None) -> dict[str, Any]:
    """Modulus, interval and contact point of a recording, by an enriched cell file.

    `bias_N`, `drift_N_per_min` and the effects that begin with a recording are that recording's; a free bias takes their place.

    Args:
        file: Recording: .mcap of a run, or CSV of one site.
        cell: The enriched cell; where it has sites, each recorded site is compared with its own.
        site: Name of one site of the run, or None for all.

    Returns:
        The keys of an `EnrichedResult`; for a run also `sites`, a list of them.
    """
    if not holds_ticks(file):
        refuse_site(file, site)
        samples = read(file)
        refuse_mixed_sites(samples.sites, f"{file.name} holds")
        return {**figures_of(enriched_modulus([samples], cell.at_site(common_site([samples]))), file.stem)}
    recording = Recording.load(file)
    names = [site] if site is not None else [each["name"] for each in recording.header["sites"]]
    sites = [figures_of(enriched_modulus([samples_of(recording, name)], cell.at_site(name)), name) for name in names]
    return {"sites": sites, **(sites[0] if len(sites) == 1 else {})}


def figures_of(estimate: EnrichedModulus, name: str) -> EnrichedResult:
    """The figures of a site, with a sentence for everything that makes them doubtful."""
    return {
        "name": name,
        "youngs_modulus_Pa": estimate.youngs_modulus_Pa,
        "ci95_Pa": list(estimate.ci95_Pa),
        "contact_point_m": estimate.surface_z_m,
        "contact_sigma_m": estimate.surface_sigma_m,
        "rms_N": estimate.rms_N,
        "warnings": [*estimate.notes, *_doubts(estimate)],
    }


def _doubts(estimate: EnrichedModulus) -> list[str]:
    scatters = any(EFFECTS[name].scatter for name in estimate.cell.effects if name in EFFECTS)  # more noise than the cell file states
    if scatters or estimate.rms_N <= UNEXPLAINED * estimate.expected_rms_N:
        return []
    times = estimate.rms_N / estimate.expected_rms_N
    return [
        f"the misfit of {estimate.rms_N:.2g} N rms is {times:.1f} times what noise and scatter of this cell make: something is not in the "
        "cell file, so E and its interval may be off; palpd diagnose --cell-out names it"
    ]


def _settled_gain(cell: CellFile, within_s: float) -> float:
    """Product of the gains of the effects that settle within a press, in s."""
    settling = [(EFFECTS[name].gain_at_rest, values) for name, values in cell.effects.items() if name in EFFECTS]
    return math.prod(gain(values, within_s) for gain, values in settling if gain is not None)


def _with(cell: CellFile, modulus_Pa: float, by_m: float) -> CellFile:
    assert cell.tissue is not None
    known = cell.estimated or Estimated()
    moved = known.model_copy(update={"surface_z_m": known.surface_z_m + by_m})
    tissue = cell.tissue.model_copy(update={"youngs_modulus_Pa": modulus_Pa})
    return cell.model_copy(update={"tissue": tissue, "estimated": moved})
