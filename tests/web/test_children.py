"""Commands of the page: in bounded number and time, cancelled at once, refused in the words of the terminal, and gone with the page."""

import asyncio
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from palpd.errors import BadInput, PalpdError, Refused
from palpd.web import children as module
from palpd.web.children import Child, Children

PYTHON = (sys.executable, "-S", "-c")
WRITES = "open('out.json', 'w').write('{\"answer\": 42}')"
SLEEPS = "import time; time.sleep(60)"


def carried_out(work: Callable[[Children], Awaitable[None]]) -> None:
    """Run a test in an event loop, and end all commands after it."""

    async def whole() -> None:
        children = Children(PYTHON)
        try:
            await work(children)
        finally:
            await children.close()

    asyncio.run(whole())


async def answered(children: Children, *what: Any, **limits: Any) -> Child:
    """Begin a command and wait for its end."""
    child = children.begin(*what, **limits)
    await child.over.wait()
    return child


def is_alive(process: str) -> bool:
    """Whether a process still runs; one that has ended may wait for its parent."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


async def until_running(child: Child) -> None:
    while child.state == "waiting" or not (child.folder / "begun").exists():
        await asyncio.sleep(0.01)


def test_a_command_that_is_done_has_its_figures_and_its_folder_is_gone_with_the_page() -> None:
    folders: list[Path] = []

    async def work(children: Children) -> None:
        child = await answered(children, "sum", ("a",), [f"print(open('in.txt').read()); {WRITES}"], limit_s=60, files={"in.txt": "x"})
        assert (child.state, child.result()) == ("done", {"answer": 42})
        assert child.folder.stat().st_mode & 0o077 == 0
        folders.append(child.folder)

    carried_out(work)
    assert not folders[0].exists()


@pytest.mark.parametrize(("code", "state"), [(2, "refused"), (3, "stopped")])
def test_a_refusal_is_the_sentence_of_the_terminal(code: int, state: str) -> None:
    script = f"import sys; print('step', file=sys.stderr); print('palpd: the plan is wrong; correct it', file=sys.stderr); sys.exit({code})"

    async def work(children: Children) -> None:
        child = await answered(children, "check", ("a",), [script], limit_s=60)
        assert (child.state, child.sentence, child.step) == (state, "the plan is wrong; correct it", "step")
        with pytest.raises(BadInput, match="the plan is wrong"):
            child.result()

    carried_out(work)


def test_a_command_that_dies_is_a_sentence_too() -> None:
    async def work(children: Children) -> None:
        died = await answered(children, "sum", ("a",), ["import os; os.kill(os.getpid(), 9)"], limit_s=60)
        assert (died.state, died.sentence) == ("failed", "sum ended by signal 9 (without a word); try again")
        broken = await answered(children, "sum", ("b",), ["1 / 0"], limit_s=60)
        assert "sum ended with code 1" in broken.sentence
        assert "ZeroDivisionError" in broken.sentence

    carried_out(work)


FAMILY = f"import os, signal; os.fork(); signal.signal(15, signal.SIG_IGN); open(f'{{os.getpid()}}.pid', 'w'); open('begun', 'w'); {SLEEPS}"
"""Two processes that ignore SIGTERM."""


async def until_gone_when_cancelled(children: Children, child: Child) -> None:
    while len(processes := [file.stem for file in child.folder.glob("*.pid")]) < 2:
        await asyncio.sleep(0.01)
    assert children.cancel(child.number).state == "cancelled"
    assert child.as_json["sentence"] == "sum was cancelled"
    while child._task is not None and not child._task.done():
        await asyncio.sleep(0.01)
    async with asyncio.timeout(30.0):  # a process that was killed still ends by itself, when a processor takes it up
        while any(map(is_alive, processes)):
            await asyncio.sleep(0.01)


def test_a_command_is_cancelled_with_all_that_it_has_started() -> None:
    async def work(children: Children) -> None:
        child = children.begin("sum", ("a",), [FAMILY], limit_s=60)
        await until_gone_when_cancelled(children, child)
        assert children.cancel(child.number).state == "cancelled", "once more changes nothing"

    carried_out(work)


def test_a_command_is_cancelled_with_all_that_it_has_started_while_it_still_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    really_begin = asyncio.create_subprocess_exec

    async def begin(*words: str, **options: Any) -> asyncio.subprocess.Process:
        process = await really_begin(*words, **options)
        await asyncio.sleep(1.0)  # a busy machine: the child is faster than the server that awaits its begin
        return process

    async def work(children: Children) -> None:
        monkeypatch.setattr(module.asyncio, "create_subprocess_exec", begin)
        await until_gone_when_cancelled(children, children.begin("sum", ("a",), [FAMILY], limit_s=60))

    carried_out(work)


def test_a_command_that_takes_too_long_is_ended() -> None:
    async def work(children: Children) -> None:
        child = await answered(children, "sum", ("a",), [SLEEPS], limit_s=0.3)
        assert (child.state, child.sentence) == ("failed", "sum took more than 0.3 s, expected less; it was ended")

    carried_out(work)


def test_the_same_wish_joins_the_first_and_a_crowd_waits_or_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_WAITING", 2)

    async def work(children: Children) -> None:
        running = [children.begin("sum", (name,), [f"open('begun', 'w'); {SLEEPS}"], limit_s=60) for name in "ab"]
        for child in running:
            await until_running(child)
        assert children.begin("sum", ("a",), ["anything"], limit_s=60) is running[0]
        waiting = [children.begin("sum", (name,), [WRITES], limit_s=60) for name in "cd"]
        assert [child.state for child in waiting] == ["waiting", "waiting"]
        with pytest.raises(Refused, match="2 calculations wait for their turn already"):
            children.begin("sum", ("e",), [WRITES], limit_s=60)
        with pytest.raises(Refused, match="sum is not over yet"):
            waiting[0].result()
        children.cancel(running[0].number)
        await waiting[0].over.wait()
        assert waiting[0].state == "done"

    carried_out(work)


def test_words_and_texts_that_no_command_can_be_given_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(children: Children) -> None:
        with pytest.raises(BadInput, match="which no command can be given"):
            children.begin("sum", ("a",), ["a\0b"], limit_s=60)
        with pytest.raises(BadInput, match="a letter that no file can hold"):
            children.begin("sum", ("a",), [WRITES], limit_s=60, files={"plan.yaml": "\ud800"})
        monkeypatch.setattr(module.tempfile, "gettempdir", lambda: "/proc/absent")
        with pytest.raises(BadInput, match="cannot be written"):
            children.begin("sum", ("a",), [WRITES], limit_s=60)
        with pytest.raises(BadInput, match="there is no calculation 7 any more"):
            children.numbered(7)

    carried_out(work)


def test_only_the_last_commands_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_KEPT", 2)

    async def work(children: Children) -> None:
        for name in "abc":
            await answered(children, "sum", (name,), [WRITES], limit_s=60)
        with pytest.raises(PalpdError, match="begin it again"):
            children.numbered(1)
        assert children.numbered(3).state == "done"

    carried_out(work)
