"""The ring and its control block."""

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from palpd.errors import PalpdError
from palpd.recording.ring import LoopState, Ring
from palpd.testing.processes import over_and_over
from palpd.tick import ROW, Request

CAPACITY = 8


@pytest.fixture
def ring() -> Iterator[Ring]:
    with closing(Ring.create(rate_Hz=CAPACITY, seconds=1.0)) as ring:
        yield ring


def put(ring: Ring, *numbers: int) -> None:
    for number in numbers:
        ring.rows[ring.begin()]["index"] = number
        ring.publish()


def test_rows_come_out_whole_and_in_order_in_another_mapping(ring: Ring) -> None:
    rng = np.random.default_rng(0)
    rows = np.frombuffer(rng.bytes(ROW.itemsize * 5), ROW)
    reader = Ring.attach(ring.name)
    for row in rows:
        ring.write(row)
    got, cursor, lost = reader.read(0)
    reader.close()
    assert got.tobytes() == rows.tobytes()
    assert (cursor, lost) == (5, 0)


def test_each_reader_has_its_own_cursor(ring: Ring) -> None:
    put(ring, 10, 11)
    _, early, _ = ring.read(0)
    put(ring, 12)
    assert ring.read(early)[0]["index"].tolist() == [12]
    assert ring.read(0)[0]["index"].tolist() == [10, 11, 12]
    assert ring.read(3)[0].size == 0


def test_a_slow_reader_loses_the_oldest_rows_and_learns_how_many(ring: Ring) -> None:
    put(ring, *range(CAPACITY + 5))
    rows, cursor, lost = ring.read(0)
    assert rows["index"].tolist() == list(range(5, CAPACITY + 5))
    assert (cursor, lost) == (CAPACITY + 5, 5)


def test_a_row_that_is_being_overwritten_is_lost_and_not_read_torn(ring: Ring) -> None:
    put(ring, *range(CAPACITY))
    ring.rows[ring.begin()]["index"] = 99  # begun, not published
    rows, cursor, lost = ring.read(0)
    assert rows["index"].tolist() == list(range(1, CAPACITY))
    assert (cursor, lost) == (CAPACITY, 1)


def test_a_row_begun_by_a_process_that_died_is_never_seen(ring: Ring) -> None:
    put(ring, 1)
    ring.rows[ring.begin()]["index"] = 99
    successor = Ring.attach(ring.name)
    put(successor, 2)
    successor.close()
    assert ring.read(0)[0]["index"].tolist() == [1, 2]


def test_no_torn_row_is_ever_returned_while_the_producer_runs_away(ring: Ring) -> None:
    row, numbers = np.zeros((), ROW), count(1)

    def produce() -> None:
        row["index"] = row["wrench"] = row["trip_limit"] = next(numbers)
        ring.write(row[()])

    cursor, seen, missed = 0, 0, 0
    with over_and_over(produce):
        while seen < 2000:
            rows, cursor, lost = ring.read(cursor)
            assert (rows["wrench"] == rows["index"][:, None, None]).all()
            assert (rows["trip_limit"] == rows["index"]).all()
            seen, missed = seen + len(rows), missed + lost
            assert seen + missed == cursor


def test_each_request_reaches_the_loop_once(ring: Ring) -> None:
    ring.ask(Request.PAUSE)
    assert [ring.request(), ring.request()] == [Request.PAUSE, Request.NONE]
    ring.ask(Request.PAUSE)
    assert ring.request() == Request.PAUSE


def test_a_later_wish_does_not_overtake_an_abort(ring: Ring) -> None:
    ring.ask(Request.ABORT)
    ring.ask(Request.RESUME)
    assert [ring.request(), ring.request(), ring.request()] == [Request.ABORT, Request.RESUME, Request.NONE]


def test_of_pause_and_resume_in_one_tick_the_newer_counts(ring: Ring) -> None:
    ring.ask(Request.RESUME)
    ring.ask(Request.PAUSE)
    assert [ring.request(), ring.request()] == [Request.PAUSE, Request.NONE]


def test_a_request_meant_for_an_earlier_run_is_void(ring: Ring) -> None:
    ring.ask(Request.ABORT)
    ring.forget_requests()
    assert ring.request() == Request.NONE


def test_the_control_words_are_shared(ring: Ring) -> None:
    other = Ring.attach(ring.name)
    other.state, other.recorder_cursor = LoopState.RUNNING, 0
    put(other, 1, 2, 3)
    assert (ring.state, ring.recorder_lag) == (LoopState.RUNNING, 3)
    other.close()


def test_a_process_that_attached_and_ended_leaves_the_memory_and_says_nothing(ring: Ring) -> None:
    put(ring, 5)
    code = f"from palpd.recording.ring import Ring; print(Ring.attach({ring.name!r}).read(0)[0]['index'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[5]"
    assert done.stderr == ""
    Ring.attach(ring.name).close()


WATCHER = """
import ctypes, signal, sys
from palpd.errors import PalpdError
from palpd.recording.ring import Ring
ring = Ring.watch(sys.argv[1])
print(ring.read(0)[0]["index"].tolist(), flush=True)
address = ring.rows.ctypes.data - 4096
libc = ctypes.CDLL(None, use_errno=True)
print(libc.mprotect(ctypes.c_void_p(address), 4096, 3), ctypes.get_errno(), flush=True)
try:
    ring.aborts = 1
except TypeError:
    print("refused", flush=True)
ctypes.c_uint64.from_address(address + 8 * 16).value = 1
print("written", flush=True)
"""


def test_a_watcher_reads_and_the_kernel_lets_it_write_nothing(ring: Ring) -> None:
    put(ring, 5, 6)
    done = subprocess.run([sys.executable, "-c", WATCHER, ring.name], capture_output=True, text=True, check=False)
    lines = done.stdout.splitlines()
    assert lines[0] == "[5, 6]"
    assert lines[1] == f"-1 {errno.EACCES}", "the file was opened for reading, so the mapping cannot be made writable either"
    assert lines[2:] == ["refused"]
    assert done.returncode == -signal.SIGSEGV, "a store through a bare address ends the watcher"
    assert ring.aborts == 0


def test_others_of_the_group_may_watch_and_nobody_else_may_write(ring: Ring) -> None:
    assert (Path("/dev/shm") / ring.name).stat().st_mode & 0o777 == 0o640


def test_a_ring_that_is_gone_is_refused_with_a_sentence() -> None:
    with pytest.raises(PalpdError, match="start palpd again"):
        Ring.attach("palpd-no-such-ring")


def test_memory_of_another_making_is_refused(ring: Ring) -> None:
    memory = Path("/dev/shm") / ring.name
    with memory.open("r+b") as file:
        file.write(b"\0" * 8)
    with pytest.raises(PalpdError, match="another version"):
        Ring.attach(ring.name)


def test_a_machine_that_may_reorder_stores_is_refused_where_the_ring_is_created(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = f"palpd-{os.getpid()}-*"
    before = set(Path("/dev/shm").glob(mine))
    monkeypatch.setattr("os.uname", lambda: SimpleNamespace(machine="aarch64"))
    with pytest.raises(PalpdError, match="this machine is aarch64, but palpd's shared memory needs the store order of x86_64"):
        Ring.create(125.0)
    assert set(Path("/dev/shm").glob(mine)) == before


def test_a_ring_whose_maker_was_killed_is_swept_away_by_the_next() -> None:
    kill = "import os; from palpd.recording.ring import Ring; print(Ring.create(125.0).name, flush=True); os.killpg(0, 9)"
    child = subprocess.run([sys.executable, "-c", kill], capture_output=True, text=True, start_new_session=True, check=False)
    left = Path("/dev/shm") / child.stdout.strip()
    assert left.name.startswith("palpd-")
    assert left.exists()
    with closing(Ring.create(125.0)) as mine:
        assert not left.exists()
        assert (Path("/dev/shm") / mine.name).exists()
