"""Evidence of many candidates at once, over joined bins; that of the likeliest is then computed with all filters."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from palpd.cell.effects.drivers import Driver, FactorName
from palpd.gap.data.noise import CHANNELS, FX, FY, TX, TY
from palpd.gap.gaussian.evidence import GroupEvidence, batch_nats, group_evidence
from palpd.gap.gaussian.nuisance_space import COARSENESS, NuisanceSpace, Products, coarse, whitened
from palpd.gap.laws.bases import Basis
from palpd.gap.laws.dictionary import groups, periodic, refined
from palpd.gap.laws.formulas import Formula, formulas_of, neighbours
from palpd.gap.laws.scene import LATERAL, LawCandidate, Scene
from palpd.tick import Floats

AZIMUTHS_RAD = np.arange(6) * np.pi / 6.0
AZIMUTH_PRICE = float(np.log(len(AZIMUTHS_RAD)))
"""Directions of a force to the side that are tried, and the nats that this costs."""

FORMULA_ROUNDS = 2
"""Number of times that the place and width in the likeliest formula are tried again nearby."""

MOST_COLUMNS, MOST_WEIGHED = 96, 60
"""Number of columns that are scored at once, and number of likeliest candidates whose evidence is computed with all its prices."""


@dataclass(frozen=True)
class Scored:
    """A candidate with its evidence; `nats` is that less all prices."""

    candidate: LawCandidate
    nats: float
    evidence: GroupEvidence


@dataclass(frozen=True)
class _Batch:
    """k candidates of m coefficients with the same channel and priors, and their whitened columns (b, k m) by channel."""

    candidates: list[LawCandidate]
    values: dict[int, Floats]


@dataclass(frozen=True)
class Scorer:
    """Computes the evidence of candidates in a residual."""

    scene: Scene
    space: NuisanceSpace
    _listed: list["_Batch"] = field(default_factory=list)
    _factors: dict[tuple[str, FactorName], dict[int, Floats]] = field(default_factory=dict)
    _drivers: dict[tuple[str, Driver], Floats] = field(default_factory=dict)

    def scan(self) -> list[Scored]:
        """The likeliest candidates of the dictionary, the likeliest first."""
        if not self._listed:
            listed = (group.candidate(factor) for group in groups(self.scene) for factor in group.factors)
            self._listed.extend(_batches((one, self._joined(one)) for one in listed))
        # A wave may be as short as two bins, so bins are not joined for it.
        repeating = _batches((one, self._filtered(one)) for one in periodic(self.scene, self.space.remainder))
        out = [*_likeliest(self.space.coarse, self._listed), *_likeliest(self.space, repeating)]
        return sorted(out, key=lambda one: -one.nats)

    def beside(self, space: NuisanceSpace) -> "Scorer":
        """A scorer of the same candidates with other nuisances and residual."""
        return replace(self, space=space)

    def refine(self, lead: Scored) -> list[Scored]:
        """A candidate with other constants of its memory, or other periods, the likeliest first."""
        joined = lead.candidate.driver.period is None
        columns = ((one, self._joined(one) if joined else self._filtered(one)) for one in refined(self.scene, lead.candidate))
        return _likeliest(self.space.coarse if joined else self.space, _batches(columns))

    def best_formula(self, lead: Scored) -> Scored | None:
        """The likeliest closed formula in place of a candidate's curve; None where it has no curve, or no formula is possible."""
        candidate = lead.candidate
        if not isinstance(candidate.basis, Basis):
            return None
        x = self._driver(candidate.channel, candidate.driver)
        formulas = formulas_of(candidate.basis, x, with_constant=candidate.factor != "one")
        listed = [replace(candidate, basis=formula, price=candidate.price + formula.price) for formula in formulas]
        periodic_law = candidate.driver.period is not None
        space = self.space if periodic_law else self.space.coarse
        columns = ((one, self._filtered(one) if periodic_law else self._joined(one)) for one in sorted(listed, key=lambda c: c.basis.size))
        best = max(_likeliest(space, _batches(columns)), key=lambda one: one.nats, default=None)
        for _ in range(FORMULA_ROUNDS):
            if best is None or periodic_law or not isinstance(best.candidate.basis, Formula):
                break
            near = [replace(best.candidate, basis=formula) for formula in neighbours(best.candidate.basis, x)]
            best = max([best, *_likeliest(space, _batches((one, self._joined(one)) for one in near))], key=lambda one: one.nats)
        return best

    def exact(self, candidate: LawCandidate) -> tuple[Scored, dict[int, Floats]]:
        """Evidence of a candidate with all filters, in all bins.

        Returns:
            The candidate with its evidence, and its whitened columns X (b, m) by channel.
        """
        columns = whitened(self.scene.problem.noise, self.scene.columns(candidate))
        evidence = group_evidence(self.space.products(columns), candidate.basis.priors)
        price = candidate.price + (AZIMUTH_PRICE if candidate.channel == LATERAL else 0.0)
        return Scored(candidate, evidence.nats - price, evidence), columns

    def _driver(self, channel: str, driver: Driver) -> Floats:
        """Values (b / COARSENESS,) of a driver in joined bins."""
        if (channel, driver) not in self._drivers:
            self._drivers[channel, driver] = _mean_of_rows(self.scene.driver(channel, driver))
        return self._drivers[channel, driver]

    def _factor(self, channel: str, factor: FactorName) -> dict[int, Floats]:
        """Whitened factor (b / COARSENESS, 1) in the channels on which it acts; a curve varies little over the memory of the noise."""
        if (channel, factor) not in self._factors:
            values, arm_m = self.scene.factor(channel, factor)[:, None], self.scene.problem.cell.probe.tip_length_m
            rows = {FX: 1.0, FY: 1.0, TX: arm_m, TY: -arm_m} if channel == LATERAL else {CHANNELS.index(channel): 1.0}
            columns = {row: arm * values for row, arm in rows.items() if self.scene.judged(row)}
            self._factors[channel, factor] = coarse(whitened(self.scene.problem.noise, columns))
        return self._factors[channel, factor]

    def _joined(self, candidate: LawCandidate) -> dict[int, Floats]:
        """Whitened columns in joined bins, without the filter of the sensor; those of heights with the servo, which is slow."""
        if candidate.channel == "z_m":
            return coarse(self._filtered(candidate))
        curve = candidate.basis.columns(self._driver(candidate.channel, candidate.driver))
        return {row: factor * curve for row, factor in self._factor(candidate.channel, candidate.factor).items()}

    def _filtered(self, candidate: LawCandidate) -> dict[int, Floats]:
        """Whitened columns in all bins, with all filters; those of a force to the side along both x and y."""
        if candidate.channel != LATERAL:
            return whitened(self.scene.problem.noise, self.scene.columns(candidate))
        x, y = (self.scene.columns(replace(candidate, azimuth_rad=angle)) for angle in (0.0, np.pi / 2.0))
        return whitened(self.scene.problem.noise, {row: x[row] if row in (FX, TY) else y[row] for row in x})


def _likeliest(space: NuisanceSpace, batches: Iterable[_Batch]) -> list[Scored]:
    """The likeliest candidates of some batches with their evidence less all prices, the likeliest first."""
    quick = [one for batch in batches for one in _scored(space, batch)]
    quick.sort(key=lambda one: -one[0])
    return sorted((_weighed(candidate, products) for _, candidate, products in quick[:MOST_WEIGHED]), key=lambda one: -one.nats)


def _mean_of_rows(values: Floats) -> Floats:
    """Means (b / COARSENESS,) over joined bins."""
    rows = np.arange(0, len(values), COARSENESS)
    return np.asarray(np.add.reduceat(values, rows) / np.diff(rows, append=len(values)))


def _kind(candidate: LawCandidate) -> tuple[str, bool, int, bool]:
    """What candidates of a batch have in common: the channel and the priors."""
    return candidate.channel, candidate.driver.period is None, candidate.basis.size, isinstance(candidate.basis, Basis)


def _batches(candidates: Iterable[tuple[LawCandidate, dict[int, Floats]]]) -> Iterator[_Batch]:
    """Batches of neighbouring candidates of the same kind."""
    mine: list[tuple[LawCandidate, dict[int, Floats]]] = []
    for one in candidates:
        if mine and (_kind(one[0]) != _kind(mine[0][0]) or len(mine) * one[0].basis.size >= MOST_COLUMNS):
            yield _batch(mine)
            mine = []
        mine.append(one)
    if mine:
        yield _batch(mine)


def _batch(mine: list[tuple[LawCandidate, dict[int, Floats]]]) -> _Batch:
    return _Batch([candidate for candidate, _ in mine], {row: np.hstack([columns[row] for _, columns in mine]) for row in mine[0][1]})


def _scored(space: NuisanceSpace, batch: _Batch) -> Iterator[tuple[float, LawCandidate, Products]]:
    """Nats of every candidate less its price, but before the price of what tolerances hide; the candidate; its products."""
    values, m = batch.values, batch.candidates[0].basis.size
    if not values:
        return
    lateral = batch.candidates[0].channel == LATERAL
    n = len(batch.candidates) * m
    index = np.arange(n).reshape(-1, m)
    if lateral:
        values = {row: np.hstack([v, np.zeros_like(v)] if row in (FX, TY) else [np.zeros_like(v), v]) for row, v in values.items()}
        index = np.hstack([index, n + index])
    products = space.products(values)
    grams, slopes = products.gram[index[:, :, None], index[:, None, :]], products.slope[index]
    priors = batch.candidates[0].basis.priors
    if lateral:
        each = [batch_nats(both.T @ grams @ both, slopes @ both, priors) for both in _azimuths(m)]
        nats = np.max(each, axis=0) - AZIMUTH_PRICE
    else:
        nats = batch_nats(grams, slopes, priors)
    for candidate, mine, gram, slope, one in zip(batch.candidates, index, grams, slopes, nats.tolist(), strict=True):
        yield one - candidate.price, candidate, Products(gram, slope, products.raw[np.ix_(mine, mine)])


def _azimuths(m: int) -> list[Floats]:
    """Matrices (2 m, m) that combine columns along x, followed by those along y, to columns along each azimuth."""
    return [np.vstack([np.cos(azimuth_rad) * np.eye(m), np.sin(azimuth_rad) * np.eye(m)]) for azimuth_rad in AZIMUTHS_RAD]


def _weighed(candidate: LawCandidate, products: Products) -> Scored:
    """Evidence of a candidate less all prices. That of a force to the side is at its best azimuth; its columns along x come before y."""
    priors = candidate.basis.priors
    if candidate.channel != LATERAL:
        evidence = group_evidence(products, priors)
        return Scored(candidate, evidence.nats - candidate.price, evidence)
    each = []
    for azimuth_rad, both in zip(AZIMUTHS_RAD, _azimuths(candidate.basis.size), strict=True):
        evidence = group_evidence(products.combined(both), priors)
        each.append(Scored(replace(candidate, azimuth_rad=float(azimuth_rad)), evidence.nats - candidate.price - AZIMUTH_PRICE, evidence))
    return max(each, key=lambda one: one.nats)
