"""Takes what alarms send to a webhook (`json://`): `python -m palpd.testing.http_sink PORT FILE` keeps a line for each message."""

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any


class HttpSink:
    """A web server on this computer.

    Attributes:
        status: What it answers with; 200 takes a message.
        received: What was taken, each with `title`, `message` and `came_s`, the time on the monotonic clock.
    """

    def __init__(self, port: int = 0) -> None:
        self.status, self.received = 200, list[dict[str, Any]]()
        sink = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                if sink.status == 200:
                    sink.received.append(json.loads(body) | {"came_s": time.monotonic()})
                self.send_response(sink.status)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Say nothing."""

        self.server = ThreadingHTTPServer(("127.0.0.1", port), Handler)

    @property
    def url(self) -> str:
        """Its address for apprise, with a user, a password and a path that are secrets."""
        return f"json://anna:pass-word-1@127.0.0.1:{self.server.server_port}/token-abc123"


@contextmanager
def listening(port: int = 0) -> Iterator[HttpSink]:
    """A sink that listens within the context."""
    sink = HttpSink(port)
    thread = threading.Thread(target=sink.server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield sink
    finally:
        sink.server.shutdown()
        sink.server.server_close()
        thread.join()


def main() -> None:
    """Keep what comes in a file, a line each, until the process is ended."""
    with listening(int(sys.argv[1])) as sink:
        while True:
            time.sleep(0.1)
            Path(sys.argv[2]).write_text("".join(f"{json.dumps(message)}\n" for message in sink.received))


if __name__ == "__main__":
    main()
