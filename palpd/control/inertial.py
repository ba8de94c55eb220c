"""The inertial force of the probe, predicted from its motion: causal features, and a small network that is checked before use.

The network (Guo, Xiao, Ren 2019: velocity and acceleration in, force out) runs on every sensor sample. A card beside it,
`<model>.json`, names its training data, probe, sensor and range. A model without a card is refused.
"""

import hashlib
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import mul
from pathlib import Path
from typing import Any

import numpy as np

from palpd.documents import read_json
from palpd.errors import ModelRefused
from palpd.files import opened
from palpd.tick import Floats, RobotState

SCHEMA = "palpd.inertial/1"
INPUTS = (("vz_m_per_s", "m/s"), ("az_m_per_s2", "m/s^2"))
"""Names and units of the features, in the order of their columns."""
INPUT_NAME, OUTPUT_NAME = "motion", "inertial_N"
WINDOW_S = 0.024
"""Length of robot states that the slope uses. It delays the acceleration by 12 ms.

At 2e-4 m/s rms of speed noise it leaves 11 mm/s² rms at 125 Hz or 7 at 500 Hz: 2 mN for a 0.2 kg probe. The difference of two
neighbouring speeds at 500 Hz leaves 28 mN."""
LARGEST_BYTES = 1_000_000
"""Largest model file: a network that runs on every sample is small."""
OPERATORS = frozenset({"Add", "Div", "Gemm", "Identity", "MatMul", "Mul", "Relu", "Sigmoid", "Sub", "Tanh"})
"""Allowed operators: enough for a small feed-forward network, and none loops, branches, reads a file or draws random numbers."""
MASS_TOLERANCE_KG = 0.005
"""Largest difference in mass between two probes that count as the same: 5 g at 0.4 m/s² are 2 mN."""


@dataclass(slots=True)
class MotionFeatures:
    """Speed and acceleration of the tip at the time of a sensor sample, from past robot states only.

    The acceleration is the slope of a straight line through the speeds of the last `WINDOW_S`, so it lags by `WINDOW_S`/2. The speed is
    read off the same line and does not lag. `sensor_delay_s` is the delay of the sensor's filter.
    """

    sensor_delay_s: float = 0.0
    _times_s: deque[float] = field(default_factory=deque)
    _speeds: deque[float] = field(default_factory=deque)
    _line: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def update(self, robot: RobotState) -> None:
        """Take in a state. A state that is not newer than the last changes nothing."""
        times_s, speeds, t_s = self._times_s, self._speeds, robot.t_s
        if times_s and t_s <= times_s[-1]:
            return
        times_s.append(t_s)
        speeds.append(robot.vz_m_per_s)
        while times_s[0] < t_s - WINDOW_S - 1e-4:  # controllers' timestamps jitter by less than that
            times_s.popleft()
            speeds.popleft()
        n = len(times_s)
        ages = [t - t_s for t in times_s]
        mean_age, mean_speed = math.fsum(ages) / n, math.fsum(speeds) / n
        slope = 0.0
        if n > 2:
            away = [age - mean_age for age in ages]
            spread = math.fsum([age**2 for age in away])
            slope = math.fsum(map(mul, away, speeds)) / spread
        self._line = (t_s + mean_age, mean_speed, slope)

    def features(self, t_s: Sequence[float]) -> list[tuple[float, float]]:
        """Return speed in m/s and acceleration in m/s² at each of the sensor times (n,); before any state they are zero.

        Beyond the newest state the line goes on for at most a window, then the speed stays constant.
        """
        mean_t_s, mean_speed, slope = self._line
        mean_t_s += self.sensor_delay_s
        return [(mean_speed + slope * min(max(t - mean_t_s, -WINDOW_S), WINDOW_S), slope) for t in t_s]


@dataclass(slots=True)
class InertialModel:
    """A network that predicts what inertia and bias add to fz, and its card.

    `low` and `high` (2,) bound the motion of the training. Beyond them the prediction is that of the nearest edge, because a network is
    arbitrary there. `not_finite` counts samples without a finite prediction; they stay uncorrected. `warnings` name what could not be
    checked.
    """

    card: dict[str, Any]
    low: tuple[float, ...]
    high: tuple[float, ...]
    network: "Network"
    not_finite: int = 0
    warnings: tuple[str, ...] = ()

    @classmethod
    def load(cls, path: Path, *, probe_mass_kg: float, sensor_serial: str | None = None) -> "InertialModel":
        """Read a model and its card.

        Args:
            path: the model; its card stands beside it.
            probe_mass_kg: mass of this cell's probe.
            sensor_serial: serial number of the connected sensor, if known.

        Raises:
            ModelRefused: model and card do not belong together, or not to this probe and sensor.
        """
        card = read_card(path)
        model = cls.from_bytes(_content(path), card, path.name)
        model.warnings = _refuse_stranger(path.name, card, probe_mass_kg, sensor_serial)
        return model

    @classmethod
    def from_bytes(cls, content: bytes, card: dict[str, Any], name: str = "the recorded model") -> "InertialModel":
        """Build a model from the bytes and the card of a recording.

        Args:
            content: the ONNX file.
            name: what errors call the model.

        Raises:
            ModelRefused: model and card do not belong together.
        """
        _refuse_incomplete(name, card)
        digest = hashlib.sha256(content).hexdigest()
        if digest != card["model_sha256"]:
            raise ModelRefused(
                f"{name} has the SHA-256 {digest[:12]}…, its card says {str(card['model_sha256'])[:12]}…; "
                "one of them was changed after training: train again or restore it"
            )
        _refuse_graph(name, content)
        low, high = _ranges(name, card).T.tolist()
        return cls(card, tuple(low), tuple(high), Network(_session(name, content)))

    def predict(self, features: Sequence[Sequence[float]]) -> list[float]:
        """Predict inertial force and learned bias (n,) in N on fz for features (n, 2); 0 where the network gives no finite number.

        The prediction is not bounded: the caller clips it.
        """
        (low_v, low_a), (high_v, high_a) = self.low, self.high
        predicted = self.network(
            [
                (
                    v if low_v <= v <= high_v else min(max(v, low_v), high_v),
                    a if low_a <= a <= high_a else min(max(a, low_a), high_a),
                )
                for v, a in features
            ]
        )
        if not math.isfinite(sum(predicted)):
            self.not_finite += sum(not math.isfinite(force_N) for force_N in predicted)
            predicted = [force_N if math.isfinite(force_N) else 0.0 for force_N in predicted]
        return predicted

    def out_of_range(self, features: Sequence[Sequence[float]]) -> int:
        """Return how many of the features (n, 2) lie outside the motion of the training."""
        (low_v, low_a), (high_v, high_a) = self.low, self.high
        return sum([not (low_v <= v <= high_v and low_a <= a <= high_a) for v, a in features])


class Network:
    """The exported graph with input and output bound once, `BATCH` rows at a time: a plain `run` costs twice as much in a tick.

    A row's result does not depend on the number of rows in the call, so a replay gives the same bits.
    """

    BATCH = 8  # a tick of 125 Hz and 1 kHz in one go

    def __init__(self, session: Any) -> None:
        self._session = session
        motion, force_N = np.zeros((self.BATCH, len(INPUTS)), np.float32), np.zeros((self.BATCH, 1), np.float32)
        self._binding = session.io_binding()
        self._binding.bind_input(INPUT_NAME, "cpu", 0, np.float32, motion.shape, motion.ctypes.data)
        self._binding.bind_output(OUTPUT_NAME, "cpu", 0, np.float32, force_N.shape, force_N.ctypes.data)
        self._motion: Any = motion.reshape(-1).data  # number by number: for two to eight rows that is cheaper than one array
        self._force_N: Any = force_N.reshape(-1).data

    def __call__(self, rows: Sequence[Sequence[float]]) -> list[float]:
        """Return the outputs (n,) for inputs (n, 2)."""
        predicted: list[float] = []
        for begin in range(0, len(rows), self.BATCH):
            some = rows[begin : begin + self.BATCH]
            for at, (speed_m_per_s, acceleration_m_per_s2) in enumerate(some):
                self._motion[2 * at], self._motion[2 * at + 1] = speed_m_per_s, acceleration_m_per_s2
            self._session.run_with_iobinding(self._binding)
            predicted += self._force_N[: len(some)].tolist()
        return predicted


def card_path(model: Path) -> Path:
    """Return the path of a model's card: `inertial.onnx` has `inertial.json`."""
    return model.parent / f"{model.stem}.json"  # not with_suffix, which raises for a path without a name, such as /


def read_card(model: Path) -> dict[str, Any]:
    """Read the card of a model. Raises ModelRefused where it is absent, no JSON, or lacks a required key."""
    path = card_path(model)
    try:
        card = read_json(path, most_bytes=LARGEST_BYTES, error=ModelRefused)
    except ModelRefused as error:
        if isinstance(error.__cause__, OSError):
            raise ModelRefused(
                f"{model.name} has no card {path.name} beside it that can be read; train the model with palpd train"
            ) from None
        raise ModelRefused(f"{error}, so nobody knows what {model.name} was trained on; train it again") from None
    _refuse_incomplete(model.name, card)
    return dict(card)


def _refuse_incomplete(name: str, card: Any) -> None:
    if not isinstance(card, dict) or card.get("schema") != SCHEMA:
        raise ModelRefused(f"the card of {name} is not of the schema {SCHEMA}; train the model again with palpd train")
    missing = [key for key in ("inputs", "input_range", "model_sha256", "probe") if key not in card]
    if missing:
        raise ModelRefused(f"the card of {name} lacks {', '.join(missing)}; train the model again with palpd train")
    for key in {"rmse_N", "bias_N"} & card.keys():
        if isinstance(card[key], bool) or not isinstance(card[key], int | float) or not math.isfinite(card[key]):
            raise ModelRefused(f"the card of {name} gives {key} as {card[key]!r}, expected a number; train the model again")


def _content(path: Path) -> bytes:
    with opened(path, most_bytes=LARGEST_BYTES, error=ModelRefused) as stream:
        return stream.read()


def _refuse_graph(name: str, content: bytes) -> None:
    """One input (n, 2), one output (n, 1), only the operators of a small network, and every weight inside the file."""
    import onnx  # imported here: 30 MB that processes which only read the card do not need

    try:
        model = onnx.load_model_from_string(content)
        onnx.checker.check_model(model)
    except Exception as error:  # the parser raises what its C++ and protobuf layers raise
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ModelRefused(f"{name} is not an ONNX model ({first[:120]}); train it again") from None
    graph = model.graph
    foreign = sorted({f"{node.domain or 'onnx'}.{node.op_type}" for node in graph.node if node.domain or node.op_type not in OPERATORS})
    if foreign or model.functions or len(graph.sparse_initializer):
        raise ModelRefused(
            f"{name} contains {', '.join(foreign) or 'functions or sparse weights'}, expected only {', '.join(sorted(OPERATORS))}"
        )
    if any(tensor.data_location == onnx.TensorProto.EXTERNAL for tensor in graph.initializer):
        raise ModelRefused(f"{name} keeps weights in another file, which its hash does not cover; store them inside")
    shapes = [_shape(value) for value in (*graph.input, *graph.output)]
    if len(graph.input) != 1 or len(graph.output) != 1 or shapes != [(INPUT_NAME, len(INPUTS)), (OUTPUT_NAME, 1)]:
        raise ModelRefused(
            f"{name} has the inputs and outputs {shapes}, expected {INPUT_NAME} (n, {len(INPUTS)}) and {OUTPUT_NAME} (n, 1) of float32"
        )


def _shape(value: Any) -> tuple[str, int]:
    """Name and number of columns of a tensor (rows, columns) of float32; 0 columns for anything else."""
    from onnx import TensorProto

    kind = value.type.tensor_type
    dims = kind.shape.dim
    return value.name, dims[1].dim_value if kind.elem_type == TensorProto.FLOAT and len(dims) == 2 else 0


def _ranges(name: str, card: dict[str, Any]) -> Floats:
    """Least and largest of each input, (2, 2). Inputs must be the ones that `MotionFeatures` gives, in its order and units."""
    expected = [{"name": each, "unit": unit} for each, unit in INPUTS]
    if card["inputs"] != expected:
        raise ModelRefused(
            f"the card of {name} lists the inputs {card['inputs']}, expected {expected} in this order; train it again with palpd train"
        )
    try:
        ranges = np.array([card["input_range"][each] for each, _ in INPUTS], dtype=float)
    except (KeyError, TypeError, ValueError):
        ranges = np.empty(0)
    if ranges.shape != (len(INPUTS), 2) or not np.isfinite(ranges).all() or (ranges[:, 0] >= ranges[:, 1]).any():
        raise ModelRefused(
            f"the card of {name} gives the input_range {card['input_range']}, expected [least, largest] of "
            f"{', '.join(each for each, _ in INPUTS)}; train it again"
        )
    return ranges


def _refuse_stranger(name: str, card: dict[str, Any], probe_mass_kg: float, sensor_serial: str | None) -> tuple[str, ...]:
    """Refuse a model of another probe or sensor; returns what could not be compared."""
    probe = card["probe"]
    trained_kg = probe.get("mass_kg") if isinstance(probe, dict) else None
    if not isinstance(trained_kg, int | float):
        raise ModelRefused(f"the card of {name} does not say probe.mass_kg; train it again with palpd train")
    if not abs(trained_kg - probe_mass_kg) <= MASS_TOLERANCE_KG:
        raise ModelRefused(
            f"{name} was trained with a probe of {trained_kg:g} kg, this cell's weighs {probe_mass_kg:g} kg (cell.probe.mass_kg); "
            "train one for this probe"
        )
    trained_serial = card.get("sensor_serial")
    if trained_serial and sensor_serial:
        if trained_serial != sensor_serial:
            raise ModelRefused(
                f"{name} was trained with the sensor {trained_serial}, the one connected is {sensor_serial}; train one for this sensor"
            )
        return ()
    whose = "the card" if not trained_serial else "the sensor connected"
    return (f"{whose} gives no serial number, so palpd has not checked that {name} was trained with this sensor",)


def _session(name: str, content: bytes) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # ten neurons: a second thread only costs wake-ups
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions have no common root of their own
        raise ModelRefused(f"{name} cannot be run ({str(error).strip().splitlines()[0][:120]}); train it again") from None
