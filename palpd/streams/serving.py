"""One loop that takes ticks from the ring and passes them on. It opens the ring for reading only, and nobody waits for it.

The force goes first. The other outputs take their part of a tick after it was sent, long before the next tick is due.
"""

import select
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path

from palpd.config import Config
from palpd.daemon.interrupts import held
from palpd.errors import BadInput
from palpd.streams.force_socket import ForceSocket
from palpd.streams.foxglove import FoxgloveServer
from palpd.streams.metrics import MetricsServer
from palpd.streams.ring_ticks import RingTicks
from palpd.streams.service_watch import ServiceWatch

LAYOUT = Path(__file__).parent / "layout.json"
"""The layout for Foxglove, in the form that its app exports and imports."""
SERVICE_S = 0.1
"""Pause between two looks at what the service has said: half of the 0.2 s between two of its statuses."""


@dataclass(frozen=True, slots=True)
class Outputs:
    """What is served, and where; None is not served."""

    listen: str = "127.0.0.1"
    foxglove_port: int | None = None
    metrics_port: int | None = None
    force_socket: Path | None = None


class Stream:
    """The outputs, fed with the ticks and the status of one service. `step` feeds them once, and never blocks for longer than a pause."""

    def __init__(
        self,
        path: Path,
        rate_Hz: float,
        force: ForceSocket | None,
        foxglove: FoxgloveServer | None,
        metrics: MetricsServer | None,
        say: Callable[[str], None],
    ) -> None:
        self.force, self.foxglove, self.metrics, self._say = force, foxglove, metrics, say
        self._ticks = RingTicks(rate_Hz)
        self._watch = ServiceWatch(path)
        self._service_s = float("-inf")
        self._trouble = ""

    @property
    def follows(self) -> bool:
        """Whether it reads the ring of a service."""
        return self._ticks.follows

    def step(self) -> None:
        """Pass new ticks and news of the service on, then wait until there may be more."""
        rows = self._ticks.take()
        if rows is not None:
            if self.force is not None:
                self.force.send(rows, self._ticks.number)
            if self.foxglove is not None:
                self.foxglove.show_ticks(rows)
            if self.metrics is not None:
                self.metrics.show_ticks(rows, self._ticks.lost)
        if time.monotonic() - self._service_s > SERVICE_S:
            self._show_service()
        urgent = self.force is not None and self.force.read
        pause_s = self._ticks.pause_s(urgent)
        if self.force is None:
            time.sleep(pause_s)
        elif select.select([self.force], [], [], pause_s)[0]:
            self.force.accept()

    def close(self) -> None:
        """Stop watching."""
        self._watch.close()
        self._ticks.close()

    def _show_service(self) -> None:
        self._service_s = time.monotonic()
        status = self._watch.status
        self._ticks.follow(str(status["ring"]) if status is not None else None)
        if self.foxglove is not None:
            self.foxglove.show_service(status, self._watch.events())
        if self.metrics is not None:
            self.metrics.show_service(status)
        trouble = self._watch.reason or self._ticks.reason
        if trouble and trouble != self._trouble:
            self._say(f"Nothing to show now: {trouble}.")
        self._trouble = trouble


def serve(config: Config, path: Path, outputs: Outputs, say: Callable[[str], None]) -> None:
    """Serve until SIGTERM, SIGINT or SIGHUP.

    Args:
        config: Configuration of the service.
        path: Its control socket.
        outputs: What is served, and where.
        say: Takes sentences for people: where each output is, and what goes wrong.

    Raises:
        BadInput: Nothing is to be served, or a library is missing.
        Refused: A port or a socket is taken.
    """
    over = threading.Event()
    with held(over.set), opened(config, path, outputs, say) as stream:
        while not over.is_set():
            stream.step()


@contextmanager
def opened(config: Config, path: Path, outputs: Outputs, say: Callable[[str], None]) -> Iterator[Stream]:
    """Serve within the context, whenever the stream is stepped.

    Args:
        config: Configuration of the service.
        path: Its control socket.
        outputs: What is served, and where.
        say: Takes sentences for people: where each output is, and what goes wrong.

    Raises:
        BadInput: Nothing is to be served, or a library is missing.
        Refused: A port or a socket is taken.
    """
    if outputs.foxglove_port is None and outputs.metrics_port is None and outputs.force_socket is None:
        raise BadInput("nothing is to be served; give --foxglove PORT, --metrics PORT or --force SOCKET")
    host, ports = outputs.listen, outputs.foxglove_port is not None or outputs.metrics_port is not None
    with ExitStack() as stack:
        foxglove = metrics = force = None
        if outputs.foxglove_port is not None:
            foxglove = stack.enter_context(closing(FoxgloveServer(host, outputs.foxglove_port, say)))
            say(f"Foxglove: ws://{host}:{foxglove.port}")
        if outputs.metrics_port is not None:
            metrics = stack.enter_context(closing(MetricsServer(host, outputs.metrics_port)))
            say(f"Metrics: http://{host}:{metrics.port}/metrics")
        if outputs.force_socket is not None:
            force = stack.enter_context(closing(ForceSocket(outputs.force_socket)))
            say(f"Force: {force.path}")
        if ports and not _is_loopback(host):
            say(f"Warning: whoever reaches {host} reads all of this; nothing asks for a password and nothing is encrypted.")
        yield stack.enter_context(closing(Stream(path, config.robot.rate_Hz, force, foxglove, metrics, say)))


def _is_loopback(host: str) -> bool:
    """Whether only this computer reaches a host name."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
