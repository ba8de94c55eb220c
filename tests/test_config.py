"""config.yaml and plan.yaml: what is wrong is said in one sentence."""

import json
import pickle
from pathlib import Path
from typing import get_args

import pytest
import yaml
from pydantic import BaseModel, TypeAdapter, ValidationError

from palpd.cell.cell_file import CellFile, CellSite
from palpd.config import Config, Plan, PlanSite, close_sites, load_config, load_plan, parse_config, parse_plan, plan_limits, refuse_unsafe
from palpd.daemon.overshoot import overshoot_N, predicted, refuse_overload
from palpd.errors import ConfigError
from tests.paths import ROOT


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
        ("check: {puck_m: [30.0, 0.0]}", ["check.puck_m.0 is 30.0", "less than or equal to 0.5"]),
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
        ("safety: {workspace_m: [[-300, 300], [-300, 300], [0, 0.5]]}", ["safety.workspace_m.0.0 is -300", "-10"]),
        ("safety: {min_z_m: -5}", ["safety.min_z_m is -5", "is it in millimetres?"]),
        ("safety: {expected_stiffness_N_per_m: 5}", ["expected_stiffness_N_per_m is 5", "100"]),
        ("robot: {tcp: [0, 0, 120, 0, 0, 0]}", ["tcp", "metres, less than 1 (120 mm is 0.12)"]),
        ("robot: {tcp: [0, 0, 0.12, 0, 0, 90]}", ["tcp", "rad, at most 6.3"]),
        ("check: {tolerances: {play_m: 0.1}}", ["play_m is 0.1", "is it in millimetres?"]),
        ("check: {tolerances: {gain: 2}}", ["gain is 2", "0.5"]),
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


@pytest.mark.parametrize("text", ["yes", "true", "on", "'12'", "1:30", "0x10", "12 N", "[12]", "null"])
def test_a_limit_that_is_not_a_number_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=r"config\.yaml, line 2: safety\.contact_limit_N is .*; expected a number"):
        load_config(written(tmp_path, f"safety:\n  contact_limit_N: {text}\n"))


def test_a_limit_that_stands_twice_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="line 3: the key 'contact_limit_N' stands here and in line 2"):
        load_config(written(tmp_path, "safety:\n  contact_limit_N: 5\n  contact_limit_N: 24\n"))


def test_a_second_safety_block_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="line 4: the key 'safety' stands here and in line 1"):
        load_config(written(tmp_path, "safety:\n  contact_limit_N: 5\nrobot: {model: ur5}\nsafety:\n  contact_limit_N: 12\n"))


@pytest.mark.parametrize("host", ["''", "' '", "a b", "5", "yes"])
def test_a_host_that_is_no_name_is_refused(tmp_path: Path, host: str) -> None:
    with pytest.raises(ConfigError, match=r"robot\.host is "):
        load_config(written(tmp_path, f"robot: {{host: {host}}}"))


@pytest.mark.parametrize(
    "url",
    [
        "camera.lab/stream", "ftp://camera.lab/", "javascript:alert(1)", "http://user:password@camera.lab/", "http://", "http://a b/",
        "http://camera.lab; script-src *", "http://camera.lab,evil", "http://camera.lab/\n",
    ],
)  # fmt: skip
def test_a_camera_is_an_address_without_a_password_that_fits_a_content_policy(tmp_path: Path, url: str) -> None:
    text = f"page: {{camera_url: {json.dumps(url)}}}"
    with pytest.raises(ConfigError, match="camera_url"):
        load_config(written(tmp_path, text))
    good = load_config(written(tmp_path, "page: {camera_url: 'https://[fe80::1]:8443/cell?fps=5'}"))
    assert good.page.camera_url == "https://[fe80::1]:8443/cell?fps=5"


@pytest.mark.parametrize("key", ["press_speed_m_per_s", "search.speed_m_per_s", "free.speed_m_per_s"])
def test_a_speed_at_which_a_press_would_never_end_is_refused(tmp_path: Path, key: str) -> None:
    block, _, last = key.rpartition(".")
    speed: dict[str, object] = {last: 1e-9}
    values = {"sites": [{"name": "A"}], "depths_m": [0.004]} | (
        {block: speed | ({"strokes": 1} if block == "free" else {})} if block else speed
    )
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match=f"{key} is 1e-09; expected greater than or equal to 0.0001"):
        load_plan(path)


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        ("", "sites and depths_m are not given"),
        ("mode: static", "sites and depths_m are not given"),
        ("sites: [{name: A}]", "depths_m is not given"),
        ("depths_m: [0.004]", "sites is not given"),
    ],
)
def test_a_plan_that_does_not_say_where_and_how_deep_is_refused(tmp_path: Path, text: str, missing: str) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=missing):
        load_plan(path)
    with pytest.raises(ConfigError, match=missing):
        parse_plan(yaml.safe_load(text) or {}, "the request")


def test_no_number_of_a_file_is_made_of_a_boolean_or_a_text() -> None:
    def lax(model: type[BaseModel], at: str) -> list[str]:
        names = []
        for name, field in model.model_fields.items():
            schema = TypeAdapter(field.rebuild_annotation())
            for value in (True, "1"):
                for shape in (value, [value] * 2, [value] * 3, [value] * 6, [[value] * 2] * 3, {"a": {"b": value}}):
                    try:
                        read = schema.validate_python(shape)
                    except ValidationError:
                        continue
                    if any(isinstance(leaf, int | float) and not isinstance(leaf, bool) for leaf in leaves(read)):
                        names.append(f"{at}.{name}")
            for inner in (field.annotation, *get_args(field.annotation)):
                if isinstance(inner, type) and issubclass(inner, BaseModel):
                    names += lax(inner, f"{at}.{name}")
        return names

    assert [lax(model, model.__name__) for model in (Config, Plan, PlanSite, CellFile, CellSite)] == [[]] * 5


def leaves(value: object) -> list[object]:
    if isinstance(value, dict):
        return [leaf for inner in value.values() for leaf in leaves(inner)]
    return [leaf for inner in value for leaf in leaves(inner)] if isinstance(value, list | tuple) else [value]


def test_a_missing_file_is_said() -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml cannot be read"):
        load_config(Path("nowhere.yaml"))


def test_the_environment_overrides_a_key_whatever_its_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPD_ROBOT__HOST", "10.1.2.3")
    monkeypatch.setenv("PALPD_SAFETY__CONTACT_LIMIT_N", "7.5")
    config = load_config(written(tmp_path, "robot: {host: elsewhere}"))
    assert config.robot.host == "10.1.2.3"
    assert config.safety.contact_limit_N == 7.5


def test_the_environment_overrides_a_whole_block_and_a_key_of_it_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPD_SAFETY", '{"contact_limit_N": 5, "lateral_limit_N": 3}')
    monkeypatch.setenv("PALPD_SAFETY__LATERAL_LIMIT_N", "2.5")
    config = load_config(written(tmp_path, "safety: {contact_limit_N: 7, torque_limit_Nm: 0.5}"))
    assert (config.safety.contact_limit_N, config.safety.lateral_limit_N, config.safety.torque_limit_Nm) == (5.0, 2.5, 0.5)


@pytest.mark.parametrize(
    ("name", "text", "attribute", "value"),
    [
        ("PALPD_ROBOT__TCP", "[0, 0, 0.1, 0, 0, 0]", ("robot", "tcp"), (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)),
        ("PALPD_SENSOR__FILTER_CUTOFF_HZ", "null", ("sensor", "filter_cutoff_Hz"), None),
        ("PALPD_MODEL__PATH", "null", ("model", "path"), None),
        ("PALPD_ROBOT__HOST", "192.168.1.10", ("robot", "host"), "192.168.1.10"),
        ("PALPD_CELL__PROBE__MASS_KG", "3e-1", ("cell", "probe", "mass_kg"), 0.3),
        ("palpd_robot__watchdog_hz", "25", ("robot", "watchdog_Hz"), 25.0),
    ],
)
def test_the_environment_overrides_keys_of_every_kind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str, attribute: tuple[str, ...], value: object
) -> None:
    monkeypatch.setenv(name, text)
    config: object = load_config(written(tmp_path, "model: {path: a.onnx}\nrobot: {host: elsewhere}\n"))
    for part in attribute:
        config = getattr(config, part)
    assert config == value


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("PALPD_SAFETY", "5", "PALPD_SAFETY is not a block of keys"),
        ("PALPD_SAFETY", "{contact_limit_N: [", "is not YAML"),
        ("PALPD_SAFETY", "{contact_limit_N: 5, contact_limit_N: 20}", "stands here and in line 1"),
        ("PALPD_SAFETY", "{contact_limit_mN: 5}", "environment variable PALPD_SAFETY: there is no key"),
        ("PALPD_SAFETY__CONTACT_LIMT_N", "5", "PALPD_SAFETY__CONTACT_LIMT_N: there is no key"),
        ("PALPD_SAFETY__CONTACT_LIMIT_N", "yes", "PALPD_SAFETY__CONTACT_LIMIT_N: safety.contact_limit_N is true; expected a number"),
        ("PALPD_SAFETY__CONTACT_LIMIT_N", "", "contact_limit_N is null"),
        ("PALPD_SAFETY_CONTACT_LIMIT_N", "5", r"did you mean PALPD_SAFETY__"),
        ("PALPD_SAFTY__CONTACT_LIMIT_N", "5", r"did you mean 'safety'\?"),
    ],
)
def test_an_override_that_would_not_take_effect_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str, words: str
) -> None:
    monkeypatch.setenv(name, text)
    with pytest.raises(ConfigError, match=words) as refused:
        load_config(written(tmp_path, "safety: {contact_limit_N: 7}"))
    assert "\n" not in str(refused.value)


def test_variables_of_other_programs_with_our_prefix_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPD_TEST_WALL_CLOCK", "5")
    assert load_config(written(tmp_path, "version: 1")) == load_config(written(tmp_path, "{}"))


def test_the_environment_does_not_change_a_configuration_that_came_as_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPD_SAFETY__CONTACT_LIMIT_N", "5")
    assert parse_config({}, "a recording") == Config()
    assert Config().safety.contact_limit_N == 12.0


def test_a_configuration_and_a_plan_survive_being_kept_in_a_recording() -> None:
    assert parse_config(Config().model_dump(mode="json"), "it") == Config()
    assert parse_plan(Plan().model_dump(mode="json"), "it") == Plan()


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


def test_every_key_that_is_wrong_has_its_sentence_which_survives_a_way_between_processes() -> None:
    with pytest.raises(ConfigError) as refused:
        parse_plan({"sites": [{"name": "A", "x_m": 9.0}], "depths_m": [0.004, 4.0], "hold": 1}, "it")
    error = pickle.loads(pickle.dumps(refused.value))
    assert set(error.faults) == {"sites.0.x_m", "depths_m.1", "hold"}
    assert str(error) == f"it: {error.faults['sites.0.x_m']}"
    slow = Config.model_validate({"safety": {"max_speed_m_per_s": 0.002}})
    with pytest.raises(ConfigError) as unsafe:
        refuse_unsafe(slow, Plan())
    assert set(unsafe.value.faults) == {"press_speed_m_per_s", "search.speed_m_per_s"}


def test_the_limit_that_a_plan_is_shown_is_the_one_that_refuses_it() -> None:
    config = Config.model_validate({"safety": {"max_speed_m_per_s": 0.03, "workspace_m": [[-0.2, 0.2], [-0.1, 0.3], [0.0, 0.5]]}})
    values = {"sites": [{"name": "A"}, {"name": "B", "x_m": 0.05}], "depths_m": [0.004], "origin": {"x_m": 0.1, "y_m": 0.0}}
    limits = plan_limits(config, parse_plan(values, "it"))
    assert limits["press_speed_m_per_s"] == (1e-4, 0.03, "safety.max_speed_m_per_s")
    assert limits["sites.1.x_m"][:2] == pytest.approx((-0.3, 0.1))
    for x_m, sound in ((limits["sites.1.x_m"][1] - 1e-9, True), (limits["sites.1.x_m"][1] + 1e-9, False)):
        plan = parse_plan({**values, "sites": [{"name": "A"}, {"name": "B", "x_m": x_m}]}, "it")
        if sound:
            refuse_unsafe(config, plan)
        else:
            with pytest.raises(ConfigError, match=r"site B is at x = 0\.2 m"):
                refuse_unsafe(config, plan)


def test_sites_nearer_than_two_tip_radii_are_questioned() -> None:
    at = {"A": 0.0, "B": 0.01, "C": 0.0101, "D": 0.03, "E": 0.0}
    plan = parse_plan({"sites": [{"name": name, "x_m": x_m} for name, x_m in at.items()], "depths_m": [0.004]}, "it")
    questions = close_sites(Config(), plan)
    assert set(questions) == {"sites.2", "sites.4"}, "10 mm are two radii of a tip of 5 mm"
    assert "site C is 0.1 mm from site B" in questions["sites.2"]
    assert "site E is 0 mm from site A" in questions["sites.4"]


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


@pytest.mark.parametrize(("origin", "words"), [((0.3, 0.0), "origin is at x = 0.3 m"), ((0.15, 0.0), "site far is at x = 0.25 m")])
def test_an_origin_or_a_site_counted_from_it_outside_the_workspace_is_refused(origin: tuple[float, float], words: str) -> None:
    config = Config.model_validate({"safety": {"workspace_m": [[-0.2, 0.2], [-0.2, 0.2], [0.0, 0.5]]}})
    plan = {"sites": [{"name": "far", "x_m": 0.1}], "depths_m": [0.004]}
    refuse_unsafe(config, parse_plan(plan, "it"))
    refuse_unsafe(config, parse_plan({**plan, "origin": {"x_m": 0.0, "y_m": 0.0}}, "it"))
    with pytest.raises(ConfigError, match=words):
        refuse_unsafe(config, parse_plan({**plan, "origin": {"x_m": origin[0], "y_m": origin[1]}}, "it"))


def test_a_name_of_a_site_with_a_space_is_refused_in_words() -> None:
    with pytest.raises(ConfigError, match=r"sites\.0\.name is 'a b'; expected letters \(a to z\), digits, .* without a space"):
        parse_plan({"sites": [{"name": "a b"}], "depths_m": [0.003]}, "the plan")


def test_a_robot_of_another_name_is_refused_with_what_works() -> None:
    with pytest.raises(ConfigError, match=r"robot.model: 'ur10e' is neither ur5 nor ur5e: only the controller matters.*docs/what-works.md"):
        parse_config({"robot": {"model": "ur10e"}}, "config.yaml")
