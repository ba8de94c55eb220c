"""Signals in a process of its own: what is printed, and the exit code."""

import signal
import subprocess
import sys

from palpd.daemon import interrupts
from tests.paths import ROOT

PATIENCE_S = 60.0


def _ended(code: str) -> tuple[int, str]:
    # A shell ignores SIGINT in what it runs in the background, and palpd leaves an ignored signal ignored.
    default = "for number in interrupts.SIGNALS: signal.signal(number, signal.SIG_DFL)"
    lines = f"import os, signal\nfrom palpd.daemon import interrupts\n{default}\ninterrupts.listen()\n{code}"
    done = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, cwd=ROOT, check=False, timeout=PATIENCE_S)
    return done.returncode, done.stderr


def test_code_that_swallows_every_exception_ends_all_the_same() -> None:
    swallowing = "while True:\n  try: os.kill(os.getpid(), signal.SIGINT)\n  except BaseException: pass"
    assert _ended(swallowing) == (130, "palpd: interrupted by SIGINT\n")


def test_a_signal_within_a_destructor_ends_the_process_without_a_traceback() -> None:
    dying = "import time\nclass Dying:\n  def __del__(self): os.kill(os.getpid(), signal.SIGINT)\nDying()\ntime.sleep(30)"
    assert _ended(dying) == (130, "palpd: interrupted by SIGINT\n")


def test_what_else_goes_wrong_in_a_destructor_is_still_printed() -> None:
    code, stderr = _ended("class Dying:\n  def __del__(self): raise ValueError('a defect')\nDying()")
    assert code == 0
    assert "ValueError: a defect" in stderr


def test_a_signal_that_was_ignored_stays_ignored() -> None:
    lines = "signal.signal(signal.SIGHUP, signal.SIG_IGN)\ninterrupts.listen()\nos.kill(os.getpid(), signal.SIGHUP)\nprint('on')"
    done = subprocess.run(
        [sys.executable, "-c", f"import os, signal\nfrom palpd.daemon import interrupts\n{lines}"],
        capture_output=True, text=True, cwd=ROOT, check=True,
    )  # fmt: skip
    assert done.stdout == "on\n"


def test_during_a_job_a_signal_raises_nothing_and_a_second_one_changes_nothing() -> None:
    body = "heard = []\nwith interrupts.held(lambda: heard.append(interrupts.received())):\n"
    body += "  for number in (signal.SIGTERM, signal.SIGINT): os.kill(os.getpid(), number)\nassert heard == ['SIGTERM'] * 2"
    assert _ended(body) == (0, "")


def test_a_child_inherits_that_the_signals_wait() -> None:
    with interrupts.shielded():
        command = "import signal; print(sorted(signal.pthread_sigmask(signal.SIG_BLOCK, ())) == [1, 2, 15])"
        done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
    assert not set(interrupts.SIGNALS) & signal.pthread_sigmask(signal.SIG_BLOCK, ())
