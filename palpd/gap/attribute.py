"""Which unmodelled effect a gap comes from: evidence for every effect and for sets of them, for none and for something unknown."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import comb, inf, log

import numpy as np
from scipy.ndimage import median_filter

from palpd.cell_file import EffectValues
from palpd.gap.discrepancy import Left, what_is_left
from palpd.gap.gaussian import gram, project
from palpd.gap.hypothesis import Fit, climb, coordinates, fit, jacobian_at, judge, start_values, stretched
from palpd.gap.noise import FZ, Z
from palpd.gap.problem import Linearisation, Problem
from palpd.tick import Floats

P_NONE, P_ONE, P_TWO, P_THREE = 0.3, 0.6, 0.12, 0.02
"""Prior probabilities of that many effects; every set of one size is as likely as the others."""

P_UNKNOWN = 0.15
"""Prior probability that something outside the list is at work."""

LAW_ENERGY = 0.04
"""Mean share of its energy in which the law of a known effect is off; that of something unknown is as likely any. With P_UNKNOWN
this puts even odds at a fifth."""

EARNED = 3.0
"""What a further effect costs at least, in nats, whatever its prior."""

JUDGED = 12
"""So many of the likeliest hypotheses are searched for what they leave."""

STRONG = 2e4
"""A gap of so many squared sigmas is large enough to change how in-tolerance deviations act."""

CREDIBLE = 4.0
"""In-tolerance deviations of fewer standard deviations may be the cell's own."""

KEPT = 14
"""Effects that are fitted after the scan."""

GROUP = 0.04
"""An effect whose odds against the named one are above this cannot be told from it."""


@dataclass(frozen=True)
class Candidate:
    """A shape of an effect before any fit, and the change it makes (channels, where not zero)."""

    effect: str
    values: dict[str, float]
    live: tuple[int, ...]
    change: Floats

    def full(self, shape: tuple[int, int]) -> Floats:
        """The change over all channels."""
        out = np.zeros(shape)
        out[list(self.live)] = self.change
        return out


@dataclass(frozen=True)
class Weighed:
    """A hypothesis with what it leaves, and its share of the probability without and with something unknown."""

    fit: Fit
    left: Left
    share: float
    known: float
    unknown: float

    @property
    def name(self) -> str:
        """Its effects in words."""
        return " with ".join(self.fit.names) or "no effect"


@dataclass
class Attribution:
    """All hypotheses, best first, and what follows from them."""

    weighed: list[Weighed]
    p_none: float
    p_unknown: float
    marginal: dict[str, float]
    groups: dict[str, list[str]]
    notes: list[str] = field(default_factory=list)

    @property
    def best(self) -> Weighed:
        """The most probable hypothesis."""
        return self.weighed[0]


def peaks(problem: Problem, residual: Floats, most: int = 3) -> list[float]:
    """Frequencies in Hz that stand out in the residual heights and in fz."""
    found: list[tuple[float, float]] = []
    for run in problem.runs[:1]:
        n = len(run.samples)
        dt_s = problem.scale.step_s
        raw = problem.raw_prediction(run, problem.cell)
        for channel, measured in ((Z, run.samples.z_m), (FZ, run.samples.wrench[:, 2])):
            if not run.judged[channel] or n < 128:
                continue
            left = (measured - raw[:, channel]) * np.hanning(n)
            spectrum = np.abs(np.fft.rfft(left - left.mean(), 2 * n)) ** 2
            frequency = np.fft.rfftfreq(2 * n, dt_s)
            local = median_filter(spectrum, size=61, mode="reflect")
            ratio = np.where(frequency > 3.0 / (n * dt_s), spectrum / np.maximum(local, 1e-300), 0.0)
            for _ in range(2):
                k = int(np.argmax(ratio))
                if ratio[k] < 25.0:
                    break
                found.append((float(ratio[k]), float(frequency[k] + _summit(spectrum, k) * frequency[1])))
                ratio[max(0, k - 30) : k + 30] = 0.0
    return [f for _, f in sorted(found, reverse=True)[:most]]


def _summit(spectrum: Floats, k: int) -> float:
    """How far, in bins, the summit of the parabola through the logarithms of three neighbours lies from the middle one."""
    low, middle, high = np.log(np.maximum(spectrum[k - 1 : k + 2], 1e-300)) if 0 < k < len(spectrum) - 1 else (0.0, 0.0, 0.0)
    bend = low - 2.0 * middle + high
    return float(np.clip(0.5 * (low - high) / bend, -0.5, 0.5)) if bend < 0.0 else 0.0


def _dictionary(problem: Problem, base: Linearisation, peaks_Hz: list[float]) -> list[Candidate]:
    out = []
    for effect in problem.library.values():
        if effect.variance:
            continue
        for values in start_values(effect, problem.scale, peaks_Hz):
            change = problem.predict({effect.id: values}, base.eta) - base.prediction
            live = tuple(np.flatnonzero(change.any(axis=1)).tolist())
            if live:
                out.append(Candidate(effect.id, values, live, change[list(live)]))
    return out


def _scan(
    problem: Problem, around: Linearisation, residual: Floats, taken: list[Floats], dictionary: list[Candidate]
) -> dict[str, list[tuple[float, float, dict[str, float]]]]:
    """For every effect its candidates as (gain in squared sigmas, best factor, values), best first; `taken` are directions that
    the fitted parameters can already move in."""
    r = project(residual, around.space)
    basis = [project(j, around.space) for j in taken]
    normal = gram(basis)
    inverse = np.linalg.pinv(normal, rcond=1e-9, hermitian=True) if len(basis) else np.zeros((0, 0))
    r_seen = np.array([b.dot(r) for b in basis])
    shape = residual.shape
    out: dict[str, list[tuple[float, float, dict[str, float]]]] = {}
    for candidate in dictionary:
        s = project(candidate.full(shape), around.space)
        seen = np.array([b.dot(s) for b in basis])
        rs = s.dot(r) - (seen @ inverse @ r_seen if len(basis) else 0.0)
        ss = s.dot(s) - (seen @ inverse @ seen if len(basis) else 0.0)
        if ss <= 1e-9 * max(float(np.vdot(s.values, s.values)), 1e-300) or ss < 1e-12:
            continue
        low, high = _factors(problem, candidate.effect)
        factor = min(max(rs / ss, low), high)
        gain = max(2.0 * factor * rs - factor**2 * ss, 0.0)
        out.setdefault(candidate.effect, []).append((gain, factor, candidate.values))
    for listed in out.values():
        listed.sort(key=lambda item: -item[0])
    return out


def _factors(problem: Problem, name: str) -> tuple[float, float]:
    """By how much a candidate may be made larger or smaller: freely where its change is in proportion to its amplitudes, within bounds
    where it is not, and never to the other sign where that does not exist."""
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


def _best_fit(
    problem: Problem,
    around: Linearisation,
    name: str,
    listed: list[tuple[float, float, dict[str, float]]],
    beside: EffectValues,
    starts: int,
    iterations: int,
) -> Fit:
    """Multi-start: the best of several climbs of one effect, beside others that climb with it."""
    names = (*beside, name)
    where = coordinates([problem.library[n] for n in names], problem.scale)
    tried = []
    trials = [stretched(problem.library[name], values, factor, problem.scale) for _, factor, values in _different(listed, starts)]
    if any(p.nominal_value(problem.scale) not in (None, 0.0) for p in problem.library[name].parameters):
        trials.append(listed[0][2])  # made larger or smaller, a limit or a stiffness may lose all its effect
    for values in trials:
        start = beside | {name: values}
        u = np.array([c.to(start[c.effect][c.parameter.name]) for c in where])
        tried.append(climb(problem, around, where, u, iterations))
    u, misfit, at, jacobian = min(tried, key=lambda t: t[1])
    return judge(problem, names, where, u, misfit, at, jacobian, around)


def _different(listed: list[tuple[float, float, dict[str, float]]], most: int) -> list[tuple[float, float, dict[str, float]]]:
    """The first few candidates that differ in their gain."""
    out: list[tuple[float, float, dict[str, float]]] = []
    for item in listed:
        if all(abs(item[0] - other[0]) > 1e-3 * max(other[0], 1.0) for other in out):
            out.append(item)
        if len(out) == most:
            break
    return out or listed[:1]


def attribute(problem: Problem) -> Attribution:
    """Weigh all hypotheses against each other."""
    eta = np.zeros(len(problem.shared_sd))
    base = problem.linearise({}, eta)
    if problem.cell.tolerances.modulus_known:
        problem.soften(problem.data - base.prediction)
        base = problem.linearise({}, eta)
        null = fit(problem, (), {}, base, rounds=2)
        if np.abs(null.eta).max() < CREDIBLE:
            base = null.linearisation  # else hypotheses that are linearised elsewhere would be judged by other tolerances
    else:
        null = fit(problem, (), {}, base, rounds=8)
        problem.soften(null.linearisation.columns[0] / problem.shared_sd[0])  # all that is in proportion to it has been fitted
        null = fit(problem, (), {}, problem.linearise({}, null.eta), rounds=2)
        base = null.linearisation
    residual = problem.data + base.offset() - base.prediction
    dictionary = _dictionary(problem, base, peaks(problem, residual))
    scanned = _scan(problem, base, residual, [], dictionary)
    fits: dict[tuple[str, ...], Fit] = {(): null}
    order = sorted(scanned, key=lambda name: -scanned[name][0][0])
    best_gain = scanned[order[0]][0][0] if order else 0.0
    kept = [n for k, n in enumerate(order) if k < KEPT or scanned[n][0][0] > 0.5 * best_gain]
    for name in kept:
        fits[(name,)] = _best_fit(problem, base, name, scanned[name], {}, 3, 8)
    if best_gain > STRONG:
        _start_afar(problem, fits, dictionary, base.eta, kept)
    _refine(problem, fits, 1, 8)
    beam = _leading(fits, 1, 4)
    for size in (2, 3):
        if not beam or beam[0].log_evidence < null.log_evidence + 2.0:
            break
        for one in beam:
            _extend(problem, fits, one, dictionary, 5 if size == 2 else 3)
        _refine(problem, fits, size, 4)
        pairs = _leading(fits, size, 2)
        singles = _leading(fits, size - 1, 1)
        if not pairs or pairs[0].log_evidence < singles[0].log_evidence + 3.0:
            break
        beam = pairs
    return weigh(problem, fits)


def _occam(fits: Mapping[tuple[str, ...], Fit]) -> dict[tuple[str, ...], float]:
    """Prior times volume of every hypothesis, in nats. A further effect must explain data that a smaller set does not, so every set is
    worth EARNED less than its smaller ones."""
    by_set = {frozenset(names): one.occam for names, one in fits.items()}
    out = {}
    for names, one in fits.items():
        smaller = [by_set[rest] for name in names if len(names) > 1 and (rest := frozenset(names) - {name}) in by_set]
        out[names] = min([one.occam, *(worth - EARNED for worth in smaller)])
    return out


def _start_afar(
    problem: Problem, fits: dict[tuple[str, ...], Fit], dictionary: list[Candidate], eta: Floats, kept: list[str]
) -> None:
    """Where a gap is large, what is within specification acts differently in the changed cell: climb also with the nuisances of each
    start, for what was kept and for everything between tip and tissue."""
    for effect in problem.library.values():
        if effect.variance or (effect.id not in kept and effect.site not in ("tip", "tissue")):
            continue
        starts = [c.values for c in dictionary if c.effect == effect.id]
        starts = starts[:: max(1, len(starts) // 6)]
        best = fits.get((effect.id,))
        if best is not None:
            starts.append(best.values[effect.id])
        tried = []
        for values in starts:
            there = problem.linearise({effect.id: values}, eta)
            r = project(problem.data + there.offset() - there.prediction, there.space)
            tried.append((r.dot(r), values, there))
        for _, values, there in sorted(tried, key=lambda item: item[0])[:2]:
            one = fit(problem, (effect.id,), {effect.id: values}, there, iterations=6, rounds=2)
            if best is None or one.log_evidence > best.log_evidence:
                best = one
        if best is not None:
            fits[(effect.id,)] = best


def _leading(fits: Mapping[tuple[str, ...], Fit], size: int, most: int) -> list[Fit]:
    return sorted((f for names, f in fits.items() if len(names) == size), key=lambda f: -f.log_evidence)[:most]


def _refine(problem: Problem, fits: dict[tuple[str, ...], Fit], size: int, most: int) -> None:
    """Linearise the tolerances of the leading hypotheses again at what was found there."""
    leading = _leading(fits, size, most)
    for one in leading:
        if one.log_evidence < leading[0].log_evidence - 40.0:
            continue
        again = fit(problem, one.names, one.values, one.linearisation, iterations=2, rounds=2)
        fits[one.names] = again


def _extend(problem: Problem, fits: dict[tuple[str, ...], Fit], one: Fit, dictionary: list[Candidate], most: int) -> None:
    around = one.linearisation
    at = problem.predict(one.values, around.eta)
    residual = problem.data + around.offset() - at
    taken = jacobian_at(problem, one.where, one.u, around.eta, at)
    scanned = _scan(problem, around, residual, taken, [c for c in dictionary if c.effect not in one.names])
    order = sorted(scanned, key=lambda name: -scanned[name][0][0])[:most]
    for name in order:
        names = (*one.names, name)
        if any(set(names) == set(other) for other in fits) or scanned[name][0][0] < 4.0:
            continue
        fits[names] = _best_fit(problem, around, name, scanned[name], one.values, 1, 5)


def prior(problem: Problem, size: int) -> float:
    """Log prior of one set of that size."""
    effects = sum(not e.variance for e in problem.library.values())
    return log((P_NONE, P_ONE, P_TWO, P_THREE)[size]) - log(comb(effects, size))


def weigh(problem: Problem, fits: Mapping[tuple[str, ...], Fit]) -> Attribution:
    """Probabilities of hypotheses, each without and with something unknown beside it."""
    occam = _occam(fits)
    logs = {names: prior(problem, len(names)) + occam[names] + one.log_likelihood for names, one in fits.items()}
    order = sorted(logs, key=lambda names: -logs[names])
    none = fits[()]
    gap = what_is_left(problem, none.remainder, none.linearisation, none.residual)
    judged: list[tuple[Fit, Left, float]] = []
    for names in dict.fromkeys([*order[:JUDGED], ()]):
        one = fits[names]
        left = what_is_left(problem, one.remainder, one.linearisation, one.residual) if names else gap
        judged.append((one, left, prior(problem, len(names)) + occam[names]))
    # One listed effect that leaves nothing is as good as any explanation can be: no data speak for what has any shape, alone or beside it.
    clean = [worth + one.log_exact for one, left, worth in judged if len(one.names) == 1 and left.log_bayes_factor < 0.0]
    most = max(clean, default=np.inf)
    most -= log(max(1, sum(worth + one.log_exact + left.log_bayes_factor > most for one, left, worth in judged)))
    found: list[tuple[Fit, Left, float, float]] = []
    for one, left, worth in judged:
        energy = max(gap.energy, none.misfit - one.misfit + left.energy)
        known, unknown = (worth + w for w in _known_and_unknown(one, left, energy, most - worth))
        found.append((one, left, known, unknown))
    total = float(np.logaddexp.reduce([w for *_, known, unknown in found for w in (known, unknown)]))
    weighed = []
    for one, left, *both in found:
        known, unknown = (float(np.exp(w - total)) for w in both)
        weighed.append(Weighed(one, left, known + unknown, known, unknown))
    weighed.sort(key=lambda w: -w.share)
    marginal: dict[str, float] = {}
    for w in weighed:
        for name in w.fit.names:
            marginal[name] = marginal.get(name, 0.0) + w.share
    p_none = sum(w.known for w in weighed if not w.fit.names)
    p_unknown = sum(w.unknown for w in weighed)
    return Attribution(weighed, p_none, p_unknown, marginal, _groups(weighed))


def _known_and_unknown(one: Fit, left: Left, gap: float, most: float) -> tuple[float, float]:
    """Log likelihoods with these effects, without and with something unknown beside them.

    Either laws as inexact as laws are suffice, or exact laws leave something of any shape. Which of both is an inexact law and which
    something unknown is told by its share of the gap's energy `gap`: small, or any. What is left, of any shape, makes the data at `most`
    so likely.
    """
    any_shape = log(P_UNKNOWN) + min(one.log_exact + left.log_bayes_factor, most)
    if not one.names:
        return log(1.0 - P_UNKNOWN) + one.log_exact, any_shape
    sums = []
    for evidence, energy in (
        (log(1.0 - P_UNKNOWN) + one.log_likelihood, one.law_energy),
        (any_shape, left.energy),
    ):
        share = min(energy / max(gap, 1.0), 1.0)
        log_odds = log(1.0 - P_UNKNOWN) - log(P_UNKNOWN) - share / LAW_ENERGY - log(LAW_ENERGY)
        sums.append((evidence - float(np.logaddexp(0.0, -log_odds)), evidence - float(np.logaddexp(0.0, log_odds))))
    known, unknown = np.logaddexp(*np.array(sums))
    return float(known), float(unknown)


def _groups(weighed: list[Weighed]) -> dict[str, list[str]]:
    """For every effect of the best hypothesis the ones that could stand in its place."""
    best = weighed[0]
    out: dict[str, list[str]] = {}
    for name in best.fit.names:
        rest = set(best.fit.names) - {name}
        rivals: list[tuple[float, str]] = []
        for w in weighed[1:]:
            others = set(w.fit.names) - rest
            if rest <= set(w.fit.names) and len(others) == 1 and w.share > GROUP * best.share:
                rivals.append((w.share, others.pop()))
        out[name] = [other for _, other in sorted(rivals, reverse=True)]
    return out
