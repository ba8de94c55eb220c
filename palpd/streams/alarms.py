"""`palpd alarms`: a process of its own that watches the service, and sends messages. It asks for `status`, `watch` and `jobs` only."""

import dataclasses
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from palpd.config import AlarmKind, Config
from palpd.daemon.interrupts import held
from palpd.documents import read_json
from palpd.errors import PalpdError, Refused
from palpd.files import write_json
from palpd.streams.addresses import Address
from palpd.streams.alarm_events import AlarmEvents
from palpd.streams.outbox import Gathering, Message, Outbox, Repeated

LOOK_S = 0.2
"""Pause between two looks: as often as the service says its status."""
CLOSING_S = 8.0
"""Longest wait for a message that is being sent when this process ends; systemd gives it 20 s."""


@dataclasses.dataclass(frozen=True, slots=True)
class KeptAlarms:
    """What survives a restart: known events, whether the disk was too full, events without a message, and what waits by address."""

    seen: list[str]
    low: bool
    gathered: dict[AlarmKind, Repeated]
    waiting: dict[str, list[Message]]


class Alarms:
    """Events of one service, gathered, and the outbox of each address. `step` looks once. Raises Refused where the file is another one."""

    def __init__(self, config: Config, path: Path, addresses: Sequence[Address], state_file: Path, say: Callable[[str], None]) -> None:
        self._file, self._say, self._kinds = state_file, say, config.alarms.events
        kept = self._kept = self._read()
        self._trouble = ""
        self._events = AlarmEvents(config, path, list(kept.seen), kept.low)
        self._gathering = Gathering(config.alarms.quiet_s, socket.gethostname(), kept.gathered)
        self._outboxes = {address.name: Outbox(address, kept.waiting.get(address.name, []), say) for address in addresses}

    def step(self) -> None:
        """Look once, and put what is new into the outboxes; no address is waited for."""
        for alarm in self._events.look():
            if alarm.kind in self._kinds:
                self._gathering.add(alarm)
        for message in self._gathering.take(time.monotonic()):
            self._say(f"{message.title}. {message.body}")
            for outbox in self._outboxes.values():
                outbox.put(message)
        self._write()

    def close(self) -> None:
        """Stop looking; what no address has taken is kept for the next start."""
        self._events.close()
        until_s = time.monotonic() + CLOSING_S
        for outbox in self._outboxes.values():
            outbox.close(max(0.0, until_s - time.monotonic()))
        self._write()

    def _read(self) -> KeptAlarms:
        if not self._file.exists():
            return KeptAlarms([], False, {}, {})
        try:
            return TypeAdapter(KeptAlarms).validate_python(read_json(self._file))
        except (PalpdError, ValidationError):
            raise Refused(f"{self._file} is not what alarms keep; delete it, or name another --state-file") from None

    def _write(self) -> None:
        """Keep what has changed. A disk that is full must not end an alarm of a disk that is full."""
        waiting = {name: outbox.waiting for name, outbox in self._outboxes.items()}
        kept = KeptAlarms(list(self._events.seen), self._events.low, dict(self._gathering.open), waiting)
        if kept == self._kept:
            return
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            write_json(self._file, dataclasses.asdict(kept), own=True)
            self._kept, self._trouble = kept, ""
        except (PalpdError, OSError) as error:
            if str(error) != self._trouble:
                self._say(f"What was sent cannot be kept, and may be sent again after a restart: {error}.")
            self._trouble = str(error)


def serve(config: Config, path: Path, addresses: Sequence[Address], state_file: Path, say: Callable[[str], None]) -> None:
    """Send alarms until SIGTERM, SIGINT or SIGHUP.

    Args:
        config: Configuration of the service.
        path: Its control socket.
        addresses: Where alarms go.
        state_file: What survives a restart of this process.
        say: Takes sentences for people, without an address.

    Raises:
        Refused: The file of what survives is another one.
    """
    over = threading.Event()
    with held(over.set), closing(Alarms(config, path, addresses, state_file, say)) as alarms:
        say(f"Alarms of the service at {path} go to {', '.join(address.name for address in addresses)}.")
        while not over.wait(LOOK_S):
            alarms.step()


def tested(addresses: Sequence[Address]) -> dict[str, str]:
    """Send one test message to each address, and return what each answered, by name: why it was not taken, or an empty text."""
    title = f"palpd on {socket.gethostname()}: a test"
    return {address.name: address.send(title, "This is what an alarm looks like. Nothing has happened.") for address in addresses}
