"""A set-up in the page: `palpd setup --talk` as a child of the server. What it says and asks is kept, so that a reload shows all of it."""

import asyncio
import contextlib
import json
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from signal import SIGTERM
from typing import Any

from palpd.daemon.socket_client import ControlAnswer
from palpd.errors import Refused
from palpd.web.log import log

END_S = 5.0
"""Longest wait for the end of a child that was interrupted: its run takes a second to stop and to close its recording."""


class SetupTalk:
    """One set-up at a time; its methods are called in the server's event loop. `lines` are what was said, asked and answered so far.

    The child ends with the server: the kernel sends it SIGTERM when this process is gone (`palpd setup --talk`).
    """

    def __init__(self, folder: Path | None, publish: Callable[[dict[str, Any]], None]) -> None:
        """Keep a set-up of a folder, or none; `publish` takes the event that all pages hear."""
        self.folder, self._publish = folder, publish
        self.lines: list[dict[str, Any]] = []
        self._asked: int | None = None
        self._process: subprocess.Popen[str] | None = None
        self._over = asyncio.Event()

    @property
    def event(self) -> dict[str, Any]:
        """Whether a set-up is under way, how many lines there are, and the number of the line that waits for an answer."""
        offered, under_way = self.folder is not None, self._process is not None
        return {"event": "setup", "offered": offered, "under_way": under_way, "lines": len(self.lines), "asked": self._asked}

    def begin(self, redo: str) -> None:
        """Begin, or go on where it ended; `redo` is a step to do again, or empty. Raises Refused where one is under way or none is led."""
        if self.folder is None:
            raise Refused("this page leads through no set-up; start it with palpd setup CELL --page")
        if self._process is not None:
            raise Refused("a set-up is under way already; answer its question, or abort it")
        words = ["setup", "--talk", *([f"--redo={redo}"] if redo else []), "--", str(self.folder)]  # a list: no shell reads them
        try:
            command, pipe = [sys.executable, "-m", "palpd", *words], subprocess.PIPE
            # in a session of its own: Ctrl-C at this server's terminal ends the server, which ends the child
            process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT, text=True, errors="replace", start_new_session=True
            )
        except (OSError, ValueError) as error:
            raise Refused(f"palpd setup cannot be started ({error}); try again") from error
        self._process, self._over = process, asyncio.Event()
        self._add({"begun": f"palpd setup {self.folder}{f' --redo {redo}' if redo else ''}"})
        threading.Thread(target=self._listen, args=(process, asyncio.get_running_loop()), daemon=True, name="setup").start()

    def answer(self, number: int, question: str, text: str) -> None:
        """Pass an answer to the question of that line and text.

        Raises:
            Refused: It is not asked now: another browser has answered it, or it was pressed twice.
        """
        process = self._process
        if process is None or process.stdin is None or self._asked != number or self.lines[number]["ask"] != question:
            raise Refused(f"question {number} is not asked any more, so nothing was answered; look at the one that is open")
        with contextlib.suppress(OSError):  # it has just ended, and says so itself
            process.stdin.write(json.dumps({"answer": text}) + "\n")
            process.stdin.flush()
        self._asked = None
        self._add({"answered": text})

    async def interrupt(self) -> ControlAnswer | None:
        """Interrupt it as Ctrl-C does at a terminal, so that its run ends in a stop; the answer to an abort, None where there was none."""
        if self._process is None:
            return None
        over = self._over
        self._process.send_signal(SIGTERM)  # not SIGINT, which a child of a shell's background job may ignore
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(over.wait(), END_S)
        if over.is_set():
            return {"ok": True, "state": "the set-up has ended"}
        return {"ok": False, "error": f"the set-up was interrupted, and has not ended within {END_S:g} s; use the emergency stop"}

    def _listen(self, process: "subprocess.Popen[str]", loop: asyncio.AbstractEventLoop) -> None:
        with contextlib.suppress(RuntimeError):  # the server has ended
            for line in process.stdout or ():
                loop.call_soon_threadsafe(self._hear, line)
            loop.call_soon_threadsafe(self._end, process.wait())

    def _hear(self, line: str) -> None:
        if not line.strip():
            return
        # whatever is no object is a refusal on stderr, or what a library prints
        content = json.loads(line) if line.startswith('{"') else {"refused": line.strip().removeprefix("palpd: ")}
        self._asked = len(self.lines) if "ask" in content else None
        self._add(content)

    def _end(self, code: int) -> None:
        self._process = self._asked = None
        self._over.set()
        log("set-up ended", code=code)
        self._add({"ended": code})

    def _add(self, line: dict[str, Any]) -> None:
        self.lines.append(line)
        self._publish(self.event)
