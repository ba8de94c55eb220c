"""Methods that predict the part of fz that is no contact, sample by sample from what is known online.

All have one interface: learn from recordings of free motion, start with a recording (a new tare), then give for each sensor sample the
part of fz that is no contact. No method sees a sample before it has come. The running zero learns on during a recording, but only where
the height is known to be clear of the tissue and the force agrees: a bias that learns under contact would learn the contact away.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, Protocol

import numpy as np

from palpd.compensation.cycles import run_time_features
from palpd.compensation.train import Method as Trained
from palpd.compensation.train import train
from palpd.control.inertial import InertialModel
from palpd.control.running_zero import RunningZero
from palpd.study.laboratory import CUTOFF_Hz, Take
from palpd.tick import Floats

SENSOR_DELAY_S = 1.0 / (2.0 * math.pi * CUTOFF_Hz)
"""Delay of a first-order filter of that cutoff, for slow signals."""


class OnlineSample(NamedTuple):
    """One sensor sample with what is known when it is explained.

    `speed` and `tool_az` are NaN unless a robot state has just come; `clear` means that the tip is above everything that is pressed.
    """

    t_s: float
    fz_N: float
    vz_m_per_s: float
    az_m_per_s2: float
    commanded_az_m_per_s2: float
    speed_m_per_s: float
    tool_az_m_per_s2: float
    clear: bool


class Method(Protocol):
    """A way to predict the part of fz that is no contact."""

    name: str

    def fit(self, runs: Sequence[Take]) -> None:
        """Learn from tared free motion."""

    def start(self) -> None:
        """A recording begins: after a tare, at rest, in free air."""

    def step(self, sample: OnlineSample, /) -> float:
        """Part of this sample's fz that is no contact, in N."""


def features(robot_t_s: Floats, vz_m_per_s: Floats, t_s: Floats) -> Floats:
    """Features as the loop has them when it explains each sample.

    Args:
        robot_t_s: Times (k,) of the robot states, in s.
        vz_m_per_s: Vertical speeds (k,).
        t_s: Times (n,) of the sensor samples, in s.

    Returns:
        Speed and acceleration (n, 2).
    """
    return run_time_features(robot_t_s, vz_m_per_s, t_s, SENSOR_DELAY_S)


def stream(run: Take) -> Iterator[OnlineSample]:
    """The samples of a recording in their order."""
    clear = run.z_m >= run.clear_z_m
    seen = features(run.robot_t_s, run.robot_vz_m_per_s, run.t_s)
    commanded = features(run.robot_t_s, run.target_vz_m_per_s, run.t_s)[:, 1]
    at_state = np.full((len(run.t_s), 2), np.nan)
    at_state[np.searchsorted(run.t_s, run.robot_t_s)] = np.column_stack([run.robot_vz_m_per_s, run.tool_az_m_per_s2])
    columns = (run.t_s, run.fz_N, *seen.T, commanded, *at_state.T, clear)
    return map(OnlineSample, *(column.tolist() for column in columns))


def corrections(method: Method, run: Take) -> Floats:
    """Prediction of a method for every sample of a recording.

    Args:
        method: The method, after it has learned.

    Returns:
        Parts of fz (n,) that are no contact, in N.
    """
    if isinstance(method, ExportedModel):  # the same numbers in one call
        return np.array(method.model.predict(features(run.robot_t_s, run.robot_vz_m_per_s, run.t_s).tolist()))
    method.start()
    return np.array([method.step(sample) for sample in stream(run)])


def fit_line(runs: Sequence[Take]) -> tuple[float, float]:
    """Bias and mass of fz = b - m a over all samples, with the acceleration that the loop has.

    Args:
        runs: Recordings of free motion.

    Returns:
        Bias in N and mass in kg.
    """
    az = np.concatenate([features(run.robot_t_s, run.robot_vz_m_per_s, run.t_s)[:, 1] for run in runs])
    fz_N = np.concatenate([run.fz_N for run in runs])
    slopes = np.column_stack([np.ones(len(az)), -az])
    bias_N, mass_kg = np.linalg.lstsq(slopes, fz_N, rcond=None)[0].tolist()
    return bias_N, mass_kg


class NoCorrection:
    """Every newton is contact."""

    name = "none"

    def fit(self, runs: Sequence[Take]) -> None:
        """Nothing to learn."""

    def start(self) -> None:
        """Nothing to forget."""

    def step(self, _sample: OnlineSample, /) -> float:
        """Nothing."""
        return 0.0


class ConstantBias(NoCorrection):
    """The mean of free motion."""

    name = "bias only"
    bias_N = 0.0

    def fit(self, runs: Sequence[Take]) -> None:
        """The mean."""
        self.bias_N = float(np.mean(np.concatenate([run.fz_N for run in runs])))

    def step(self, _sample: OnlineSample, /) -> float:
        """Always the same."""
        return self.bias_N


class ExportedModel(NoCorrection):
    """A model as `palpd train --method` writes it and the daemon runs it, one sample a call."""

    def __init__(self, method: Trained, name: str) -> None:
        self._method, self.name = method, name
        self.model: InertialModel

    def fit(self, runs: Sequence[Take]) -> None:
        """Train, write, and load what was written."""
        with TemporaryDirectory() as folder:
            path = Path(folder) / "inertial.onnx"
            train([run.samples() for run in runs], path, probe_mass_kg=0.2, sensor_delay_s=SENSOR_DELAY_S, method=self._method)
            self.model = InertialModel.load(path, probe_mass_kg=0.2)

    def step(self, sample: OnlineSample) -> float:
        """The network's answer."""
        return self.model.predict([(sample.vz_m_per_s, sample.az_m_per_s2)])[0]


class LinearModelWithRunningZero:
    """Mass from training, bias from the free air just before: fz = zero(t) - m a."""

    name = "m·a + running zero"

    def __init__(self) -> None:
        self._bias_N = self._mass_kg = 0.0
        self._zero = RunningZero()

    def fit(self, runs: Sequence[Take]) -> None:
        """Mass; and the bias to start with."""
        self._bias_N, self._mass_kg = fit_line(runs)

    def start(self) -> None:
        """The zero of the last recording is not that of this one."""
        self._zero = RunningZero(self._bias_N)

    def step(self, sample: OnlineSample) -> float:
        """Bias and inertia."""
        inertia_N = -self._mass_kg * sample.az_m_per_s2
        if sample.clear:
            self._zero.step(sample.t_s, sample.fz_N - inertia_N)
        return self._zero.zero_N + inertia_N
