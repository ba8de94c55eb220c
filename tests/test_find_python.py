"""Which Python `make` makes the environment with, on computers that have these and no others."""

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.paths import ROOT

STUB = """#!/bin/sh
case "$*" in
*urlopen*) exit {offline} ;; # whether GitHub answers
*"-m venv"*) mkdir -p "$3/bin"; cp "$0.uv" "$3/bin/uv"; cp "$0.uv" "$3/bin/pip" ;;
*) echo '{version}' ;;
esac
"""
UV = """#!/bin/sh
case "$*" in *find*) echo {fetched} ;; *) echo noise ;; esac
"""


def search(folder: Path, pythons: dict[str, str], *given: str, machine: str = "x86_64", network: bool = False) -> tuple[str, str, int]:
    """What find-python prints, what it says, and its exit code, where these Pythons are installed."""
    for name in ("mktemp", "rm", "mkdir", "cp", "timeout"):
        (folder / name).symlink_to(str(shutil.which(name)))
    stubs = {"uname": f"#!/bin/sh\necho Linux {machine}\n"}
    stubs |= {name: STUB.format(version=version, offline=int(not network)) for name, version in pythons.items()}
    stubs |= {"python3.uv": UV.format(fetched=folder / "fetched"), "fetched": STUB.format(version="3.12.9", offline=1)}
    for name, text in stubs.items():
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    done = subprocess.run(
        [ROOT / "find-python", *given], env={"PATH": str(folder), "TMPDIR": str(folder)}, capture_output=True, text=True, check=False
    )
    return done.stdout.strip(), done.stderr.strip(), done.returncode


@pytest.mark.parametrize(
    ("pythons", "chosen", "reason"),
    [
        ({"python3": "3.11.2", "python3.12": "3.12.1"}, "python3", "Python 3.11.2"),
        ({"python3": "3.12.1"}, "python3", "Python 3.12.1"),
        ({"python3": "3.13.0", "python3.12": "3.12.1", "python3.11": "3.11.7"}, "python3.12", "because python3 is 3.13.0"),
        ({"python3": "3.10.4", "python3.11": "3.11.7"}, "python3.11", "because python3 is 3.10.4"),
        ({"python3": "3.11.2 without venv (apt …)", "python3.12": "3.12.1"}, "python3.12", "because python3 is 3.11.2 without venv"),
    ],
)
def test_the_first_python_that_has_all_is_taken_and_the_reason_said(
    tmp_path: Path, pythons: dict[str, str], chosen: str, reason: str
) -> None:
    printed, message, code = search(tmp_path, pythons)
    assert (printed, code, message.count("\n")) == (chosen, 0, 0)
    assert str(tmp_path / chosen) in message
    assert reason in message


@pytest.mark.parametrize(
    ("pythons", "sentence"),
    [
        ({}, "there is no python3, expected Python 3.11 or 3.12 with venv"),
        (
            {"python3": "3.10.4", "python3.11": "3.11.7 without venv (apt …)"},
            "python3 is 3.10.4, python3.11 is 3.11.7 without venv (apt …), e",
        ),
        ({"python3": "3.13.0"}, "or do without the robot: make setup PYTHON=python3"),
    ],
)
def test_where_none_has_all_and_there_is_no_network_it_is_refused_in_one_sentence(
    tmp_path: Path, pythons: dict[str, str], sentence: str
) -> None:
    printed, message, code = search(tmp_path, pythons)
    assert (printed, code, message.count("\n")) == ("", 2, 0)
    assert sentence in message


def test_where_none_has_all_uv_fetches_one(tmp_path: Path) -> None:
    printed, message, code = search(tmp_path, {"python3": "3.13.0"}, network=True)
    assert (printed, code) == (str(tmp_path / "fetched"), 0)
    assert "Python 3.12.9" in message
    assert not list(tmp_path.glob("tmp*")), "uv itself is not kept"


def test_a_given_python_is_honoured_and_what_it_cannot_do_is_said(tmp_path: Path) -> None:
    printed, message, code = search(tmp_path, {"python3": "3.12.1", "python3.13": "3.13.0"}, "python3.13")
    assert (printed, code) == ("python3.13", 0)
    assert "ur-rtde has no wheel for it" in message


@pytest.mark.parametrize(("version", "sentence"), [("3.14.0", "needs Python 3.11 to 3.13"), ("3.12.1 without venv", "with venv")])
def test_a_given_python_on_which_palpd_does_not_run_is_refused(tmp_path: Path, version: str, sentence: str) -> None:
    printed, message, code = search(tmp_path, {"python3": "3.12.1", "mine": version}, "mine")
    assert (printed, code) == ("", 2)
    assert sentence in message
    assert f"mine is {version}" in message


def test_a_given_python_that_is_not_there_is_refused(tmp_path: Path) -> None:
    assert search(tmp_path, {"python3": "3.12.1"}, "python3.12") == (
        "", "palpd: python3.12 cannot be run; correct PYTHON, or leave it out", 2
    )  # fmt: skip


def test_a_machine_without_any_wheel_of_ur_rtde_takes_any_python(tmp_path: Path) -> None:
    printed, message, code = search(tmp_path, {"python3": "3.13.0", "python3.12": "3.12.1"}, machine="aarch64")
    assert (printed, code) == ("python3", 0)
    assert "ur-rtde has no wheel" in message
