"""Recordings of one cell against its simulation, as one whitened vector with everything that is within specification marginalised."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_array, diags_array
from scipy.special import ndtr

from palpd.cell import predict_motion, scale_of, wrench_of
from palpd.cell_file import CROSSTALK_ARM_M, CellFile, EffectValues, Estimated
from palpd.dynamics import Motion
from palpd.effects import EFFECTS, Effect, Scale
from palpd.gap.bins import Bins, make_bins
from palpd.gap.gaussian import Nuisances, nuisances
from palpd.gap.noise import FX, FY, FZ, TX, TY, Z, dead, declared_rms, measured_rms, resolutions
from palpd.gap.phases import FREE_STILL, HOLDING, Phases, find_phases
from palpd.gap.whitening import Whitening
from palpd.kinematics import measured_motion, slope_weights
from palpd.reported import Reports, find_reports, straight_between
from palpd.samples import Samples
from palpd.tick import Floats

SHARED = (
    "youngs_modulus",
    "surface_z_m",
    "gain",
    "latency_s",
    "filter_cutoff",
    "mass_kg",
    "servo_natural_frequency",
    "fx_per_fz",
    "fy_per_fz",
    "tx_per_fz",
    "ty_per_fz",
)
"""In-tolerance deviations that all recordings of a cell share; bias and drift are each recording's own, since each is tared."""

SERVO = np.array(SHARED) == "servo_natural_frequency"
LEAKS_INTO = {"fx_per_fz": FX, "fy_per_fz": FY, "tx_per_fz": TX, "ty_per_fz": TY}
LEAKS = np.isin(SHARED, list(LEAKS_INTO))

RELATIVE = {"youngs_modulus", "filter_cutoff", "servo_natural_frequency"}
"""Deviations that are fitted as logarithms, so that a modulus that is not known at all stays positive."""

TRUSTED = 0.02
"""No cell follows the laws of a simulator to better than this share of its gap."""

MOST_HELD = 0.2
"""Share of a bin in which the sensor may have said nothing new."""

UNSHARED = 0.25
"""Share of the noise of reported heights that every bin is given for itself, since bins shorter than reports are apart know no more
than their neighbours."""

FORGOTTEN = 4.6
"""After so many time constants a filter remembers a hundredth."""

REMEMBERED = 96
"""So many predictions are kept, since a search comes back to where it was a moment ago."""

LEVELS, SHARPEST = 3, 0.25
"""Rounding is followed over so many levels to either side, and never taken for sharper than with noise of that share of a step: the
levels, and where between them a force lies, are not known better."""

UNKNOWN_LOG_SD = 2.5
"""One standard deviation of the logarithm of a modulus of which nothing is known: a factor of twelve."""


@dataclass(frozen=True)
class Run:
    """One recording, prepared: phases, bins, the motion behind its noisy heights, and the noise of every bin."""

    samples: Samples
    phases: Phases
    bins: Bins  # of samples
    steps: Bins  # of the simulation's steps, each several samples long where the motion is smooth enough
    sampled: Motion  # the motion behind the noisy heights, at every sample
    motion: Motion  # at those steps, moved to even times where they were nearly even
    step_t_s: Floats  # when those steps really are
    smoother: tuple[Motion, Motion]  # its path, and its acceleration, averaged once more
    reports: Reports  # of the robot
    robot_t_s: Floats  # (k,) when the robot is simulated: at the samples where it reports more slowly, else at the steps
    z_cmd_m: Floats | None  # (k,)
    z_means: csr_array  # (b, k), means over the bins of heights at those times
    shaken_N: csr_array  # (b, r), what one standard deviation of the error of each reported speed does to fz
    noise_rms: Floats  # (7,) of one sample, as measured
    noise_ratio: Floats  # (7,) measured over declared
    rest: NDArray[np.bool_]  # (n,) where it was measured
    noise_measured: bool  # whether that was enough
    judged: tuple[bool, ...]
    t_s: Floats  # (b,)
    bin_phase: Floats
    bin_cycle: Floats
    bin_press: Floats

    @property
    def samples_each(self) -> float:
        """How many samples there are for every report of the robot."""
        return self.reports.rows_each


def prepare(samples: Samples, cell: CellFile, max_bins: int) -> Run:
    """A recording of that cell, ready to be compared."""
    surface_m = cell.tissue.surface_z_m if cell.tissue is not None else -np.inf
    phases = find_phases(samples, surface_m, cell.robot.position_noise_rms_m)
    reports = find_reports(samples.t_s, samples.z_m)
    motion = measured_motion(cell, samples.t_s, samples.z_m, samples.vz_m_per_s, samples.z_cmd_m, reports)
    again = measured_motion(cell, samples.t_s, motion.z_m, motion.vz_m_per_s, samples.z_cmd_m)
    smoother = (replace(motion, z_m=again.z_m, vz_m_per_s=again.vz_m_per_s), replace(motion, az_m_per_s2=again.az_m_per_s2))
    together = Bins.of_equal_length(samples.t_s, _together(samples, cell, reports.rows_each))
    steps = make_bins(together.mean(samples.t_s), phases, together, max_bins)
    bins = together.merged(steps)
    if reports.rows_each > 1.0:
        robot_t_s, z_cmd_m = samples.t_s - samples.t_s[0], samples.z_cmd_m
        z_means = bins.means() @ reports.joined @ straight_between(reports.t_s, samples.t_s)
    else:
        # The robot's lag turns a time that is off by a tenth of a step into heights that are off by more than their noise.
        t_s = together.mean(motion.t_s)
        robot_t_s = _even(t_s)
        z_cmd_m = None if samples.z_cmd_m is None else np.interp(robot_t_s, t_s, together.mean(samples.z_cmd_m))
        z_means = steps.means() @ straight_between(t_s, robot_t_s)
    declared = declared_rms(cell)
    still = np.isin(phases.phase, (FREE_STILL, HOLDING)) & (phases.since_s > 0.1 * phases.since_s.max())
    unheld = still if samples.held is None else still & ~samples.held
    judged, measured = [], np.zeros(7)
    for channel in range(7):
        if channel == Z:
            usable = samples.z_cmd_m is not None and not dead(samples.z_m)
            signal, rest = reports.values(samples.z_m), still[np.searchsorted(samples.t_s, reports.t_s)]
        else:
            signal, rest = samples.wrench[:, channel - 1], unheld
            usable = not dead(signal)
        judged.append(usable)
        if usable:
            measured[channel] = measured_rms(signal, rest) if rest.sum() >= 60 else min(measured_rms(signal), declared[channel])
    floor = np.where(declared > 0, declared, np.maximum(measured, 1e-300))
    rms = np.where(measured > 0, np.maximum(measured, 0.5 * floor), floor)
    return Run(
        samples,
        phases,
        bins,
        steps,
        motion,
        _at_steps(motion, together),
        together.mean(motion.t_s),
        (_at_steps(smoother[0], together), _at_steps(smoother[1], together)),
        reports,
        robot_t_s,
        z_cmd_m,
        z_means,
        _shaken(samples, cell, motion, reports, bins) if judged[FZ] else csr_array((len(bins), 1)),
        rms,
        np.where(measured > 0, measured / floor, 1.0),
        unheld,
        bool(still.sum() >= 60),
        tuple(judged),
        bins.mean(samples.t_s - samples.t_s[0]),
        bins.first(phases.phase).astype(float),
        bins.first(phases.cycle).astype(float),
        bins.first(phases.press).astype(float),
    )


def _shaken(samples: Samples, cell: CellFile, motion: Motion, reports: Reports, bins: Bins) -> csr_array:
    """What one standard deviation of the error of each reported speed (k,) does to the binned force of inertia (b,), in N.

    The error of one report shows as a push forth and back over as long as reports are apart and slopes are taken over, and as long again as
    the sensor's filter remembers: bins share it.
    """
    n, dt_s = len(samples), 1.0 / samples.rate_Hz
    weights = cell.probe.mass_kg * motion.v_noise_m_per_s * slope_weights(dt_s, motion.slope_half)
    first = -(len(weights) // 2)
    if cell.sensor.filter_cutoff_Hz:
        per_step = 2.0 * np.pi * cell.sensor.filter_cutoff_Hz * dt_s
        remembered = np.exp(-per_step * np.arange(int(FORGOTTEN / per_step) + 1))
        weights, first = np.convolve(weights, remembered[::-1] / remembered.sum()), first - len(remembered) + 1
    trust = bins.mean(np.broadcast_to(motion.trust, n))
    return csr_array(diags_array(trust) @ _means_of_sums(bins, weights, first, n) @ reports.joined)


def _means_of_sums(bins: Bins, weights: Floats, first: int, n: int) -> csr_array:
    """What takes weighted sums of neighbours, from `first` on, of n samples, and their mean over every bin, as a matrix (b, n)."""
    reach = bins.count + len(weights) - 1
    row = np.repeat(np.arange(len(bins)), reach)
    k = np.arange(len(row)) - np.repeat(np.cumsum(reach) - reach, reach)
    column = bins.begin[row] + first + k
    total = np.concatenate([[0.0], np.cumsum(weights)])
    value = (total[np.minimum(k + 1, len(weights))] - total[np.maximum(k + 1 - bins.count[row], 0)]) / bins.count[row]
    inside = (column >= 0) & (column < n)
    return csr_array((value[inside], (row[inside], column[inside])), shape=(len(bins), n))


def _together(samples: Samples, cell: CellFile, samples_each: float) -> int:
    """How many samples one step of the simulation may take: a sixth of what the heights are averaged over, and never so many that fewer
    than 4500 steps are left; up to a third where the robot reports no more often, since no faster motion is known then."""
    averaged = 0.25 / cell.robot.servo_natural_frequency_Hz * samples.rate_Hz
    return max(1, min(int(averaged / 5.0), len(samples) // 4500), min(int(averaged / 3.0), int(samples_each)))


def _at_steps(motion: Motion, together: Bins) -> Motion:
    t_s = together.mean(motion.t_s)
    even_s = _even(t_s)

    def at(values: Floats) -> Floats:
        return np.interp(even_s, t_s, together.mean(values))

    z_m, vz_m_per_s, az_m_per_s2 = at(motion.z_m), at(motion.vz_m_per_s), at(motion.az_m_per_s2)
    return replace(motion, t_s=even_s, z_m=z_m, vz_m_per_s=vz_m_per_s, az_m_per_s2=az_m_per_s2)


def _even(t_s: Floats) -> Floats:
    """Times of steps, moved by up to half a step to where they are evenly spaced; the last, which may be short, by any amount.
    As they are where that does not suffice. (A filter over even steps costs a tenth of one over uneven ones.)"""
    if len(t_s) < 4:
        return t_s
    step_s = float(t_s[-2] - t_s[0]) / (len(t_s) - 2)
    even_s = t_s[0] + step_s * np.arange(len(t_s))
    return even_s if float(np.abs(even_s - t_s)[:-1].max()) < 0.5 * step_s else t_s


@dataclass
class Columns:
    """Which of the columns after the shared ones is what; effects change which there are (a press that no longer touches has none).

    `own`: (channel, number, bias or drift) of every recording's own; `press`: (number, stiffness or surface_z_m) of every press's scatter;
    `numerical`: numbers of what the computation itself is not sure of.
    """

    own: list[tuple[int, int, str]] = field(default_factory=list)
    press: list[tuple[int, str]] = field(default_factory=list)
    numerical: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class Linearisation:
    """The nuisances around one state of the cell: the effects there, the shared deviations there (in standard deviations)."""

    effects: EffectValues
    eta: Floats
    columns: Floats  # (k, c, b), the first len(eta) of them the shared deviations
    space: Nuisances
    prediction: Floats  # of the cell in that state
    index: Columns

    def offset(self) -> Floats:
        """What the linear model has to give back, since its deviations count from zero and not from `eta`."""
        return np.tensordot(self.eta, self.columns[: len(self.eta)], axes=1)


@dataclass(frozen=True)
class Rounding:
    """How fz is rounded where that is coarser than stated: to `level_N` and every `step_N` from there."""

    step_N: float
    level_N: float
    noise_rms_N: float

    def mean(self, force_N: Floats) -> Floats:
        """What readings (n,) are on average of forces (n,) with normal noise before they are rounded."""
        sigma = max(self.noise_rms_N, SHARPEST * self.step_N)
        nearest = np.rint((force_N - self.level_N) / self.step_N)
        out = np.zeros_like(force_N)
        for k in range(-LEVELS, LEVELS + 1):
            level = (nearest + k) * self.step_N + self.level_N
            above = np.full_like(force_N, np.inf) if k == LEVELS else (level + 0.5 * self.step_N - force_N) / sigma
            below = np.full_like(force_N, -np.inf) if k == -LEVELS else (level - 0.5 * self.step_N - force_N) / sigma
            out += level * (ndtr(above) - ndtr(below))
        return out

    def slope(self, force_N: Floats) -> Floats:
        """How much of a small offset of forces (n,) is left in the mean readings."""
        h = 0.1 * self.step_N
        return (self.mean(force_N + h) - self.mean(force_N - h)) / (2.0 * h)


@dataclass
class Problem:
    """Everything a hypothesis is judged by."""

    cell: CellFile
    runs: list[Run]
    library: Mapping[str, Effect]
    scale: Scale
    shared_sd: Floats
    noise: Whitening = field(init=False)
    measured: Floats = field(init=False)  # (7, b)
    data: Floats = field(init=False)  # (7, b) whitened
    floor_rms: Floats = field(init=False)  # (7, b), of the noise alone
    rounding: Rounding | None = None
    """Of fz, where it is coarser than stated."""
    noisy: bool = False
    """Whether its noise is not the stated one, but larger."""
    simulations: int = 0

    def cell_at(self, effects: EffectValues, eta: Floats) -> CellFile:
        """The cell with these effects and shared deviations (in standard deviations)."""
        return self.cell.with_effects(effects).with_estimated(self.estimated(eta))

    def estimated(self, eta: Floats) -> Estimated:
        """The shared deviations in the units of the cell file."""
        value = dict(zip(SHARED, (eta * self.shared_sd).tolist(), strict=True))
        for name in RELATIVE:
            value[name] = float(np.expm1(np.clip(value[name], -20.0, 20.0)))
        return Estimated.model_construct(
            bias_N=0.0,
            drift_N_per_min=0.0,
            gain=value["gain"],
            latency_s=value["latency_s"],
            filter_cutoff=value["filter_cutoff"],
            crosstalk=(value["fx_per_fz"], value["fy_per_fz"], value["tx_per_fz"], value["ty_per_fz"]),
            mass_kg=value["mass_kg"],
            youngs_modulus=value["youngs_modulus"],
            surface_z_m=value["surface_z_m"],
            servo_natural_frequency=value["servo_natural_frequency"],
        )

    def raw_prediction(self, run: Run, cell: CellFile) -> Floats:
        """Heights and wrench (n, 7) at every sample; zero where a channel is not judged."""
        samples = run.samples
        out = np.zeros((len(samples), 7))
        if run.judged[Z] and samples.z_cmd_m is not None:
            heights_m = predict_motion(cell, samples.t_s, samples.z_cmd_m, self.library)
            out[:, Z] = run.reports.joined @ np.interp(run.reports.t_s, samples.t_s, heights_m)
        out[:, 1:] = wrench_of(cell, run.sampled, self.library)
        return out

    def _heights(self, run: Run, cell: CellFile) -> Floats:
        """Binned heights (b,)."""
        if not run.judged[Z] or run.z_cmd_m is None:
            return np.zeros(len(run.bins))
        return run.z_means @ predict_motion(cell, run.robot_t_s, run.z_cmd_m, self.library)

    def _wrench(self, run: Run, cell: CellFile, motion: Motion) -> Floats:
        """Binned wrench (6, b)."""
        self.simulations += 1
        wrench = wrench_of(cell, motion, self.library)
        if self.rounding is not None:
            wrench[:, FZ - 1] = self.rounding.mean(wrench[:, FZ - 1])
        out = np.zeros((6, len(run.bins)))
        for axis in range(6):
            if wrench[:, axis].any():
                out[axis] = _binned_steps(run, motion, wrench[:, axis])
        return out

    def predict(self, effects: EffectValues, eta: Floats) -> Floats:
        """The whitened prediction (7, b)."""
        servo = np.where(SERVO, eta, 0.0)
        moves = {name: values for name, values in effects.items() if self.library[name].motion}
        pushes = {name: values for name, values in effects.items() if name not in moves}
        heights = self._remembered("heights", moves, servo, self._heights)
        wrench = self._remembered("wrench", pushes, eta - servo, lambda run, cell: self._wrench(run, cell, run.motion))
        return self.noise.whiten(np.vstack([heights, wrench]))

    def _remembered(self, what: str, effects: EffectValues, eta: Floats, simulated: Callable[[Run, CellFile], Floats]) -> Floats:
        """Binned heights (1, b), or wrenches (6, b), of all recordings. The robot alone decides on its heights, and what is driven by
        measured heights does not depend on it, so each is simulated only where something of its own has changed."""
        key = (what, repr(effects), eta.tobytes())
        known = self._known.get(key)
        if known is None:
            if len(self._known) >= REMEMBERED:
                del self._known[next(iter(self._known))]
            cell = self.cell_at(effects, eta)
            known = np.hstack([np.atleast_2d(simulated(run, cell)) for run in self.runs])
            # A trial far outside all reason may overflow: it then fits badly, and that is all that is asked of it.
            known = self._known[key] = known if np.isfinite(known.sum()) else np.nan_to_num(known, nan=1e100, posinf=1e100, neginf=-1e100)
        return known

    def __post_init__(self) -> None:
        self._known: dict[tuple[str, str, bytes], Floats] = {}
        measured = []
        sigmas = []
        for run in self.runs:
            z = run.samples.z_m[:, None] if run.judged[Z] else np.zeros((len(run.samples), 1))
            measured.append(self._binned(run, np.hstack([z, run.samples.wrench])))
            sigma = run.noise_rms[:, None] / np.sqrt(run.bins.count)[None, :]
            if run.samples.held is not None:  # what was put between two readings is none, and bends where the motion does not
                sigma[FX:, run.bins.mean(run.samples.held.astype(float)) > MOST_HELD] = np.inf
            if run.samples_each > 1.0:  # only reports are independent, and neighbours share them
                sigma[Z] *= UNSHARED * np.sqrt(run.samples_each)
            sigma[FZ] = np.hypot(sigma[FZ], run.motion.z_noise_m * self._stiffness(run))
            sigma[FZ] = np.hypot(sigma[FZ], _coherent(self.rounding.step_N if self.rounding else 0.0, float(run.noise_rms[FZ])))
            sigma[~np.array(run.judged)] = np.inf
            sigmas.append(sigma)
        heights_m = [run.bins.means() @ run.reports.joined * (run.noise_rms[Z] * (run.samples_each > 1.0)) for run in self.runs]
        shared = {Z: csr_array(block_diag(heights_m)), FZ: csr_array(block_diag([run.shaken_N for run in self.runs]))}
        self.measured = np.hstack(measured)
        self._judge_by(Whitening.of(np.hstack(sigmas), shared))
        self.floor_rms = self.noise.rms

    def _judge_by(self, noise: Whitening) -> None:
        self.noise = noise
        self.data = noise.whiten(self.measured)

    def soften(self, gap: Floats) -> None:
        """Trust no bin to better than a small share of its channel's whitened gap (7, b): no law of a real cell is that exact."""
        level = np.quantile(np.abs(self.noise.natural(gap)), 0.95, axis=1)[:, None]
        self._judge_by(self.noise.softened(np.hypot(1.0, TRUSTED * level / self.noise.sigma)))

    def weigh(self, weight: float) -> None:
        """Let each row count for so many."""
        self._judge_by(self.noise.weighed(weight))

    def only(self, bins: NDArray[np.bool_]) -> "Problem":
        """The same problem with all other bins weighing nothing."""
        part = copy.copy(self)
        part._judge_by(self.noise.restricted(bins))
        return part

    def _binned(self, run: Run, values: Floats) -> Floats:
        return np.ascontiguousarray(run.bins.mean(values).T)

    def _stiffness(self, run: Run) -> Floats:
        """dF/dz of the nominal tissue at every bin."""
        if self.cell.tissue is None:
            return np.zeros(len(run.bins))
        tissue, radius_m = self.cell.tissue, self.cell.probe.tip_radius_m
        depth_m = run.bins.mean(run.phases.depth_m)
        known = self.cell.tolerances.modulus_known
        reduced_Pa = tissue.youngs_modulus_Pa / (1.0 - tissue.poisson_ratio**2) if known else 0.0
        return np.asarray(2.0 * reduced_Pa * np.sqrt(radius_m * depth_m))

    def linearise(self, effects: EffectValues, eta: Floats) -> Linearisation:
        """Nuisance columns around a state: shared deviations, bias and drift of every recording, scatter of every press."""
        prediction = self.predict(effects, eta)
        step = np.where(np.array(SHARED) == "surface_z_m", 0.3, 0.5)
        shared = []
        leaking = eta + np.where(LEAKS, 0.5, 0.0)  # each into an axis of its own, so all at once
        leaks = (self.predict(effects, leaking) - prediction) / 0.5 if self.shared_sd[LEAKS].any() else np.zeros_like(prediction)
        for k, sd in enumerate(self.shared_sd):
            column = np.zeros_like(prediction)
            if SHARED[k] in LEAKS_INTO:
                channel = LEAKS_INTO[SHARED[k]]
                column[channel] = leaks[channel]
            elif sd > 0.0:
                h = min(step[k], 0.05 / sd) if SHARED[k] in RELATIVE else step[k]
                there = eta.copy()
                there[k] += h
                column = (self.predict(effects, there) - prediction) / h
            shared.append(column)
        own, index = self._own_columns(effects, eta, prediction, shared)
        columns = np.array([*shared, *own])
        return Linearisation(effects, eta.copy(), columns, nuisances(columns), prediction, index)

    def _own_columns(
        self, effects: EffectValues, eta: Floats, prediction: Floats, shared: Sequence[Floats]
    ) -> tuple[list[Floats], Columns]:
        tol, rep = self.cell.tolerances, self.cell.repeatability
        modulus, surface = shared[SHARED.index("youngs_modulus")], shared[SHARED.index("surface_z_m")]
        sd_modulus, sd_surface = (self.shared_sd[SHARED.index(name)] for name in ("youngs_modulus", "surface_z_m"))
        cell = self.cell_at(effects, eta)
        columns: list[Floats] = []
        index = Columns()
        start = 0
        for run in self.runs:
            stop = start + len(run.bins)
            here = slice(start, stop)

            def column(channel: int, values: Floats, here: slice = here) -> Floats:
                out = np.zeros_like(prediction)
                out[channel, here] = values
                return self.noise.whiten(out)

            felt = self._felt(run, cell)
            for channel in range(FX, 7):
                if run.judged[channel]:
                    arm = 1.0 if channel < TX else torque_arm_m(self.cell)
                    index.own += [(channel, len(columns), "bias"), (channel, len(columns) + 1, "drift")]
                    share = felt if channel == FZ else 1.0
                    columns.append(column(channel, share * arm * tol.bias_N * np.ones(stop - start)))
                    columns.append(column(channel, share * arm * tol.drift_N_per_min / 60.0 * run.t_s))
            if run.judged[Z]:
                # A target that is held between controller cycles is known to about a tenth of a step.
                index.numerical.append(len(columns))
                slope = np.gradient(self.noise.natural(prediction)[Z, here], run.t_s)
                columns.append(column(Z, 0.1 * run.samples_each / run.samples.rate_Hz * slope))
            # What averaging took away from the motion once, averaging again takes away again: so uncertain is the motion.
            here_raw = self._wrench(run, cell, run.motion)[FZ - 1]
            for motion in run.smoother if run.judged[FZ] else ():
                index.numerical.append(len(columns))
                columns.append(column(FZ, self._wrench(run, cell, motion)[FZ - 1] - here_raw))
            for press in range(run.phases.presses):
                window = np.zeros(prediction.shape[1], dtype=bool)
                window[here] = _around(run.bin_press == press)
                for name, source, sd, scatter in (
                    ("stiffness", modulus, sd_modulus, rep.stiffness),
                    ("surface_z_m", surface, sd_surface, rep.surface_z_m),
                ):
                    if sd > 0 and scatter > 0 and source[FZ, window].any():
                        index.press.append((len(columns), name))
                        columns.append(np.where(window, source * (scatter / sd), 0.0))
            columns.extend(self._rounding_columns(run, column))
            start = stop
        return columns, index

    def _felt(self, run: Run, cell: CellFile) -> Floats | float:
        """What share of a small offset of fz shows in every bin (b,): readings between two coarse levels do not follow it."""
        if self.rounding is None:
            return 1.0
        return _binned_steps(run, run.motion, self.rounding.slope(wrench_of(cell, run.motion, self.library)[:, FZ - 1]))

    def _rounding_columns(self, run: Run, column: Callable[[int, Floats], Floats]) -> list[Floats]:
        """Where noise does not dither the rounding, every rest keeps an offset of up to half a step."""
        columns = []
        for channel, stated in enumerate(resolutions(self.cell)):
            step = self.rounding.step_N if channel == FZ and self.rounding is not None else stated
            if step <= 0 or not run.judged[channel]:
                continue
            coherent = _coherent(step, float(run.noise_rms[channel]))
            if coherent < 0.1 * run.noise_rms[channel]:
                continue
            still = np.isin(run.bin_phase, (FREE_STILL, HOLDING))
            edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
            for a, b in list(zip(edges[::2], edges[1::2], strict=True))[:80]:
                if b - a >= 3:
                    rest = np.zeros(len(run.bins))
                    rest[a:b] = coherent
                    columns.append(column(channel, rest))
        return columns


def _binned_steps(run: Run, motion: Motion, values: Floats) -> Floats:
    """Means over the bins (b,) of what was computed at the even times of a motion."""
    return run.steps.mean(np.interp(run.step_t_s, motion.t_s, values))


def torque_arm_m(cell: CellFile) -> float:
    """What turns a tolerated force into a tolerated torque: 0.05 m, and in proportion more on a probe that is longer than 0.08 m."""
    return max(CROSSTALK_ARM_M, CROSSTALK_ARM_M / 0.08 * cell.probe.tip_length_m)


def _coherent(step: float, rms: float) -> float:
    """Rms of the rounding error that averaging does not remove, since noise of that rms (rounding included) does not dither it."""
    if step <= 0.0:
        return 0.0
    pure = np.sqrt(max(rms**2 - step**2 / 12.0, 0.0))
    return float(step / np.sqrt(12.0) * np.exp(-2.0 * (np.pi * pure / step) ** 2))


def _around(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask and a neighbour at either side."""
    wide = mask.copy()
    wide[1:] |= mask[:-1]
    wide[:-1] |= mask[1:]
    return wide


def make_problem(
    recordings: Sequence[Samples],
    cell: CellFile,
    library: Mapping[str, Effect] = EFFECTS,
    max_bins: int = 4500,
    rounding: Rounding | None = None,
) -> Problem:
    """The recordings of one cell against its simulation without effects."""
    cell = cell.with_effects({}).with_estimated(None)
    share = max(600, max_bins // len(recordings))
    runs = [prepare(samples, cell, share) for samples in recordings]
    longest = max(recordings, key=lambda s: s.duration_s)
    scale = scale_of(cell, longest.t_s, longest.z_m, longest.vz_m_per_s, longest.wrench[:, 2])
    tol = cell.tolerances
    sd = {
        "youngs_modulus": tol.youngs_modulus if tol.modulus_known else UNKNOWN_LOG_SD,
        "surface_z_m": tol.surface_z_m,
        "gain": tol.gain,
        "latency_s": tol.latency_s,
        "filter_cutoff": tol.filter_cutoff if cell.sensor.filter_cutoff_Hz else 0.0,
        "mass_kg": tol.mass_kg,
        "servo_natural_frequency": tol.servo_natural_frequency,
    }
    if cell.tissue is None:
        sd["youngs_modulus"] = sd["surface_z_m"] = 0.0
    crosstalk = {name: tol.crosstalk * (torque_arm_m(cell) / CROSSTALK_ARM_M if name[0] == "t" else 1.0) for name in SHARED[-4:]}
    shared_sd = np.array([(sd | crosstalk)[name] for name in SHARED])
    return Problem(cell, runs, library, scale, shared_sd, rounding=rounding)
