"""Packages bring readers, effects, sensors and robots; one that is broken is a sentence, and stops nothing that does not use it."""

import tomllib
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from palpd.cell.cell_file import load_cell
from palpd.cell.effects import EFFECTS, installed_effects, load_effects, user_effects
from palpd.config import Config, Plan, PlanSite, SensorConfig
from palpd.daemon import run_header, wiring
from palpd.errors import BadInput, ConfigError, RecordingError, RobotError, SensorError
from palpd.interchange import registry
from palpd.plugins import plugins
from palpd.recording.reader import Recording
from palpd.testing.simulated_recording import write_simulated
from tests.paths import ROOT

PACKAGE = """
import numpy as np
from palpd.cell.effects import Effect, Parameter
from palpd.tick import NO_FRAMES, RobotKind

def push(s, p, memory):
    s.contact_N = s.contact_N + p["force_N"]

PUSH = Effect("tissue.push", site="tissue", what="a push", parameters=(Parameter("force_N", "N", 0.0, 1.0, (0.1,)),), law=push)
SAME = [Effect("sensor.gain", site="tissue", what="a push", parameters=(Parameter("force_N", "N", 0.0, 1.0, (0.1,)),), law=push)]
NO_EFFECT = [1, 2]

class Sensor:
    serial_number, calibration_source, pulled_over_pressed, delay_s, counter_step = "S1", "sheet", None, 0.0, 1
    counts_per_N = counts_per_Nm = np.ones(3)
    def __init__(self, settings): self.scale = settings.options.get("scale", 1.0)
    def read(self): return NO_FRAMES
    def close(self): pass

class Reader:
    def __init__(self, settings): self.host = settings.host
    def read(self): raise RuntimeError
    def close(self): pass

ROBOT = RobotKind(Reader, Reader)
"""


@pytest.fixture
def installs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Installs a package with these entry points, as pip would leave it."""

    def install(entry_points: str) -> None:
        (tmp_path / "palpd_extra.py").write_text(PACKAGE)
        (tmp_path / "palpd_broken.py").write_text("raise RuntimeError('no\\nlicence')")
        info = tmp_path / "palpd_extra-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: palpd-extra\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(entry_points)
        monkeypatch.syspath_prepend(tmp_path)

    forget()
    yield install
    monkeypatch.undo()
    forget()


def forget() -> None:
    installed_effects.cache_clear()
    registry.readers.cache_clear()


def test_what_is_ours_stands_in_one_list_and_the_entry_points_are_left_to_other_packages() -> None:
    assert "entry-points" not in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for group, ours in (("palpd.sensors", wiring.SENSORS), ("palpd.robots", wiring.ROBOTS), ("palpd.readers", registry.OURS)):
        assert all(plugins(group, ours)[name].load() for name in ours)


def test_entry_points_that_an_older_palpd_left_behind_change_nothing(installs: Callable[[str], None], tmp_path: Path) -> None:
    installs("[palpd.effects]\nsensor = palpd.cell.effects.sensor:EFFECTS\n[palpd.readers]\ncsv = palpd.interchange.table:READER\n")
    info = tmp_path / "palpd_extra-1.0.dist-info" / "METADATA"
    info.write_text(info.read_text().replace("palpd-extra", "palpd"))
    assert installed_effects() == (EFFECTS, ())
    assert not registry.readers()[1]
    assert registry.readers()[0].keys() == registry.OURS.keys()


def test_the_library_is_found_as_others_are_and_nothing_is_added_to_it() -> None:
    effects, failures = installed_effects()
    assert {name: effects[name] for name in EFFECTS} == EFFECTS
    assert list(load_effects())[: len(EFFECTS)] == list(EFFECTS)
    assert not [sentence for sentence in failures if "package palpd" in sentence]


def test_an_installed_effect_is_known_to_cell_files_and_counts_as_an_added_one(installs: Callable[[str], None], tmp_path: Path) -> None:
    installs("[palpd.effects]\nextra = palpd_extra:PUSH\n")
    library = load_effects()
    assert [effect.id for effect in user_effects(library)] == ["tissue.push"]
    (tmp_path / "cell.yaml").write_text("effects: {tissue.push: {force_N: 0.5}}")
    assert load_cell(tmp_path / "cell.yaml", library).effects["tissue.push"] == {"force_N": 0.5}
    assert "tissue.push" in load_effects(ROOT / "docs" / "examples" / "my_effect.py")


def test_broken_effects_are_left_out_with_a_sentence_each(installs: Callable[[str], None]) -> None:
    installs(
        "[palpd.effects]\na = palpd_broken:X\nb = palpd_extra:NO_EFFECT\nc = palpd_extra:SAME\nd = palpd_extra:PUSH\ne = palpd_extra:NONE\n"
    )
    effects, failures = installed_effects()
    assert [effects[name] for name in EFFECTS] == list(EFFECTS.values())
    assert "tissue.push" in effects
    assert failures == (
        "plug-in 'a' of palpd.effects cannot be used (palpd_broken:X: RuntimeError: no licence); repair or uninstall package palpd-extra",
        "plug-in 'b' of palpd.effects cannot be used (palpd_extra:NO_EFFECT: it gives no palpd.cell.effects.Effect and no list of them); "
        "repair or uninstall package palpd-extra",
        "plug-in 'c' of palpd.effects cannot be used (palpd_extra:SAME: there is an effect sensor.gain already, expected an id of its own)"
        "; repair or uninstall package palpd-extra",
        "plug-in 'e' of palpd.effects cannot be used (palpd_extra:NONE: AttributeError: module 'palpd_extra' has no attribute 'NONE'); "
        "repair or uninstall package palpd-extra",
    )


def test_a_broken_reader_is_left_out_and_named_where_no_reader_takes_a_file(installs: Callable[[str], None], tmp_path: Path) -> None:
    installs("[palpd.readers]\nlab = palpd_broken:READER\nodd = palpd_extra:PUSH\n")
    (tmp_path / "a.csv").write_text("t,z\n0,1\n")
    assert registry.reader_of(tmp_path / "a.csv").name.startswith("a table")
    (tmp_path / "b.bin").write_bytes(b"\x00\x01\x02" * 100)
    with pytest.raises(RecordingError, match=r"plug-in 'lab' of palpd.readers cannot be used .*; plug-in 'odd' .*it has no name, expected"):
        registry.reader_of(tmp_path / "b.bin")


def test_a_sensor_and_a_robot_of_another_package_are_chosen_by_name(installs: Callable[[str], None]) -> None:
    installs("[palpd.sensors]\nmine = palpd_extra:Sensor\n[palpd.robots]\nmine = palpd_extra:ROBOT\n")
    config = Config.model_validate({
        "sensor": {"kind": "mine", "port": "10.0.0.3", "rate_Hz": 333.0, "options": {"scale": 2.5, "mode": "fast"}},
        "robot": {"kind": "mine", "host": "10.0.0.2", "rtde_rate_Hz": 200.0},
    })  # fmt: skip
    assert wiring.open_sensor(config).scale == 2.5  # type: ignore[attr-defined]
    assert wiring.open_reader(config).host == "10.0.0.2"  # type: ignore[attr-defined]


def test_a_run_with_another_robot_is_recorded_without_ur_rtde(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def version(name: str) -> str:
        if name == "ur-rtde":
            raise PackageNotFoundError(name)
        return "1.2"

    monkeypatch.setattr(run_header, "version", version)
    recording = Recording.load(write_simulated(tmp_path / "run.mcap", Plan(sites=(PlanSite(name="A"),), depths_m=(0.002,))))
    assert recording.header["versions"] == {"palpd": "1.2", "numpy": "1.2", "onnxruntime": "1.2"}


def test_nobody_replaces_a_driver_of_ours(installs: Callable[[str], None]) -> None:
    installs("[palpd.sensors]\nhex-70 = palpd_extra:Sensor\n")
    assert plugins("palpd.sensors", wiring.SENSORS)["hex-70"].place == wiring.SENSORS["hex-70"]
    assert wiring.sensor_kind(Config()).__module__ == "hw.hex_sensor"


@pytest.mark.parametrize(
    ("block", "sentence"),
    [
        ({"sensor": {"kind": "hex70"}}, r"sensor.kind is 'hex70' \(did you mean 'hex-70'\?\); known are .*hex-70.*install the package"),
        ({"sensor": {"kind": "bad"}}, r"plug-in 'bad' of palpd.sensors cannot be used .*RuntimeError: no licence.*package palpd-extra"),
        ({"sensor": {"kind": "odd"}}, r"plug-in 'odd' of palpd.sensors .*it cannot be called, expected a function that opens a sensor"),
        (
            {"robot": {"kind": "odd", "rtde_rate_Hz": 100.0}},
            "plug-in 'odd' of palpd.robots .*it is a list, expected a palpd.tick.RobotKind",
        ),
    ],
)
def test_a_driver_that_cannot_be_used_is_one_sentence(installs: Callable[[str], None], block: dict[str, object], sentence: str) -> None:
    installs(
        "[palpd.sensors]\nbad = palpd_broken:X\nodd = palpd_extra:NO_EFFECT\n"
        "[palpd.robots]\nmine = palpd_extra:ROBOT\nodd = palpd_extra:NO_EFFECT\n"
    )
    robot = {"robot": {"kind": "mine", "rtde_rate_Hz": 100.0}}
    with pytest.raises(BadInput, match=sentence):
        wiring.devices(Config.model_validate(robot | block), True)
    assert wiring.sensor_kind(Config())  # what does not use it goes on


@pytest.mark.parametrize(
    ("block", "sentence"),
    [
        ({"robot": {"kind": "mine"}}, "rtde_rate_Hz is not given; a mine needs it"),
        ({"sensor": {"kind": "mine", "fz_slopes": "both"}}, "fz_slopes and fz_pulled_counts_per_N are for a hex-70, but kind is mine"),
        ({"sensor": {"capacity_N": 300.0}}, "capacity_N is 300, but a hex-70 bears 200 N"),
        ({"sensor": {"options": {"a": [1]}}}, "sensor.options.a"),
    ],
)
def test_keys_of_one_kind_are_refused_for_another(block: dict[str, object], sentence: str) -> None:
    from palpd.config import parse_config

    with pytest.raises(ConfigError, match=sentence):
        parse_config(block, "it")


def test_the_drivers_of_the_tree_refuse_options_that_they_do_not_have() -> None:
    from hw.hex_sensor import open_hex_70
    from hw.rtde import UR_RTDE
    from palpd.config import RobotConfig

    with pytest.raises(SensorError, match=r"sensor.options holds gain, but the HEX-70 has no options"):
        open_hex_70(SensorConfig(options={"gain": 2}))
    with pytest.raises(RobotError, match=r"robot.options holds gain, but a UR has no options"):
        UR_RTDE.open_reader(RobotConfig(options={"gain": 2}))
