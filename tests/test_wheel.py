"""The wheel, unpacked into an empty folder: it brings the files of the service, and runs without the robot's library."""

import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from tests.paths import ROOT

SHIPPED = (
    "config.yaml", "plan.yaml",
    "systemd/palpd.service", "systemd/palpd-web.service", "systemd/palpd-stream.service", "systemd/palpd-alarms.service",
    "systemd/palpd.sysusers.conf", "systemd/99-palpd-hex.rules",
)  # fmt: skip


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an unpacked wheel, in which ur-rtde cannot be imported."""
    folder = tmp_path_factory.mktemp("wheel")
    built = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder], cwd=ROOT, capture_output=True, text=True
    )
    assert built.returncode == 0, built.stderr
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
        wheel.extractall(folder / "site")
    for library in ("rtde_control", "rtde_receive"):
        (folder / "site" / f"{library}.py").write_text("raise ImportError")
    return folder / "site"


def _palpd(site: Path, folder: Path, *words: str | Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(site)}
    return subprocess.run([sys.executable, "-P", "-m", "palpd", *words], cwd=folder, env=environment, capture_output=True, text=True)


def test_the_wheel_holds_what_install_and_init_copy_and_says_that_it_is_typed(unpacked: Path) -> None:
    for name in SHIPPED:
        assert (unpacked / "palpd" / "shipped" / name).read_text() == (ROOT / name).read_text()
    assert (unpacked / "palpd" / "py.typed").exists()
    assert (unpacked / "hw" / "py.typed").exists()
    assert {path.name for path in (unpacked / "palpd" / "testing").glob("*.py")} == {
        path.name for path in (ROOT / "palpd" / "testing").glob("*.py")
    }


def test_an_installed_wheel_writes_the_starting_files_and_those_of_the_service(unpacked: Path, tmp_path: Path) -> None:
    done = _palpd(unpacked, tmp_path, "init", "cell")
    assert done.returncode == 0, done.stderr
    done = _palpd(unpacked, tmp_path, "check-config", "cell/config.yaml", "--plan", "cell/plan.yaml")
    assert done.returncode == 0, done.stderr
    done = _palpd(unpacked, tmp_path, "install", "--prefix", tmp_path / "root")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "root/etc/systemd/system/palpd.service").exists()


def test_without_the_robots_library_a_simulation_works_and_a_run_is_refused_in_one_sentence(unpacked: Path, tmp_path: Path) -> None:
    assert _palpd(unpacked, tmp_path, "init", "cell").returncode == 0
    done = _palpd(unpacked, tmp_path, "effects")
    assert done.returncode == 0, done.stderr
    refused = _palpd(unpacked, tmp_path, "calibrate", "--config", "cell/config.yaml")
    assert refused.returncode == 2
    assert len(refused.stderr.strip().splitlines()) == 1
    assert "ur-rtde" in refused.stderr
    assert "Linux on x86-64" in refused.stderr


def test_without_the_robots_library_the_demo_offers_the_run_without_wires_and_says_what_that_does_not_show(
    unpacked: Path, tmp_path: Path
) -> None:
    refused = _palpd(unpacked, tmp_path, "demo")
    assert refused.returncode == 2
    assert "ur-rtde" in refused.stderr
    assert refused.stderr.endswith("or add --no-wires: the cell's physics alone, without bytes, timing and faults\n")
    assert "--no-wires" not in _palpd(unpacked, tmp_path, "demo", "--page").stderr, "the page needs a service on wires"
    assert not list(tmp_path.iterdir()), "neither has begun"
    done = _palpd(unpacked, tmp_path, "demo", "--no-wires", "--json", "demo.json", "--out", "demo")
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "demo.json").read_text())
    assert result["verdict"] == "done"
    assert "bytes, timing and faults were not part of it" in result["notes"][0]
    assert "µs" not in done.stdout, "no timing was measured"
    for site in result["sites"]:
        assert site["static_youngs_modulus_Pa"] == pytest.approx(site["true_youngs_modulus_Pa"], rel=0.02)


def test_the_version_is_that_of_the_project(unpacked: Path, tmp_path: Path) -> None:
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert _palpd(unpacked, tmp_path, "--version").stdout == f"palpd {stated}\n"
