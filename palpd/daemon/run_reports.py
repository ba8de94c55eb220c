"""Starts the process that looks back at a run when it is over (`palpd.history.after_run`). Nothing here waits for it."""

import subprocess
import sys
from collections import deque
from contextlib import suppress
from pathlib import Path

MODULE = "palpd.history.after_run"


def begin_report(recording: Path, folder: Path, *, stays: bool = False) -> subprocess.Popen[bytes]:
    """Start to write the report of a run.

    Args:
        folder: The folder of the runs, for the catalogue.
        stays: Whether the starting process stays and shows its sentences; else the process is on its own, and palpd report says what fails.

    Returns:
        The process.
    """
    return subprocess.Popen(
        [sys.executable, "-m", MODULE, str(recording.absolute()), str(folder.absolute())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=None if stays else subprocess.DEVNULL,
        start_new_session=not stays,  # a Ctrl-C in the terminal, or its end, is not meant for it
    )


class RunReports:
    """The reports of a service: written one after the other, and only while nothing runs. `poll` never waits."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._waiting: deque[Path] = deque()
        self._process: subprocess.Popen[bytes] | None = None
        self._called_off = False

    def add(self, recording: Path) -> None:
        """Write the report of this recording as soon as nothing runs."""
        self._waiting.append(recording)

    def poll(self, *, busy: bool) -> None:
        """Start the next report, or call the present one off: it is written after the run that begins now.

        Args:
            busy: Whether a run or a check of the devices is under way.
        """
        if self._process is not None:
            if busy and not self._called_off:
                self._process.terminate()
                self._called_off = True
            if self._process.poll() is None:
                return
            if not self._called_off:
                self._waiting.popleft()
            self._process, self._called_off = None, False
        if self._waiting and not busy:
            with suppress(OSError):  # this computer starts no process now; the next poll tries again
                self._process = begin_report(self._waiting[0], self._folder, stays=True)

    def close(self) -> None:
        """Call off what is being written; palpd report makes it at any time."""
        self._waiting.clear()
        if self._process is not None:
            self._process.terminate()
            self._process = None
