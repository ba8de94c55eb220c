"""What is an alarm: jobs, checks and ticks of the service, its death, and a disk that fills up. It only watches.

The death of the service shows in three ways. The first that shows counts, and gives the one alarm:

| what | shows | after |
|---|---|---|
| `service-end` in the state folder, by ExecStopPost= of palpd.service | what systemd says of the end | milliseconds; in a run seconds |
| its socket is there and refuses connections | it died without closing it: kill -9, out of memory | `DIED_S` |
| it does not answer, though its socket takes connections | it hangs | `SILENT_S` |

A service that ends in order removes its socket, and systemd calls that a success.
"""

import datetime
import shutil
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Literal

from palpd.config import AlarmKind, Config
from palpd.daemon.socket_client import SILENT_PATIENCE_S, JobSummary, ask
from palpd.documents import read_json
from palpd.errors import PalpdError, Refused
from palpd.streams.outbox import Alarm
from palpd.streams.ring_ticks import RingTicks
from palpd.streams.service_watch import ServiceWatch, Status
from palpd.tick import Trip

LAST_CHECK = "check.json"
"""File in the state folder that says how the last `palpd check` ended."""
SERVICE_END = "service-end"
"""File in the state folder with one line, such as `signal killed KILL`: $SERVICE_RESULT, $EXIT_CODE and $EXIT_STATUS of systemd."""
DIED_S = 1.0
"""Wait for the words of systemd after the socket of the service was lost."""
SILENT_S = 2.5
"""Time without an answer after which the service hangs. It was silent for up to 1.5 s before that counts."""
RECORD_S = 120.0
"""Time after a death in which what systemd says of it may still come: more than all time limits of the unit together."""
SLOW_LOOK_S = 10.0
"""Period of looking at the disk and at the last morning check."""
LATE_SHARE, LATE_WINDOW_S = 0.05, 10.0
"""Share of missed ticks within a window that is an alarm. Single ones are usual where other programs run; the guard stops at 50 ms."""
MOST_SEEN = 200
"""Events that are known as told: far more than the 20 jobs that a service knows."""
OLDEST_S = 86_400.0
"""Age of an event that nobody needs to hear of any more."""
KINDS: Mapping[int, AlarmKind] = {Trip.OVERLOAD: "overload", Trip.LATE_TICKS: "late-ticks"}
"""Trips of the guard that are alarms of their own; every other one is a stop."""


class AlarmEvents:
    """Looks at a service; each event is given once, also over restarts of this process.

    Attributes:
        seen: Names of the events that were given.
        low: Whether the disk was too full at the last look.
    """

    def __init__(self, config: Config, path: Path, seen: list[str], low: bool) -> None:
        now_s = time.time()
        self.seen, self.low = seen, low
        self._since_s = now_s - OLDEST_S if seen else float(int(now_s))  # dates of the service have whole seconds
        if not seen:
            self.seen.append("begin")
        self._path, self._config = path, config
        self._watch, self._ticks = ServiceWatch(path), RingTicks(config.robot.rate_Hz)
        self._slow_s = self._dead_s = float("-inf")
        self._up, self._died = False, False
        self._ring = self._ended_ring = ""
        self._lost_s: float | None = None
        self._trip, self._late, self._window_s = 0, [0, 0], float("-inf")

    def close(self) -> None:
        """Stop watching."""
        self._watch.close()
        self._ticks.close()

    def look(self) -> Iterator[Alarm]:
        """Yield what has happened since the last look; takes a second at most."""
        record = self._record()
        if record is not None:
            self._ended_ring = self._ring
        status = self._watch.status
        if status is not None:
            self._ring = str(status["ring"])  # a new one at each start of the service
            if self._ring == self._ended_ring:
                status = None  # systemd knew of the end before this process
        yield from self._deaths(record, status)
        if status is not None:
            self._ticks.follow(str(status["ring"]))
            if not self._up:
                self._up, self._dead_s = True, float("-inf")
                yield from self._past_jobs()
        yield from self._late_ticks()
        for event in self._watch.events():
            if event["event"] == "job":
                yield from self._ended_job(event)
        if status is not None and (cell := status.get("cell")) is not None and not cell["ready"]:
            yield from self._once(f"check {cell['date']}", "check", _seconds(cell["date"]), cell["reason"])
        if time.monotonic() >= self._slow_s + SLOW_LOOK_S:
            self._slow_s = time.monotonic()
            yield from self._full_disk()
            yield from self._morning_check()

    # --- the service ------------------------------------------------------------------------------------------------------------

    def _deaths(self, record: tuple[float, str] | None, status: Status | None) -> Iterator[Alarm]:
        now_s = time.monotonic()
        if record is not None:
            at_s, words = record
            known = now_s < self._dead_s + RECORD_S
            self._dead_s, self._up, self._lost_s, self._died = float("-inf"), False, None, False
            alarms = list(self._once(f"end {at_s}", "dead", at_s, f"the service ended ({words}); journalctl -u palpd says more"))
            if words.split()[0] != "success" and not known:
                yield from alarms
        elif status is not None and not self._died:
            self._lost_s = None
        elif self._up:
            self._lost_s = now_s if self._lost_s is None else self._lost_s
            end = _end_of(self._path)
            self._died = self._died or end == "died"
            if self._died and now_s >= self._lost_s + DIED_S:
                yield self._dead(now_s, "the service died without a word (kill -9, or no memory); look at the arm first")
            elif end == "silent" and now_s >= self._lost_s + SILENT_S:
                yield self._dead(now_s, "the service does not answer; look at the arm first")
            elif end == "closed" and now_s >= self._lost_s + DIED_S:
                self._up, self._lost_s = False, None

    def _dead(self, now_s: float, sentence: str) -> Alarm:
        at_s = time.time() - now_s + (self._lost_s or now_s)
        self._dead_s, self._up, self._lost_s, self._died = now_s, False, None, False
        return Alarm("dead", at_s, sentence)

    def _record(self) -> tuple[float, str] | None:
        """When the service ended the last time, and how, where that is new."""
        path = self._config.paths.state / SERVICE_END
        with suppress(OSError):
            at_s = path.stat().st_mtime
            if f"end {at_s}" not in self.seen and (words := path.read_text(errors="replace")[:200]).endswith("\n") and words.split():
                return at_s, " ".join(words.split())
        return None

    # --- its runs ---------------------------------------------------------------------------------------------------------------

    def _past_jobs(self) -> Iterator[Alarm]:
        """Jobs that ended while nobody watched."""
        with suppress(Refused):
            for job in reversed(ask(self._path, {"do": "jobs"}, SILENT_PATIENCE_S).get("jobs", [])):
                yield from self._ended_job(job)

    def _ended_job(self, job: JobSummary | Mapping[str, object]) -> Iterator[Alarm]:
        ended = job["ended"]
        if ended is None:
            return
        kind, self._trip = KINDS.get(self._trip, "stop"), 0
        if kind not in self._config.alarms.events:  # who wants to hear of stops hears of each
            kind = "stop"
        if job["verdict"] == "stopped" and not job["aborted"]:
            yield from self._once(f"job {job['id']}", kind, _seconds(str(ended)), f"{job['id']}: {job['reason']}")

    def _late_ticks(self) -> Iterator[Alarm]:
        rows = self._ticks.take()
        if rows is None:
            return
        trips = rows["trip"][rows["trip"] != Trip.NONE]
        self._trip = int(trips[-1]) if len(trips) else self._trip
        if self._late == [0, 0]:
            self._window_s = float(rows["now_s"][0])
        self._late = [self._late[0] + int(rows["missed"].sum()), self._late[1] + len(rows)]
        if float(rows["now_s"][-1]) < self._window_s + LATE_WINDOW_S:
            return
        (missed, ticks), self._late = self._late, [0, 0]
        if missed > LATE_SHARE * (missed + ticks):
            yield Alarm("late-ticks", time.time(), f"{missed} of {missed + ticks} ticks were missed; end other programs on this computer")

    # --- the computer -----------------------------------------------------------------------------------------------------------

    def _full_disk(self) -> Iterator[Alarm]:
        least_MB, runs = self._config.alarms.min_free_MB, self._config.paths.runs.absolute()
        with suppress(OSError):
            folder = next(parent for parent in (runs, *runs.parents) if parent.is_dir())
            free_MB = shutil.disk_usage(folder).free / 1e6
            before, self.low = self.low, free_MB < (1.1 if self.low else 1.0) * least_MB
            if self.low and not before:
                room = f"{folder} has room for {free_MB:.0f} MB, less than alarms.min_free_MB of {least_MB:g}"
                yield Alarm("disk", time.time(), f"{room}; move recordings elsewhere")

    def _morning_check(self) -> Iterator[Alarm]:
        with suppress(PalpdError, KeyError, TypeError, ValueError):  # no check, or none that can be read
            last = read_json(self._config.paths.state / LAST_CHECK)
            if last["level"] not in ("ok", "open"):
                yield from self._once(f"morning check {last['date']}", "check", _seconds(last["date"]), last["sentence"])

    def _once(self, name: str, kind: AlarmKind, at_s: float, sentence: str) -> Iterator[Alarm]:
        """The event of that name, where it is new."""
        if name in self.seen:
            return
        self.seen.append(name)
        del self.seen[:-MOST_SEEN]
        if at_s >= self._since_s:
            yield Alarm(kind, at_s, sentence)


def _end_of(path: Path) -> Literal["died", "silent", "closed"]:
    """How a service has gone that does not answer: without closing its socket, not at all, or in order."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.1)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return "died"
        except FileNotFoundError:
            return "closed"
        except OSError:
            pass
    return "silent"


def _seconds(date: str) -> float:
    """Unix time of a date, ISO 8601."""
    return datetime.datetime.fromisoformat(date).timestamp()
