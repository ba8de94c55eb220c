"""The link that `palpd web` prints opens the page that it serves."""

import socket
import subprocess
import sys
import urllib.request
from contextlib import suppress
from pathlib import Path

import pytest

from palpd.web.sessions import read_token


def has_ipv6() -> bool:
    with suppress(OSError), socket.create_server(("::1", 0), family=socket.AF_INET6):
        return True
    return False


@pytest.mark.parametrize("listen", ["127.0.0.1", "127.0.0.77", "0.0.0.0", "localhost", "::", "::1"])
def test_the_link_is_that_of_the_address_that_is_listened_at(tmp_path: Path, listen: str) -> None:
    if ":" in listen and not has_ipv6():
        pytest.skip("this computer has no IPv6 address")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    places = ["--socket", tmp_path / "absent.sock", "--runs", tmp_path, "--token-file", tmp_path / "token"]
    command = [sys.executable, "-m", "palpd.web", *map(str, places), "--listen", listen, "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        try:
            assert server.stdout is not None
            link = server.stdout.readline().split()[-1].partition("?")[0]
            bearer = {"Authorization": f"Bearer {read_token(tmp_path / 'token')}"}
            with urllib.request.urlopen(urllib.request.Request(link, headers=bearer), timeout=60.0) as page:
                assert page.status == 200
        finally:
            server.terminate()
