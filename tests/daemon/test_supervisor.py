"""The states of a job: each row of the table in ARCHITECTURE.md is walked with a fake motion process, recorder and clock."""

import re
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import pytest

from palpd.config import Plan, PlanSite, parse_config
from palpd.control.loop import Outcome
from palpd.control.plan_place import PlanPlace
from palpd.control.probe_state import ProbeAnswer, ProbeState
from palpd.daemon import supervisor
from palpd.daemon.motion_job import Job
from palpd.daemon.motion_process import CALLED_OFF, GO, Ended, Failed, Message, Observed, Opened
from palpd.daemon.supervisor import Closed, Happened, JobRun, Overdue, Report, Stage
from palpd.errors import PalpdError, RecordingError, Refused
from palpd.recording.ring import LoopState, RecorderState, Ring
from palpd.tick import Request
from tests.paths import ROOT

STEP_S = 0.1
LONG_S = 70.0
"""Longer than every time limit of the supervisor."""
OPENED = Opened({}, (0.0,) * 6, (0.0,) * 6)  # type: ignore[typeddict-item]


class Bench:
    """A job whose motion process, recorder, witness, state folder and clock are in the test's hands. `effects` is what it did to them."""

    run: JobRun

    def __init__(self, ring: Ring) -> None:
        self.now_s, self.ring, self.effects = 100.0, ring, list[str]()
        self.walked: list[tuple[str, str, str, list[str]]] = []
        self.events: set[Any] = set()
        self.messages: deque[Message] = deque()
        self.alive = self.recorder_alive = True
        self.answered = False
        self.asked: str | None = None
        self.disk: Exception | None = None
        self.unready: Exception | None = None
        self.unmarked: Exception | None = None
        self.unrecorded: Exception | None = None
        self.unkept: Exception | None = None
        self.footer: Any = None

    def begin(self, folder: Path) -> None:
        config = parse_config({"paths": {"state": str(folder / "state"), "runs": str(folder / "runs")}}, "the test's configuration")
        job = Job("palpation", config, Plan(sites=(PlanSite(name="A"),), depths_m=(0.004,)))
        self.run = JobRun(job, lambda *_: pytest.fail("nothing is opened here"), self.ring, self, "run")  # type: ignore[arg-type]

    @property
    def state(self) -> str:
        return type(self.run._stage).__name__

    def did(self, effect: str, failure: Exception | None = None) -> None:
        if failure is not None:
            raise failure
        self.effects.append(effect)

    def step(self, stage: Stage, event: Any) -> Stage:
        """In the place of `JobRun._next`, which it calls: keeps what the transition did."""
        self.effects.clear()
        after = NEXT(self.run, stage, event)
        self.events.add(event if isinstance(event, Happened) else type(event))
        before, ends = type(stage).__name__, type(after).__name__
        report = after.report.verdict if ends == "Closing" and before != ends else "-"  # type: ignore[union-attr]
        if before != ends or self.effects:
            self.walked.append((before, ends, report, list(self.effects)))
        return after

    def wait(self, limit_s: float = LONG_S) -> float:
        """Poll until something happens; the time that it took, in s."""
        began_s = self.now_s
        while not self.walked and self.now_s - began_s < limit_s:
            self.run.poll()
            if not self.walked:
                self.now_s += STEP_S
        return self.now_s - began_s

    # --- the fakes ------------------------------------------------------------------------------------------------------------

    def send(self, message: Any) -> None:
        if message in (GO, CALLED_OFF):
            self.did(f"send {message}")

    def recv(self) -> Message:
        return self.messages.popleft()

    def keep(self, name: str, _: Any) -> None:
        self.did(f"keep {name}")

    def put_back(self, name: str, before: object) -> None:
        self.did(f"put {name} back to {before}")

    def motion(self, *_: Any) -> Any:
        def join(timeout_s: float | None = None) -> None:
            self.alive = self.alive and timeout_s is not None

        process = SimpleNamespace(is_alive=lambda: self.alive, exitcode=-9, join=join, kill=lambda: self.did("kill motion"))
        pipe = SimpleNamespace(poll=lambda: bool(self.messages), recv=self.recv, send=self.send)
        return SimpleNamespace(process=process, pipe=pipe, end=lambda: self.did("end motion"))

    def witness(self, *_: Any) -> Any:
        return SimpleNamespace(stalls=[], hear=lambda: None, end=lambda: self.did("end witness"))

    def recorder(self, _: Ring, path: Path, *__: Any) -> Any:
        self.did("begin recorder", self.disk)
        bench, self.answered = self, False

        class FakeRecorder:
            answered = property(lambda _: bench.answered)
            alive = property(lambda _: bench.recorder_alive)

            def __init__(self) -> None:
                self.path = path

            def confirm(self) -> None:
                if not bench.answered:
                    raise RecordingError("the recorder has not answered in time")
                if bench.unready is not None:
                    raise bench.unready
                bench.answered = False

            def discard(self) -> None:
                bench.did("discard recording")

            def finish(self, footer: Any) -> None:
                bench.footer = footer
                bench.did("finish recording")
                bench.answered = False

            def close(self, timeout_s: float) -> Path:
                bench.did("close recording", bench.unrecorded)
                return path

        return FakeRecorder()

    def marked(self, *_: Any) -> Any:
        self.did("write marker", self.unmarked)

        def end(*_: Any) -> ProbeAnswer:
            self.did("judge probe", self.unkept)
            return ProbeAnswer(ProbeState.FREE)

        return SimpleNamespace(follow=lambda _: None, undo=lambda: self.did("put marker back"), end=end)

    def latch(self) -> None:
        return None

    def clear_latch(self) -> None:
        self.did("clear latch")


NEXT = JobRun._next
Fresh = Callable[[str], Bench]


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fresh]:
    """A job in the state with that name."""
    rings: list[Ring] = []

    def bench_in(state: str) -> Bench:
        ring = Ring.create(125.0)
        rings.append(ring)
        bench = Bench(ring)
        monkeypatch.setattr(supervisor, "time", SimpleNamespace(monotonic=lambda: bench.now_s))
        monkeypatch.setattr(supervisor, "MotionProcess", lambda *_: bench.motion())
        monkeypatch.setattr(supervisor, "Witness", lambda *_: bench.witness())
        monkeypatch.setattr(supervisor, "Recorder", SimpleNamespace(begin=bench.recorder))
        monkeypatch.setattr(supervisor, "MarkedRun", bench.marked)
        monkeypatch.setattr(supervisor, "header_of", lambda *_: {})
        monkeypatch.setattr(supervisor, "question", lambda *_: bench.asked)
        monkeypatch.setattr(ring, "ask", lambda request: bench.did(f"ask loop to {request.name.lower()}"))
        bench.begin(tmp_path)
        monkeypatch.setattr(bench.run, "_next", bench.step)
        for name in ORDER[: ORDER.index(state)]:
            ON[name](bench)
            bench.wait(STEP_S / 2 if name != "Running" else LONG_S)
            bench.walked.clear()
        bench.run.poll()
        assert (bench.state, bench.walked) == (state, [])
        bench.effects.clear()
        return bench

    yield bench_in
    for ring in rings:
        ring.close()


# --- what can happen ------------------------------------------------------------------------------------------------------------


def message(*messages: Message) -> Callable[[Bench], None]:
    return lambda bench: bench.messages.extend(messages)


def now(**there: Any) -> Callable[[Bench], None]:
    def happens(bench: Bench) -> None:
        for name, value in there.items():
            setattr(bench, name, value)

    return happens


def loop_is(state: LoopState) -> Callable[[Bench], None]:
    return lambda bench: setattr(bench.ring, "state", state)


def both(*parts: Callable[[Bench], None]) -> Callable[[Bench], None]:
    def happens(bench: Bench) -> None:
        for part in parts:
            part(bench)

    return happens


AT_ONCE: dict[str, Callable[[Bench], None]] = {
    "abort": lambda bench: bench.run.ask(Request.ABORT),
    "devices open": message(OPENED),
    "devices open, origin to be asked": both(now(asked="which origin?"), message(OPENED)),
    "devices open, disk full": both(now(disk=OSError(28, "No space left on device")), message(OPENED)),
    "result": message(Observed({}, (), None)),  # type: ignore[typeddict-item]
    "job failed": message(Failed("the sensor is silent", 3)),
    "job refused": message(Failed("the probe may touch", 2)),
    "loop ended": message(Ended(Outcome("done"), (), (), None)),
    "recorder ready": now(answered=True),
    "recorder failed": now(answered=True, recorder_alive=False, unready=RecordingError("the recorder has died")),
    "recorder says that it failed": lambda bench: setattr(bench.ring, "recorder_state", RecorderState.FAILED),
    "recorder ready, marker not written": now(answered=True, unmarked=PalpdError("contact.json cannot be written")),
    "ticks due": loop_is(LoopState.RUNNING),
    "motion process and recorder ended": now(alive=False, answered=True),
}
"""What happens between two polls."""
IN_TIME: dict[str, Callable[[Bench], None]] = {
    "silence": lambda bench: None,
    "silence after the last tick": loop_is(LoopState.ENDED),
    "signal, then silence": lambda bench: bench.run.interrupt("SIGTERM"),
    "motion process died": now(alive=False),
}
"""What has its effect after a time, or at once."""
EVENTS = AT_ONCE | IN_TIME
ON = {
    "Opening": EVENTS["devices open"],
    "OpeningRecorder": EVENTS["recorder ready"],
    "Starting": EVENTS["ticks due"],
    "Running": EVENTS["silence"],
    "Closing": EVENTS["motion process and recorder ended"],
}
ORDER = [each.__name__ for each in get_args(Stage)]


# --- the table ------------------------------------------------------------------------------------------------------------------


def rows() -> dict[tuple[str, str], tuple[str, float, str, list[str]]]:
    """The table of ARCHITECTURE.md: next state, time in s, verdict and effects of each state and event."""
    text = (ROOT / "ARCHITECTURE.md").read_text()
    lines = text.partition("<!-- states:begin -->")[2].partition("<!-- states:end -->")[0].strip().splitlines()[2:]
    table = {}
    for line in lines:
        states, events, after, ends, verdict, effects = (cell.strip() for cell in line.strip("|").split("|"))
        for state, event in product(re.findall(r"\w+", states), events.split("; ")):
            assert (state, event) not in table, "a state and an event have one row"
            time_s = 0.0 if after == "at once" else float(after.removesuffix(" s"))
            following = state if ends == "the same" else ends.strip("`")
            table[state, event] = (following, time_s, verdict, [] if effects == "nothing" else effects.split(", "))
    return table


def test_every_row_of_the_table_is_what_the_code_does_and_nothing_else_happens(fresh: Fresh) -> None:
    table, seen, untouched = rows(), set(), []
    assert {state for state, _ in table} == set(ORDER) - {"Closed"}
    assert {event for _, event in table} == set(EVENTS)
    for state, event in product(ORDER, EVENTS):
        bench = fresh(state)
        EVENTS[event](bench)
        took_s = bench.wait(LONG_S if event in IN_TIME else STEP_S / 2)
        seen |= bench.events
        if (state, event) not in table:
            untouched.append((state, event))
            assert bench.walked == [], f"{state}, {event}: the table has no row"
            continue
        ends, time_s, verdict, effects = table[state, event]
        assert bench.walked, f"{state}, {event}: nothing happens"
        assert bench.walked[0] == (state, ends, verdict, effects), f"{state}, {event}"
        assert time_s <= took_s + 1e-6 <= time_s + STEP_S + 2e-6, f"{state}, {event}: after {took_s} s"
    assert {(state, event) for state, event in untouched if state == "Closed"} == set(product(["Closed"], EVENTS))
    unseen = {*Happened, *get_args(Message), Overdue} - seen
    assert {each.__name__ for each in unseen} == {"ReferenceTaken"}, "a calibration's result, which Observed stands for"


@pytest.mark.parametrize("state", ORDER[:-1])
def test_every_state_ends_closed_when_the_motion_process_dies_and_the_recorder_hangs(fresh: Fresh, state: str) -> None:
    bench = fresh(state)
    bench.alive = False
    for _ in range(round(LONG_S / STEP_S)):
        bench.run.poll()
        bench.now_s += STEP_S
    assert isinstance(bench.run._stage, Closed)
    report = bench.run.poll()
    assert isinstance(report, Report)
    assert report.verdict == "stopped"


def test_a_run_that_could_not_be_recorded_says_what_the_recorder_said(fresh: Fresh) -> None:
    bench = fresh("Running")
    why = "the recording run.mcap stopped after 3 ticks (No space left on device)"
    bench.ring.recorder_state, bench.unrecorded = RecorderState.FAILED, RecordingError(why)
    bench.run.poll()
    assert bench.effects == ["ask loop to abort"]
    bench.effects.clear()
    bench.run.poll()
    assert bench.effects == [], "the abort is asked for once"
    stopped = Ended(Outcome("stopped", "the operator aborted the run"), (), (), None)
    bench.messages.append(stopped)
    bench.run.poll()
    bench.alive, bench.answered = False, True
    report = bench.run.poll()
    assert report is not None
    assert report.reason == f"the run was stopped because it was no longer recorded: {why}"
    assert report.recording is None


@pytest.mark.parametrize(("state", "called_off"), [("Opening", True), ("OpeningRecorder", True), ("Starting", False), ("Running", False)])
def test_an_abort_calls_a_job_off_only_before_its_loop_was_started(fresh: Fresh, state: str, called_off: bool) -> None:
    bench = fresh(state)
    bench.run.ask(Request.ABORT)
    assert bench.run.called_off == called_off
    bench.run.poll()
    assert bench.run.called_off == called_off


def test_a_recording_says_why_palpd_itself_aborted_the_run(fresh: Fresh) -> None:
    """A state folder that became read-only was recorded, and listed by palpd runs, as an abort of the operator."""
    bench, why = fresh("Running"), "the run does not count as done: contact.json cannot be written"
    bench.run.ask(Request.ABORT, why)
    bench.messages.append(Ended(Outcome("stopped", "the operator aborted the run"), (), (), None))
    bench.run.poll()
    assert bench.footer["reason"] == f"the operator aborted the run ({why})"


def test_a_run_whose_end_cannot_be_kept_is_stopped_and_not_refused_as_if_nothing_had_moved(fresh: Fresh) -> None:
    bench = fresh("Running")
    EVENTS["loop ended"](bench)
    assert bench.run.poll() is None
    EVENTS["motion process and recorder ended"](bench)
    bench.unkept = Refused("contact.json cannot be written")
    assert bench.run.poll() is None
    report = bench.run.poll()
    assert report is not None
    assert (report.verdict, report.exit_code) == ("stopped", 3)
    assert report.reason == bench.run.unkept == "the run does not count as done: contact.json cannot be written"
    assert bench.run._abort_cause == report.reason
    assert report.probe is not None, "what an older look says of the probe does not hold any more"
    assert report.probe.state == ProbeState.UNKNOWN


def test_a_computer_that_starts_no_process_refuses_the_run(fresh: Fresh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The service ended with a traceback, since it answers refusals only."""
    bench = fresh("Opening")

    def full(*_: object) -> None:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(supervisor, "MotionProcess", full)
    with pytest.raises(Refused, match=r"starts no process \(Too many open files\); nothing was moved"):
        bench.begin(tmp_path)


def test_a_run_whose_start_was_refused_at_its_tare_is_not_unfinished(fresh: Fresh) -> None:
    """The next start elsewhere was asked for --return or --here, and a check was refused, because of a run that had moved nothing."""
    bench = fresh("Running")
    bench.messages.append(Ended(Outcome("stopped", "the probe may touch", refused=True), (), (), None))
    bench.run.poll()
    bench.alive, bench.answered = False, True
    bench.effects.clear()
    report = bench.run.poll()
    assert report is not None
    assert report.exit_code == 2
    assert bench.effects == ["close recording", "put marker back", "put place back to None"]


@pytest.mark.parametrize("refused", [True, False])
def test_a_run_that_has_begun_clears_the_latch_before_it_and_one_that_was_refused_does_not(fresh: Fresh, refused: bool) -> None:
    bench = fresh("Running")
    bench.run.job = replace(bench.run.job, clears_latch=True)
    bench.messages.append(Ended(Outcome("stopped" if refused else "done", "", refused=refused), (), (), None))
    bench.run.poll()
    bench.alive, bench.answered = False, True
    bench.run.poll()
    assert ("clear latch" in bench.effects) == (not refused)


@pytest.mark.parametrize(("away_m", "effects"), [(0.2, ["begin recorder"]), (0.31, ["send called off", "end motion", "end witness"])])
def test_a_way_back_is_said_before_anything_moves_and_a_long_one_is_refused(fresh: Fresh, away_m: float, effects: list[str]) -> None:
    bench = fresh("Opening")
    last = PlanPlace("today", "the-run-before", (away_m, 0.0), (away_m, 0.0, 0.0), 0.005, (("A", 0.0, 0.0),))
    bench.run.job = replace(bench.run.job, last=last, choice="return", back_to_m=last.start_m)
    EVENTS["devices open"](bench)
    bench.run.poll()
    assert bench.effects == effects
    assert bench.run.way_back.startswith(f"the arm goes {away_m * 1e3:.0f} mm sideways, to ({away_m:.3f}, 0.000, 0.000) m")


@pytest.mark.parametrize(("puck_m", "named"), [(0.003, True), (0.03, False)])
def test_a_run_on_the_puck_of_the_check_before_it_says_so(fresh: Fresh, puck_m: float, named: bool) -> None:
    """Who forgot to move the arm after the morning check got the modulus of the puck as that of site A, without a word."""
    bench = fresh("Running")
    check = PlanPlace("today", "the-check", (0.0, 0.0), (0.0, 0.0, 0.0), 0.005, (("puck", puck_m, 0.0),), returned=True)
    bench.run.job = replace(bench.run.job, last=check)
    bench.messages.append(Ended(Outcome("done"), (), (), None))
    bench.run.poll()
    bench.alive, bench.answered = False, True
    report = bench.run.poll()
    assert report is not None
    assert any("site A is where the check before this run pressed its puck" in note for note in report.notes) == named
