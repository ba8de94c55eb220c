"""A WebSocket server for Foxglove: the topics of a recording while they come, besides what the service says.

Topics, types and bytes are those of a recording, so one layout shows both. Nothing is packed for a topic that nobody has subscribed to.
The library's threads send. A viewer that is too slow loses messages there, and a viewer can send nothing that would count.
"""

import json
import logging
import re
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from palpd.errors import BadInput, Refused
from palpd.recording.ring import Rows
from palpd.recording.topics import SCHEMAS, TOPICS, TopicMessages
from palpd.streams.ring_ticks import QUIET_S
from palpd.streams.service_watch import Status

PROTOCOL = "foxglove.sdk.v1"
"""What viewers must ask for. The library refuses the older foxglove.websocket.v1, with a sentence that does not say so."""
STATUS_TOPIC, LOG_TOPIC = "/status", "/log"
STATUS_SCHEMA: dict[str, Any] = json.loads(Path(__file__).with_name("status.schema.json").read_text(encoding="utf-8"))
"""Form of /status. It has no nulls, which Foxglove's JSON schemas do not know."""


class _LibrarySays(logging.Handler):
    """Passes on what the library says, and says of each computer once why its viewer was refused."""

    def __init__(self, say: Callable[[str], None]) -> None:
        super().__init__(logging.ERROR)
        self._say, self._refused = say, set[str]()

    def emit(self, record: logging.LogRecord) -> None:
        """Say it."""
        sentence = record.getMessage()
        refused = re.fullmatch(r"Dropping client (.*):\d+: handshake failed", sentence)
        if refused is None:
            self._say(f"Foxglove: {sentence}.")
        elif refused[1] not in self._refused:
            self._refused.add(refused[1])
            self._say(f"Foxglove: a viewer at {refused[1]} was refused, since it does not speak {PROTOCOL}; install a newer viewer.")


class FoxgloveServer:
    """Serves at a host and port from its creation on. Raises BadInput without the library, Refused where the port is taken.

    Args:
        host: Address to listen at.
        port: Port to listen at; 0: any.
        say: Takes sentences for people.
    """

    def __init__(self, host: str, port: int, say: Callable[[str], None] = print) -> None:
        try:
            import foxglove
            from foxglove.channels import LogChannel
            from foxglove.messages import Log, LogLevel
        except ImportError:
            raise BadInput("--foxglove needs foxglove-sdk, which is not installed; install palpd[live]") from None
        log = logging.getLogger("foxglove")
        log.handlers, log.propagate = [_LibrarySays(say)], False
        context = self._context = foxglove.Context()  # the server keeps no hold of it, and without it announces no topic
        self._channels = {
            topic: foxglove.Channel(
                topic,
                schema=foxglove.Schema(name=name, encoding="ros2msg", data=SCHEMAS[name].encode()),
                message_encoding="cdr",
                context=context,
            )
            for topic, name in TOPICS.items()
        }
        self._status_channel = foxglove.Channel(STATUS_TOPIC, schema=STATUS_SCHEMA, message_encoding="json", context=context)
        self._log_channel = LogChannel(LOG_TOPIC, context=context)
        self._log_message, self._levels = Log, {"log": LogLevel.Info, "latched": LogLevel.Error}
        self._messages: TopicMessages | None = None
        self._newest_s = float("-inf")
        self._status: dict[str, object] = {}
        self._status_watched = False
        try:
            self._server = foxglove.start_server(name="palpd", host=host, port=port, context=context)
        except RuntimeError as error:
            raise Refused(f"Foxglove cannot be served at {host}:{port} ({error}); choose another port or host") from None

    @property
    def port(self) -> int:
        """The port; the system has chosen one where 0 was asked for."""
        return int(self._server.port)

    @property
    def subscribed(self) -> set[str]:
        """The topics that somebody has subscribed to."""
        channels: dict[str, Any] = {**self._channels, STATUS_TOPIC: self._status_channel, LOG_TOPIC: self._log_channel}
        return {topic for topic, channel in channels.items() if channel.has_sinks()}

    def show_ticks(self, rows: Rows) -> None:
        """Send new rows (n,), at least one, on the topics that somebody has subscribed to."""
        began_s = float(rows["now_s"][0])
        if self._messages is None or began_s > self._newest_s + QUIET_S:  # another run: the computer's clock may have been set meanwhile
            self._messages = TopicMessages(time.time() - time.monotonic())
        self._newest_s = float(rows["now_s"][-1])
        topics = self.subscribed & self._channels.keys()
        for topic, stamp_ns, messages in self._messages.of(rows, topics) if topics else ():
            channel = self._channels[topic]
            for time_ns, message in zip(stamp_ns.tolist(), messages, strict=True):
                channel.log(message, log_time=time_ns)

    def show_service(self, status: Status | None, events: Iterable[dict[str, Any]]) -> None:
        """Send the status where it has changed or a viewer has come, and what jobs have said.

        Args:
            status: The newest status; None while no service answers.
            events: Events of jobs since the last call.
        """
        for event in events:
            if event["event"] == "log":
                self._say("log", str(event["id"]), str(event["line"]))
        now = flat(status)
        watched = STATUS_TOPIC in self.subscribed
        if now["latched"] and now["latched"] != self._status.get("latched"):
            self._say("latched", "palpd", str(now["latched"]))
        if watched and (now != self._status or not self._status_watched):
            self._status_channel.log(json.dumps(now).encode())
        self._status, self._status_watched = now, watched

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()

    def _say(self, kind: str, name: str, sentence: str) -> None:
        self._log_channel.log(self._log_message(level=self._levels[kind], name=name, message=sentence))


def flat(status: Status | None) -> dict[str, object]:
    """Turn a status of the service into the form of /status.

    Args:
        status: The status; None while no service answers.

    Returns:
        All properties of `STATUS_SCHEMA`.
    """
    known = status or {"state": "away"}
    active = known.get("active") or {}
    return {
        "state": str(known["state"]),
        "latched": str(known.get("latched") or ""),
        "controls": str(known.get("controls") or ""),
        "job": str(known.get("job") or ""),
        "activity": str(known.get("activity") or active.get("activity") or ""),
        "phase": str(known.get("phase") or ""),
        "site": int(known.get("site", -1)),
        "steps_done": int(known.get("steps_done", 0)),
        "steps": int(known.get("steps", 0)),
    }
