"""`palpd init`: both files fit each other, and nothing is overwritten."""

from pathlib import Path

import pytest

from palpd.daemon.starting_files import checked, write_starting_files
from palpd.errors import BadInput, ConfigError


@pytest.mark.parametrize(("model", "limit_N"), [("ur5", 12.0), ("ur5e", 5.0), ("ur5", 40.0)])
def test_the_files_hold_what_was_asked_for_and_are_sound(tmp_path: Path, model: str, limit_N: float) -> None:
    config, plan = checked(*write_starting_files(tmp_path / "cell", model, limit_N, []))
    assert (config.robot.model, config.safety.contact_limit_N) == (model, limit_N)
    assert config.safety.absolute_limit_N >= 2.0 * limit_N
    assert 0.001 < plan.depths_m[0] < plan.depths_m[1] < plan.depths_m[2]


def test_depths_that_the_limit_would_cut_short_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"8 mm into 143 kPa needs 12\.9 N, above the 10\.8 N"):
        write_starting_files(tmp_path, "ur5", 12.0, [0.004, 0.008])
    with pytest.raises(ConfigError, match="depths are in metres"):
        write_starting_files(tmp_path, "ur5", 12.0, [0.0001])
    assert not any(tmp_path.iterdir())


def test_files_that_exist_are_kept(tmp_path: Path) -> None:
    (tmp_path / "plan.yaml").write_text("mine")
    with pytest.raises(BadInput, match="not overwritten"):
        write_starting_files(tmp_path, "ur5", 12.0, [])
    assert [each.name for each in tmp_path.iterdir()] == ["plan.yaml"]


def test_depths_that_overflow_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="depths are in metres"):
        write_starting_files(tmp_path / "cell", "ur5", 12.0, [1e297])
    assert not any(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to("loop")
    for folder in (tmp_path / "file", tmp_path / "loop", Path("/proc/x"), tmp_path / ("n" * 300)):
        with pytest.raises(BadInput, match=r"cannot be (written|made)"):
            write_starting_files(folder, "ur5", 12.0, [])


@pytest.mark.parametrize(
    ("block", "known"), [("sensor: {kind: franka}", "hex-70"), ("robot: {kind: franka, rtde_rate_Hz: 100}", "ur-rtde")]
)
def test_a_driver_that_no_package_brings_is_not_sound(tmp_path: Path, block: str, known: str) -> None:
    (tmp_path / "config.yaml").write_text(block)
    with pytest.raises(ConfigError, match=rf"kind is 'franka'; known are .*{known}.*docs/sensors.md"):
        checked(tmp_path / "config.yaml", None)
