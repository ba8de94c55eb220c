"""Methods of compensation that are compared with those of the daemon: a linear model, recursive estimators and Kalman filters.

Sources: [29, 30] Kubus et al. 2008, 2009; [31] Bätz et al. 2013; [32] Farsoni et al. 2017. The methods that learn on during a recording
do so only in free air, as the running zero does.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpd.control.running_zero import FreeAir
from palpd.study.laboratory import STEP_S, CUTOFF_Hz, Take
from palpd.study.methods import ConstantBias, ExportedModel, LinearModelWithRunningZero, Method, NoCorrection, OnlineSample, fit_line
from palpd.tick import Floats

SPEED_NOISE_M_PER_S = 2.0e-4
TOOL_NOISE_M_PER_S2 = 0.1
JERK_M_PER_S3 = 8.0
"""Change of acceleration per second that observers expect, rms: 0.5 m/s² within a servo's 60 ms."""
BIAS_WALK_N = 0.002
"""Change of bias in one second that observers expect: a warm-up of 0.3 N in minutes."""
MASS_SIGMA_KG = 0.03
READING_SIGMA_N = 0.065


class LinearModel(NoCorrection):
    """fz = b - m a by least squares over the samples, with the features of run time."""

    name = "m·a + bias"
    bias_N = mass_kg = 0.0

    def fit(self, runs: Sequence[Take]) -> None:
        """Bias and mass."""
        self.bias_N, self.mass_kg = fit_line(runs)

    def step(self, sample: OnlineSample) -> float:
        """Bias and inertia."""
        return self.bias_N - self.mass_kg * sample.az_m_per_s2


class InstrumentalVariables:
    """Bias and mass learned on while the tip is free, with the commanded acceleration as instrument for the noisy one [29, 30]."""

    name = "recursive instrumental variables"
    forget = math.exp(-STEP_S / 10.0)

    def __init__(self) -> None:
        self._fitted = np.zeros(2)
        self._theta = np.zeros(2)
        self._P = np.eye(2)
        self._free = FreeAir()

    def fit(self, runs: Sequence[Take]) -> None:
        """What to start with."""
        self._fitted = np.array(fit_line(runs))

    def start(self) -> None:
        """Back to what was learned, sure of the mass and not of the bias."""
        self._free = FreeAir()
        self._theta = self._fitted.copy()
        self._P = np.diag([1.0, (MASS_SIGMA_KG / READING_SIGMA_N) ** 2])

    def step(self, sample: OnlineSample) -> float:
        """Bias and inertia."""
        slopes = np.array([1.0, -sample.az_m_per_s2])
        predicted_N = float(slopes @ self._theta)
        if sample.clear and self._free(sample.t_s, sample.fz_N - predicted_N):
            instrument = np.array([1.0, -sample.commanded_az_m_per_s2])
            gain = self._P @ instrument / (self.forget + float(slopes @ self._P @ instrument))
            self._theta = self._theta + gain * (sample.fz_N - predicted_N)
            self._P = (self._P - np.outer(gain, slopes @ self._P)) / self.forget
            self._P = np.clip(self._P, -1.0, 1.0)  # without motion nothing is learned of the mass and its covariance would grow for ever
        return predicted_N


@dataclass(frozen=True, slots=True)
class _ObserverModel:
    """State (bias, mass, speed, acceleration, what the filter shows of bias and inertia) of the observers [31]."""

    pole: float = 1.0 - math.exp(-2.0 * math.pi * CUTOFF_Hz * STEP_S)

    def ahead(self, x: Floats) -> Floats:
        """One sensor sample later; x is (5,) or (5, k)."""
        bias, mass, speed, acceleration, shown = x
        return np.array([bias, mass, speed + acceleration * STEP_S, acceleration, shown + self.pole * (bias - mass * acceleration - shown)])

    def slope(self, x: Floats) -> Floats:
        """Derivative of `ahead`, (5, 5)."""
        derivative = np.eye(5)
        derivative[2, 3] = STEP_S
        derivative[4] = self.pole, -self.pole * x[3], 0.0, -self.pole * x[1], 1.0 - self.pole
        return derivative


def _walk() -> Floats:
    """Covariance that one sample adds."""
    jerk = JERK_M_PER_S3**2 * 0.06 * STEP_S  # changes of acceleration last 60 ms, so they add up like a walk of that correlation
    return np.diag([BIAS_WALK_N**2 * STEP_S, 1e-12, 0.0, jerk, 0.0])


READING, SPEED, TOOL = np.eye(5)[[4, 2, 3]]


class ExtendedKalman:
    """Observer of bias, mass and motion, linearised about its estimate; fz is believed while the tip is free [31]."""

    def __init__(self, accelerometer: bool) -> None:
        self.name = "extended Kalman" + (" + accelerometer" if accelerometer else "")
        self._tool = accelerometer
        self._model = _ObserverModel()
        self._Q = _walk()
        self._fitted = (0.0, 0.0)
        self._x = np.zeros(5)
        self._P = np.eye(5)
        self._free = FreeAir()

    def fit(self, runs: Sequence[Take]) -> None:
        """What to start with."""
        self._fitted = fit_line(runs)

    def start(self) -> None:
        """At rest, the mass known, the bias not."""
        self._free = FreeAir()
        bias_N, mass_kg = self._fitted
        self._x = np.array([bias_N, mass_kg, 0.0, 0.0, bias_N])
        self._P = np.diag([0.1**2, MASS_SIGMA_KG**2, 1e-6, 1e-4, 0.1**2])

    def step(self, sample: OnlineSample) -> float:
        """Bias and inertia as the filter shows them."""
        self._predict()
        if not math.isnan(sample.speed_m_per_s):
            self._correct(SPEED, sample.speed_m_per_s, SPEED_NOISE_M_PER_S)
            if self._tool:
                self._correct(TOOL, sample.tool_az_m_per_s2, TOOL_NOISE_M_PER_S2)
        shown_N = float(self._x[4])
        if sample.clear and self._free(sample.t_s, sample.fz_N - shown_N):
            self._correct(READING, sample.fz_N, READING_SIGMA_N)
        return shown_N

    def _predict(self) -> None:
        slope = self._model.slope(self._x)
        self._x = self._model.ahead(self._x)
        self._P = slope @ self._P @ slope.T + self._Q

    def _correct(self, row: Floats, measured: float, sigma: float) -> None:
        across = self._P @ row
        gain = across / (float(row @ across) + sigma**2)
        self._x = self._x + gain * (measured - float(row @ self._x))
        self._P = self._P - np.outer(gain, across)


class UnscentedKalman(ExtendedKalman):
    """The same observer, its uncertainty carried by eleven points instead of a slope [31]."""

    def __init__(self, accelerometer: bool) -> None:
        super().__init__(accelerometer)
        self.name = "unscented Kalman" + (" + accelerometer" if accelerometer else "")

    def _predict(self) -> None:
        """Julier's points with kappa = 1: weights 1/6 in the middle and 1/12 around it."""
        root = np.linalg.cholesky(6.0 * (self._P + 1e-15 * np.eye(5)))
        points = self._x[:, None] + np.concatenate((np.zeros((5, 1)), root, -root), axis=1)
        later = self._model.ahead(points)
        weights = np.full(11, 1.0 / 12.0)
        weights[0] = 1.0 / 6.0
        self._x = later @ weights
        away = later - self._x[:, None]
        self._P = (away * weights) @ away.T + self._Q


class AxisKalman(NoCorrection):
    """Acceleration from speed and accelerometer by a linear Kalman filter, mass and bias from training: [32] without its rotations."""

    name = "one-axis Kalman (quaternion idea)"

    def __init__(self) -> None:
        self._bias_N = self._mass_kg = self._shown_N = 0.0
        self._x, self._P = np.zeros(2), np.eye(2)
        self._F = np.array([[1.0, STEP_S], [0.0, 1.0]])
        self._Q = np.diag([0.0, _walk()[3, 3]])
        self._R = np.diag([SPEED_NOISE_M_PER_S**2, TOOL_NOISE_M_PER_S2**2])
        self._pole = _ObserverModel().pole

    def fit(self, runs: Sequence[Take]) -> None:
        """Bias and mass."""
        self._bias_N, self._mass_kg = fit_line(runs)

    def start(self) -> None:
        """At rest."""
        self._x, self._P, self._shown_N = np.zeros(2), np.diag([1e-6, 1e-4]), self._bias_N

    def step(self, sample: OnlineSample) -> float:
        """Bias and inertia as the filter shows them."""
        self._x = self._F @ self._x
        self._P = self._F @ self._P @ self._F.T + self._Q
        if not math.isnan(sample.speed_m_per_s):
            gain = self._P @ np.linalg.inv(self._P + self._R)
            self._x = self._x + gain @ (np.array([sample.speed_m_per_s, sample.tool_az_m_per_s2]) - self._x)
            self._P = self._P - gain @ self._P
        self._shown_N += self._pole * (self._bias_N - self._mass_kg * float(self._x[1]) - self._shown_N)
        return self._shown_N


def methods() -> list[Method]:
    """All methods that are compared, but for the recurrent networks."""
    return [
        NoCorrection(),
        ConstantBias(),
        LinearModel(),
        ExportedModel("linear", "m·a + bias, exported"),
        ExportedModel("network", "2-10-1 network (the paper's)"),
        ExportedModel("prior-network", "m·a + bias + bounded network"),
        InstrumentalVariables(),
        AxisKalman(),
        ExtendedKalman(accelerometer=False),
        ExtendedKalman(accelerometer=True),
        UnscentedKalman(accelerometer=False),
        UnscentedKalman(accelerometer=True),
        LinearModelWithRunningZero(),
    ]
