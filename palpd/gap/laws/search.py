"""The search for a law: score the dictionary, take the likeliest term, add it to the nuisances, repeat."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FZ, Z
from palpd.gap.data.phases import Ints
from palpd.gap.data.rounding import undithered_rms_of
from palpd.gap.gaussian.evidence import group_evidence
from palpd.gap.gaussian.nuisance_space import NuisanceSpace, whitened
from palpd.gap.infer.posterior import price_nats
from palpd.gap.laws.bases import Basis
from palpd.gap.laws.held_out import HeldOut, held_out, spread_over_folds
from palpd.gap.laws.scene import LawCandidate, Scene
from palpd.gap.laws.scoring import Scored, Scorer
from palpd.gap.model.problem import return_memory
from palpd.tick import Floats


@dataclass(frozen=True)
class LawTerm:
    """A term of a learned law: factor × curve(driver), with m coefficients w.

    Attributes:
        candidate: Channel, factor, driver and curve.
        nats: Its evidence with the earlier terms among the nuisances, less its price.
        columns: Whitened columns X (b, m) by channel, with all filters.
        root: Root s L (m, m) of the prior covariance of w.
        held_out: Gains on strokes that its fit did not see.
        alike: Candidates with other factors or drivers that fit as well.
        free_curve: The curve that its formula replaced; None where the term is a curve itself.
    """

    candidate: LawCandidate
    nats: float
    columns: dict[int, Floats]
    root: Floats
    held_out: HeldOut
    alike: tuple[Scored, ...]
    free_curve: LawCandidate | None = None


@dataclass(frozen=True)
class LearnedLaw:
    """A law of one or two terms, in the scene in which it was found.

    Attributes:
        space: Nuisances and residual without the terms.
        terms: In the order in which they were found; empty where there is no law.
    """

    scene: Scene
    space: NuisanceSpace
    terms: tuple[LawTerm, ...]

    @property
    def nats(self) -> float:
        """Evidence of all terms, in nats."""
        return sum(term.nats for term in self.terms)

    @cached_property
    def _joint(self) -> tuple[Floats, Floats, list[slice]]:
        """Posterior mean and covariance of the coefficients w of all terms, and which of them belong to each term."""
        sizes = [len(term.root) for term in self.terms]
        ends = np.cumsum(sizes).tolist()
        slices = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
        root = np.zeros((ends[-1], ends[-1]))
        columns: dict[int, Floats] = {}
        for term, mine in zip(self.terms, slices, strict=True):
            root[mine, mine] = term.root
            for channel, values in term.columns.items():
                columns.setdefault(channel, np.zeros((len(values), ends[-1])))[:, mine] = values
        products = self.space.products(columns)
        inner = np.linalg.inv(np.eye(len(root)) + root.T @ products.gram @ root)
        covariance = root @ inner @ root.T
        return covariance @ products.slope, covariance, slices

    def coefficients(self, number: int) -> tuple[Floats, Floats]:
        """Posterior mean (m,) and covariance (m, m) of the coefficients w of a term, fitted together with the other terms."""
        mean, covariance, slices = self._joint
        return mean[slices[number]], covariance[slices[number], slices[number]]

    def uncertain(self, number: int) -> tuple[LawCandidate, Floats]:
        """How well the curve of a term is known: as a free curve also where a formula holds, since another formula may be the true one.

        Returns:
            The free curve, and the covariance (m, m) of its coefficients w, more where strokes disagree on it than noise says.
        """
        term = self.terms[number]
        if term.free_curve is None:
            candidate, columns, root, covariance = term.candidate, term.columns, term.root, self.coefficients(number)[1]
            products = self.space.products(columns)
        else:
            candidate, columns = term.free_curve, whitened(self.scene.problem.noise, self.scene.columns(term.free_curve))
            products = self.space.products(columns)
            evidence = group_evidence(products, candidate.basis.priors)
            root, covariance = evidence.root, evidence.covariance
        without_others = NuisanceSpace(self.space.columns, self.space.residual - self.change + self._change_by(number))
        spread = spread_over_folds(without_others, columns, root, self.scene.strokes(ASSUMED.laws.folds))
        return candidate, covariance * max(1.0, float(np.sum(products.gram * spread) / max(np.sum(products.gram * covariance), 1e-300)))

    @cached_property
    def change(self) -> Floats:
        """Change (7, b) of the whitened prediction by the law, X w."""
        return sum((self._change_by(number) for number in range(len(self.terms))), np.zeros_like(self.space.residual))

    def _change_by(self, number: int) -> Floats:
        """Change (7, b) by one term."""
        out, (mean, _) = np.zeros_like(self.space.residual), self.coefficients(number)
        for channel, values in self.terms[number].columns.items():
            out[channel] += values @ mean
        return out

    @property
    def likely(self) -> bool:
        """Whether the first term is likely enough to be named."""
        named_nats = ASSUMED.laws.named_height_nats if self.terms and self.terms[0].candidate.channel == "z_m" else ASSUMED.laws.named_nats
        return bool(self.terms) and self.terms[0].nats >= named_nats + price_nats(self.scene.problem, "")

    @property
    def carries(self) -> bool:
        """Whether the first term is likely enough, and holds on strokes that its fit did not see."""
        return self.likely and self.terms[0].held_out.carries(self.terms[0].nats)

    def instead(self, candidate: LawCandidate) -> "LearnedLaw | None":
        """The same law with another first term; None where tolerances hide that term."""
        columns = whitened(self.scene.problem.noise, self.scene.columns(candidate))
        evidence = group_evidence(self.space.products(columns), candidate.basis.priors)
        if not np.isfinite(evidence.nats):
            return None
        first = LawTerm(candidate, evidence.nats - candidate.price, columns, evidence.root, self.terms[0].held_out, ())
        return replace(self, terms=(first, *self.terms[1:]))


def search(scene: Scene, space: NuisanceSpace, gained: float = 0.0) -> LearnedLaw:
    """Search for a law in a residual.

    Args:
        gained: Nats that listed effects have gained before.

    Returns:
        The law; without terms where no candidate is likely enough.
    """
    fold = scene.strokes(ASSUMED.laws.folds)
    terms: list[LawTerm] = []
    scorer = Scorer(scene, space)
    while len(terms) < ASSUMED.laws.most_terms:
        term = _next_term(scorer, fold)
        if term is None:
            break
        if not terms and "direction" in (*term.candidate.factor.split("_"), term.candidate.driver.quantity):
            scene, term = _with_best_rest_speed(scene, space, term, fold)
            scorer = Scorer(scene, space)
        so_far = max(gained, 0.0) + sum(one.nats for one in terms)
        if terms and (
            term.nats < max(ASSUMED.laws.further_nats, ASSUMED.laws.further_share * so_far)
            or term.held_out.total < ASSUMED.laws.least_gain_share * term.nats
        ):
            break
        terms.append(term)
        if not LearnedLaw(scene, space, (term,)).carries and len(terms) == 1:
            break
        more = {channel: values @ term.root for channel, values in term.columns.items()}
        scorer = scorer.beside(scorer.space.with_columns(more))
    return LearnedLaw(scene, space, tuple(terms))


def _next_term(scorer: Scorer, fold: Ints) -> LawTerm | None:
    """The likeliest term, with a closed formula where one holds."""
    scene, space = scorer.scene, scorer.space
    scored = scorer.scan()
    return_memory()
    if not scored or scored[0].nats < ASSUMED.laws.look_nats:
        return None
    scored += [better for one in _first_of_each(scored, 3) for better in scorer.refine(one)]
    scored.sort(key=lambda one: -one.nats)
    leading = _first_of_each(scored, ASSUMED.laws.pairs_with_formulas)
    leading += [one for lead in leading if (one := scorer.best_formula(lead)) is not None]
    return_memory()
    exact = sorted((scorer.exact(lead.candidate) for lead in leading), key=lambda one: -one[0].nats)
    hidden = _hidden(scene)
    exact = [(one, columns) for one, columns in exact if _shows(scene, one, columns, hidden)]
    if not exact:
        return None
    (best, columns), *others = exact
    close = [one for one, _ in others if one.nats > best.nats - ASSUMED.laws.alike_nats and one.candidate.name != best.candidate.name]
    close += [
        one
        for one in scored
        if one.nats > best.nats - ASSUMED.laws.alike_nats and one.candidate.name not in {o.candidate.name for o in [best, *close]}
    ]
    return LawTerm(
        best.candidate,
        best.nats,
        columns,
        best.evidence.root,
        held_out(space, columns, best.evidence.root, fold),
        tuple(_first_of_each(close, 8)),
        _free_curve(best, scored),
    )


def _with_best_rest_speed(scene: Scene, space: NuisanceSpace, term: LawTerm, fold: Ints) -> tuple[Scene, LawTerm]:
    """The term with the likeliest speed at which its friction turns over, and the scene with that speed."""
    best = scene, term
    for ratio in ASSUMED.laws.rest_speed_ratios:
        other = scene.with_rest_speed(ratio * scene.rest_speed_m_per_s)
        one, columns = Scorer(other, space).exact(term.candidate)
        nats = one.nats - float(np.log(1 + len(ASSUMED.laws.rest_speed_ratios)))
        if nats > best[1].nats:
            gains = held_out(space, columns, one.evidence.root, fold)
            best = other, replace(term, nats=nats, columns=columns, root=one.evidence.root, held_out=gains)
    return best


def _free_curve(best: Scored, scored: list[Scored]) -> LawCandidate | None:
    """The likeliest curve with the factor and driver of a formula; None where the candidate is a curve."""
    if isinstance(best.candidate.basis, Basis):
        return None
    same = (one.candidate for one in scored if one.candidate.name == best.candidate.name)
    return next((replace(one, azimuth_rad=best.candidate.azimuth_rad) for one in same), None)


def _first_of_each(scored: list[Scored], most: int) -> list[Scored]:
    """The first candidate of each channel, factor, quantity and memory, at most `most` in all."""
    out: dict[tuple[object, ...], Scored] = {}
    for one in scored:
        driver = one.candidate.driver
        key = (one.candidate.channel, one.candidate.factor, driver.quantity, driver.memory, driver.period is None)
        out.setdefault(key, one)
    return list(out.values())[:most]


def _shows(scene: Scene, one: Scored, columns: dict[int, Floats], hidden: Floats) -> bool:
    """Whether the change by a candidate is larger, in a channel, than what the simulation of that channel may lack: `hidden` (7,).

    A change of the reported height below the noise of one report is an error of the model of the follower. A change of a force below the
    error of its rounding that noise does not dither is that error: a few hundred readings of one force keep it.
    """
    white = np.zeros_like(scene.problem.data)
    for channel, values in columns.items():
        white[channel] = values @ one.evidence.mean
    change = scene.problem.noise.natural(white)
    rms = np.sqrt((change**2).mean(axis=1) / np.maximum((change != 0.0).mean(axis=1), 1e-300))
    return bool((rms > hidden)[list(columns)].any())


def _hidden(scene: Scene) -> Floats:
    """Noise of a report of the height, the largest of all recordings, and errors of rounding (7,) in the units of the channels."""
    problem = scene.problem
    hidden = undithered_rms_of(problem.cell)
    hidden[Z] = max(float(one.noise_rms[Z]) for one in problem.recordings)
    hidden[FZ] = 0.0 if problem.rounding is None else problem.rounding.undithered_rms_N
    return hidden
