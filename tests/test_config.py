"""config.yaml and plan.yaml: what is wrong is said in one sentence."""

from pathlib import Path

import pytest
import yaml

from palpd.config import Config, Plan, load_config, load_plan, refuse_unsafe
from palpd.errors import ConfigError
from palpd.overshoot import overshoot_N, predicted, refuse_overload

ROOT = Path(__file__).parent.parent


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    return path


def test_the_shipped_files_load_and_agree_with_the_defaults() -> None:
    config = load_config(ROOT / "config.yaml")
    assert config.safety == Config().safety
    assert config.robot == Config().robot
    assert config.sensor == Config().sensor
    plan = load_plan(ROOT / "plan.yaml")
    refuse_unsafe(config, plan)
    refuse_overload(config, plan)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("safety: {contact_limit_mN: 12}", ["safety.contact_limit_mN", "contact_limit_N"]),
        ("safty: {}", ["safty", "safety"]),
        ("robot: {watchdog_Hz: abc}", ["robot.watchdog_Hz", "number"]),
        ("robot: {rtde_rate_Hz: 130}", ["130"]),
        ("robot: {model: ur5, rtde_rate_Hz: 500}", ["500", "ur5"]),
        ("robot: {watchdog_Hz: 80}", ["watchdog_Hz", "80"]),
        ("sensor: {rate_Hz: 300}", ["300", "1000/n"]),
        ("sensor: {filter_cutoff_Hz: 100}", ["100", "150"]),
        ("sensor: {counts_per_N: [41, 41, 7.6]}", ["counts_per_N", "both"]),
        ("sensor: {counts_per_N: [0, 41, 7.6], counts_per_Nm: [1, 1, 1]}", ["zero"]),
        ("safety: {contact_limit_N: 30}", ["absolute_limit_N", "25", "30"]),
        ("safety: {max_speed_m_per_s: 50}", ["max_speed_m_per_s", "50"]),
        ("safety: {workspace_m: [[0.2, -0.2], [0, 1], [0, 1]]}", ["workspace_m", "empty"]),
        ("model: {correction_limit_N: 1.0}", ["correction_limit_N", "hide"]),
        ("safety: {contact_limit_N: .nan}", ["contact_limit_N"]),
        ("- 1\n- 2", ["list"]),
        ("robot: [", ["YAML", "line"]),
    ],
)
def test_what_is_wrong_is_named_in_one_sentence(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as raised:
        load_config(written(tmp_path, text))
    sentence = str(raised.value)
    assert "\n" not in sentence
    for word in words:
        assert word in sentence


def test_a_missing_file_is_said() -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml cannot be read"):
        load_config(Path("nowhere.yaml"))


def test_the_environment_overrides_a_key_whatever_its_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPD_ROBOT__HOST", "10.1.2.3")
    monkeypatch.setenv("PALPD_SAFETY__CONTACT_LIMIT_N", "7.5")
    config = load_config(written(tmp_path, "robot: {host: elsewhere}"))
    assert config.robot.host == "10.1.2.3"
    assert config.safety.contact_limit_N == 7.5


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    config = load_config(written(tmp_path, "model: {path: models/a.onnx}"))
    assert config.paths.runs == tmp_path / "runs"
    assert config.model.path == tmp_path / "models/a.onnx"


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"depths_m": [4.0]}, "metres"),
        ({"depths_mm": [4]}, "depths_m"),
        ({"sites": [{"name": "A"}, {"name": "A"}]}, "differ"),
        ({"sites": [{"name": "../../etc"}]}, "name"),
        ({"mode": "fast"}, "mode"),
        ({"repeats": 0}, "repeats"),
        ({"depths_m": []}, "does nothing"),
    ],
)
def test_a_wrong_plan_is_refused(tmp_path: Path, values: dict[str, object], word: str) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match=word):
        load_plan(path)


def test_a_plan_faster_than_the_limit_is_refused() -> None:
    config = Config.model_validate({"safety": {"max_speed_m_per_s": 0.005}})
    with pytest.raises(ConfigError, match="press_speed"):
        refuse_unsafe(config, Plan())


def test_limits_that_overload_the_sensor_on_the_expected_stiffness_are_refused() -> None:
    hard = Config.model_validate({"safety": {"expected_stiffness_N_per_m": 5e5}})
    with pytest.raises(ConfigError, match="beyond the sensor"):
        refuse_overload(hard, Plan())
    refuse_overload(Config(), Plan())


def test_the_overshoot_grows_with_speed_and_stiffness_and_filter_delay() -> None:
    slow_filter = Config.model_validate({"sensor": {"filter_cutoff_Hz": 15}})
    base = overshoot_N(Config(), 0.01, 5000)
    assert overshoot_N(Config(), 0.01, 20000) > base
    assert overshoot_N(Config(), 0.02, 5000) > 2 * (base - 0.3)
    # 15 Hz instead of 150 Hz is 9.5 ms more at 50 N/s
    assert overshoot_N(slow_filter, 0.01, 5000) - base == pytest.approx(0.4775, abs=1e-3)
    assert {row["stiffness_N_per_m"] for row in predicted(Config(), Plan())["overshoot"]} >= {1000.0, 5000.0, 20000.0}
