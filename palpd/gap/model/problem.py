"""Recordings of one cell against its simulation: measured bins y, their prediction f(θ, η) and their noise Σ."""

import contextlib
import ctypes
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_array

from palpd.cell.cell_file import CROSSTALK, CROSSTALK_ARM_M, CellFile, EffectValues, Estimated
from palpd.cell.effects import EFFECTS, Effect, Scale
from palpd.cell.lattice import lattice_step
from palpd.cell.simulation import predict_motion, scale_of
from palpd.cell.span import TipMotion
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FX, FZ, Z
from palpd.gap.data.observations import Observations
from palpd.gap.data.phases import PHASES
from palpd.gap.data.prepare import PreparedRecording, prepare, stated_cell
from palpd.gap.data.rounding import Rounding, undithered_rms, undithered_rms_of
from palpd.gap.gaussian.nuisances import Columns
from palpd.gap.gaussian.whitening import Whitening
from palpd.gap.model.fixed_nuisances import Column, FixedNuisances, fixed_nuisances, torque_arm_m
from palpd.gap.model.servo_error import ORDER, ServoErrors, servo_errors
from palpd.gap.model.workspace import Workspace
from palpd.gap.user_simulator import UserSimulator
from palpd.recording.samples import Samples
from palpd.tick import Floats

Scalar = TypeVar("Scalar", bound=np.generic)

SHARED = (
    "youngs_modulus",
    "surface_z_m",
    "gain",
    "latency_s",
    "filter_cutoff",
    "mass_kg",
    "servo_natural_frequency",
    *CROSSTALK,
)
"""The deviations η, which all recordings of a cell share. Each recording has its own bias and drift, since each is tared."""

RELATIVE = {"youngs_modulus", "filter_cutoff", "servo_natural_frequency"}
"""Deviations that are fitted as logarithms, so that an unknown modulus stays positive."""


MAX_BINS = 4500
"""Approximate number of bins of a diagnosis; it bounds the time and memory of a diagnosis."""

MODULUS = np.array(SHARED) == "youngs_modulus"
SERVO = np.array(SHARED) == "servo_natural_frequency"
LOGARITHMIC = np.isin(SHARED, list(RELATIVE))
NOMINAL_ETA = np.zeros(len(SHARED))
"""Shared deviations η (11,) of a cell as its file states it."""


def tolerance_key(deviation: str) -> str:
    """Key in the cell file's tolerances of a shared deviation."""
    return "crosstalk" if deviation in CROSSTALK else deviation


def own_tolerances(effects: Iterable[Effect]) -> NDArray[np.bool_]:
    """For which of SHARED (11,) an effect stands (`Effect.tolerance`); there the effect is fitted, and η is 0."""
    keys = {effect.tolerance for effect in effects}
    return np.array([tolerance_key(name) in keys for name in SHARED])


@dataclass(frozen=True)
class Problem:
    """The data of a diagnosis and the prediction that they are compared with; nothing but its workspace changes in place.

    Attributes:
        cell: The nominal cell, with the effects that are known.
        recordings: Prepared, with b bins in all.
        library: The effects that may be present.
        rounding: How fz is rounded; None where noise dithers it.
        scale: Sizes that bounds and starting values of effects refer to.
        shared_sd: Standard deviations of SHARED (11,) in the units of the cell file; those of RELATIVE are of the logarithm.
        servo_errors: What the controller of each recording may change within specification.
        excess_noise: Whether the noise is larger than stated.
        measured: Measured bins y (7, b) in the units of the channels.
        noise: Σ of the bins, with the error of the simulator where `with_model_error_floor` has added it.
        floor_rms: Rms (7, b) of the noise without any error of the simulator, in the units of the channels.
        law_errors: What the laws of known effects, and a nominal that was learned, may be wrong by, m nuisances (m, 7, b) in the units of
            the channels.
        price_share: Share of the prices of a nominal that was learned that count: they are evidence of its recordings, bin by bin.
    """

    cell: CellFile
    recordings: tuple[PreparedRecording, ...]
    library: Mapping[str, Effect]
    rounding: Rounding | None
    scale: Scale
    shared_sd: Floats
    servo_errors: tuple[ServoErrors, ...]
    excess_noise: bool
    measured: Floats
    noise: Whitening
    floor_rms: Floats
    law_errors: Floats
    price_share: float = 1.0
    workspace: Workspace = field(default_factory=Workspace, repr=False, compare=False)

    @cached_property
    def data(self) -> Floats:
        """Measured bins y (7, b), whitened."""
        return self.noise.whiten(self.measured)

    @cached_property
    def fixed_nuisances(self) -> FixedNuisances:
        """Nuisances that do not depend on the state of the cell, whitened."""
        force_N = self.binned_prediction({}, NOMINAL_ETA)[FZ]
        fixed = fixed_nuisances(self.cell, self.recordings, self.rounding, self.servo_errors, self.noise, force_N)
        of_laws = Columns.of([dict(enumerate(self.noise.whiten(one))) for one in self.law_errors], self.measured.shape)
        labels = (Column("computation", "law of a known effect"),) * of_laws.size
        return FixedNuisances((*fixed.labels, *labels), fixed.columns.followed_by(of_laws))

    def per_bin(self, of: Callable[[PreparedRecording], NDArray[Scalar]]) -> NDArray[Scalar]:
        """Values (b,) of the bins of all recordings, joined.

        Args:
            of: Gives a value for each bin of a recording.
        """
        return np.concatenate([of(recording) for recording in self.recordings])

    # other problems of the same data

    def with_model_error_floor(self, gap: Floats) -> "Problem":
        """The problem in which no bin counts for more than the error of the simulator allows.

        Args:
            gap: Whitened gap (7, b). In each channel that error is `noise.model_error_share` of its quantile in the air and of that within
                presses, at least `noise.model_error_elsewhere` of that of the other. Where the cell has known effects, what they change
                counts as the gap: a second diagnosis knows their laws no better than the first. The gap counts for no more than the
                readings themselves, since a fit may run away.
        """
        spread = np.abs(self.measured - np.median(self.measured, axis=1, keepdims=True))
        size, level = np.minimum(np.abs(self.noise.natural(gap)), spread.max(axis=1, keepdims=True)), np.zeros(gap.shape)
        if self.cell.effects:
            without = self.without_known_effects()
            size = np.maximum(size, np.abs(self.binned_prediction({}, NOMINAL_ETA) - without.binned_prediction({}, NOMINAL_ETA)))
        in_air = self.per_bin(lambda recording: recording.bin_press) < 0
        for bins in (in_air, ~in_air):
            if bins.any():
                level[:, bins] = np.quantile(size[:, bins], ASSUMED.noise.model_error_quantile, axis=1)[:, None]
        level = np.maximum(level, ASSUMED.noise.model_error_elsewhere * level.max(axis=1, keepdims=True))
        return replace(self, noise=self.noise.widened(np.hypot(1.0, ASSUMED.noise.model_error_share * level / self.noise.sigma)))

    def without_known_effects(self) -> "Problem":
        """The problem of the cell without the effects that are known of it."""
        return replace(self, cell=self.cell.with_effects({}), workspace=Workspace())

    def with_row_weight(self, weight: float | Floats) -> "Problem":
        """The problem in which every bin counts for `weight` bins.

        Args:
            weight: A number for all channels, or a number for each channel (7,); below 1 where neighbouring residuals are correlated.
        """
        of_fz = float(np.broadcast_to(weight, len(self.measured))[FZ])
        return replace(self, noise=self.noise.with_row_weight(weight), price_share=self.price_share * of_fz)

    def with_shared_sd(self, shared_sd: Floats) -> "Problem":
        """The problem with other tolerances: standard deviations of SHARED (11,), as the attribute."""
        return replace(self, shared_sd=shared_sd, workspace=Workspace())

    def without(self, change: Floats) -> "Problem":
        """The problem of readings from which a whitened change (7, b) is taken away."""
        return replace(self, measured=self.measured - self.noise.natural(change))

    def restricted_to(self, bins: NDArray[np.bool_]) -> "Problem":
        """The problem in which only some bins (b,) count."""
        return replace(self, noise=self.noise.restricted_to(bins))

    # predictions

    def cell_at(self, effects: EffectValues, eta: Floats) -> CellFile:
        """The cell in a state.

        Args:
            effects: Parameters θ by effect. Known effects of the cell are added; of an effect in both, these parameters count.
            eta: Shared deviations η (11,) in standard deviations.
        """
        return self.cell.with_effects(self._acting(effects)).with_estimated(self.estimated(eta))

    def _acting(self, effects: EffectValues) -> EffectValues:
        """Effects and known effects that change the mean of the readings; the error of a coarse step is a nuisance (`rounding_error`)."""
        return {name: values for name, values in (self.cell.effects | effects).items() if not self.library[name].scatter}

    def estimated(self, eta: Floats) -> Estimated:
        """Shared deviations in the units of the cell file.

        Args:
            eta: The deviations η (11,) in standard deviations.

        Returns:
            The block `estimated` of a cell file, without bias and drift.
        """
        linear = eta * self.shared_sd
        relative = np.expm1(np.minimum(np.maximum(linear, -20.0), 20.0))
        value = dict(zip(SHARED, np.where(LOGARITHMIC, relative, linear).tolist(), strict=True))
        crosstalk = tuple(value.pop(name) for name in CROSSTALK)
        return Estimated.model_construct(bias_N=0.0, drift_N_per_min=0.0, crosstalk=crosstalk, **value)

    def raw_prediction(self, recording: PreparedRecording, cell: CellFile) -> Floats:
        """Prediction at every sample.

        Args:
            recording: A recording of the problem, n samples.
            cell: With effects and deviations, as `cell_at` gives it.

        Returns:
            Heights and wrench (n, 7) in the units of the channels; heights that are not compared are 0.
        """
        samples, command_m = recording.samples, recording.command_m
        out = np.zeros((len(samples), 7))
        if recording.judged[Z] and command_m is not None:
            heights_m = predict_motion(cell, samples.t_s, command_m, self.library, start=recording.state_at(0.0))
            heights_m = recording.heights(heights_m, recording.sampled.t_s)
            out[:, Z] = recording.reports.joined @ np.interp(recording.reports.t_s, samples.t_s, heights_m)
        out[:, 1:] = recording.reading(cell, recording.sampled, self.library).wrench(len(samples))
        return out

    def predict(self, effects: EffectValues, eta: Floats) -> Floats:
        """Whitened prediction f(θ, η) (7, b) of the cell in a state.

        Args:
            effects: Parameters θ by effect.
            eta: Shared deviations η (11,) in standard deviations.
        """
        return self.noise.whiten(self.binned_prediction(effects, eta))

    def binned_prediction(self, effects: EffectValues, eta: Floats) -> Floats:
        """Prediction f(θ, η) (7, b) of the cell in a state, in the units of the channels.

        The robot alone decides on its heights, and a force that is driven by measured heights does not depend on the robot. So heights and
        forces are each simulated again only where something that they depend on has changed.

        Args:
            effects: Parameters θ by effect.
            eta: Shared deviations η (11,) in standard deviations.
        """
        servo = np.where(SERVO, eta, 0.0)
        every = self._acting(effects)
        moves = {name: values for name, values in every.items() if self.library[name].motion}
        pushes = {name: values for name, values in every.items() if name not in moves}
        heights = self._cached("heights", moves, servo, self._binned_heights)
        wrench = self._cached("wrench", pushes, eta - servo, self.binned_wrench)
        return np.vstack([heights, wrench])

    def _cached(self, what: str, effects: EffectValues, eta: Floats, binned: Callable[[int, CellFile], Floats]) -> Floats:
        """Binned heights (1, b) or wrenches (6, b) of all recordings."""

        def simulated() -> Floats:
            cell = self.cell.with_effects(effects).with_estimated(self.estimated(eta))
            each = [np.atleast_2d(binned(number, cell)) for number in range(len(self.recordings))]
            return each[0] if len(each) == 1 else np.hstack(each)

        return self.workspace.prediction((what, repr(effects), eta.tobytes()), simulated, self.measured.size)

    def _binned_heights(self, number: int, cell: CellFile) -> Floats:
        recording = self.recordings[number]
        if not recording.judged[Z] or recording.z_cmd_m is None:
            return np.zeros(len(recording.bins))
        followed = self.workspace.followed.setdefault(number, {})
        t_s = recording.robot_t_s
        start = recording.state_at(float(t_s[0]))
        heights_m = predict_motion(cell, t_s, recording.z_cmd_m, self.library, begin_s=0.0, start=start, followed=followed)
        return recording.z_means @ recording.heights(heights_m, t_s)

    def binned_wrench(self, number: int, cell: CellFile, motion: TipMotion | None = None) -> Floats:
        """Predicted wrench in the bins of a recording.

        Args:
            number: Of the recording, which has b bins.
            cell: With effects and deviations, as `cell_at` gives it.
            motion: Motion of the tip at the steps of that recording; None: the most probable one.

        Returns:
            Wrench (6, b) in N and Nm.
        """
        self.workspace.simulations += 1
        recording = self.recordings[number]
        motion = recording.motion if motion is None else motion
        reading = recording.reading(cell, motion, self.library)
        return reading.averaged(lambda values: recording.step_means @ values, len(recording.bins))


def return_memory() -> None:
    """Give the system what freed arrays leave between those in use: of a million rows 0.2 GB after a search."""
    with contextlib.suppress(AttributeError):  # glibc alone has it
        ctypes.CDLL(None).malloc_trim(0)


def scale_of_longest(recordings: Sequence[Samples], cell: CellFile) -> Scale:
    """The scale of several recordings of a cell: that of the longest one."""
    longest = max(recordings, key=lambda samples: samples.duration_s)
    return scale_of(cell, longest.t_s, longest.z_m, longest.vz_m_per_s, longest.wrench[:, 2])


def problem_of(observations: Observations, library: Mapping[str, Effect]) -> Problem:
    """The problem that a diagnosis solves.

    Args:
        library: The effects that may be present.
    """
    return _problem(observations.cell, observations.recordings, library, observations.rounding, excess_noise=observations.excess_noise)


def make_problem(
    recordings: Sequence[Samples],
    cell: CellFile,
    library: Mapping[str, Effect] = EFFECTS,
    max_bins: int = MAX_BINS,
    *,
    rounding: Rounding | None = None,
    scale: Scale | None = None,
    simulators: Sequence[UserSimulator] = (),
) -> Problem:
    """Compare recordings with the simulation of a cell as they are: nothing is checked or cleaned.

    Args:
        cell: Its cell file; known effects in it are part of the nominal cell.
        library: The effects that may be present.
        max_bins: Largest number of bins of all recordings together, approximately; at least LEAST_BINS for each.
        rounding: Of fz; None where noise dithers it.
        scale: Sizes that effects refer to; None: those of the longest recording.
        simulators: A user's own simulator for each recording; empty where palpd itself simulates the nominal cell.
    """
    cell = stated_cell(cell)
    return _problem(cell, prepare(recordings, cell, library, max_bins, rounding, simulators), library, rounding, scale)


def _problem(
    cell: CellFile,
    recordings: tuple[PreparedRecording, ...],
    library: Mapping[str, Effect],
    rounding: Rounding | None,
    scale: Scale | None = None,
    excess_noise: bool = False,
) -> Problem:
    errors = tuple(servo_errors(recording, cell, library) for recording in recordings)
    noise = _whitening(cell, recordings, rounding, errors)
    return Problem(
        cell=cell,
        recordings=recordings,
        library=library,
        rounding=rounding,
        scale=scale or scale_of_longest([recording.samples for recording in recordings], cell),
        shared_sd=_shared_sd(cell),
        servo_errors=errors,
        excess_noise=excess_noise,
        measured=np.hstack([recording.measured for recording in recordings]),
        noise=noise,
        floor_rms=noise.rms,
        law_errors=_learned_errors(recordings),
    )


def _learned_errors(recordings: Sequence[PreparedRecording]) -> Floats:
    """What a nominal that was learned may be wrong by (m, 7, b), in the units of the channels; each recording has errors of its own."""
    total, begin, errors = sum(len(one.bins) for one in recordings), 0, []
    for one in recordings:
        doubt = None if one.simulated is None else one.simulated.doubt
        for error in () if doubt is None else doubt.errors:
            column = np.zeros((7, total))
            column[:, begin : begin + len(one.bins)] = one.bins.mean(error.T).T
            errors.append(column)
        begin += len(one.bins)
    return np.array(errors).reshape(-1, 7, total)


def _shared_sd(cell: CellFile) -> Floats:
    sd = {name: float(getattr(cell.tolerances, tolerance_key(name))) for name in SHARED}
    if not cell.tolerances.modulus_known:
        sd["youngs_modulus"] = ASSUMED.prior.unknown_modulus_log_sd
    if not cell.sensor.filter_cutoff_Hz:
        sd["filter_cutoff"] = 0.0
    if cell.tissue is None:
        sd["youngs_modulus"] = sd["surface_z_m"] = 0.0
    for name in ("tx_per_fz", "ty_per_fz"):
        sd[name] *= torque_arm_m(cell) / CROSSTALK_ARM_M
    return np.array([sd[name] for name in SHARED])


def _whitening(
    cell: CellFile, recordings: Sequence[PreparedRecording], rounding: Rounding | None, errors: Sequence[ServoErrors]
) -> Whitening:
    """Σ of the bins: noise of readings, of motion that drives the force, of rounding, of the controller, of reports that bins share."""
    sigmas, rounding_N = [], 0.0 if rounding is None else ASSUMED.rounding.unphased_share * rounding.undithered_rms_N
    for recording, error in zip(recordings, errors, strict=True):
        sigma = recording.noise_rms[:, None] / np.sqrt(recording.bins.count)[None, :]
        held = recording.samples.held
        if held is not None:  # values interpolated between two readings are no readings
            sigma[FX:, recording.bins.mean(held.astype(float)) > ASSUMED.noise.most_held] = np.inf
        if recording.reports.rows_each > 1.0:  # only reports are independent, and neighbours share them
            sigma[Z] *= ASSUMED.noise.own_height_share * np.sqrt(recording.reports.rows_each)
        sigma[Z] = np.hypot(sigma[Z], error.heights_m.get(ORDER, 0.0))
        sigma[FZ] = np.hypot(sigma[FZ], recording.motion.z_noise_m * _stiffness(cell, recording))
        sigma[FZ] = np.hypot(sigma[FZ], cell.probe.mass_kg * recording.removed_m_per_s2)
        sigma[FZ] = np.hypot(sigma[FZ], error.inertial_N.get(ORDER, 0.0))
        sigma[FZ] = np.hypot(sigma[FZ], rounding_N)
        sigma = np.hypot(sigma, _hidden_rms(cell, recording))
        if recording.simulated is not None and recording.simulated.doubt is not None:
            doubt = recording.simulated.doubt
            sigma = np.hypot(sigma, recording.bins.mean(doubt.unexplained.T).T)
            sigma[:, recording.bins.mean(doubt.known.astype(float)) < 0.5] = np.inf
        sigma[~np.array(recording.judged)] = np.inf
        sigmas.append(sigma)
    heights_m = [its.bins.means() @ its.reports.joined * (its.noise_rms[Z] * (its.reports.rows_each > 1.0)) for its in recordings]
    for means_m in heights_m:
        means_m.eliminate_zeros()  # all of them where every sample is a report
    shared = {Z: csr_array(block_diag(heights_m)), FZ: csr_array(block_diag([its.inertial_noise_N for its in recordings]))}
    return Whitening.of(np.hstack(sigmas), shared)


def _hidden_rms(cell: CellFile, recording: PreparedRecording) -> Floats:
    """Rms (7, 1) of the error of rounding that noise does not dither, of heights, lateral forces and torques; 0 of fz.

    Where the reading is the same, so is that error: no number of bins averages it, and all of them count as one reading for each phase.
    """
    rms = undithered_rms_of(cell)
    rms[Z], rms[FZ] = undithered_rms(lattice_step(recording.samples.z_m), recording.noise_rms[Z]), 0.0
    return np.sqrt(len(recording.bins) / len(PHASES)) * rms[:, None]


def _stiffness(cell: CellFile, recording: PreparedRecording) -> Floats:
    """dF/dz of the nominal tissue at every bin (b,), in N/m; 0 while its modulus is not known."""
    if cell.tissue is None or not cell.tolerances.modulus_known:
        return np.zeros(len(recording.bins))
    if recording.simulated is not None:
        return recording.bins.mean(recording.simulated.sampled.stiffness_N_per_m)
    depth_m = recording.bins.mean(recording.phases.depth_m)
    reduced_Pa = cell.tissue.youngs_modulus_Pa / (1.0 - cell.tissue.poisson_ratio**2)
    return np.asarray(2.0 * reduced_Pa * np.sqrt(cell.probe.tip_radius_m * depth_m))
