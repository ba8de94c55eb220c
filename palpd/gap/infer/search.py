"""Stage 3 of a diagnosis: the search over sets of effects. Each step makes the next state."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from math import inf

import numpy as np

from palpd.cell.cell_file import EffectValues
from palpd.cell.effects import Effect, Scale
from palpd.gap.assumptions import ASSUMED
from palpd.gap.gaussian.nuisances import project
from palpd.gap.infer.candidates import Candidate, Match, candidates_of, further_candidates, ringing_frequencies, scan, spectral_peaks
from palpd.gap.infer.evidence import Fit, fit, laplace_evidence
from palpd.gap.infer.fit import gauss_newton, jacobian_at
from palpd.gap.infer.settle import NominalFit
from palpd.gap.model.coordinates import coordinates, coordinates_of, other_laws, start_values, stretched
from palpd.gap.model.linearise import Linearisation, linearise
from palpd.gap.model.problem import MODULUS, NOMINAL_ETA, Problem
from palpd.tick import Floats

Fits = Mapping[tuple[str, ...], Fit]
"""Fits of sets by their effects."""


@dataclass(frozen=True)
class SearchState:
    """A search between two of its steps.

    Attributes:
        linearisation: From it single effects are fitted.
        frequencies_Hz: Those at which an oscillation may start.
        candidates: For a single effect.
        fits: The best fit of every set so far; the empty set is among them.
        largest_gain: That a scan has promised, in squared sigmas.
    """

    problem: Problem
    linearisation: Linearisation
    frequencies_Hz: tuple[float, ...]
    candidates: tuple[Candidate, ...]
    fits: Fits
    largest_gain: float = 0.0

    def with_fit(self, fitted: Fit, gain: float = 0.0) -> "SearchState":
        """The state with this fit of its set; `gain` is what a scan promised of it."""
        return replace(self, fits={**self.fits, fitted.names: fitted}, largest_gain=max(self.largest_gain, gain))

    def leading(self, size: int, most: int) -> list[Fit]:
        """The fits of sets of `size` effects, by falling evidence, at most `most` of them."""
        return sorted((f for names, f in self.fits.items() if len(names) == size), key=lambda f: -f.log_evidence)[:most]


Step = Callable[[SearchState], SearchState]


def single_effects(state: SearchState) -> SearchState:
    """Fit the effects that match the residual best."""
    problem, linearisation = state.problem, state.linearisation
    residual = problem.data + linearisation.offset() - linearisation.prediction
    matches = scan(problem, linearisation, residual, [], state.candidates)
    order = sorted(matches, key=lambda name: -matches[name][0].gain)
    for number, name in enumerate(order):
        gain = matches[name][0].gain
        if number < ASSUMED.search.fitted_after_scan or gain > ASSUMED.search.also_fitted_gain * matches[order[0]][0].gain:
            fitted = _fit_from(problem, linearisation, name, matches[name], {}, starts=3, iterations=8)
            state = state.with_fit(fitted, gain)
    return state


def from_afar(state: SearchState) -> SearchState:
    """Fit also from nuisances that are linearised at each start, since a large gap changes how in-tolerance deviations act.

    This covers the effects that are fitted already and everything between tip and tissue. Where the modulus is not known, a limit of the
    readings is always sought so: it hides how stiff the tissue is, and the nominal modulus then lies below all that it could clip.
    """
    problem = state.problem
    large_gap = state.largest_gain > ASSUMED.search.large_gap
    for effect in problem.library.values():
        single = state.fits.get((effect.id,))
        limited = _limits_readings(effect, problem.scale) and not problem.cell.tolerances.modulus_known
        near = large_gap and (single is not None or effect.site in ("tip", "tissue"))
        if effect.scatter or not (near or limited):
            continue
        starts = [candidate.values for candidate in state.candidates if candidate.effect == effect.id]
        starts = starts[:: max(1, len(starts) // 6)]
        if single is not None:
            starts.append(single.values[effect.id])
        if limited:
            starts = start_values(effect, problem.scale, [])
        etas = [state.linearisation.eta, *(_stiffer(state, factor) for factor in ASSUMED.search.stiffer if limited)]
        misfits = []
        for values, eta in product(starts, etas):
            there = linearise(problem, {effect.id: values}, eta)
            residual = project(problem.data + there.offset() - there.prediction, there.space)
            misfits.append((residual.dot(residual), values, there))
        for _, values, there in sorted(misfits, key=lambda item: item[0])[:2]:
            fitted = fit(problem, {effect.id: values}, there, iterations=6, rounds=ASSUMED.search.rounds)
            single = fitted if single is None or fitted.log_evidence > single.log_evidence else single
            state = state.with_fit(single)
    return state


def refine(state: SearchState, size: int, most: int) -> SearchState:
    """Linearise the nuisances of the leading fits again at their optimum; one by `search.hopeless_nats` below the first is left.

    There the other laws by which real cells show an effect are tried once more: far from the optimum the usual one may look better.
    """
    problem, leading = state.problem, state.leading(size, most)
    for before in leading:
        if before.log_evidence >= leading[0].log_evidence - ASSUMED.search.hopeless_nats:
            fits = [fit(problem, before.values, before.linearisation, iterations=2, rounds=ASSUMED.search.rounds)]
            for values in other_laws(fits[0].values, problem.library, problem.scale):
                fits.append(fit(problem, values, fits[0].linearisation, iterations=6, rounds=1))
            state = state.with_fit(max(fits, key=lambda fitted: fitted.log_evidence))
    return state


def extend(state: SearchState, size: int, sets: int, further: int) -> SearchState:
    """Fit the leading sets of `size` effects, each together with the effects that match its residual best."""
    problem = state.problem
    for smaller in state.leading(size, sets):
        linearisation = smaller.linearisation
        at = problem.predict(smaller.values, linearisation.eta)
        taken = jacobian_at(problem, smaller.where, smaller.u, linearisation.eta, at)
        candidates = further_candidates(problem, state.candidates, smaller, state.frequencies_Hz)
        matches = scan(problem, linearisation, problem.data + linearisation.offset() - at, taken, candidates)
        for name in sorted(matches.keys() - set(smaller.names), key=lambda name: (-matches[name][0].gain, name))[:further]:
            gain, names = matches[name][0].gain, {*smaller.names, name}
            if gain >= ASSUMED.search.least_gain and not any(names == set(known) for known in state.fits):
                fitted = _fit_from(problem, linearisation, name, matches[name], smaller.values, starts=1, iterations=5)
                state = state.with_fit(fitted, gain)
    return state


STEPS: tuple[tuple[Step, ...], ...] = (
    (single_effects, from_afar, partial(refine, size=1, most=ASSUMED.search.refined[0])),
    (
        partial(extend, size=1, sets=ASSUMED.search.extended[0], further=ASSUMED.search.added[0]),
        partial(refine, size=2, most=ASSUMED.search.refined[1]),
    ),
    (
        partial(extend, size=2, sets=ASSUMED.search.extended[1], further=ASSUMED.search.added[1]),
        partial(refine, size=3, most=ASSUMED.search.refined[1]),
    ),
)
"""The steps in their order, by the size of the sets that they fit: a beam search."""


def search(nominal: NominalFit, largest: int = len(STEPS)) -> SearchState:
    """Fit no effect, the likely single effects, and sets of two and three that extend them, up to sets of `largest`."""
    problem, linearisation = nominal.problem, nominal.linearisation
    # Of the cell without effects as fitted: what its deviations explain would hide a small line.
    predicted = problem.raw_prediction(problem.recordings[0], problem.cell_at({}, nominal.fit.eta))
    frequencies_Hz = (*spectral_peaks(problem, predicted), *ringing_frequencies(problem, predicted))
    candidates = candidates_of(problem, problem.library, {}, linearisation.eta, frequencies_Hz)
    state = SearchState(problem, linearisation, frequencies_Hz, candidates, {(): nominal.fit})
    for size, steps in enumerate(STEPS[:largest], start=1):
        if size > 1 and _larger_sets_are_unlikely(state, size - 1):
            break
        for step in steps:
            state = step(state)
    return state


def _larger_sets_are_unlikely(state: SearchState, size: int) -> bool:
    """Whether no set of `size` effects beats the best smaller set by `search.further_effect_nats`."""
    best, smaller = state.leading(size, most=1), state.leading(size - 1, most=1)
    return not best or best[0].log_evidence < smaller[0].log_evidence + ASSUMED.search.further_effect_nats[size - 1]


def _fit_from(
    problem: Problem, linearisation: Linearisation, name: str, matches: list[Match], present: EffectValues, *, starts: int, iterations: int
) -> Fit:
    """The fit of an effect with the most evidence, from several starts; the parameters of the effects `present` are fitted with it.

    Each form is fitted: with and without optional parameters, and with each choice of a parameter that has a few values only.
    """
    effect, scale, library = problem.library[name], problem.scale, problem.library
    forms: dict[tuple[tuple[str, float | None], ...], list[Match]] = {}
    for match in matches:
        form = tuple((p.name, match.values[p.name] if p.choices else None) for p in effect.parameters if p.name in match.values)
        forms.setdefault(form, []).append(match)
    best_of_forms = []
    for of_form in forms.values():
        trials = [stretched(effect, match.values, match.factor, scale) for match in _different(of_form, starts)]
        if any(p.nominal_value(scale) not in (None, 0.0) for p in effect.parameters):
            trials.append(of_form[0].values)  # made larger or smaller, a limit or a stiffness may lose all its effect
        where = coordinates(present | {name: trials[0]}, library, scale)
        optima = [gauss_newton(problem, linearisation, where, coordinates_of(where, present | {name: v}), iterations) for v in trials]
        best_of_forms.append(laplace_evidence(problem, min(optima, key=lambda optimum: optimum.misfit)))
    return max(best_of_forms, key=lambda fitted: fitted.log_evidence)


def _stiffer(state: SearchState, factor: float) -> Floats:
    """Shared deviations (11,) of the cell as stated, with the nominal fit's modulus times a factor."""
    modulus = state.linearisation.eta + np.log(factor) / np.maximum(state.problem.shared_sd, 1e-300)
    return np.where(MODULUS, modulus, NOMINAL_ETA)


def _limits_readings(effect: Effect, scale: Scale) -> bool:
    """Whether an effect caps the readings: it is absent where its limit is infinite."""
    return any(p.unit == "N" and p.nominal_value(scale) == inf for p in effect.parameters)


def _different(matches: list[Match], most: int) -> list[Match]:
    """The first few matches that differ in their gain."""
    out: list[Match] = []
    for match in matches:
        if all(abs(match.gain - other.gain) > 1e-3 * max(other.gain, 1.0) for other in out):
            out.append(match)
    return out[:most]
