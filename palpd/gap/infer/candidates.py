"""Stage 3 of a diagnosis: parameters at which the fit of an effect may start, and how well its change matches a residual."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from palpd.cell.cell_file import EffectValues
from palpd.cell.effects import Effect
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FZ, Z
from palpd.gap.gaussian.nuisances import ProjectedColumns, Vectors, gram, project
from palpd.gap.infer.evidence import Fit
from palpd.gap.model.coordinates import start_values
from palpd.gap.model.linearise import Linearisation
from palpd.gap.model.problem import Problem
from palpd.tick import Floats


class Candidate(NamedTuple):
    """Parameters of an effect at which a fit may start, and its change (b,) of the whitened prediction by channel."""

    effect: str
    values: dict[str, float]
    change: dict[int, Floats]


def candidates_of(
    problem: Problem, effects: Mapping[str, Effect], present: EffectValues, eta: Floats, frequencies_Hz: Sequence[float]
) -> tuple[Candidate, ...]:
    """Every start of some effects that changes the mean of the readings of a cell with the effects `present`.

    Args:
        eta: Shared deviations η (11,) of that cell.
        frequencies_Hz: Those at which an oscillation may start.
    """
    at, out = problem.predict(present, eta), []
    for effect in effects.values():
        for values in start_values(effect, problem.scale, frequencies_Hz) if not effect.scatter else ():
            change = problem.predict(present | {effect.id: values}, eta) - at
            live = {channel: row.copy() for channel, row in enumerate(change) if row.any()}
            if live:
                out.append(Candidate(effect.id, values, live))
    return tuple(out)


def further_candidates(
    problem: Problem, candidates: Sequence[Candidate], fitted: Fit, frequencies_Hz: Sequence[float]
) -> Sequence[Candidate]:
    """The candidates, as they change a cell that has the effects of a hypothesis already.

    In tissue these hardly alter what a further effect does to the contact force. Without tissue, effects at the tip are simulated again
    together with them: play there, for example, shows only if the hypothesis has friction.
    """
    if problem.cell.tissue is not None:
        return candidates
    library = problem.library
    at_the_tip = {name: effect for name, effect in library.items() if effect.site == "tip" and name not in fitted.names}
    elsewhere = [candidate for candidate in candidates if library[candidate.effect].site != "tip"]
    return (*elsewhere, *candidates_of(problem, at_the_tip, fitted.values, fitted.eta, frequencies_Hz))


@dataclass(frozen=True)
class Match:
    """Gain of a candidate in squared sigmas when its change is multiplied with the best factor."""

    gain: float
    factor: float
    values: dict[str, float]


def scan(
    problem: Problem, linearisation: Linearisation, residual: Floats, taken: Sequence[Floats], candidates: Sequence[Candidate]
) -> dict[str, list[Match]]:
    """How well every candidate matches a residual at its best factor (matching pursuit).

    Args:
        problem: Gives the bounds of the factors.
        linearisation: Has the nuisances A to project out.
        residual: The whitened residual (7, b).
        taken: Slopes (7, b) of the parameters that are fitted already; these are projected out, too.

    Returns:
        The matches of every effect that can change something there, best first.
    """
    vectors = Vectors.of([candidate.change for candidate in candidates], (7, problem.data.shape[1]))
    changes = ProjectedColumns.of(vectors, linearisation.space)
    r, basis = project(residual, linearisation.space), [project(j, linearisation.space) for j in taken]
    inverse = np.linalg.pinv(gram(basis), rcond=1e-9, hermitian=True)
    against_basis = np.array([changes.dot(b) for b in basis]).reshape(len(basis), len(candidates))
    against_residual = changes.dot(r) - np.array([b.dot(r) for b in basis]) @ inverse @ against_basis
    left = changes.squares - (against_basis * (inverse @ against_basis)).sum(axis=0)
    out: dict[str, list[Match]] = {}
    for candidate, rs, ss, square in zip(candidates, against_residual.tolist(), left.tolist(), vectors.squares.tolist(), strict=True):
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
            if ratio[k] < ASSUMED.search.peak_ratio:
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
    lowest_Hz = max(0.5 * problem.scale.servo_natural_frequency_Hz, 1.0 / (ASSUMED.search.hump_width * n * dt_s))
    frequency_Hz = np.exp(np.arange(np.log(lowest_Hz), np.log(0.45 / dt_s), 0.5 * ASSUMED.search.hump_width))

    def mean(factor: float) -> tuple[Floats, Floats]:
        """Mean power between f / factor and f · factor, and the number of values there."""
        first = np.rint(frequency_Hz / factor * n * dt_s).astype(int)
        end = np.minimum(np.rint(frequency_Hz * factor * n * dt_s).astype(int) + 1, len(power) - 1)
        return (power[end] - power[first]) / (end - first), end - first

    power_there, values = mean(1.0 + ASSUMED.search.hump_width)
    prominence = (power_there / np.maximum(mean(ASSUMED.search.neighbourhood)[0], 1e-300) - 1.0) * np.sqrt(values)
    out: list[float] = []
    for k in np.argsort(-prominence):
        if len(out) < ASSUMED.search.humps and all(
            abs(np.log(frequency_Hz[k] / other)) > ASSUMED.search.least_hump_distance for other in out
        ):
            out.append(float(frequency_Hz[k]))
    return out


def _summit(spectrum: Floats, k: int) -> float:
    """Distance, in steps of frequency, from the middle of three values to the summit of the parabola through their logarithms."""
    low, middle, high = np.log(np.maximum(spectrum[k - 1 : k + 2], 1e-300)) if 0 < k < len(spectrum) - 1 else (0.0, 0.0, 0.0)
    curvature = low - 2.0 * middle + high
    return float(np.clip(0.5 * (low - high) / curvature, -0.5, 0.5)) if curvature < 0.0 else 0.0
