"""Learning the inertial model from free motion, after Guo, Xiao, Ren 2019: repeats averaged, smoothed, differentiated, then fitted.

What is fitted is a choice: a line b - m a, the paper's network 2-10-1, or the line with a small bounded network on top; which is
best is measured in docs/compensation.md. What it takes away is said in three parts on its card: a bias (tare, drift, rounding),
the inertia of a mass, and the rest. An inertial force averages to nothing over a motion from rest to rest, so whatever mean is left
is no inertia.
"""

import hashlib
import json
import math
import platform
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import onnx
import onnxruntime
import sklearn
from onnx import TensorProto, helper, numpy_helper
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor

from palpd.errors import BadInput, RecordingError
from palpd.inertial import INPUT_NAME, INPUTS, MASS_TOLERANCE_KG, OUTPUT_NAME, SCHEMA, WINDOW_S, InertialModel, Motion, card_path
from palpd.record import Recording
from palpd.samples import Samples
from palpd.tick import Floats, RobotMode, RobotState, SafetyMode
from palpd.young import correlated_sigmas, student_t_95

Method = Literal["linear", "network", "prior-network", "bias"]
METHODS: tuple[Method, ...] = get_args(Method)
"""b - m a; the paper's 2-10-1; b - m a with a bounded network on what that leaves; a constant."""
DEFAULT_METHOD: Method = "linear"
"""The best of those that the loop can run, by docs/compensation.md."""
HIDDEN = 10
PRIOR_HIDDEN = 4
PRIOR_LIMIT_N = 0.02
"""The most that a network on top of the line may say: cables and friction, not contact."""
EXTRAPOLATION_N = 0.02
LARGEST_SPEED_M_PER_S, LARGEST_ACCELERATION_M_PER_S2 = 0.25, 5.0
"""A law may be asked beyond what it was trained on while its own uncertainty stays below that force, within what the arm can do."""
POINTS = 500
SMOOTHING_S = 0.025
"""Window of the centred moving average, applied twice: it leaves 1 mN of a 0.06 N noise averaged over ten cycles, and a start of the
arm lasts 40 ms or more."""
TOUCH_N = 0.3
TOUCH_WINDOW_S = 0.1
"""A mean over the window that is this far from the recording's median is contact: rounding moves it by 0.07 N, noise by 0.02 N."""
APART = 0.1
"""Share of the stroke by which repeats of one motion may differ."""
LEAST_STROKE_M = 0.002
MASS_CERTAINTY = 0.5
"""Largest half-width of the mass's 95 % interval, as a share of the probe's mass, at which mass and bias count as told apart."""
ROBOT_STEP_S = 0.008
"""Cycle of a CB3 controller, at which the model is tried with the features that it will have at run time."""
OPSET, IR_VERSION = 17, 8


@dataclass(frozen=True, slots=True)
class Card:
    """What is known of a trained model; stored beside it as JSON. Intervals are 95 %.

    `input_range` is where it may be asked, `trained_range` what it has seen: a network has no more, a law reaches further.
    `rmse_N` is the model's error over its `n` training points, `raw_rms_N` the scatter of single samples around the mean cycle,
    `run_time_rms_N` what the causal features of run time change in its output. Of its output `bias_N` is constant, `inertial_rms_N` the
    inertia -m a and `other_rms_N` neither; mass, bias and drag are a line b - m a - c v fitted to the same mean cycle.
    """

    schema: str
    method: str
    inputs: list[dict[str, str]]
    input_range: dict[str, list[float]]
    trained_range: dict[str, list[float]]
    output: dict[str, str]
    rmse_N: float
    bias_N: float
    inertial_rms_N: float
    other_rms_N: float
    raw_rms_N: float
    run_time_rms_N: float
    mass_kg: float
    mass_ci95_kg: list[float]
    drag_N_s_per_m: float
    bias_ci95_N: list[float]
    n: int
    repeats: int
    recordings: int
    smoothing: dict[str, Any]
    sensor_delay_s: float
    probe: dict[str, float]
    sensor_serial: str | None
    data_sha256: str
    model_sha256: str
    versions: dict[str, str]
    date: str
    notes: list[str]


@dataclass(frozen=True, slots=True)
class _Cycle:
    """One repeat of the motion: arrays (n,) over the time since it began; `at_run_time` (n, 2) as the loop would have had it."""

    recording: int
    start_s: float
    z_m: Floats
    vz_m_per_s: Floats
    fz_N: Floats
    at_run_time: Floats


def train(
    recordings: Sequence[Samples],
    out: Path,
    *,
    probe_mass_kg: float,
    sensor_serial: str | None = None,
    sensor_delay_s: float = 0.0,
    method: Method = DEFAULT_METHOD,
) -> Card:
    """Learn velocity and acceleration -> fz from tared free motion, and write the model and its card.

    `sensor_delay_s` is how late the sensor's filter shows a force. Raises RecordingError where a recording contains contact, clips,
    differs in motion from the others, or moves too little to tell mass from bias; BadInput where a file would be overwritten.
    """
    if method not in METHODS:
        raise BadInput(f"there is no method {method!r} of training; choose one of {', '.join(METHODS)}")
    for path in (out, card_path(out)):
        if path.exists():
            raise BadInput(f"{path.name} exists and is not overwritten; choose another name or move it away")
    if not recordings:
        raise BadInput("no recording was given; train on at least one of palpd free-motion")
    for number, samples in enumerate(recordings, start=1):
        _refuse_clipping(number, samples)
        _refuse_contact(number, samples, probe_mass_kg)
    step_s = 1.0 / recordings[0].rate_Hz
    cycles = _cycles(recordings, step_s, sensor_delay_s)
    _refuse_different(cycles, step_s)
    smoothed, force_N = _average(cycles, step_s, sensor_delay_s)
    features = _average_at_run_time(cycles, step_s)
    fitted, half = _line(cycles, step_s, sensor_delay_s, probe_mass_kg)
    mass_kg, bias_N, drag_N_s_per_m = fitted.tolist()
    mass_half_kg, bias_half_N, _ = half.tolist()
    raw_rms_N = _rms(np.concatenate([_margin_cut(cycle.fz_N, force_N) - force_N for cycle in cycles]))
    at = np.linspace(0.0, len(force_N) - 1.0, POINTS)
    points = np.column_stack([np.interp(at, np.arange(len(force_N)), column) for column in (*features.T, force_N, *smoothed.T)])
    at_run_time, force_N, smoothed = points[:, :2], points[:, 2], points[:, 3:]
    features = smoothed if method == "network" else at_run_time  # the paper's network as the paper trained it
    content, predicted_N = _model(method, features, force_N, fitted, half)
    seen = np.stack([features.min(axis=0), features.max(axis=0)], axis=1)
    allowed = _reach(seen, half) if method != "network" else seen
    inertia_N = -mass_kg * smoothed[:, 1]
    card = Card(
        schema=SCHEMA,
        method=method,
        inputs=[{"name": name, "unit": unit} for name, unit in INPUTS],
        input_range=_named(allowed),
        trained_range=_named(seen),
        output={"name": OUTPUT_NAME, "unit": "N"},
        rmse_N=_rms(predicted_N - force_N),
        bias_N=bias_N,
        inertial_rms_N=_rms(inertia_N),
        other_rms_N=_rms(predicted_N - bias_N - inertia_N),
        raw_rms_N=raw_rms_N,
        run_time_rms_N=0.0,
        mass_kg=mass_kg,
        mass_ci95_kg=[mass_kg - mass_half_kg, mass_kg + mass_half_kg],
        drag_N_s_per_m=drag_N_s_per_m,
        bias_ci95_N=[bias_N - bias_half_N, bias_N + bias_half_N],
        n=len(force_N),
        repeats=len(cycles),
        recordings=len(recordings),
        smoothing={
            "training": "repeats averaged; centred moving average, twice, on features and force alike; features as at run time, "
            "but for the paper's network, whose features are smoothed over past and future",
            "training_window_s": SMOOTHING_S,
            "run_time": "slope of a line through the last robot states, causal",
            "run_time_window_s": WINDOW_S,
            "run_time_acceleration_delay_s": WINDOW_S / 2.0,
        },
        sensor_delay_s=sensor_delay_s,
        probe={"mass_kg": probe_mass_kg},
        sensor_serial=sensor_serial,
        data_sha256=_data_sha256(recordings),
        model_sha256=hashlib.sha256(content).hexdigest(),
        versions={
            "python": platform.python_version(),
            **{module.__name__: module.__version__ for module in (np, sklearn, onnx, onnxruntime)},
        },
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        notes=[],
    )
    model = InertialModel.from_bytes(content, asdict(card), out.name)  # it must pass what the daemon asks of it
    causal_rms_N = _rms(np.array(model.predict(at_run_time.tolist())) - np.array(model.predict(smoothed.tolist())))
    values = asdict(card) | {"run_time_rms_N": causal_rms_N}
    card = Card(**values | {"notes": _notes(values, recordings[0])})
    _write(out, content, card)
    return card


def refuse_other_probe(recording: Recording, mass_kg: float) -> None:
    """Raise BadInput where the recording was made with a probe of another mass, as far as it says."""
    found_kg = recording.header.get("config", {}).get("cell", {}).get("probe", {}).get("mass_kg", mass_kg)
    if abs(found_kg - mass_kg) > MASS_TOLERANCE_KG:
        raise BadInput(
            f"{recording.path.name} was recorded with a probe of {found_kg:g} kg, expected the {mass_kg:g} kg of cell.probe.mass_kg; "
            "what one reads beside the contact, another does not: record it with this probe"
        )


def _cycles(recordings: Sequence[Samples], step_s: float, sensor_delay_s: float) -> list[_Cycle]:
    """Every repeat of the motion, cut where the tip rises through the middle of the first recording's stroke, less a quarter period."""
    middle_m = (float(recordings[0].z_m.min()) + float(recordings[0].z_m.max())) / 2.0
    quarter_m = float(np.ptp(recordings[0].z_m)) / 4.0
    if 4.0 * quarter_m < LEAST_STROKE_M:
        raise RecordingError(
            f"recording 1 moves by {4.0 * quarter_m:.2g} m only, expected {LEAST_STROKE_M:g} m or more up and down; "
            "record it with palpd free-motion"
        )
    rises = [_rises(samples, middle_m, quarter_m) for samples in recordings]
    for number, found in enumerate(rises, start=1):
        if not len(found):
            raise RecordingError(
                f"recording {number} never rises through {middle_m:.4g} m, the middle of recording 1's motion; "
                "train on repeats of one motion"
            )
    periods = np.concatenate([np.diff(found) for found in rises])
    period_s = float(np.median(periods)) if len(periods) else min(samples.duration_s for samples in recordings)
    cycles = []
    for number, (samples, found) in enumerate(zip(recordings, rises, strict=True), start=1):
        at_run_time = _at_run_time(samples, sensor_delay_s)
        for rise_s in found:
            start_s = rise_s - period_s / 4.0 if len(periods) else samples.t_s[0]
            grid_s = start_s + np.arange(round(period_s / step_s)) * step_s
            if grid_s[0] < samples.t_s[0] - step_s or grid_s[-1] > samples.t_s[-1] + step_s:
                continue
            columns = (samples.z_m, samples.vz_m_per_s, samples.wrench[:, 2])
            z_m, vz_m_per_s, fz_N, *motion = (np.interp(grid_s, samples.t_s, column) for column in (*columns, *at_run_time.T))
            cycles.append(_Cycle(number, float(start_s), z_m, vz_m_per_s, fz_N, np.column_stack(motion)))
    if not cycles:
        raise RecordingError("no recording holds a whole cycle up and down; record it with palpd free-motion")
    return cycles


def _rises(samples: Samples, middle_m: float, quarter_m: float) -> Floats:
    """Times at which the tip rises through the middle, each after it was a quarter of the stroke below."""
    found = []
    low = False
    above = samples.z_m > middle_m
    below = samples.z_m < middle_m - quarter_m
    for i in np.flatnonzero(below | (above & ~np.roll(above, 1))):
        if below[i]:
            low = True
        elif low:
            found.append(float(samples.t_s[i]))
            low = False
    return np.array(found)


def _average(cycles: list[_Cycle], step_s: float, sensor_delay_s: float) -> tuple[Floats, Floats]:
    """Features (n, 2) and force (n,) of the mean cycle, all three smoothed alike so that a linear law between them stays true."""
    speed = np.mean([cycle.vz_m_per_s for cycle in cycles], axis=0)
    force_N = np.mean([cycle.fz_N for cycle in cycles], axis=0)
    width = max(1, 2 * round(SMOOTHING_S / step_s / 2.0) + 1)
    speed = _smooth(_smooth(speed, width), width)
    force_N = _smooth(_smooth(force_N, width), width)
    acceleration = np.gradient(speed, step_s)
    at = np.arange(len(speed)) * step_s
    delayed = [np.interp(at - sensor_delay_s, at, column) for column in (speed, acceleration)]
    return np.column_stack(delayed), force_N


def _average_at_run_time(cycles: list[_Cycle], step_s: float) -> Floats:
    """What the loop would have had (n, 2) in the mean cycle, smoothed like the force; it keeps the lag of run time."""
    motion = np.mean([cycle.at_run_time for cycle in cycles], axis=0)
    width = max(1, 2 * round(SMOOTHING_S / step_s / 2.0) + 1)
    return np.column_stack([_smooth(_smooth(column, width), width) for column in motion.T])


def _margin_cut(whole: Floats, smoothed: Floats) -> Floats:
    """The part of a cycle that is left of it after smoothing."""
    margin = (len(whole) - len(smoothed)) // 2
    return whole[margin : margin + len(smoothed)]


def _smooth(values: Floats, width: int) -> Floats:
    """Centred moving average over an odd number of samples; only where the window is full."""
    return np.convolve(values, np.full(width, 1.0 / width), mode="valid")


def _line(cycles: list[_Cycle], step_s: float, sensor_delay_s: float, probe_mass_kg: float) -> tuple[Floats, Floats]:
    """Mass, bias and drag (3,) of f = b - m a - c v in the mean cycle, and the half-widths (3,) of their 95 % intervals.

    The drag stands in for cables and friction, which would otherwise pass for noise that lasts as long as a stroke. The interval is
    the wider of two: what lines fitted to single cycles scatter by, and what the residual of the mean cycle allows, which shows what all
    cycles have in common (rounding that noise does not dither).
    """

    def solved(some: list[_Cycle]) -> tuple[Floats, Floats, Floats]:
        features, force_N = _average(some, step_s, sensor_delay_s)
        slopes = np.column_stack([-features[:, 1], np.ones(len(force_N)), -features[:, 0]])
        solution = np.asarray(np.linalg.lstsq(slopes, force_N, rcond=None)[0], dtype=float)
        return solution, slopes, force_N - slopes @ solution

    solution, slopes, residual_N = solved(cycles)
    sigmas, n_effective = correlated_sigmas(slopes, residual_N, slow=False)
    half = student_t_95(max(n_effective - 3.0, 3.0)) * sigmas
    if len(cycles) > 1:
        scatter = np.std([solved([cycle])[0] for cycle in cycles], axis=0, ddof=1) / math.sqrt(len(cycles))
        half = np.maximum(half, student_t_95(len(cycles) - 1.0) * scatter)
    allowed_kg = MASS_CERTAINTY * probe_mass_kg
    if half[0] > allowed_kg:
        raise RecordingError(
            f"the mean of {len(cycles)} cycles accelerates by {_rms(slopes[:, 0]):.2g} m/s² rms only, which leaves the moving mass at "
            f"{solution[0]:.2f} ± {half[0]:.2f} kg, expected within {allowed_kg:.2f} kg: mass and bias cannot be told apart; move faster "
            "or record more cycles"
        )
    return solution, half


def _model(method: Method, features: Floats, force_N: Floats, fitted: Floats, half: Floats) -> tuple[bytes, Floats]:
    """A model as ONNX, and what it says of its own training points in N. `fitted` and `half` (3,) are of `_line`.

    The line is fitted to the features of run time, which lag behind the true ones: its weights are what predicts best with these, and
    need not be the mass. It takes the drag along only where it is larger than its uncertainty.
    """
    if method == "network":
        return _network(features, force_N)
    dragged = abs(fitted[2]) > half[2]
    slopes = np.column_stack([features[:, 0] if dragged else np.zeros(len(features)), features[:, 1], np.ones(len(features))])
    *speeds, bias_N = np.linalg.lstsq(slopes, force_N, rcond=None)[0].tolist()
    weights = np.array(speeds)
    if method == "bias":
        weights, bias_N = np.zeros(2), float(force_N.mean())
    line_N: Floats = features @ weights + bias_N
    line = {"line_weights": weights[:, None], "line_offset": np.array([bias_N])}
    if method != "prior-network":
        return _onnx([helper.make_node("Gemm", [INPUT_NAME, *line], [OUTPUT_NAME])], line), line_N
    rest = np.clip((force_N - line_N) / PRIOR_LIMIT_N, -0.9, 0.9)
    hidden, predicted = _perceptron(features, np.arctanh(rest), PRIOR_HIDDEN)
    limited = {**line, **hidden, "limit": np.array([PRIOR_LIMIT_N])}
    nodes = [
        helper.make_node("Gemm", [INPUT_NAME, *line], ["line"]),
        *_layers("rest"),
        helper.make_node("Tanh", ["rest"], ["bounded"]),
        helper.make_node("Mul", ["bounded", "limit"], ["small"]),
        helper.make_node("Add", ["line", "small"], [OUTPUT_NAME]),
    ]
    return _onnx(nodes, limited), line_N + PRIOR_LIMIT_N * np.tanh(predicted)


def _network(features: Floats, force_N: Floats) -> tuple[bytes, Floats]:
    """The paper's network 2-10-1 as ONNX, and what it says of its own training points in N."""
    weights, predicted_N = _perceptron(features, force_N, HIDDEN)
    return _onnx(_layers(OUTPUT_NAME), weights), predicted_N


def _perceptron(features: Floats, target: Floats, hidden: int) -> tuple[dict[str, Floats], Floats]:
    """Weights of a trained perceptron with one hidden layer, scalers folded in, and its answers at the training points."""
    centre, scale = features.mean(axis=0), features.std(axis=0)
    level, span = float(target.mean()), float(target.std()) or 1.0
    fit = MLPRegressor(hidden_layer_sizes=(hidden,), activation="tanh", solver="lbfgs", alpha=1e-3, max_iter=1000, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a thousand steps fit what is there; more fit the noise
        fit.fit((features - centre) / scale, (target - level) / span)
    (first, second), (first_offset, second_offset) = fit.coefs_, fit.intercepts_
    weights = {
        "hidden_weights": first / scale[:, None],
        "hidden_offset": first_offset - (centre / scale) @ first,
        "output_weights": second * span,
        "output_offset": second_offset * span + level,
    }
    return weights, fit.predict((features - centre) / scale) * span + level


def _layers(output: str) -> list[Any]:
    """The nodes of a perceptron."""
    return [
        helper.make_node("Gemm", [INPUT_NAME, "hidden_weights", "hidden_offset"], ["hidden"]),
        helper.make_node("Tanh", ["hidden"], ["active"]),
        helper.make_node("Gemm", ["active", "output_weights", "output_offset"], [output]),
    ]


def _onnx(nodes: list[Any], weights: dict[str, Floats]) -> bytes:
    graph = helper.make_graph(
        nodes,
        "inertial_force",
        [helper.make_tensor_value_info(INPUT_NAME, TensorProto.FLOAT, ["rows", len(INPUTS)])],
        [helper.make_tensor_value_info(OUTPUT_NAME, TensorProto.FLOAT, ["rows", 1])],
        [numpy_helper.from_array(values.astype(np.float32), name) for name, values in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="palpd")
    return model.SerializeToString(deterministic=True)


def _reach(seen: Floats, half: Floats) -> Floats:
    """Least and largest of each input (2, 2) up to which the uncertainty of drag and mass (`half` of mass, bias, drag) is small."""
    limits = np.array([LARGEST_SPEED_M_PER_S, LARGEST_ACCELERATION_M_PER_S2])
    reach = np.minimum(EXTRAPOLATION_N / np.maximum(half[[2, 0]], 1e-12), limits)
    return np.stack([np.minimum(seen[:, 0], -reach), np.maximum(seen[:, 1], reach)], axis=1)


def _named(ranges: Floats) -> dict[str, list[float]]:
    return {name: [float(low), float(high)] for (name, _), (low, high) in zip(INPUTS, ranges, strict=True)}


def run_time_features(robot_t_s: Floats, speed: Floats, t_s: Floats, sensor_delay_s: float) -> Floats:
    """Speed and acceleration (n, 2) as the loop has them when it explains each sample: from the states up to the tick it came in."""
    motion, found = Motion(sensor_delay_s), np.empty((len(t_s), 2))
    zeros = (0.0,) * 6
    ends = np.searchsorted(t_s, robot_t_s, side="right")
    begin = 0
    for end, when_s, vz in zip(ends.tolist(), robot_t_s.tolist(), speed.tolist(), strict=True):
        moving = (0.0, 0.0, vz, 0.0, 0.0, 0.0)
        motion.update(RobotState(when_s, when_s, zeros, moving, zeros, moving, zeros[:3], RobotMode.RUNNING, SafetyMode.NORMAL, 1, 2, True))
        found[begin:end] = np.reshape(motion.features(t_s[begin:end].tolist()), (-1, 2))
        begin = end
    found[begin:] = np.reshape(motion.features(t_s[begin:].tolist()), (-1, 2))
    return found


def _at_run_time(samples: Samples, sensor_delay_s: float) -> Floats:
    """The features (n, 2) that the loop would have had at each sample of a recording, from robot states at a controller's cycle."""
    robot_s = np.arange(samples.t_s[0], samples.t_s[-1], ROBOT_STEP_S)
    return run_time_features(robot_s, np.interp(robot_s, samples.t_s, samples.vz_m_per_s), samples.t_s, sensor_delay_s)


def _refuse_clipping(number: int, samples: Samples) -> None:
    """A clipped signal piles up on its last level; noise that is rounded thins out towards it, to a tenth of the level before.

    With three levels or fewer the two look alike (a bias near half a count fills the last level too), so nothing is said of those.
    """
    for axis, force_N in zip("xyz", samples.wrench[:, :3].T, strict=True):
        for side, values in (("highest", -force_N), ("lowest", force_N)):
            levels, counts = np.unique(np.round(values, 9), return_counts=True)
            if len(levels) >= 4 and counts[0] > 0.05 * len(values) and counts[0] > 0.5 * counts[1]:
                first = int(np.argmin(values))
                raise RecordingError(
                    f"recording {number} clips: {counts[0]} of {len(values)} samples of f{axis}_N stand at its {side} value of "
                    f"{force_N[first]:.4g} N, first at t = {samples.t_s[first]:.3f} s; tare the sensor or check its range, and record again"
                )


def _refuse_contact(number: int, samples: Samples, probe_mass_kg: float) -> None:
    """Free air has bias, noise and a little inertia; anything larger that lasts is a touch."""
    width = max(1, round(TOUCH_WINDOW_S * samples.rate_Hz))
    if len(samples) <= 2 * width:
        raise RecordingError(
            f"recording {number} lasts {samples.duration_s:.2g} s, too short for free motion up and down; record for longer"
        )
    speed = _smooth(samples.vz_m_per_s, width)
    inertia_N = probe_mass_kg * float(np.abs(np.gradient(speed)).max()) * samples.rate_Hz
    for axis, force_N in zip("xyz", samples.wrench[:, :3].T, strict=True):
        away_N = np.abs(_smooth(force_N, width) - float(np.median(force_N)))
        allowed_N = TOUCH_N + (inertia_N if axis == "z" else 0.0)
        if float(away_N.max()) > allowed_N:
            at = int(np.argmax(away_N > allowed_N)) + width // 2
            raise RecordingError(
                f"recording {number} is not free: f{axis}_N is {float(away_N.max()):.2f} N away from its median, expected below "
                f"{allowed_N:.2f} N, first at t = {samples.t_s[at]:.2f} s (z = {samples.z_m[at]:.4f} m): the probe touched something "
                "or the sensor drifted; record it in free air with a warm sensor"
            )


def _refuse_different(cycles: list[_Cycle], step_s: float) -> None:
    """Repeats are averaged, so they must be repeats."""
    height_m = np.array([cycle.z_m for cycle in cycles])
    usual_m = np.median(height_m, axis=0)
    allowed_m = APART * float(np.ptp(usual_m))
    apart_m = np.abs(height_m - usual_m)
    worst, at = np.unravel_index(int(np.argmax(apart_m)), apart_m.shape)
    if apart_m[worst, at] > allowed_m:
        cycle = cycles[int(worst)]
        raise RecordingError(
            f"recording {cycle.recording} moves differently in the cycle that begins at t = {cycle.start_s:.2f} s: "
            f"at t = {cycle.start_s + float(at) * step_s:.2f} s it is {apart_m[worst, at] * 1e3:.1f} mm away from the usual cycle, "
            f"expected below {allowed_m * 1e3:.1f} mm; train on repeats of one motion"
        )


def _notes(card: dict[str, Any], samples: Samples) -> list[str]:
    """What a reader of the card should know before trusting the correction."""
    bias_N, inertial_N = abs(card["bias_N"]), card["inertial_rms_N"]
    share = bias_N / (bias_N + inertial_N) if bias_N + inertial_N > 0 else 0.0
    notes = [f"{100.0 * share:.0f} % of the correction is bias ({card['bias_N']:+.3f} N), the rest inertia ({inertial_N:.4f} N rms)"]
    if share > 0.5:
        notes.append("a bias belongs to one tare and does not carry over to the next: tare again rather than subtract it")
    levels = np.unique(np.round(samples.wrench[:, 2], 9))
    count_N = float(np.median(np.diff(levels))) if 2 <= len(levels) <= 200 else 0.0
    if 0.0 < card["raw_rms_N"] < 0.45 * count_N:
        notes.append(
            f"samples scatter by {card['raw_rms_N']:.3f} N rms, less than noise that dithers a count of {count_N:.3f} N would: "
            "averages keep a rounding error of up to half a count"
        )
    if not card["mass_ci95_kg"][0] <= card["probe"]["mass_kg"] <= card["mass_ci95_kg"][1]:
        notes.append(f"the moving mass of {card['mass_kg']:.3f} kg found is not the probe's {card['probe']['mass_kg']:g} kg")
    return notes


def _data_sha256(recordings: Sequence[Samples]) -> str:
    """Of time, height, speed and wrench of all recordings in their order, as little-endian float64."""
    digest = hashlib.sha256()
    for samples in recordings:
        for column in (samples.t_s, samples.z_m, samples.vz_m_per_s, samples.wrench):
            digest.update(np.ascontiguousarray(column, dtype="<f8").tobytes())
    return digest.hexdigest()


def _rms(values: Floats) -> float:
    return math.sqrt(float(np.mean(np.square(values))))


def _write(out: Path, content: bytes, card: Card) -> None:
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("xb") as file:
            file.write(content)
        with card_path(out).open("x", encoding="utf-8") as text:
            json.dump(asdict(card), text, indent=2)
            text.write("\n")
    except OSError as error:
        raise BadInput(f"{out} cannot be written ({error.strerror}); choose another place") from None
