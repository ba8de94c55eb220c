"""From events to messages: repeated events become one message, and each address has an outbox that keeps what could not be sent.

A thread an outbox sends, so a slow address delays neither the others nor whoever looks at the service.
"""

import datetime
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from palpd.config import AlarmKind
from palpd.streams.addresses import Address

TITLES: Mapping[AlarmKind, str] = {
    "stop": "a run was stopped",
    "overload": "overload of the force sensor",
    "check": "a check of the cell failed",
    "disk": "the disk fills up",
    "late-ticks": "ticks are late",
    "dead": "the service is dead",
}
MOST_WAITING = 20
"""Messages that an outbox keeps; for a further one the oldest is dropped, and counted. One message then holds them all."""
FIRST_RETRY_S, LAST_RETRY_S = 5.0, 300.0
"""Pause after the first failure to send, doubled by each further one, and the longest."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """One event: what it tells of, when it was (Unix time), and a sentence."""

    kind: AlarmKind
    at_s: float
    sentence: str


@dataclass(frozen=True, slots=True)
class Repeated:
    """Events of one kind that no message has told of: their number, when the first was (Unix time), and the last one."""

    count: int
    first_s: float
    last: Alarm


@dataclass(frozen=True, slots=True)
class Message:
    """What an address receives."""

    title: str
    body: str


class Gathering:
    """Turns events into messages: the first of a kind at once, what follows within the quiet interval into one message with its number.

    Attributes:
        open: What no message has told of, by kind.
    """

    def __init__(self, quiet_s: float, host: str, open_: Mapping[AlarmKind, Repeated]) -> None:
        self.open = dict(open_)
        self._quiet_s, self._host = quiet_s, host
        self._quiet_until_s: dict[AlarmKind, float] = {}

    def add(self, alarm: Alarm) -> None:
        """Take one event."""
        known = self.open.get(alarm.kind)
        self.open[alarm.kind] = replace(known, count=known.count + 1, last=alarm) if known else Repeated(1, alarm.at_s, alarm)

    def take(self, now_s: float) -> Iterator[Message]:
        """Take the messages that are due at a time of a clock that only runs forward."""
        for kind, events in list(self.open.items()):
            if now_s >= self._quiet_until_s.get(kind, now_s):
                del self.open[kind]
                self._quiet_until_s[kind] = now_s + self._quiet_s
                yield self._message(events)

    def _message(self, events: Repeated) -> Message:
        body = f"{_date(events.last.at_s)}: {events.last.sentence}"
        if events.count > 1:
            body = f"{events.count} times since {_date(events.first_s)}; the last: {body}"
        return Message(f"palpd on {self._host}: {TITLES[events.last.kind]}", body)


class Outbox:
    """Sends messages to one address in their order, from a thread of its own, and tries again what was not taken.

    Args:
        address: Where they go.
        waiting: What waits already.
        say: Takes sentences for people, without an address.
    """

    def __init__(self, address: Address, waiting: Iterable[Message], say: Callable[[str], None]) -> None:
        self._address, self._say = address, say
        self._waiting = deque(waiting, maxlen=MOST_WAITING)
        self._news = threading.Condition()
        self._over = self._fresh = False
        self._trouble = ""
        self._dropped = 0
        self._thread = threading.Thread(target=self._serve, name=f"alarms to {address.name}", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> list[Message]:
        """What was not taken yet, the oldest first."""
        with self._news:
            return list(self._waiting)

    def put(self, message: Message) -> None:
        """Send a message as soon as the address takes it; returns at once."""
        with self._news:
            self._dropped += len(self._waiting) == MOST_WAITING
            self._waiting.append(message)
            self._fresh = True
            self._news.notify()

    def close(self, patience_s: float) -> None:
        """Send what waits, for at most that time for each try; what is not taken by then still waits."""
        with self._news:
            self._over = True
            self._news.notify()
        self._thread.join(patience_s)

    def _serve(self) -> None:
        pause_s = FIRST_RETRY_S
        while True:
            with self._news:
                while not self._waiting:
                    if self._over:
                        return
                    self._news.wait()
                batch, dropped, self._fresh = list(self._waiting), self._dropped, False
            trouble = self._address.send(*_joined(batch, dropped))
            self._report(batch, trouble)
            with self._news:
                if not trouble:
                    pause_s = FIRST_RETRY_S
                    still = [message for message in self._waiting if not any(message is sent for sent in batch)]
                    self._dropped -= dropped + len(batch) - (len(self._waiting) - len(still))  # dropped, but sent before
                    self._waiting = deque(still, maxlen=MOST_WAITING)
                    continue
                if self._over:
                    return
                self._news.wait_for(lambda: self._over or self._fresh, pause_s)
                pause_s = min(2.0 * pause_s, LAST_RETRY_S)

    def _report(self, batch: list[Message], trouble: str) -> None:
        if not trouble:
            self._say(f"{self._address.name} has taken {len(batch)} message{'s' * (len(batch) > 1)}: {batch[-1].title}.")
        elif trouble != self._trouble:
            self._say(f"{self._address.name} has not taken a message, which is sent again later: {trouble}.")
        self._trouble = trouble


def _joined(batch: list[Message], dropped: int) -> tuple[str, str]:
    """Title and body of one message that holds a whole batch."""
    if len(batch) == 1 and not dropped:
        return batch[0].title, batch[0].body
    lines = [f"{message.title}. {message.body}" for message in batch]
    lines += [f"{dropped} older messages are lost."] * bool(dropped)
    return f"{batch[-1].title}, and {len(batch) - 1 + dropped} more", "\n".join(lines)


def _date(at_s: float) -> str:
    return datetime.datetime.fromtimestamp(at_s).astimezone().isoformat(sep=" ", timespec="seconds")
