"""Learning the inertial model, on free motion made here: a probe of known mass on a servo, a sensor with bias, noise and counts."""

import json
from pathlib import Path

import numpy as np
import pytest

from palpd.cell.dynamics import servo
from palpd.compensation.model_card import ModelCard
from palpd.compensation.refusals import refuse_other_probe
from palpd.compensation.train import METHODS, Method, train
from palpd.control.inertial import InertialModel, card_path
from palpd.errors import BadInput, RecordingError
from palpd.recording.reader import Recording
from palpd.recording.samples import Samples
from palpd.tick import ROW, Floats

MASS_KG = 0.2
COUNT_N = 0.131


def free_motion(
    seed: int = 0,
    cycles: int = 10,
    speed_m_per_s: float = 0.02,
    bias_N: float = 0.19,
    noise_N: float = 0.05,
    mass_kg: float = MASS_KG,
    viscous_N_s_per_m: float = 0.0,
    stroke_m: float = 0.02,
    rate_Hz: float = 1000.0,
) -> Samples:
    """Two centimetres up and down: a ramped target, a servo of 8 Hz behind it, robot states of 125 Hz interpolated to the sensor."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, 1.0 + cycles * 2.0 * (stroke_m / speed_m_per_s + 0.3) + 0.5, 1.0 / rate_Hz)
    half_s = stroke_m / speed_m_per_s + 0.3
    along_s = np.clip(t_s - 1.0, 0.0, cycles * 2.0 * half_s)
    half, within_s = np.divmod(along_s, half_s)
    way_m = np.clip(within_s * speed_m_per_s, 0.0, stroke_m)
    target_m = np.where(half % 2 == 0, way_m, stroke_m - way_m)
    z_m, vz_m_per_s, acceleration = servo(target_m, 1.0 / rate_Hz, 8.0, 1.0, {})
    fz_N = bias_N - mass_kg * acceleration - viscous_N_s_per_m * vz_m_per_s + rng.normal(0.0, noise_N, len(t_s))
    wrench = rng.normal(0.0, 0.001, (len(t_s), 6))
    wrench[:, 2] = np.round(fz_N / COUNT_N) * COUNT_N
    robot_s = np.arange(0.0, t_s[-1] + 0.008, 0.008)
    reported = [
        np.interp(t_s, robot_s, np.interp(robot_s, t_s, column) + rng.normal(0.0, noise, len(robot_s)))
        for column, noise in ((z_m, 5e-6), (vz_m_per_s, 2e-4))
    ]
    return Samples(t_s, target_m, reported[0], reported[1], wrench)


def changed(samples: Samples, fz_N: Floats) -> Samples:
    """The same motion with another force along z."""
    wrench = samples.wrench.copy()
    wrench[:, 2] = fz_N
    return Samples(samples.t_s, samples.z_cmd_m, samples.z_m, samples.vz_m_per_s, wrench)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[ModelCard, Path]:
    out = tmp_path_factory.mktemp("model") / "inertial.onnx"
    return train([free_motion(0), free_motion(1)], out, probe_mass_kg=MASS_KG, sensor_serial="HEX-1"), out


def test_bias_and_mass_are_found_and_told_apart(trained: tuple[ModelCard, Path]) -> None:
    card, _ = trained
    assert card.bias_N == pytest.approx(0.19, abs=0.005)
    assert card.mass_ci95_kg[0] < MASS_KG < card.mass_ci95_kg[1]
    assert card.mass_kg == pytest.approx(MASS_KG, abs=0.03)
    assert card.inertial_rms_N == pytest.approx(MASS_KG * 0.082, rel=0.15)
    assert card.rmse_N < 0.005
    assert card.n == 500
    assert card.repeats == 20
    assert any("is bias" in note for note in card.notes)


def test_the_exported_network_says_what_the_card_promises(trained: tuple[ModelCard, Path]) -> None:
    card, out = trained
    model = InertialModel.load(out, probe_mass_kg=MASS_KG, sensor_serial="HEX-1")
    still, braking = model.predict(np.array([[0.0, 0.0], [0.0, 0.3]]))
    assert still == pytest.approx(0.19, abs=0.01)
    assert braking == pytest.approx(0.19 - MASS_KG * 0.3, abs=0.02)
    assert out.stat().st_size < 1000
    stored = json.loads(card_path(out).read_text())
    for key in ("rmse_N", "bias_N", "inputs", "input_range", "data_sha256", "model_sha256", "versions", "date", "sensor_serial"):
        assert stored[key] == getattr(card, key)


def test_the_same_recordings_give_the_same_model(trained: tuple[ModelCard, Path], tmp_path: Path) -> None:
    card, _ = trained
    again = train([free_motion(0), free_motion(1)], tmp_path / "again.onnx", probe_mass_kg=MASS_KG, sensor_serial="HEX-1")
    assert (again.model_sha256, again.data_sha256) == (card.model_sha256, card.data_sha256)


def test_the_card_says_what_smoothing_with_the_future_hides(trained: tuple[ModelCard, Path]) -> None:
    card, _ = trained
    assert "future" in card.smoothing["training"]
    assert "causal" in card.smoothing["run_time"]
    assert 0.001 < card.run_time_rms_N < 0.03


def test_what_is_neither_bias_nor_inertia_is_said(tmp_path: Path) -> None:
    card = train([free_motion(viscous_N_s_per_m=3.0)], tmp_path / "m.onnx", probe_mass_kg=MASS_KG)
    assert card.other_rms_N == pytest.approx(3.0 * 0.017, rel=0.25)
    assert card.mass_ci95_kg[0] < MASS_KG < card.mass_ci95_kg[1]


def test_the_interval_of_the_mass_covers_it(tmp_path: Path) -> None:
    covered = 0
    for seed in range(8):
        card = train([free_motion(seed, cycles=3)], tmp_path / f"{seed}.onnx", probe_mass_kg=MASS_KG)
        covered += card.mass_ci95_kg[0] <= MASS_KG <= card.mass_ci95_kg[1]
    assert covered >= 6


def test_a_sensor_that_is_late_is_matched_with_the_motion_before(tmp_path: Path) -> None:
    samples = free_motion()
    late = changed(samples, np.interp(samples.t_s - 0.05, samples.t_s, samples.wrench[:, 2]))
    card = train([late], tmp_path / "late.onnx", probe_mass_kg=MASS_KG, sensor_delay_s=0.05)
    assert card.mass_kg == pytest.approx(MASS_KG, abs=0.03)


def test_contact_in_the_recording_is_refused_with_its_place(tmp_path: Path) -> None:
    samples = free_motion()
    touched = changed(samples, samples.wrench[:, 2] + np.where((samples.t_s > 14.0) & (samples.z_m < 0.003), 0.6, 0.0))
    with pytest.raises(RecordingError, match=r"recording 2 is not free: fz_N .* first at t = 1\d\.\d\d s \(z = 0\.00"):
        train([samples, touched], tmp_path / "m.onnx", probe_mass_kg=MASS_KG)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("noise_N", "counts"), [(0.15, 1), (0.22, 2)])
def test_a_clipped_force_is_refused_with_its_place(noise_N: float, counts: int, tmp_path: Path) -> None:
    samples = free_motion(noise_N=noise_N)
    clipped = changed(samples, np.minimum(samples.wrench[:, 2], counts * COUNT_N))
    with pytest.raises(RecordingError, match=rf"recording 1 clips: .* fz_N stand at its highest value of 0\.{131 * counts} N, first at "):
        train([clipped], tmp_path / "m.onnx", probe_mass_kg=MASS_KG)


def test_too_little_excitation_is_said_and_not_fitted(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="mass and bias cannot be told apart; move faster"):
        train([free_motion(cycles=2, speed_m_per_s=0.001, stroke_m=0.003)], tmp_path / "m.onnx", probe_mass_kg=MASS_KG)


def test_a_still_robot_is_no_free_motion(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="recording 1 moves by"):
        train([free_motion(stroke_m=0.001)], tmp_path / "m.onnx", probe_mass_kg=MASS_KG)


def test_different_motions_are_refused_with_the_place(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"recording 2 moves differently in the cycle that begins at t = "):
        train([free_motion(), free_motion(1, cycles=3, speed_m_per_s=0.016)], tmp_path / "m.onnx", probe_mass_kg=MASS_KG)


def test_a_model_replaces_one_of_palpd_and_nothing_else(trained: tuple[ModelCard, Path], tmp_path: Path) -> None:
    _, model = trained
    out, card = tmp_path / "some.onnx", tmp_path / "some.json"
    out.write_bytes(model.read_bytes())
    card.write_text("mine")
    with pytest.raises(BadInput, match=r"some\.json exists and is not overwritten"):
        train([free_motion()], out, probe_mass_kg=MASS_KG)
    assert (out.read_bytes(), card.read_text()) == (model.read_bytes(), "mine")
    card.unlink()
    train([free_motion()], out, probe_mass_kg=MASS_KG)
    assert card.exists()


def test_a_place_where_no_model_can_stand_is_refused_before_the_work(tmp_path: Path) -> None:
    for out, sentence in (
        ("m.txt", r"expected a name that ends in \.onnx"),
        ("none/m.onnx", "is no folder"),
        ("n" * 300 + ".onnx", "too long"),
    ):
        with pytest.raises(BadInput, match=sentence):
            train([], tmp_path / out, probe_mass_kg=MASS_KG)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_writes_a_model_that_the_daemon_accepts(method: Method, tmp_path: Path) -> None:
    card = train([free_motion(0, speed_m_per_s=0.03)], tmp_path / "m.onnx", probe_mass_kg=MASS_KG, method=method)
    model = InertialModel.load(tmp_path / "m.onnx", probe_mass_kg=MASS_KG)
    still, braking = model.predict(np.array([[0.0, 0.0], [0.0, 0.3]]))
    assert card.method == method
    assert still == pytest.approx(0.19, abs=0.015)
    assert still - braking == pytest.approx(0.0 if method == "bias" else 0.3 * MASS_KG, abs=0.02)


def test_a_line_reaches_further_than_what_it_was_trained_on_and_a_network_does_not(tmp_path: Path) -> None:
    hard = np.array([[0.0, 2.0]])
    for method, expected_N in (("linear", 2.0 * MASS_KG), ("network", 0.5 * MASS_KG)):
        card = train([free_motion(0), free_motion(1)], tmp_path / f"{method}.onnx", probe_mass_kg=MASS_KG, method=method)
        model = InertialModel.load(tmp_path / f"{method}.onnx", probe_mass_kg=MASS_KG)
        away_N = float(model.predict(np.zeros((1, 2)))[0] - model.predict(hard)[0])
        assert abs(away_N - expected_N) < 0.1, method
        assert (card.input_range != card.trained_range) == (method == "linear")


def test_an_unknown_method_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="there is no method 'magic' of training; choose one of linear, network"):
        train([free_motion(0)], tmp_path / "m.onnx", probe_mass_kg=MASS_KG, method="magic")  # type: ignore[arg-type]


def test_a_recording_of_another_probe_is_refused(tmp_path: Path) -> None:
    header = {"config": {"cell": {"probe": {"mass_kg": 0.25}}}}
    recording = Recording(tmp_path / "free.mcap", np.zeros(1, ROW), header, {}, None)
    with pytest.raises(BadInput, match=r"free\.mcap was recorded with a probe of 0\.25 kg, expected the 0\.2 kg"):
        refuse_other_probe(recording, MASS_KG)
    refuse_other_probe(recording, 0.252)


def test_a_force_without_a_live_axis_trains_nothing(tmp_path: Path) -> None:
    still = free_motion()
    still.wrench[:] = 0.0
    with pytest.raises(RecordingError, match="recording 1: fz_N is 0 throughout, and no other axis"):
        train([still], tmp_path / "m.onnx", probe_mass_kg=MASS_KG, accept_implausible=True)


@pytest.mark.parametrize("factor", [0.0, -1.0, 1e-3])
def test_a_mass_that_is_not_the_probes_is_questioned_and_can_be_accepted(tmp_path: Path, factor: float) -> None:
    motion = free_motion(bias_N=0.0)
    odd = changed(motion, factor * motion.wrench[:, 2])
    with pytest.raises(BadInput, match=r"a moving mass of .* kg, expected about the probe's 0\.2 kg; .*--accept-implausible"):
        train([odd], tmp_path / "m.onnx", probe_mass_kg=MASS_KG)
    assert not list(tmp_path.iterdir())
    train([odd], tmp_path / "m.onnx", probe_mass_kg=MASS_KG, accept_implausible=True)
    assert (tmp_path / "m.onnx").exists()


def test_the_same_recording_twice_trains_nothing(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="recordings 1 and 2 hold the same samples"):
        train([free_motion(), free_motion()], tmp_path / "m.onnx", probe_mass_kg=MASS_KG)
