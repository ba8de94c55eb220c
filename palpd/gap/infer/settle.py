"""Stage 2 of a diagnosis: the cell without effects, which settles how large the simulator's error may be."""

from dataclasses import dataclass, replace

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FZ
from palpd.gap.infer.discrepancy import discrepancy_columns
from palpd.gap.infer.evidence import Fit, fit
from palpd.gap.infer.fit import jacobian_at
from palpd.gap.model.coordinates import coordinates, coordinates_of, other_laws
from palpd.gap.model.linearise import Linearisation, linearise
from palpd.gap.model.problem import NOMINAL_ETA, SHARED, Problem
from palpd.gap.model.servo_error import HELD_TARGETS
from palpd.tick import Floats


@dataclass(frozen=True)
class NominalFit:
    """The cell without effects.

    Attributes:
        problem: With the error of the simulator in its noise.
        fit: The hypothesis that there is no effect.
        stated: Linearisation of the cell as stated, η₀ = 0; where its modulus is not known, at the fitted deviations.
        linearisation: From it effects are searched: that of `fit`, or `stated` where a deviation of `fit` is not credible.
    """

    problem: Problem
    fit: Fit
    stated: Linearisation
    linearisation: Linearisation


def settle(problem: Problem) -> NominalFit:
    """Fit the cell without effects, which also says how large the error of the simulator may be."""
    stated = linearise(problem, {}, NOMINAL_ETA)
    if any(drags := _cycles_that_drag(problem, stated)):
        pairs = zip(problem.servo_errors, drags, strict=True)
        problem = replace(problem, servo_errors=tuple(errors.without(HELD_TARGETS) if drag else errors for errors, drag in pairs))
        stated = linearise(problem, {}, NOMINAL_ETA)
    if problem.cell.effects:
        problem = replace(problem, law_errors=np.concatenate([problem.law_errors, _law_errors(problem, stated)]))
        stated = linearise(problem, {}, NOMINAL_ETA)
    if not problem.cell.tolerances.modulus_known:
        first = fit(problem, {}, stated, rounds=8)
        # The force in proportion to the modulus has been fitted: it is the gap's size.
        by_modulus = (np.arange(first.linearisation.space.size) == SHARED.index("youngs_modulus")).astype(float)
        problem = problem.with_model_error_floor(first.linearisation.space.explained(by_modulus) / problem.shared_sd[0])
        nominal = fit(problem, {}, linearise(problem, {}, first.eta), rounds=ASSUMED.search.rounds)
        return NominalFit(problem, nominal, nominal.linearisation, nominal.linearisation)
    problem = problem.with_model_error_floor(problem.data - stated.prediction)
    stated = linearise(problem, {}, NOMINAL_ETA)
    nominal = fit(problem, {}, stated, rounds=ASSUMED.search.rounds)
    # Beyond that, hypotheses that are linearised elsewhere would be judged by other tolerances.
    credible = np.abs(nominal.eta).max() < ASSUMED.noise.credible_sd
    return NominalFit(problem, nominal, stated, nominal.linearisation if credible else stated)


def _cycles_that_drag(problem: Problem, stated: Linearisation) -> list[bool]:
    """In which recordings what samples miss between held targets would drag, and no cycle of a controller shows.

    Nothing shows a cycle as long as a sample. What samples miss then pushes or drags, by chance. A push has no other cause; a drag is more
    often that of a cable, so it is tolerated no more.
    """
    sizes_sd = stated.space.coefficients(problem.data + stated.offset() - stated.prediction)
    misses_sd = iter(size_sd for size_sd, label in zip(sizes_sd.tolist(), stated.labels, strict=True) if label.name == HELD_TARGETS)
    return [recording.judged[FZ] and next(misses_sd) < 0.0 and recording.cycle_s is None for recording in problem.recordings]


def _law_errors(problem: Problem, stated: Linearisation) -> Floats:
    """What the laws of known effects may be wrong by (m, 7, b), in the units of the channels.

    `law_error.sizes[1]` × D. The diagnosis that found the effects allowed as much. Without it, the next one would take the error of a law
    for a further effect. Where real cells show an effect by another law, too, whose nuisance no cell file holds, that law may act, with
    parameters that change the effect by as much.
    """
    without, known, at = problem.without_known_effects(), problem.cell.effects, stated.prediction
    size, eta = ASSUMED.law_error.sizes[1], stated.eta
    directions, _ = discrepancy_columns(without, known, at, stated)
    errors = [*directions.scaled(size).dense()]
    others = list(other_laws(known, problem.library, problem.scale))
    where = [c for c in coordinates(known, problem.library, problem.scale) if others and not c.fixed]
    slopes = jacobian_at(without, where, coordinates_of(where, known), eta, at)
    for values in others:
        name = next(name for name in known if values[name] != known[name])
        part = at - without.predict({one: mine for one, mine in known.items() if one != name}, eta)
        moves = [slope / max(float(np.linalg.norm(slope)), 1e-300) for c, slope in zip(where, slopes, strict=True) if c.effect == name]
        errors += [without.predict(values, eta) - at, *(size * float(np.linalg.norm(part)) * move for move in moves)]
    return problem.noise.natural(np.array(errors).reshape(-1, *at.shape))
