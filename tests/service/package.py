"""The Debian package under a real systemd: `make test-deb`. Installs it in a container as an administrator does, uses it, and purges it.

It needs root, systemd-nspawn and a package in dist/ (`make deb`); elsewhere it is skipped, and says why.
"""

import re
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

import pytest

from palpd.daemon.socket_client import ask
from tests.paths import ROOT
from tests.service.container import INSIDE_CODE, Container, booted, missing, until

PACKAGES = list((ROOT / "dist").glob("palpd_*.deb"))
pytestmark = [
    pytest.mark.hil,
    pytest.mark.skipif(missing() is not None, reason=f"booting systemd in a container {missing()}"),
    pytest.mark.skipif(not PACKAGES, reason="there is no package in dist/; make deb builds one"),
]
UNITS = ("palpd.service", "palpd-web.service", "palpd-stream.service", "palpd-alarms.service")
INSTALL_S = 300.0
RECORDING = "/var/lib/palpd/runs/20260714-101502-palpation.mcap"


@pytest.fixture(scope="module")
def inside(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    """A container into which the newest package of dist/ is installed."""
    with booted(tmp_path_factory.mktemp("nspawn")) as container:
        install(container)
        yield container


def install(container: Container) -> None:
    """Install the newest package of dist/, also over an installed one."""
    package = max(PACKAGES, key=lambda path: path.stat().st_mtime)
    container.run("dpkg", "--install", str(INSIDE_CODE / "dist" / package.name), timeout_s=INSTALL_S)


def test_the_package_is_installed_and_its_command_answers(inside: Container) -> None:
    assert inside.run("dpkg-query", "--show", "--showformat=${Status}", "palpd") == "install ok installed"
    assert inside.run("palpd", "--version").split()[-1] == version("palpd")


def test_nothing_starts_by_itself(inside: Container) -> None:
    for unit in UNITS:
        assert inside.shows(unit, "ActiveState") == "inactive"
        assert inside.shows(unit, "UnitFileState") == "disabled"


def test_its_units_are_clean(inside: Container) -> None:
    for unit in UNITS:
        assert inside.run("systemd-analyze", "verify", f"/lib/systemd/system/{unit}") == ""


def test_its_configuration_is_judged_and_a_plan_is_carried_out_on_the_simulated_cell(inside: Container) -> None:
    inside.write("/tmp/plan.yaml", "sites: [{name: A}]\ndepths_m: [0.004]\nmode: static\nhold_s: 0.5\n")
    inside.run("palpd", "check-config", "/etc/palpd/config.yaml")
    words = ["--plan", "/tmp/plan.yaml", "--config", "/etc/palpd/config.yaml", "--configured-cell"]
    printed = inside.run("palpd", "sim", *words, timeout_s=120.0)
    assert re.search(r"\bA\b.*\d", printed)


def test_the_service_starts_without_devices_and_moves_nothing(inside: Container) -> None:
    inside.run("systemctl", "start", "palpd")
    until(lambda: inside.path("/run/palpd/palpd.sock").exists(), 60.0, "the service listens")

    def status() -> dict[str, Any]:
        return ask(inside.path("/run/palpd/palpd.sock"), {"do": "status"}, 30.0)

    until(lambda: status()["cell"] is not None, 60.0, "the service has looked at the cell", every_s=0.5)
    assert not status()["cell"]["ready"]
    assert status()["state"] in ("checking", "disarmed")


def test_the_page_is_served_from_the_package(inside: Container) -> None:
    inside.run("systemctl", "start", "palpd-web")
    asked = "import urllib.request as r; print(r.urlopen('http://127.0.0.1:8700/static/icon.svg', timeout=5).status)"
    until(lambda: inside.run("python3", "-c", asked, check=False).strip() == "200", 60.0, "the page answers", every_s=0.5)


def test_another_installation_keeps_what_was_configured(inside: Container) -> None:
    changed = inside.path("/etc/palpd/config.yaml").read_text() + "# the robot of room 3\n"
    inside.write("/etc/palpd/config.yaml", changed)
    install(inside)
    assert inside.path("/etc/palpd/config.yaml").read_text() == changed


def test_a_purge_leaves_the_recordings_and_nothing_else(inside: Container) -> None:
    inside.write(RECORDING, "a recording")
    printed = inside.run("dpkg", "--purge", "palpd", timeout_s=INSTALL_S)
    assert "/var/lib/palpd with its recordings stays" in printed
    assert inside.path(RECORDING).read_text() == "a recording"
    left = [
        path
        for path in ("/etc/palpd", "/usr/bin/palpd", "/opt/palpd/bin", "/run/palpd", "/var/lib/palpd-web", "/var/lib/palpd-alarms")
        if inside.path(path).exists()
    ]
    left += [unit for unit in UNITS if inside.path(f"/lib/systemd/system/{unit}").exists()]
    assert left == []
