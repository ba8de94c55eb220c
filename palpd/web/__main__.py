"""`python -m palpd.web`: the server of the page. `palpd web` reads the configuration and starts it with plain values."""

import argparse
import asyncio
import contextlib
import os
import socket
import sys
from ipaddress import ip_address
from pathlib import Path

import uvicorn

from palpd.errors import PalpdError
from palpd.web.access import is_loopback
from palpd.web.application import build
from palpd.web.connections import EntranceServer
from palpd.web.log import log
from palpd.web.page import PageSettings
from palpd.web.sessions import Sessions, read_token


def main(words: list[str]) -> int:
    """Serve the page until SIGTERM or SIGINT. Returns the exit code."""
    settings, token_file = _settings(words)
    try:
        token = read_token(token_file)
    except PalpdError as error:
        print(f"palpd: {error}", file=sys.stderr)
        return error.exit_code
    try:
        family = socket.AF_INET6 if ":" in settings.listen else socket.AF_INET
        listener = socket.create_server((settings.listen, settings.port), family=family)
    except OSError as error:
        reason = error.strerror or error
        print(
            f"palpd: the page cannot listen at {settings.listen} port {settings.port} ({reason}); see --listen and --port", file=sys.stderr
        )
        return 2
    config = uvicorn.Config(
        build(settings, Sessions(token)),
        log_config=None,
        access_log=False,
        lifespan="on",
        loop="asyncio",
        http="h11",
        ws="websockets-sansio",
        ws_max_size=4096,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=1,
        server_header=False,
    )
    address = _link(settings, listener)
    if "JOURNAL_STREAM" in os.environ:  # others may read the journal
        print(f"The page of palpd: {address}, the token stands in {token_file}", flush=True)
    else:
        print(f"The page of palpd: {address}?token={token}", flush=True)
    log(
        "page served",
        listen=settings.listen,
        port=settings.port,
        socket=str(settings.socket),
        loopback_only=is_loopback({"client": listener.getsockname()}),
    )
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(EntranceServer(config, listener).serve())
    return 0


def _link(settings: PageSettings, listener: socket.socket) -> str:
    """The address to open. Where the page listens at all addresses, that is the first `--name`, else this computer's own."""
    host, address = settings.listen, ip_address(listener.getsockname()[0])
    if address.is_unspecified:
        host = settings.names[0] if settings.names else "127.0.0.1" if address.version == 4 else "::1"
    return f"http://{f'[{host}]' if ':' in host else host}:{settings.port}/"


def _settings(words: list[str]) -> tuple[PageSettings, Path]:
    parser = argparse.ArgumentParser(prog="python -m palpd.web", description="The server of palpd's page; palpd web starts it.")
    parser.add_argument("--socket", type=Path, required=True)
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--token-file", type=Path, required=True)
    parser.add_argument("--listen", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8700)
    parser.add_argument("--name", dest="names", action="append", default=[])
    parser.add_argument("--plan", type=Path)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--setup", type=Path)
    parser.add_argument("--camera-url")
    values = vars(parser.parse_args(words))
    token_file, names = values.pop("token_file"), tuple(values.pop("names"))
    return PageSettings(names=names, **values), token_file


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
