"""Training of the inertial model on free motion, after Guo, Xiao, Ren 2019: repeats averaged, smoothed, differentiated, then fitted.

The method is a choice: a line b - m a, the paper's network 2-10-1, or the line with a small bounded network on top;
docs/compensation.md compares them. The card gives the correction in three parts: a bias (tare, drift, rounding), the inertia of a mass,
and the rest. An inertial force averages to nothing over a motion from rest to rest, so a mean that remains is no inertia.
"""

import hashlib
import math
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from onnx import TensorProto, helper, numpy_helper
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor

from palpd.analysis.intervals import correlated_sigmas, student_t_95
from palpd.cell.plausible import ask
from palpd.compensation.cycles import Cycle, find_cycles, mean_cycle, mean_cycle_at_run_time
from palpd.compensation.model_card import SMOOTHING, ModelCard, data_sha256, notes_of, refuse_place, software_versions, write_model
from palpd.compensation.refusals import refuse_clipping, refuse_contact, refuse_different
from palpd.control.inertial import INPUT_NAME, INPUTS, OUTPUT_NAME, SCHEMA, InertialModel
from palpd.errors import BadInput, RecordingError
from palpd.recording.oddities import refuse_dead, refuse_repeated
from palpd.recording.samples import Samples
from palpd.tick import Floats

Method = Literal["linear", "network", "prior-network", "bias"]
METHODS: tuple[Method, ...] = get_args(Method)
"""b - m a; the paper's 2-10-1; b - m a with a bounded network on the residual; a constant."""
DEFAULT_METHOD: Method = "linear"
"""The best of those that the loop can run, by docs/compensation.md."""
HIDDEN = 10
"""Hidden units of the paper's network."""
PRIOR_HIDDEN = 4
"""Hidden units of the network on top of the line: friction and cables need a few bends."""
PRIOR_LIMIT_N = 0.02
"""Largest output of the network on top of the line: cables and friction, not contact."""
EXTRAPOLATION_N = 0.02
LARGEST_SPEED_M_PER_S, LARGEST_ACCELERATION_M_PER_S2 = 0.25, 5.0
"""A law may be asked beyond its training while its own uncertainty stays below that force, within the limits of the arm."""
POINTS = 500
"""Training points on the mean cycle: a network of 41 weights needs no more, and trains in a second."""
MASS_CERTAINTY = 0.5
"""Largest half-width of the mass's 95 % interval, as a share of the probe's mass, at which mass and bias count as separable."""
ODD_MASS_RATIO = 2.0
"""Ratio of the moving mass to the probe's that is questioned: the probe was weighed, and a dead or turned fz shows none or less."""
OPSET, IR_VERSION = 17, 8
"""Versions of the ONNX format: what the oldest onnxruntime that palpd allows reads."""


@dataclass(frozen=True, slots=True)
class _Training:
    """Points on the mean cycle: features (n, 2) from past and future and as at run time, and force (n,).

    `raw_rms_N` is the scatter of single samples around the mean cycle.
    """

    smoothed: Floats
    at_run_time: Floats
    force_N: Floats
    raw_rms_N: float


def train(
    recordings: Sequence[Samples],
    out: Path,
    *,
    probe_mass_kg: float,
    sensor_serial: str | None = None,
    sensor_delay_s: float = 0.0,
    method: Method = DEFAULT_METHOD,
    accept_implausible: bool = False,
) -> ModelCard:
    """Train velocity and acceleration -> fz on tared free motion, and write the model and its card.

    Args:
        recordings: Recordings of one free motion, with this probe.
        out: File of the model; the card goes beside it.
        sensor_serial: Serial number of the sensor, if known.
        sensor_delay_s: Delay with which the sensor's filter shows a force.
        accept_implausible: Whether a moving mass counts that is not the probe's.

    Raises:
        RecordingError: A recording contains contact, clips, is dead, differs in motion from the others, or moves too little.
        BadInput: The method is unknown, no recording was given, a file cannot be written, or the mass is not the probe's and nobody
            accepts it.
    """
    _refuse_arguments(recordings, out, method)
    refuse_repeated(recordings)
    for number, samples in enumerate(recordings, start=1):
        refuse_dead(samples, f"recording {number}: ")
        refuse_clipping(number, samples)
        refuse_contact(number, samples, probe_mass_kg)
    step_s = 1.0 / recordings[0].rate_Hz
    cycles = find_cycles(recordings, step_s, sensor_delay_s)
    refuse_different(cycles, step_s)
    line, half = _line(cycles, step_s, sensor_delay_s, probe_mass_kg)
    check = "check that fz_N is alive and in newtons, its sign, and cell.probe.mass_kg"
    ask(_mass_doubts(float(line[0]), float(half[0]), probe_mass_kg), accept_implausible, check)
    training = _training(cycles, step_s, sensor_delay_s)
    features = training.smoothed if method == "network" else training.at_run_time  # the paper's network as the paper trained it
    content, predicted_N = _model(method, features, training.force_N, line, half)
    provenance = {
        "repeats": len(cycles),
        "recordings": len(recordings),
        "sensor_delay_s": sensor_delay_s,
        "probe": {"mass_kg": probe_mass_kg},
        "sensor_serial": sensor_serial,
        "data_sha256": data_sha256(recordings),
        "model_sha256": hashlib.sha256(content).hexdigest(),
    }
    card = _card(method, training, predicted_N, line, half, provenance)
    model = InertialModel.from_bytes(content, asdict(card), out.name)  # it must pass the checks of the daemon
    at_run_time_N, smoothed_N = (np.array(model.predict(some.tolist())) for some in (training.at_run_time, training.smoothed))
    card = replace(card, run_time_rms_N=_rms(at_run_time_N - smoothed_N))
    card = replace(card, notes=notes_of(asdict(card), recordings[0]))
    write_model(out, content, card)
    return card


def _mass_doubts(mass_kg: float, half_kg: float, probe_mass_kg: float) -> list[str]:
    """A sentence where the mass that moves (95 %: ± `half_kg`) is below half or above twice the probe's."""
    if mass_kg + half_kg >= probe_mass_kg / ODD_MASS_RATIO and mass_kg - half_kg <= ODD_MASS_RATIO * probe_mass_kg:
        return []
    return [f"the recordings show a moving mass of {mass_kg:.3f} ± {half_kg:.3f} kg, expected about the probe's {probe_mass_kg:g} kg"]


def _refuse_arguments(recordings: Sequence[Samples], out: Path, method: Method) -> None:
    if method not in METHODS:
        raise BadInput(f"there is no method {method!r} of training; choose one of {', '.join(METHODS)}")
    refuse_place(out)
    if not recordings:
        raise BadInput("no recording was given; train on at least one of palpd free-motion")


def _training(cycles: list[Cycle], step_s: float, sensor_delay_s: float) -> _Training:
    """Even points on the mean cycle."""
    smoothed, force_N = mean_cycle(cycles, step_s, sensor_delay_s)
    features = mean_cycle_at_run_time(cycles, step_s)
    raw_rms_N = _rms(np.concatenate([_margin_cut(cycle.fz_N, force_N) - force_N for cycle in cycles]))
    at = np.linspace(0.0, len(force_N) - 1.0, POINTS)
    points = np.column_stack([np.interp(at, np.arange(len(force_N)), column) for column in (*features.T, force_N, *smoothed.T)])
    return _Training(points[:, 3:], points[:, :2], points[:, 2], raw_rms_N)


def _card(method: Method, training: _Training, predicted_N: Floats, line: Floats, half: Floats, provenance: dict[str, Any]) -> ModelCard:
    """The card, but for what running the model decides; `line` and `half` (3,) are those of `_line`."""
    mass_kg, bias_N, drag_N_s_per_m = line.tolist()
    mass_half_kg, bias_half_N, _ = half.tolist()
    features = training.smoothed if method == "network" else training.at_run_time
    trained = np.stack([features.min(axis=0), features.max(axis=0)], axis=1)
    inertia_N = -mass_kg * training.smoothed[:, 1]
    return ModelCard(
        schema=SCHEMA,
        method=method,
        inputs=[{"name": name, "unit": unit} for name, unit in INPUTS],
        input_range=_named(_reach(trained, half) if method != "network" else trained),
        trained_range=_named(trained),
        output={"name": OUTPUT_NAME, "unit": "N"},
        rmse_N=_rms(predicted_N - training.force_N),
        bias_N=bias_N,
        inertial_rms_N=_rms(inertia_N),
        other_rms_N=_rms(predicted_N - bias_N - inertia_N),
        raw_rms_N=training.raw_rms_N,
        run_time_rms_N=0.0,
        mass_kg=mass_kg,
        mass_ci95_kg=[mass_kg - mass_half_kg, mass_kg + mass_half_kg],
        drag_N_s_per_m=drag_N_s_per_m,
        bias_ci95_N=[bias_N - bias_half_N, bias_N + bias_half_N],
        n=len(training.force_N),
        smoothing=SMOOTHING,
        versions=software_versions(),
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        notes=[],
        **provenance,
    )


def _margin_cut(whole: Floats, smoothed: Floats) -> Floats:
    """The part of a cycle that is left of it after smoothing."""
    margin = (len(whole) - len(smoothed)) // 2
    return whole[margin : margin + len(smoothed)]


def _line(cycles: list[Cycle], step_s: float, sensor_delay_s: float, probe_mass_kg: float) -> tuple[Floats, Floats]:
    """Mass, bias and drag (3,) of f = b - m a - c v in the mean cycle, and the half-widths (3,) of their 95 % intervals.

    The drag stands in for cables and friction, which would otherwise pass for noise that lasts as long as a stroke. The interval is
    the wider of two: the scatter of lines fitted to single cycles, and the uncertainty by the residual of the mean cycle. The residual
    also shows errors that all cycles share (rounding that noise does not dither).
    """

    def solved(some: list[Cycle]) -> tuple[Floats, Floats, Floats]:
        features, force_N = mean_cycle(some, step_s, sensor_delay_s)
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
    """A model as ONNX, and its answers (n,) at its training points in N. `fitted` and `half` (3,) are those of `_line`.

    The line is fitted to the features of run time, which lag behind the true ones: its weights predict best with these features and
    need not be the mass. It has a drag only where the drag is larger than its uncertainty.
    """
    if method == "network":
        network, predicted_N = _perceptron(features, force_N, HIDDEN)
        return _onnx(_layers(OUTPUT_NAME), network), predicted_N
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


def _reach(trained: Floats, half: Floats) -> Floats:
    """Least and largest of each input (2, 2) up to which the uncertainty of drag and mass is small (`half`: mass, bias, drag)."""
    limits = np.array([LARGEST_SPEED_M_PER_S, LARGEST_ACCELERATION_M_PER_S2])
    reach = np.minimum(EXTRAPOLATION_N / np.maximum(half[[2, 0]], 1e-12), limits)
    return np.stack([np.minimum(trained[:, 0], -reach), np.maximum(trained[:, 1], reach)], axis=1)


def _named(ranges: Floats) -> dict[str, list[float]]:
    return {name: [float(low), float(high)] for (name, _), (low, high) in zip(INPUTS, ranges, strict=True)}


def _rms(values: Floats) -> float:
    return math.sqrt(float(np.mean(np.square(values))))
