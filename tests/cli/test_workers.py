"""Commands that compute in several processes: none of these outlives its command, whichever signal ends it."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from palpd.cell.cell_file import nominal, save_cell
from palpd.recording.samples import write_csv
from palpd.testing.processes import family, until
from tests.gap.test_diagnosis import recording
from tests.paths import ROOT

SOON_S = 2.0
"""Longest time from the end of a command to the end of its workers: the kernel ends them at once, a busy machine takes longer to see it."""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with recordings enough for two workers and some seconds."""
    folder = tmp_path_factory.mktemp("fleet")
    write_csv(folder / "0.csv", recording(nominal(), {"tissue.viscoelastic": {"ratio": 0.2, "tau_s": 0.8}}))
    for number in range(1, 8):
        shutil.copy(folder / "0.csv", folder / f"{number}.csv")
    save_cell(folder / "cell.yaml", nominal())
    return folder


@pytest.mark.parametrize(
    ("words", "number"),
    [
        ("diagnose {fleet} --jobs 2", signal.SIGTERM),
        ("diagnose {fleet} --jobs 2", signal.SIGINT),
        ("diagnose {fleet} --jobs 2", signal.SIGKILL),
        ("blind --cases 1 --jobs 1", signal.SIGTERM),
        ("blind --cases 1 --jobs 1", signal.SIGKILL),
    ],
)
def test_no_worker_outlives_its_command(words: str, number: signal.Signals, fleet: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "palpd", *words.format(fleet=fleet).split()]
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True, env=environment
    ) as one:
        until(
            lambda: len(family(one.pid)) > 2 or one.poll() is not None,
            "two workers compute, or the process that diagnoses sealed cases and its own",
        )
        if number == signal.SIGINT:
            os.killpg(one.pid, number)  # as a terminal does
        else:
            one.send_signal(number)
        _, stderr = one.communicate(timeout=10.0)
        until(lambda: not family(one.pid), "no worker is left", SOON_S)
    if number == signal.SIGKILL:
        assert one.returncode == -number
    else:
        assert (one.returncode, stderr) == (128 + number, f"palpd: interrupted by {number.name}\n")


def test_a_module_that_runs_beside_a_process_is_gone_when_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "sleeps.py").write_text("import os, sys, time; print(os.getpid(), *sys.argv[1:], flush=True); time.sleep(600)")
    starting = "import subprocess; from palpd.workers import beside; subprocess.run(beside('sleeps', 'an argument'))"
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{tmp_path}"}
    with subprocess.Popen(
        [sys.executable, "-c", starting], stdout=subprocess.PIPE, text=True, start_new_session=True, env=environment
    ) as one:
        assert one.stdout is not None
        pid, *arguments = one.stdout.readline().split()
        assert (int(pid) in family(one.pid), arguments) == (True, ["an", "argument"])
        one.kill()
        until(lambda: not family(one.pid), "what ran beside it is gone", SOON_S)


def test_a_module_whose_process_has_died_before_never_begins() -> None:
    gone = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True, check=True
    ).stdout.strip()
    done = subprocess.run([sys.executable, "-m", "palpd.workers", gone, "this"], capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stdout) == (1, "")
