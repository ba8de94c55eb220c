"""How the last run ended, and what each next command then does, over emulated wires: the table of docs/safety.md.

python -m benchmarks.after_a_run --docs docs
"""

import argparse
import itertools
import os
import signal
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path

from benchmarks.marked_text import parted, write_marked
from palpd.errors import Refused
from palpd.testing.emulated_cell import PATIENT, PRESS, EmulatedCell, emulated_cell, retry_if_machine_stalled
from palpd.testing.operator import Operator
from palpd.testing.processes import command_of, family, until
from palpd.testing.served_cell import ServedCell, served

SOFT_N_PER_M, HARD_N_PER_M = 1000.0, 8000.0
SIDE_BY_SIDE = 3
"""Emulated cells at a time."""
PAGE, MARK = "safety.md", "after-a-run"


# --- how a run ends ---------------------------------------------------------------------------------------------------------------


def _done(service: ServedCell) -> None:
    Operator(service.do).arm()
    service.do("start", plan=PRESS | {"depths_m": [0.002]})
    service.until_idle()


def _contact_limit(service: ServedCell) -> None:
    Operator(service.do).arm()
    service.do("start", plan=PRESS | {"depths_m": [0.02]})
    until(lambda: (now := service.status()).get("phase") == "baseline" and now["depth_m"] is not None, "the surface is found", every_s=0.02)
    service.cell.wall(0.003, HARD_N_PER_M)
    service.until_idle()


def _abort(service: ServedCell) -> None:
    service.press()
    service.do("abort")
    service.until_idle()


def _latched(service: ServedCell) -> None:
    service.press()
    service.cell.wires.ask("silent", s=1.0)
    service.until_idle()
    time.sleep(1.0)


def _motion_killed(service: ServedCell) -> None:
    service.press()
    for pid in family(service.process.pid):
        if "spawn_main" in command_of(pid):
            os.kill(pid, signal.SIGKILL)
    service.until_idle()


def _service_killed(service: ServedCell) -> None:
    service.press()
    service.end(signal.SIGKILL)
    time.sleep(2.0)
    service.begin()


def _power_lost(service: ServedCell) -> None:
    service.press()
    os.killpg(service.process.pid, signal.SIGKILL)
    service.process.wait()
    time.sleep(2.0)
    service.begin()


ENDS: Mapping[str, Callable[[ServedCell], None]] = {
    "done": _done,
    "contact limit": _contact_limit,
    "abort": _abort,
    "latched stop": _latched,
    "motion process killed": _motion_killed,
    "service killed": _service_killed,
    "power lost": _power_lost,
}

# --- what comes next --------------------------------------------------------------------------------------------------------------


def _why(refused: str) -> str:
    """A refusal, in a word."""
    words = {
        "the probe is pressed": "refused: pressed",
        "is not known": "refused: unknown",
        "the last run was stopped": "refused: latched",
        "is disarmed": "refused: disarmed",
        "is clear of the tissue": "refused: free",
    }
    return next((short for phrase, short in words.items() if phrase in refused), f"refused: {refused}")


def _outcome(act: Callable[[], str]) -> str:
    try:
        return act()
    except Refused as refused:
        return _why(str(refused))


def _arm(service: ServedCell) -> str:
    return str(service.do("arm")["state"])


def _start(service: ServedCell) -> str:
    service.do("start", plan=PRESS | {"depths_m": [0.002]})
    last = service.until_idle()
    return "runs" if last["verdict"] == "done" else f"{last['verdict']}: {last['reason']}"


def _calibrate(service: ServedCell) -> str:
    job = service.program("calibrate")
    return "kept" if job["verdict"] == "done" else _why(job["reason"])


def _take_reference(service: ServedCell) -> str:
    daemon = service.cell.run(PRESS | {"depths_m": [0.002]})
    code = daemon.wait()
    return "runs" if code == 0 else _why(daemon.stderr)


def _doctor(service: ServedCell) -> str:
    findings = service.program("doctor", watch_s=1.0)["result"]["findings"]
    finding = next(one for one in findings if one["name"] == "probe free")
    return str(finding["figures"]["state"])


def _retract(service: ServedCell) -> str:
    service.do("retract")
    last = service.until_idle()
    if last["verdict"] == "done":
        return f"leaves the tissue, then {service.status()['probe']['state']}"
    return _why(last["reason"])


def _clear(service: ServedCell) -> str:
    service.do("clear")
    return f"clears the latch; {service.status()['probe']['state']}"


def _map(service: ServedCell) -> str:
    with suppress(Refused):
        service.do("arm")
    job = service.program("map", most_presses=1, depth_m=0.002, width_m=0.01, height_m=0.01)
    return "runs" if job["verdict"] == "done" else _why(job["reason"])


COMMANDS: Mapping[str, Callable[[ServedCell], str]] = {
    "doctor": _doctor,
    "arm": _arm,
    "start": _start,
    "calibrate": _calibrate,
    "run --take-reference": _take_reference,
    "clear": _clear,
    "map": _map,
    "retract": _retract,
}


def row(wired: EmulatedCell, end: str, commands: tuple[str, ...] = tuple(COMMANDS)) -> dict[str, str]:
    """End a run in that way, and try the commands one after the other in the state that it left.

    Args:
        wired: The emulated cell.
        end: Name of the end.
        commands: Which commands to try, in this order.

    Returns:
        What each did.
    """
    with served(wired) as service:
        ENDS[end](service)
        return {command: _outcome(lambda command=command: COMMANDS[command](service)) for command in commands}  # type: ignore[misc]


def filled(folder: Path, known: Mapping[str, Mapping[str, str]] | None = None) -> dict[str, dict[str, str]]:
    """Fill the table: every end in an emulated cell of its own, some of them side by side, since they mostly wait.

    Args:
        folder: Where the cells keep their files.
        known: The rows as they were before. A row that differs is made again where the machine stood still meanwhile; None: no row is.

    Returns:
        What each command did, by the end before it.
    """

    def filled_row(end: str) -> dict[str, str]:
        own = folder / end.replace(" ", "-")
        with ExitStack() as stack:
            attempts = itertools.count()

            def cell() -> EmulatedCell:
                wires, run = own / f"wires-{(k := next(attempts))}", own / f"run-{k}"
                wires.mkdir(parents=True)
                run.mkdir()
                return stack.enter_context(emulated_cell(wires)).anew(run, SOFT_N_PER_M, **PATIENT)

            def attempt(wired: EmulatedCell) -> dict[str, str]:
                try:
                    cells = row(wired, end)
                except Refused as refused:
                    raise AssertionError(f"{end}: {refused}") from refused
                print(end, cells, flush=True)
                assert known is None or cells == known[end], f"{end}: {cells}, expected {known[end]}"
                return cells

            return retry_if_machine_stalled(cell, attempt)

    with ThreadPoolExecutor(SIDE_BY_SIDE) as threads:
        return dict(zip(ENDS, threads.map(filled_row, ENDS), strict=True))


def table(rows: Mapping[str, Mapping[str, str]]) -> str:
    """The rows as Markdown."""
    lines = [f"| the last run ended by | {' | '.join(COMMANDS)} |", f"|---{'|---' * len(COMMANDS)}|"]
    return "\n".join([*lines, *(f"| {end} | {' | '.join(row[command] for command in COMMANDS)} |" for end, row in rows.items())])


def rows_of(page: str) -> dict[str, dict[str, str]]:
    """The rows of a page that holds the table."""
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in parted(page, MARK)[1].splitlines()]
    return {row[0]: dict(zip(cells[0][1:], row[1:], strict=True)) for row in cells[2:]}


def main() -> None:
    """Fill the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--docs", type=Path, help="folder of the pages; the table is written into it")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = filled(Path(folder))
    print(table(rows))
    if arguments.docs is not None:
        write_marked(arguments.docs / PAGE, MARK, table(rows))


if __name__ == "__main__":
    main()
