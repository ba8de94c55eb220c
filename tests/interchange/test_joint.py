"""A recording of one joint: read with its units, kept in them, and answered in them."""

from pathlib import Path

import numpy as np
import pytest

import palpd
from palpd.cli.application import carry_out
from palpd.errors import BadInput, RecordingError

JOINT = {"probe": {"mass_kg": 0.02}, "sensor": {"filter_cutoff_Hz": None, "noise_rms_N": 0.005, "resolution_fz_N": 0.0}, "tissue": None}


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An actuator of 0.02 kg m² that swings by degrees, with 0.12 Nm of friction; its log is in degrees and Ncm."""
    t_s = np.arange(0.0, 20.0, 0.004)
    angle_rad = 1.5 * np.sin(0.8 * t_s) * np.sin(0.23 * t_s) ** 2
    speed = np.gradient(angle_rad, t_s)
    torque_Nm = -0.02 * np.gradient(speed, t_s) - 0.12 * np.tanh(speed / 1e-3)
    random = np.random.default_rng(5)
    rows = [t_s, np.degrees(angle_rad + 2e-5 * random.normal(size=len(t_s))), 100.0 * (torque_Nm + 0.005 * random.normal(size=len(t_s)))]
    path = tmp_path_factory.mktemp("joint") / "joint.csv"
    np.savetxt(path, np.column_stack(rows), delimiter=",", header="time_s,position_deg,effort_Ncm", comments="", fmt="%.7g")
    return path


def test_degrees_and_newton_centimetres_become_rad_and_nm(table: Path, tmp_path: Path) -> None:
    out = tmp_path / "recording.csv"
    columns = ["--height-column", "position_deg", "--force-column", "effort_Ncm", "--time-column", "time_s", "--units", "confirmed"]
    carry_out(["import", str(table), "--joint", *columns, "--csv", str(out)])
    assert out.read_text().splitlines()[0] == "t_s,angle_rad,speed_rad_per_s,torque_Nm"
    recording, original = palpd.load(out), np.loadtxt(table, delimiter=",", skiprows=1)
    assert np.allclose(recording["angle_rad"], np.radians(original[:, 1]), atol=1e-12)
    assert np.allclose(recording["torque_Nm"], original[:, 2] / 100.0)
    assert " rad of travel" in recording.sentence
    again = palpd.import_file(out, joint=True)
    assert np.array_equal(again["torque_Nm"], recording["torque_Nm"])


def test_its_friction_is_named_in_newton_metres(table: Path, tmp_path: Path) -> None:
    options = {"height_column": "position_deg", "force_column": "effort_Ncm", "time_columns": ("time_s",), "units_confirmed": True}
    recording = palpd.import_file(table, joint=True, **options)
    for source in (recording, recording.columns):
        answer = palpd.diagnose(source, JOINT)
        assert [effect["id"] for effect in answer.to_json()["effects"]] == ["cable.friction"], answer.sentence
        assert answer.to_json()["joint"] is True
        words = {name: value for name, _, value in answer.to_json()["plain"]["causes"][0]["parameters"]}
        assert words["force_N"].startswith("0.12")
        assert words["force_N"].endswith("N m")
        assert "torque" in answer.sentence
        assert "vertical force" not in answer.sentence
    report = tmp_path / "report.html"
    answer.report(report)
    assert "torque (" in report.read_text()
    assert "vertical force" not in report.read_text()


def test_an_angle_may_grow_without_end_and_a_height_not() -> None:
    t_s = np.arange(0.0, 20.0, 0.01)
    turning = {"t_s": t_s, "angle_rad": 30.0 * t_s, "speed_rad_per_s": np.full(len(t_s), 30.0)}
    turning["torque_Nm"] = -0.1 + 0.005 * np.random.default_rng(1).normal(size=len(t_s))
    palpd.diagnose(turning, JOINT)
    heights = {"t_s": t_s, "z_m": turning["angle_rad"], "vz_m_per_s": turning["speed_rad_per_s"], "fz_N": turning["torque_Nm"]}
    with pytest.raises(RecordingError, match="z_m spans 600 m"):
        palpd.diagnose(heights, JOINT)


def test_what_does_not_fit_a_joint_is_refused(table: Path) -> None:
    with pytest.raises(BadInput, match=r"position_deg is in deg, expected a length .* --joint"):
        palpd.import_file(table, height_column="position_deg", force_column="effort_Ncm", time_columns=("time_s",), units_confirmed=True)
    with pytest.raises(RecordingError, match="column speed_rad_per_s is missing"):
        palpd.diagnose({"t_s": np.arange(40.0), "angle_rad": np.arange(40.0), "torque_Nm": np.arange(40.0)}, JOINT)
