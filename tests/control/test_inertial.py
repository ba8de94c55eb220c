"""Causal features, and everything for which a model is refused."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from palpd.control.inertial import INPUT_NAME, INPUTS, OUTPUT_NAME, SCHEMA, WINDOW_S, InertialModel, MotionFeatures, card_path
from palpd.control.loop import Explainer
from palpd.errors import ModelRefused
from palpd.tick import RobotMode, RobotState, SafetyMode, SensorFrames

MASS_KG = 0.2
BIAS_N = 0.19
EMPTY = (np.zeros(1, np.uint16), np.zeros(1, np.uint16))


def state(t_s: float, vz_m_per_s: float) -> RobotState:
    zeros = (0.0,) * 6
    speed = (0.0, 0.0, vz_m_per_s, 0.0, 0.0, 0.0)
    return RobotState(t_s, t_s, zeros, speed, zeros, speed, zeros[:3], RobotMode.RUNNING, SafetyMode.NORMAL, 1, 2, True)


def linear(node: str = "Gemm", offset: float = BIAS_N, rows: tuple[Any, ...] = ("rows", 2)) -> onnx.ModelProto:
    """The plainest model there is: bias - mass · acceleration."""
    weights = {"w": np.array([[0.0], [-MASS_KG]], np.float32), "b": np.array([offset], np.float32)}
    graph = helper.make_graph(
        [helper.make_node(node, [INPUT_NAME, "w", "b"] if node == "Gemm" else [INPUT_NAME], [OUTPUT_NAME])],
        "inertia",
        [helper.make_tensor_value_info(INPUT_NAME, TensorProto.FLOAT, list(rows))],
        [helper.make_tensor_value_info(OUTPUT_NAME, TensorProto.FLOAT, ["rows", 1])],
        [numpy_helper.from_array(values, name) for name, values in weights.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def card_of(content: bytes) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "inputs": [{"name": name, "unit": unit} for name, unit in INPUTS],
        "input_range": {"vz_m_per_s": [-0.03, 0.03], "az_m_per_s2": [-0.5, 0.5]},
        "model_sha256": hashlib.sha256(content).hexdigest(),
        "probe": {"mass_kg": MASS_KG},
        "sensor_serial": "HEX-1",
    }


def written(folder: Path, model: onnx.ModelProto | None = None, change: Callable[[dict[str, Any]], Any] = lambda card: None) -> Path:
    path = folder / "inertial.onnx"
    content = (model or linear()).SerializeToString()
    path.write_bytes(content)
    card = card_of(content)
    change(card)
    card_path(path).write_text(json.dumps(card))
    return path


def load(path: Path, probe_mass_kg: float = MASS_KG, sensor_serial: str | None = "HEX-1") -> InertialModel:
    return InertialModel.load(path, probe_mass_kg=probe_mass_kg, sensor_serial=sensor_serial)


@pytest.mark.parametrize("rate_Hz", [125, 500])
def test_speed_does_not_lag_and_acceleration_lags_by_half_a_window(rate_Hz: int) -> None:
    motion, jerk = MotionFeatures(), 2.0
    for k in range(rate_Hz):
        t_s = k / rate_Hz
        motion.update(state(t_s, 0.5 * jerk * t_s**2))
    features = motion.features([t_s])[0]
    assert features[0] == pytest.approx(0.5 * jerk * t_s**2, abs=jerk * WINDOW_S**2)
    assert features[1] == pytest.approx(jerk * (t_s - WINDOW_S / 2), rel=1e-6)


@pytest.mark.parametrize(("rate_Hz", "most"), [(125, 0.013), (500, 0.009)])
def test_the_noise_of_the_acceleration_is_milli_newtons_of_a_probe(rate_Hz: int, most: float) -> None:
    rng = np.random.default_rng(0)
    motion, accelerations = MotionFeatures(), []
    for k in range(2000):
        motion.update(state(k / rate_Hz, rng.normal(0.0, 2e-4)))
        accelerations.append(motion.features([k / rate_Hz])[0][1])
    assert np.std(accelerations[20:]) < most
    assert np.std(accelerations[20:]) * MASS_KG < 0.003


def test_features_depend_on_nothing_that_has_not_come() -> None:
    speeds = np.random.default_rng(1).normal(0.0, 0.01, 40)
    whole, part = MotionFeatures(), MotionFeatures()
    for k in range(20):
        whole.update(state(k * 0.008, speeds[k]))
        part.update(state(k * 0.008, speeds[k]))
    before = whole.features([0.155])
    whole.update(state(20 * 0.008, speeds[20]))
    assert np.array_equal(before, part.features([0.155]))


def test_a_repeated_state_changes_nothing_and_no_state_means_rest() -> None:
    motion = MotionFeatures()
    assert np.array_equal(motion.features([1.0, 2.0]), np.zeros((2, 2)))
    for k in range(10):
        motion.update(state(k * 0.008, 0.01 * k))
    before = motion.features([0.08])
    motion.update(state(9 * 0.008, 5.0))
    motion.update(state(8 * 0.008, 5.0))
    assert np.array_equal(before, motion.features([0.08]))


def test_a_robot_that_falls_silent_is_not_extrapolated_for_ever() -> None:
    motion = MotionFeatures()
    for k in range(10):
        motion.update(state(k * 0.008, 0.01 * k))
    (soon, _), (late, _) = motion.features([0.2, 20.0])
    assert soon == late < 0.15


def test_a_late_sensor_is_given_the_speed_of_then() -> None:
    now, then = MotionFeatures(), MotionFeatures(sensor_delay_s=0.01)
    for k in range(10):
        for motion in (now, then):
            motion.update(state(k * 0.008, 0.01 * k))
    assert then.features([0.07])[0][0] == pytest.approx(now.features([0.06])[0][0])


def test_a_model_says_bias_and_inertia(tmp_path: Path) -> None:
    model = load(written(tmp_path))
    assert model.predict(np.array([[0.01, 0.0], [0.0, 0.4]])) == pytest.approx([0.19, 0.11], abs=1e-6)
    assert model.warnings == ()


def test_beyond_its_range_the_nearest_edge_answers_and_it_is_said(tmp_path: Path) -> None:
    model = load(written(tmp_path))
    features = np.array([[0.0, 0.5], [0.0, 50.0], [1.0, 0.0]])
    assert model.out_of_range(features) == 2
    assert model.predict(features)[1] == model.predict(features)[0]


def test_no_number_means_no_correction_and_is_counted(tmp_path: Path) -> None:
    model = load(written(tmp_path))
    assert model.predict(np.array([[0.0, np.nan], [0.0, 0.0]])) == pytest.approx([0.0, BIAS_N])
    assert model.not_finite == 1
    broken = load(written(tmp_path, linear(offset=float("nan"))))
    assert broken.predict(np.zeros((3, 2))) == [0.0, 0.0, 0.0]
    assert broken.not_finite == 3


def test_a_recorded_model_predicts_as_the_file_did(tmp_path: Path) -> None:
    path = written(tmp_path)
    again = InertialModel.from_bytes(path.read_bytes(), json.loads(card_path(path).read_text()))
    features = np.random.default_rng(0).normal(0.0, 0.01, (100, 2))
    assert np.array_equal(again.predict(features), load(path).predict(features))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda card: card.update(model_sha256="0" * 64), "one of them was changed after training"),
        (lambda card: card["inputs"].reverse(), "in this order"),
        (lambda card: card["inputs"][0].update(unit="mm/s"), "in this order"),
        (lambda card: card["inputs"].pop(), "in this order"),
        (lambda card: card.update(schema="something/1"), "not of the schema"),
        (lambda card: card.pop("input_range"), "lacks input_range"),
        (lambda card: card.update(input_range={"vz_m_per_s": [0, 1]}), "gives the input_range"),
        (lambda card: card["input_range"].update(az_m_per_s2=[1, -1]), "gives the input_range"),
        (lambda card: card["probe"].update(mass_kg=0.25), "trained with a probe of 0.25 kg, this cell's weighs 0.2 kg"),
        (lambda card: card.update(probe="the small one"), "does not say probe.mass_kg"),
        (lambda card: card.update(sensor_serial="HEX-2"), "trained with the sensor HEX-2, the one connected is HEX-1"),
    ],
)
def test_a_card_that_does_not_fit_is_refused(tmp_path: Path, change: Callable[[dict[str, Any]], Any], sentence: str) -> None:
    with pytest.raises(ModelRefused, match=sentence.replace(".", r"\.")):
        load(written(tmp_path, change=change))


def test_a_model_without_a_readable_card_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path)
    card_path(path).write_text("{")
    with pytest.raises(ModelRefused, match="is not JSON"):
        load(path)
    card_path(path).unlink()
    with pytest.raises(ModelRefused, match=r"has no card inertial\.json"):
        load(path)
    with pytest.raises(ModelRefused, match="has no card"):
        load(Path("/"))


@pytest.mark.parametrize(
    ("model", "sentence"),
    [
        (linear("RandomNormalLike"), "contains onnx.RandomNormalLike"),
        (linear(rows=("rows", 3)), "expected motion"),
        (linear(rows=("rows", 2, 1)), "expected motion"),
    ],
    ids=["random numbers", "three inputs", "three dimensions"],
)
def test_a_graph_that_is_no_small_network_is_refused(tmp_path: Path, model: onnx.ModelProto, sentence: str) -> None:
    with pytest.raises(ModelRefused, match=sentence.replace(".", r"\.")):
        load(written(tmp_path, model))


def test_a_big_file_a_foreign_file_and_weights_elsewhere_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path)
    path.write_bytes(b"x" * 1_000_001)
    with pytest.raises(ModelRefused, match="expected at most 1000000"):
        load(path)
    path.write_bytes(b"no network")
    card_path(path).write_text(json.dumps(card_of(b"no network")))
    with pytest.raises(ModelRefused, match="is not an ONNX model"):
        load(path)
    outside = linear()
    onnx.external_data_helper.set_external_data(outside.graph.initializer[0], "weights.bin")
    outside.graph.initializer[0].ClearField("raw_data")
    with pytest.raises(ModelRefused, match=r"in another file|not an ONNX model"):
        load(written(tmp_path, outside))
    path.unlink()
    with pytest.raises(ModelRefused, match="cannot be read"):
        load(path)


def test_what_cannot_be_compared_is_said(tmp_path: Path) -> None:
    assert "the sensor connected gives no serial number" in load(written(tmp_path), sensor_serial=None).warnings[0]
    unknown = written(tmp_path, change=lambda card: card.update(sensor_serial=None))
    assert "the card gives no serial number" in load(unknown).warnings[0]


def test_what_the_model_could_not_do_is_told_to_the_reader(tmp_path: Path) -> None:
    def notes(model: InertialModel | None, speed_m_per_s: float) -> str:
        explainer = Explainer(np.zeros(6), model=model, correction_limit_N=0.5)
        for k in range(4):
            explainer.contact(state(0.01 * k, speed_m_per_s), SensorFrames(np.array([0.01 * k]), *EMPTY, np.zeros((1, 6))))
        return "; ".join(explainer.notes())

    assert notes(None, 1.0) == notes(load(written(tmp_path)), 0.01) == ""
    assert "100.0% of the samples" in notes(load(written(tmp_path)), 1.0)
    assert "no number for 4 samples" in notes(load(written(tmp_path, linear(offset=float("nan")))), 0.01)
    assert "not checked" in notes(load(written(tmp_path), sensor_serial=None), 0.01)
