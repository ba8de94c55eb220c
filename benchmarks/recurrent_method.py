"""A small recurrent network, the future work of Guo, Xiao, Ren 2019: it also knows speed and acceleration of the recent past.

An echo state network (Jaeger 2001): the recurrent weights are drawn and kept, only the readout is learned, by least squares; no
gradient through time and no framework, and the same recordings give the same network. Units forget within 4 to 200 ms, which spans
ramps, servo and filter. Exported as an ONNX graph that is given its state with each sample and gives the next back.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from palpd.compensation.train import IR_VERSION, OPSET
from palpd.control.running_zero import RunningZero
from palpd.study.laboratory import STEP_S, Take
from palpd.study.methods import NoCorrection, OnlineSample, features
from palpd.tick import Floats

UNITS = 20
FORGETS_S = (0.004, 0.2)
RADIUS = 0.8
"""Spectral radius of the drawn weights: below one, so that a state dies away."""
RIDGE = 1e-3
"""Relative to the mean square of a regressor."""


class Recurrent(NoCorrection):
    """Speed and acceleration with their past; with `zero` the bias follows the free air as in the daemon."""

    def __init__(self, zero: bool) -> None:
        self.name = "recurrent network (echo state, 20 units)" + (" + running zero" if zero else "")
        rng = np.random.default_rng(0)
        drawn = rng.normal(0.0, 1.0, (UNITS, UNITS))
        self._recurrent = drawn * RADIUS / float(np.abs(np.linalg.eigvals(drawn)).max())
        self._input, self._offset = rng.uniform(-1.0, 1.0, (2, UNITS)), rng.uniform(-0.5, 0.5, UNITS)
        self._leak = 1.0 - np.exp(-STEP_S / np.geomspace(*FORGETS_S, UNITS))
        self._scale = np.ones(2)
        self._readout = np.zeros(UNITS + 2)
        self._bias_N = 0.0
        self._with_zero, self._zero = zero, RunningZero()
        self._session: Any = None
        self._state = np.zeros((1, UNITS), np.float32)

    def fit(self, runs: Sequence[Take]) -> None:
        """The readout; then the graph."""
        motions = [features(run.robot_t_s, run.robot_vz_m_per_s, run.t_s) for run in runs]
        self._scale = np.maximum(np.std(np.concatenate(motions), axis=0), 1e-9)
        rows = np.concatenate([self._regressors(motion) for motion in motions])
        fz_N = np.concatenate([run.fz_N for run in runs])
        centre = rows.mean(axis=0)
        away = rows - centre
        gram = away.T @ away / len(rows)
        self._readout = np.linalg.solve(gram + RIDGE * np.diag(np.diag(gram)), away.T @ (fz_N - fz_N.mean()) / len(rows))
        self._bias_N = float(fz_N.mean() - centre @ self._readout)
        import onnxruntime

        self._session = onnxruntime.InferenceSession(self.exported(), providers=["CPUExecutionProvider"])

    def _regressors(self, motion: Floats) -> Floats:
        """Inputs and states (n, 2 + UNITS) of a recording."""
        inputs = motion / self._scale
        driven = inputs @ self._input + self._offset
        states = np.empty((len(motion), UNITS))
        state = np.zeros(UNITS)
        for k in range(len(motion)):
            state = state + self._leak * (np.tanh(driven[k] + state @ self._recurrent) - state)
            states[k] = state
        return np.hstack([inputs, states])

    def start(self) -> None:
        """At rest for long; another zero."""
        self._state = np.zeros((1, UNITS), np.float32)
        self._zero = RunningZero()

    def step(self, sample: OnlineSample) -> float:
        """The network's answer, and the zero."""
        motion = np.array([[sample.vz_m_per_s, sample.az_m_per_s2]], np.float32)
        force, self._state = self._session.run(None, {"motion": motion, "state": self._state})
        network_N = float(force[0, 0])
        if not self._with_zero:
            return network_N
        if sample.clear:
            self._zero.step(sample.t_s, sample.fz_N - network_N)
        return network_N + self._zero.zero_N

    def exported(self) -> bytes:
        """(motion (1, 2), state (1, UNITS)) -> (force (1, 1), state): operators of a feed-forward graph only."""
        weights = {
            "input": self._input / self._scale[:, None],
            "offset": self._offset,
            "recurrent": self._recurrent,
            "none": np.zeros(UNITS),
            "leak": self._leak[None, :],
            "of_motion": (self._readout[:2] / self._scale)[:, None],
            "of_state": self._readout[2:, None],
            "bias": np.array([self._bias_N]),
        }
        nodes = [
            helper.make_node("Gemm", ["motion", "input", "offset"], ["driven"]),
            helper.make_node("Gemm", ["state", "recurrent", "none"], ["echo"]),
            helper.make_node("Add", ["driven", "echo"], ["sum"]),
            helper.make_node("Tanh", ["sum"], ["target"]),
            helper.make_node("Sub", ["target", "state"], ["away"]),
            helper.make_node("Mul", ["away", "leak"], ["change"]),
            helper.make_node("Add", ["state", "change"], ["next_state"]),
            helper.make_node("Gemm", ["motion", "of_motion", "bias"], ["direct"]),
            helper.make_node("Gemm", ["next_state", "of_state"], ["remembered"]),
            helper.make_node("Add", ["direct", "remembered"], ["force_N"]),
        ]
        kinds = {"motion": 2, "state": UNITS, "force_N": 1, "next_state": UNITS}
        shown = {name: helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, width]) for name, width in kinds.items()}
        graph = helper.make_graph(
            nodes,
            "recurrent",
            [shown["motion"], shown["state"]],
            [shown["force_N"], shown["next_state"]],
            [numpy_helper.from_array(values.astype(np.float32), name) for name, values in weights.items()],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="palpd")
        return model.SerializeToString(deterministic=True)
