"""Heavy work of the page, outside of its server: each piece is a command of palpd in a process of low priority and bounded time.

The server imports nothing that computes. So it stays small, a refusal has the words of the terminal, and a diagnosis can be cancelled.
"""

import asyncio
import contextlib
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import deque
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, Literal

from palpd.documents import read_json
from palpd.errors import BadInput, PalpdError, Refused
from palpd.workers import beside

NICENESS = 15
"""Niceness of a child: the loop, the service and the server all come first."""
MOST_AT_ONCE = 2
"""Children that compute at the same time; others wait for their turn."""
MOST_WAITING = 10
"""Children that wait for their turn. A further one is refused: many reloads of a page must not become a queue of an hour."""
MOST_KEPT = 40
"""Children that are over and still known, with their files: those of an operator's last minutes."""
KEPT_LINES = 5
"""Last lines of stderr that are kept: the refusal stands in the last one."""
END_S = 2.0
"""Time that a child may take to end by itself before it is killed."""
OUT = "out.json"
"""File that a command writes its figures to, in its folder."""
WORDS = "palpd: "
"""Begins the sentence of a refusal on stderr."""

State = Literal["waiting", "running", "done", "refused", "stopped", "cancelled", "failed"]
OVER: tuple[State, ...] = ("done", "refused", "stopped", "cancelled", "failed")


@dataclass
class Child:
    """A command under way or over.

    Attributes:
        number: Number by which a page asks for it.
        name: What it does, for people.
        key: What it is about, with the stamps of the files that it reads.
        words: The command line behind `palpd`; its files stand in `folder`.
        limit_s: Longest time that it may run.
        folder: A folder of its own, which is gone when it is forgotten.
        state: How far it is.
        step: What it computes now.
        sentence: Why it is over, if not done.
        begun_s: Monotonic time of its begin, None while it waits.
        ended_s: Monotonic time of its end, None before that.
        over: Is set when it is over.
    """

    number: int
    name: str
    key: tuple[Any, ...]
    words: tuple[str, ...]
    limit_s: float
    folder: Path
    state: State = "waiting"
    step: str = ""
    sentence: str = ""
    begun_s: float | None = None
    ended_s: float | None = None
    over: asyncio.Event = field(default_factory=asyncio.Event)
    _task: asyncio.Task[None] | None = None

    @property
    def as_json(self) -> dict[str, Any]:
        """How far it is, for the page."""
        elapsed_s = 0.0 if self.begun_s is None else (self.ended_s or time.monotonic()) - self.begun_s
        return {
            "number": self.number,
            "name": self.name,
            "state": self.state,
            "step": self.step,
            "sentence": self.sentence,
            "elapsed_s": round(elapsed_s, 1),
            "limit_s": self.limit_s,
        }

    def refuse_unless_done(self) -> None:
        """Refuse to use what is not there.

        Raises:
            Refused: It is not over yet.
            BadInput: It was refused, stopped or cancelled; the sentence is its own.
        """
        if self.state not in OVER:
            raise Refused(f"{self.name} is not over yet ({self.step or self.state}); wait for it, or cancel it")
        if self.state != "done":
            raise BadInput(self.sentence)

    def result(self) -> Any:
        """What it has written with `--json out.json`, also where it was stopped. Raises Refused or BadInput as `refuse_unless_done`."""
        if not (self.state == "stopped" and (self.folder / OUT).exists()):
            self.refuse_unless_done()
        return read_json(self.folder / OUT)


class Children:
    """The commands that a page has asked for. All methods are called in the server's event loop."""

    def __init__(self, program: Sequence[str] | None = None) -> None:
        """Make a keeper of commands.

        Args:
            program: What runs them; palpd where not given, which then ends with this process.
        """
        self._program = tuple(program or beside("palpd"))
        self._numbers = count(1)
        self._children: dict[int, Child] = {}
        self._turn = asyncio.Semaphore(MOST_AT_ONCE)

    def begin(
        self, name: str, key: tuple[Any, ...], words: Sequence[str], *, limit_s: float, files: Mapping[str, str] | None = None
    ) -> Child:
        """Begin a command, or join the same one that is under way or done.

        Args:
            name: What it does, for people.
            key: What it is about; whoever asks with the same key gets the same child.
            words: The command line behind `palpd`. It runs in its folder, so files that it writes are named without one.
            limit_s: Longest time that it may run.
            files: Text files that it reads, by name; None for none.

        Raises:
            Refused: Too many wait already.
            BadInput: A word is no text of a command line, or its folder cannot be made.
        """
        for child in self._children.values():
            if child.key == key and child.state in ("waiting", "running", "done"):
                return child
        if any("\0" in word for word in words):
            raise BadInput("a text holds '\\x00', which no command can be given; remove it")
        if sum(child.state == "waiting" for child in self._children.values()) >= MOST_WAITING:
            raise Refused(f"{MOST_WAITING} calculations wait for their turn already; wait for them, or cancel some")
        self._forget()
        number = next(self._numbers)
        folder = Path(tempfile.gettempdir()) / f"palpd-{os.getpid()}-{os.urandom(4).hex()}-{number}"
        try:
            folder.mkdir(mode=0o700)
            for file, text in (files or {}).items():
                (folder / file).write_text(text, encoding="utf-8", errors="surrogateescape")
        except (OSError, UnicodeEncodeError) as error:
            shutil.rmtree(folder, ignore_errors=True)
            reason = error.strerror if isinstance(error, OSError) else "a letter that no file can hold"
            raise BadInput(f"{folder} cannot be written ({reason}); make room, or correct the text") from error
        child = Child(number, name, key, tuple(words), limit_s, folder)
        self._children[number] = child
        child._task = asyncio.create_task(self._carry_out(child))  # noqa: SLF001 - the keeper owns its children
        return child

    def numbered(self, number: int) -> Child:
        """The child of that number. Raises BadInput where there is none any more."""
        if number not in self._children:
            raise BadInput(f"there is no calculation {number} any more; begin it again")
        return self._children[number]

    def cancel(self, number: int) -> Child:
        """End a child now; one that is over stays as it is. Raises BadInput where there is none."""
        child = self.numbered(number)
        if child.state not in OVER and child._task is not None:  # noqa: SLF001
            self._end(child, "cancelled", f"{child.name} was cancelled")
            child._task.cancel()  # noqa: SLF001
        return child

    async def close(self) -> None:
        """End all children, and remove their files."""
        for number in list(self._children):
            self.cancel(number)
        tasks = [child._task for child in self._children.values() if child._task is not None]  # noqa: SLF001
        await asyncio.gather(*tasks, return_exceptions=True)
        for child in self._children.values():
            shutil.rmtree(child.folder, ignore_errors=True)

    def _forget(self) -> None:
        """Forget the oldest that are over, with their files."""
        ended = [child for child in self._children.values() if child.state in OVER]
        for child in ended[: max(0, len(ended) - MOST_KEPT + 1)]:
            del self._children[child.number]
            shutil.rmtree(child.folder, ignore_errors=True)

    async def _carry_out(self, child: Child) -> None:
        try:
            async with self._turn:
                if child.state in OVER:
                    return
                child.state, child.begun_s = "running", time.monotonic()
                await self._run(child)
        except asyncio.CancelledError:
            self._end(child, "cancelled", f"{child.name} was cancelled")
        except OSError as error:
            self._end(child, "failed", f"{child.name} could not begin ({error.strerror}); try again")
        except PalpdError as error:
            self._end(child, "failed", str(error))

    async def _run(self, child: Child) -> None:
        import_path = os.pathsep.join(filter(None, sys.path))  # the child runs in its own folder, and finds the same palpd
        start = asyncio.ensure_future(
            asyncio.create_subprocess_exec(
                *self._program,
                *child.words,
                cwd=child.folder,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=asyncio.subprocess.PIPE,
                start_new_session=True,
                env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": import_path},
            )
        )
        try:
            process = await asyncio.shield(start)
        except asyncio.CancelledError:  # unshielded it would kill the child and leave what the child has started
            await _gone(await start)
            raise
        with contextlib.suppress(OSError):  # it has ended already
            os.setpriority(os.PRIO_PROCESS, process.pid, NICENESS)
        lines: deque[str] = deque(maxlen=KEPT_LINES)
        try:
            async with asyncio.timeout(child.limit_s):
                assert process.stderr is not None
                async for line in _lines(process.stderr):
                    lines.append(line)
                    if not line.startswith(WORDS):
                        child.step = line
                code = await process.wait()
        except TimeoutError:
            self._end(child, "failed", f"{child.name} took more than {child.limit_s:g} s, expected less; it was ended")
        else:
            sentence = next((line.removeprefix(WORDS) for line in reversed(lines) if line.startswith(WORDS)), "")
            if code == 0:
                self._end(child, "done", "")
            elif code in (2, 3):
                self._end(child, "refused" if code == 2 else "stopped", sentence)
            else:
                end = f"by signal {-code}" if code < 0 else f"with code {code}"
                self._end(child, "failed", f"{child.name} ended {end} ({' '.join(lines)[-300:] or 'without a word'}); try again")
        finally:
            await _gone(process)

    def _end(self, child: Child, state: State, sentence: str) -> None:
        if child.state not in OVER:
            child.state, child.sentence, child.ended_s = state, sentence, time.monotonic()
            child.over.set()


async def _lines(stream: asyncio.StreamReader) -> AsyncIterator[str]:
    """The lines of a stream as text; one that is too long is cut."""
    while True:
        try:
            line = await stream.readline()
        except ValueError:  # longer than the stream's buffer
            continue
        if not line:
            return
        yield line.decode("utf-8", "replace").rstrip()


async def _gone(process: asyncio.subprocess.Process) -> None:
    """End a process and all that it has started: first politely, so that it removes half-written files."""
    end = asyncio.ensure_future(process.wait())
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        # asyncio.timeout would not do: before Python 3.11.3 it raises CancelledError for TimeoutError in a task that was cancelled
        await asyncio.wait([end], timeout=END_S)
    end.cancel()
