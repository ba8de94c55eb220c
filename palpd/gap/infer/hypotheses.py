"""Stage 3 of a diagnosis: which sets of effects could have made the residual; each likely one is fitted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import inf

import numpy as np
from scipy.ndimage import median_filter

from palpd.cell.cell_file import EffectValues
from palpd.cell.effects import Effect, Scale
from palpd.gap.data.noise import FZ, Z
from palpd.gap.data.rounding import WAYS
from palpd.gap.gaussian.nuisances import Vectors, gram, project
from palpd.gap.infer.evidence import Fit, fit, laplace_evidence
from palpd.gap.infer.fit import gauss_newton, jacobian_at
from palpd.gap.model.coordinates import coordinates, coordinates_of, start_values, stretched
from palpd.gap.model.linearise import Linearisation, linearise
from palpd.gap.model.problem import MODULUS, SHARED, Problem
from palpd.tick import Floats

WAY_NATS = 5.0
"""Nats by which another way of rounding must beat rounding to the nearest level."""

LARGE_GAP = 2e4
"""Gap, in squared sigmas, that is large enough to change how in-tolerance deviations act."""

CREDIBLE_SD = 4.0
"""Shared deviations η below this many standard deviations are credible for a healthy cell."""

FITTED_AFTER_SCAN = 14
"""Number of effects that are fitted after the scan; further effects are fitted only if they reach half the gain of the best."""

ROUNDS = 6
"""Most linearisations of a likely hypothesis; most converge in three."""

LARGEST_SET = 3
"""Largest number of effects that are sought together."""

FURTHER_EFFECT_NATS = (2.0, 3.0)
"""Nats of evidence by which a single effect must beat no effect, and a set the best smaller set, before larger sets are searched."""

STIFFER = (1.0, 3.0, 10.0)
"""Factors on an unknown modulus at which a limit of the readings is sought."""

LEAST_GAIN = 4.0
"""Gain, in squared sigmas, below which a further effect is not fitted: noise gives as much."""

PEAK_RATIO = 25.0
"""Power of a line in the residual spectrum over its neighbourhood from which on it stands out."""

HUMP_WIDTH, NEIGHBOURHOOD = 0.04, 1.5
"""Half the width of a hump over its frequency, as damping ratios of 0.02 to 0.1 make it, and factor to the ends of its neighbourhood."""

HUMPS, LEAST_HUMP_DISTANCE = 3, 0.15
"""Number of humps at which a resonance is sought, and least distance of their logarithms. A search finds it from a tenth away."""

Fits = dict[tuple[str, ...], Fit]


@dataclass(frozen=True)
class NominalFit:
    """The cell without effects.

    Attributes:
        problem: With the error of the simulator in its noise.
        fit: The hypothesis that there is no effect.
        stated: Linearisation of the cell as stated, η₀ = 0; where its modulus is not known, at the fitted deviations.
        around: Linearisation from which effects are searched: that of `fit`, or `stated` where a deviation of `fit` is not credible.
    """

    problem: Problem
    fit: Fit
    stated: Linearisation
    around: Linearisation


def fit_nominal(problem: Problem) -> NominalFit:
    """Fit the cell without effects, which also says how large the error of the simulator may be."""
    stated = linearise(problem, {}, problem.nominal_eta)
    if not problem.cell.tolerances.modulus_known:
        first = fit(problem, {}, stated, rounds=8)
        # The force in proportion to the modulus has been fitted: it is the gap's size.
        by_modulus = np.zeros(first.linearisation.space.size)
        by_modulus[SHARED.index("youngs_modulus")] = 1.0
        problem = problem.with_model_error_floor(first.linearisation.space.explained(by_modulus) / problem.shared_sd[0])
        nominal = fit(problem, {}, linearise(problem, {}, first.eta), rounds=ROUNDS)
        return NominalFit(problem, nominal, nominal.linearisation, nominal.linearisation)
    problem = problem.with_model_error_floor(problem.data - stated.prediction)
    stated = linearise(problem, {}, problem.nominal_eta)
    nominal = fit(problem, {}, stated, rounds=ROUNDS)
    # Beyond that, hypotheses that are linearised elsewhere would be judged by other tolerances.
    credible = np.abs(nominal.eta).max() < CREDIBLE_SD
    return NominalFit(problem, nominal, stated, nominal.linearisation if credible else stated)


def fit_rounding(problem: Problem) -> NominalFit:
    """Fit the cell without effects, with the way in which coarse readings are rounded.

    Another way than to the nearest level must win by WAY_NATS, since an effect may imitate it. Only a step that is coarser than the stated
    step is tried in other ways; it may also round readings that were rounded to the stated step before.

    Args:
        problem: With readings rounded to the nearest level, if they are rounded coarsely.
    """
    nominal = fit_nominal(problem)
    rounding = problem.roundings[0] if problem.roundings else None
    if rounding is None or rounding.step_N == problem.cell.sensor.resolution_fz_N:
        return nominal
    others = [fit_nominal(problem.with_rounding(way, 0.0)) for way in WAYS if way != rounding.way]
    best = min(nominal, *others, key=_surprise)
    if first_N := problem.cell.sensor.resolution_fz_N:
        best = min(best, fit_nominal(problem.with_rounding(best.problem.roundings[0].way, first_N)), key=_surprise)
    return best if _surprise(best) < _surprise(nominal) - WAY_NATS else nominal


def _surprise(nominal: NominalFit) -> float:
    """Negative log likelihood of a cell without effects, up to a constant. It counts the width of the noise, which the floor changes."""
    sigma = nominal.problem.noise.sigma
    return -nominal.fit.log_exact + float(np.log(sigma[np.isfinite(sigma)]).sum())


def search(nominal: NominalFit) -> Fits:
    """Fit no effect, the likely single effects, and sets of two and three that extend them (a beam search)."""
    tried = _Search(nominal.problem, nominal.around, {(): nominal.fit})
    tried.fit_singles()
    tried.refine(size=1, most=8)
    beam = tried.leading(size=1, most=4)
    for size in range(2, LARGEST_SET + 1):
        if not beam or beam[0].log_evidence < nominal.fit.log_evidence + FURTHER_EFFECT_NATS[0]:
            break
        for one in beam:
            tried.extend(one, most=5 if size == 2 else 3)
        tried.refine(size, most=4)
        beam, smaller = tried.leading(size, most=2), tried.leading(size - 1, most=1)
        if not beam or beam[0].log_evidence < smaller[0].log_evidence + FURTHER_EFFECT_NATS[1]:
            break
    return tried.fits


@dataclass(frozen=True)
class Candidate:
    """An effect with parameters at which its fit may start."""

    effect: str
    values: dict[str, float]


Start = tuple[Candidate, dict[int, Floats]]
"""A candidate and its change (b,) of the whitened prediction by channel."""


@dataclass(frozen=True)
class Match:
    """Gain of a candidate in squared sigmas when its change is multiplied with the best factor."""

    gain: float
    factor: float
    values: dict[str, float]


@dataclass
class _Search:
    """A search in progress: candidates, the linearisation from which they start, and the fits so far."""

    problem: Problem
    around: Linearisation
    fits: Fits
    peaks_Hz: list[float] = field(init=False)
    starts: list[Start] = field(init=False)
    candidates: list[Candidate] = field(init=False)
    changes: Vectors = field(init=False)

    def __post_init__(self) -> None:
        """Make the candidates of every effect that changes the mean of the readings."""
        # Of the cell without effects as fitted: what its deviations explain would hide a small line.
        problem, eta = self.problem, self.fits[()].eta
        predicted = problem.raw_prediction(problem.recordings[0], problem.cell_at({}, eta))
        self.peaks_Hz = [*spectral_peaks(problem, predicted), *ringing_frequencies(problem, predicted)]
        self.starts = self._changes_of(self.problem.library, {}, self.around.eta)
        self.candidates, self.changes = self._gathered(self.starts)

    def fit_singles(self) -> None:
        """Fit the effects that match the residual best."""
        residual = self.problem.data + self.around.offset() - self.around.prediction
        matches = scan(self.problem, self.around, residual, [], self.candidates, self.changes)
        order = sorted(matches, key=lambda name: -matches[name][0].gain)
        best_gain = matches[order[0]][0].gain if order else 0.0
        kept = [name for k, name in enumerate(order) if k < FITTED_AFTER_SCAN or matches[name][0].gain > 0.5 * best_gain]
        for name in kept:
            self.fits[(name,)] = self._best_of_starts(self.around, name, matches[name], {}, starts=3, iterations=8)
        if best_gain > LARGE_GAP or not self.problem.cell.tolerances.modulus_known:
            self._start_afar(kept, all_near_the_tip=best_gain > LARGE_GAP)

    def leading(self, size: int, most: int) -> list[Fit]:
        """The fits of sets of `size` effects, by falling evidence, at most `most` of them."""
        return sorted((f for names, f in self.fits.items() if len(names) == size), key=lambda f: -f.log_evidence)[:most]

    def refine(self, size: int, most: int) -> None:
        """Linearise the nuisances of the leading fits again at their optimum; a fit 40 nats below the first is left as it is."""
        leading = self.leading(size, most)
        for one in leading:
            if one.log_evidence >= leading[0].log_evidence - 40.0:
                self.fits[one.names] = fit(self.problem, one.values, one.linearisation, iterations=2, rounds=ROUNDS)

    def extend(self, one: Fit, most: int) -> None:
        """Fit a set, together with each of the `most` further effects that match its residual best."""
        around = one.linearisation
        at = self.problem.predict(one.values, around.eta)
        taken = jacobian_at(self.problem, one.where, one.u, around.eta, at)
        candidates, changes = self._seen_beside(one)
        matches = scan(self.problem, around, self.problem.data + around.offset() - at, taken, candidates, changes)
        for name in sorted(matches.keys() - set(one.names), key=lambda name: (-matches[name][0].gain, name))[:most]:
            names = (*one.names, name)
            if matches[name][0].gain >= LEAST_GAIN and not any(set(names) == set(known) for known in self.fits):
                self.fits[names] = self._best_of_starts(around, name, matches[name], one.values, starts=1, iterations=5)

    def _seen_beside(self, one: Fit) -> tuple[list[Candidate], Vectors]:
        """Candidates for a further effect, and how they change a cell that has the effects of a set already.

        In tissue the set hardly alters what they do to the contact force. Without tissue, effects at the tip are simulated again together
        with the set: play there, for example, shows only if the set has friction.
        """
        library = self.problem.library
        if self.problem.cell.tissue is not None:
            return self.candidates, self.changes
        at_the_tip = {name: effect for name, effect in library.items() if effect.site == "tip" and name not in one.names}
        elsewhere = [start for start in self.starts if library[start[0].effect].site != "tip"]
        return self._gathered(elsewhere + self._changes_of(at_the_tip, one.values, one.eta))

    def _gathered(self, starts: Sequence[Start]) -> tuple[list[Candidate], Vectors]:
        """Candidates, and their changes gathered for a scan."""
        return [candidate for candidate, _ in starts], Vectors.of([change for _, change in starts], self.problem.data.shape[1])

    def _changes_of(self, effects: Mapping[str, Effect], beside: EffectValues, eta: Floats) -> list[Start]:
        """Every start of some effects that changes the mean of the readings of a cell with the effects `beside`, and its change."""
        at, out = self.problem.predict(beside, eta), []
        for effect in effects.values():
            for values in start_values(effect, self.problem.scale, self.peaks_Hz) if not effect.scatter else ():
                change = self.problem.predict(beside | {effect.id: values}, eta) - at
                live = {channel: there.copy() for channel, there in enumerate(change) if there.any()}
                if live:
                    out.append((Candidate(effect.id, values), live))
        return out

    def _best_of_starts(
        self, around: Linearisation, name: str, matches: list[Match], beside: EffectValues, *, starts: int, iterations: int
    ) -> Fit:
        """The fit of an effect with the most evidence, from several starts; the parameters of `beside` are fitted with it.

        Each form is fitted: with and without optional parameters, and with each choice of a parameter that has a few values only.
        """
        effect, scale, library = self.problem.library[name], self.problem.scale, self.problem.library
        forms: dict[tuple[tuple[str, float | None], ...], list[Match]] = {}
        for match in matches:
            form = tuple((p.name, match.values[p.name] if p.choices else None) for p in effect.parameters if p.name in match.values)
            forms.setdefault(form, []).append(match)
        best_of_forms = []
        for those in forms.values():
            trials = [stretched(effect, match.values, match.factor, scale) for match in _different(those, starts)]
            if any(p.nominal_value(scale) not in (None, 0.0) for p in effect.parameters):
                trials.append(those[0].values)  # made larger or smaller, a limit or a stiffness may lose all its effect
            where = coordinates(beside | {name: trials[0]}, library, scale)
            optima = [
                gauss_newton(self.problem, around, where, coordinates_of(where, beside | {name: values}), iterations) for values in trials
            ]
            best_of_forms.append(laplace_evidence(self.problem, min(optima, key=lambda optimum: optimum.misfit)))
        return max(best_of_forms, key=lambda one: one.log_evidence)

    def _start_afar(self, kept: Sequence[str], *, all_near_the_tip: bool) -> None:
        """Fit also from nuisances that are linearised at each start, since a large gap changes how in-tolerance deviations act.

        This covers the effects that were kept and everything between tip and tissue. Where the modulus is not known, a limit of the
        readings is always sought so: it hides how stiff the tissue is, and the nominal modulus then lies below all that it could clip.
        """
        problem = self.problem
        for effect in problem.library.values():
            limited = _limits_readings(effect, problem.scale) and not problem.cell.tolerances.modulus_known
            near = all_near_the_tip and (effect.id in kept or effect.site in ("tip", "tissue"))
            if effect.scatter or not (near or limited):
                continue
            starts = [c.values for c in self.candidates if c.effect == effect.id]
            starts = starts[:: max(1, len(starts) // 6)]
            best = self.fits.get((effect.id,))
            if best is not None:
                starts.append(best.values[effect.id])
            if limited:
                starts = start_values(effect, problem.scale, [])
            etas = [self.around.eta, *(self._stiffer(factor) for factor in STIFFER if limited)]
            tried = []
            for values, eta in product(starts, etas):
                there = linearise(problem, {effect.id: values}, eta)
                residual = project(problem.data + there.offset() - there.prediction, there.space)
                tried.append((residual.dot(residual), values, there))
            for _, values, there in sorted(tried, key=lambda item: item[0])[:2]:
                one = fit(problem, {effect.id: values}, there, iterations=6, rounds=ROUNDS)
                if best is None or one.log_evidence > best.log_evidence:
                    best = one
            if best is not None:
                self.fits[(effect.id,)] = best

    def _stiffer(self, factor: float) -> Floats:
        """Shared deviations (11,) of the cell as stated, with the nominal fit's modulus times a factor."""
        modulus = self.around.eta + np.log(factor) / np.maximum(self.problem.shared_sd, 1e-300)
        return np.where(MODULUS, modulus, self.problem.nominal_eta)


def _limits_readings(effect: Effect, scale: Scale) -> bool:
    """Whether an effect caps the readings: it is absent where its limit is infinite."""
    return any(p.unit == "N" and p.nominal_value(scale) == inf for p in effect.parameters)


def scan(
    problem: Problem, around: Linearisation, residual: Floats, taken: Sequence[Floats], candidates: Sequence[Candidate], changes: Vectors
) -> Mapping[str, list[Match]]:
    """How well every candidate matches a residual at its best factor (matching pursuit).

    Args:
        problem: Gives the bounds of the factors.
        around: Nuisances A to project out.
        residual: The whitened residual (7, b).
        taken: Slopes (7, b) of the parameters that are fitted already; these are projected out, too.
        candidates: The m candidates.
        changes: The changes that they make, in the same order.

    Returns:
        The matches of every effect that can change something there, best first.
    """
    r, basis = project(residual, around.space), [project(j, around.space) for j in taken]
    inverse = np.linalg.pinv(gram(basis), rcond=1e-9, hermitian=True) if len(basis) else np.zeros((0, 0))
    hidden = changes.against(around.space)
    seen = np.array([changes.dot(b.values) - b.seen @ hidden for b in basis]).reshape(len(basis), len(candidates))
    r_seen = np.array([b.dot(r) for b in basis])
    against_residual = changes.dot(residual) - r.seen @ hidden - r_seen @ inverse @ seen
    squares = changes.squares - (hidden**2).sum(axis=0) - (seen * (inverse @ seen)).sum(axis=0)
    out: dict[str, list[Match]] = {}
    for candidate, rs, ss, square in zip(candidates, against_residual.tolist(), squares.tolist(), changes.squares.tolist(), strict=True):
        if ss <= 1e-9 * max(square, 1e-300) or ss < 1e-12:
            continue
        low, high = _factor_bounds(problem, candidate.effect)
        factor = min(max(rs / ss, low), high)
        gain = max(2.0 * factor * rs - factor**2 * ss, 0.0)
        out.setdefault(candidate.effect, []).append(Match(gain, factor, candidate.values))
    return {name: sorted(matches, key=lambda match: -match.gain) for name, matches in out.items()}


def _factor_bounds(problem: Problem, name: str) -> tuple[float, float]:
    """Bounds of a candidate's factor.

    It is free where its change is proportional to its amplitudes and bounded elsewhere. It never takes a sign that does not exist.
    """
    low, high = -1e6, 1e6
    for parameter in problem.library[name].parameters:
        nominal = parameter.nominal_value(problem.scale)
        if nominal is None:
            continue
        if nominal != 0.0:
            low, high = max(low, -3.0), min(high, 4.0)
        if parameter.bounds(problem.scale)[0] >= 0.0 and nominal in (0.0, inf):
            low = max(low, 0.05 if nominal == inf else 0.0)
    return low, high


def _different(matches: list[Match], most: int) -> list[Match]:
    """The first few matches that differ in their gain."""
    out: list[Match] = []
    for match in matches:
        if all(abs(match.gain - other.gain) > 1e-3 * max(other.gain, 1.0) for other in out):
            out.append(match)
        if len(out) == most:
            break
    return out or matches[:1]


def spectral_peaks(problem: Problem, predicted: Floats, most: int = 3) -> list[float]:
    """At most `most` frequencies that stand out in the residuals of height and of fz in the first recording.

    Args:
        predicted: Prediction of the first recording at every sample (n, 7).

    Returns:
        Frequencies in Hz, the strongest first.
    """
    peaks: list[tuple[float, float]] = []
    recording = problem.recordings[0]
    n, dt_s = len(recording.samples), problem.scale.step_s
    for channel, measured in ((Z, recording.samples.z_m), (FZ, recording.samples.wrench[:, 2])):
        if not recording.judged[channel] or n < 128:
            continue
        residual = (measured - predicted[:, channel]) * np.hanning(n)
        spectrum = np.abs(np.fft.rfft(residual - residual.mean(), 2 * n)) ** 2
        frequency = np.fft.rfftfreq(2 * n, dt_s)
        local = median_filter(spectrum, size=61, mode="reflect")
        ratio = np.where(frequency > 3.0 / (n * dt_s), spectrum / np.maximum(local, 1e-300), 0.0)
        for _ in range(2):
            k = int(np.argmax(ratio))
            if ratio[k] < PEAK_RATIO:
                break
            peaks.append((float(ratio[k]), float(frequency[k] + _summit(spectrum, k) * frequency[1])))
            ratio[max(0, k - 30) : k + 30] = 0.0
    return [frequency_Hz for _, frequency_Hz in sorted(peaks, reverse=True)[:most]]


def ringing_frequencies(problem: Problem, predicted: Floats) -> list[float]:
    """Frequencies near which the residual of fz in the first recording may ring.

    A resonance rings after every start and stop and decays, so it makes a hump in the spectrum and no line. A search for it must start near
    its frequency, since a ringing that is off by more than its damping is soon out of phase.

    Args:
        predicted: Prediction of the first recording at every sample (n, 7).

    Returns:
        Frequencies in Hz, the most prominent first; empty where fz is not compared or the recording is short.
    """
    recording = problem.recordings[0]
    n, dt_s = len(recording.samples), problem.scale.step_s
    if not recording.judged[FZ] or n < 128:
        return []
    residual = (recording.samples.wrench[:, FZ - 1] - predicted[:, FZ]) * np.hanning(n)
    power = np.concatenate([[0.0], np.cumsum(np.abs(np.fft.rfft(residual - residual.mean())) ** 2)])
    lowest_Hz = max(0.5 * problem.scale.servo_natural_frequency_Hz, 1.0 / (HUMP_WIDTH * n * dt_s))
    frequency_Hz = np.exp(np.arange(np.log(lowest_Hz), np.log(0.45 / dt_s), 0.5 * HUMP_WIDTH))

    def mean(factor: float) -> tuple[Floats, Floats]:
        """Mean power between f / factor and f · factor, and the number of values there."""
        first = np.rint(frequency_Hz / factor * n * dt_s).astype(int)
        end = np.minimum(np.rint(frequency_Hz * factor * n * dt_s).astype(int) + 1, len(power) - 1)
        return (power[end] - power[first]) / (end - first), end - first

    here, values = mean(1.0 + HUMP_WIDTH)
    prominence = (here / np.maximum(mean(NEIGHBOURHOOD)[0], 1e-300) - 1.0) * np.sqrt(values)
    out: list[float] = []
    for k in np.argsort(-prominence):
        if len(out) < HUMPS and all(abs(np.log(frequency_Hz[k] / other)) > LEAST_HUMP_DISTANCE for other in out):
            out.append(float(frequency_Hz[k]))
    return out


def _summit(spectrum: Floats, k: int) -> float:
    """Distance, in steps of frequency, from the middle of three values to the summit of the parabola through their logarithms."""
    low, middle, high = np.log(np.maximum(spectrum[k - 1 : k + 2], 1e-300)) if 0 < k < len(spectrum) - 1 else (0.0, 0.0, 0.0)
    curvature = low - 2.0 * middle + high
    return float(np.clip(0.5 * (low - high) / curvature, -0.5, 0.5)) if curvature < 0.0 else 0.0
