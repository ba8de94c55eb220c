"""Hypotheses that a motion may refute: what each predicts of it, and what of that prediction is free."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.gaussian.nuisance_space import whitened
from palpd.gap.infer.evidence import Fit
from palpd.gap.infer.posterior import Attribution
from palpd.gap.laws.scene import Scene
from palpd.gap.laws.search import LearnedLaw
from palpd.gap.model.coordinates import values_at
from palpd.gap.model.problem import Problem
from palpd.tick import Floats


@dataclass(frozen=True)
class Rival:
    """A hypothesis that a motion may refute.

    Attributes:
        share: Its probability.
        eta: Shared deviations η (11,) with which it predicts, in standard deviations.
        law: The learned law among its effects: its curve is known no better than its band, so another motion may show it elsewhere in the
            band. None for listed effects.
    """

    fit: Fit
    share: float
    eta: Floats
    law: LearnedLaw | None = None

    @property
    def name(self) -> str:
        """The ids of its effects in words."""
        return " with ".join(self.fit.names) or "no effect"

    def without_deviation(self, k: int) -> "Rival":
        """The same with its shared deviation η of number k at zero."""
        return replace(self, eta=np.where(np.arange(len(self.eta)) == k, 0.0, self.eta))

    def prediction(self, trial: Problem) -> Floats:
        """Whitened prediction (7, b) of the problem that another recording would pose."""
        return trial.predict(self.fit.values, self.eta)

    def free_columns(self, trial: Problem, prediction: Floats) -> Iterator[Floats]:
        """Whitened changes (7, b) of the prediction by one standard deviation of each independent combination of what was fitted.

        Args:
            trial: The problem that another recording would pose, b bins.
            prediction: Whitened prediction (7, b) without these changes.
        """
        values, vectors = np.linalg.eigh(self.fit.covariance)
        for value, vector in zip(values, vectors.T, strict=True):
            spread = min(max(float(value), 0.0), 1e6) ** 0.5
            step = min(1e-2, spread) if spread > 0.0 else 1e-2
            moved = trial.predict(values_at(self.fit.where, self.fit.u + step * vector), self.eta)
            yield (moved - prediction) * (spread / step)
        if self.law is None:
            return
        scene = Scene.of(trial, self.fit.values, self.eta).with_rest_speed(self.law.scene.rest_speed_m_per_s)
        for number in range(len(self.law.terms)):
            candidate, covariance = self.law.uncertain(number)
            columns = whitened(trial.noise, scene.columns(candidate))
            variances, vectors = np.linalg.eigh(covariance)
            for step in (vectors * np.sqrt(np.maximum(variances, 0.0))).T:
                change = np.zeros_like(trial.data)
                for channel, values in columns.items():
                    change[channel] = values @ step
                if change.any():
                    yield change


def open_rivals(attribution: Attribution) -> list[Rival]:
    """The open hypotheses, the most probable first, without those that only add an effect to a more probable hypothesis."""
    least = ASSUMED.advice.open_above * attribution.best.share
    rivals: list[Rival] = []
    for hypothesis in attribution.hypotheses:
        fit = hypothesis.fit
        if hypothesis.share > least and not any(rival.fit.names and set(rival.fit.names) < set(fit.names) for rival in rivals):
            rivals.append(Rival(fit, hypothesis.share, fit.eta))
    return rivals[: ASSUMED.advice.most_open]
