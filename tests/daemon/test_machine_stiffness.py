"""What counts as the stiffness of the machine, and which run may count with it."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from palpd.cli.application import app
from palpd.config import Config, MachineConfig, PathsConfig, Plan
from palpd.daemon.doctor.stored import examine_machine_stiffness
from palpd.daemon.finding import Finding
from palpd.daemon.machine_stiffness import measured_stiffness
from palpd.daemon.motion_job import explainer_of
from palpd.daemon.programs import PROGRAMS, StiffnessArguments
from palpd.daemon.session import job, measured_job
from palpd.daemon.starting_files import checked
from palpd.daemon.stored_state import Calibration, MachineStiffness, State, now
from palpd.errors import ConfigError, RecordingError, Refused
from tests.daemon.test_morning_check import SimulatedHost

COMPLIANCE = "robot.compliance"


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return Config(paths=PathsConfig(runs=tmp_path / "runs", state=tmp_path / "state"))


def kept(config: Config, stiffness_N_per_m: float = 48e3, date: str | None = None) -> None:
    machine = MachineStiffness(stiffness_N_per_m, (0.9 * stiffness_N_per_m, 1.1 * stiffness_N_per_m), date or now(), "ISE111")
    State(config.paths.state).keep("stiffness", machine)


def calibrated(config: Config, serial: str) -> None:
    State(config.paths.state).keep("calibration", Calibration((0.0,) * 6, now(), serial))


def finding(config: Config) -> Finding:
    (only,) = examine_machine_stiffness(config)
    return only


def test_a_plate_is_kept_and_a_machine_softer_than_any_mount_is_refused_and_not_kept(config: Config) -> None:
    soft = SimulatedHost(config, {COMPLIANCE: {"stiffness_N_per_m": 5e3}})
    with pytest.raises(RecordingError, match=r"the presses measure 4\.\d+ N for 1 mm, expected at least 10 N .*; tighten the screws"):
        PROGRAMS["stiffness"].carry_out(soft, StiffnessArguments(), Path())
    assert not State(config.paths.state).holds("stiffness")
    measured_stiffness(SimulatedHost(config, {COMPLIANCE: {"stiffness_N_per_m": 5e4}}))
    machine = State(config.paths.state).machine_stiffness()
    assert machine is not None
    assert machine.stiffness_N_per_m == pytest.approx(1.0 / (1.0 / 50e3 + 1e-6), rel=0.03)


def test_a_machine_whose_stiffness_nobody_measured_is_said(config: Config) -> None:
    assert (finding(config).verdict, finding(config).measured) == ("warn", "none: arm, mount and sensor count as rigid")


def test_no_palpation_counts_with_a_machine_that_is_too_soft_and_it_can_be_measured_again(config: Config) -> None:
    kept(config, 900.0)
    with pytest.raises(ConfigError, match=r"stiffness\.json holds 0\.9 N for 1 mm, expected at least 10 N"):
        measured_job("palpation", config, Plan())
    assert measured_job("stiffness", config, Plan()).machine_stiffness_N_per_m is None
    assert finding(config).verdict == "fail"
    stated = config.model_copy(update={"machine": MachineConfig(stiffness_N_per_m=2e4)})
    assert measured_job("palpation", stated, Plan()).machine_stiffness_N_per_m == 2e4
    assert examine_machine_stiffness(stated) == []


@pytest.mark.parametrize("stated", [48.0, 5000.0])
def test_nor_does_it_count_with_one_that_the_configuration_states(config: Config, stated: float, tmp_path: Path) -> None:
    """5 N for 1 mm made 74 kPa of 62.5, "done" and without a note; 48 (typed in N/mm) was blamed on a cable, with the probe in contact."""
    file = tmp_path / "config.yaml"
    file.write_text(f"machine: {{stiffness_N_per_m: {stated:g}}}\n")
    sentence = rf"machine\.stiffness_N_per_m is {stated:g}, that is .* N for 1 mm, expected at least 10 N .* in N/m"
    with pytest.raises(ConfigError, match=sentence):
        checked(file, None)
    with pytest.raises(ConfigError, match=sentence):
        job("palpation", config.model_copy(update={"machine": MachineConfig(stiffness_N_per_m=stated)}), Plan())


def test_the_stiffness_of_another_sensor_does_not_count(config: Config) -> None:
    kept(config)
    work, about = measured_job("palpation", config, Plan()), dict[str, Any](sensor_serial="ISE111")
    assert explainer_of(work, about, 0.0)  # type: ignore[arg-type]
    sentence = "was measured with sensor ISE111, but ISE222 is mounted; .* run palpd stiffness"
    with pytest.raises(Refused, match=sentence):
        explainer_of(work, about | {"sensor_serial": "ISE222"}, 0.0)  # type: ignore[arg-type]
    calibrated(config, "ISE111")
    assert finding(config).verdict == "ok"
    calibrated(config, "ISE222")
    assert finding(config).verdict == "fail"


def test_a_stiffness_of_last_year_is_said_by_check_config_and_counts(config: Config, tmp_path: Path) -> None:
    kept(config, date="2020-01-01T00:00:00+00:00")
    assert finding(config).verdict == "warn"
    assert measured_job("palpation", config, Plan()).machine_stiffness_N_per_m == 48e3
    file = tmp_path / "config.yaml"
    file.write_text(f"paths: {{state: {config.paths.state}, runs: {config.paths.runs}}}\n")
    done = CliRunner().invoke(app, ["check-config", str(file)])
    assert done.exit_code == 0, done.output
    assert "machine stiffness: 48 N for 1 mm, of 2020-01-01" in " ".join(done.output.split())
    assert "more than a year old and counts all the same: run palpd stiffness again" in " ".join(done.output.split())
