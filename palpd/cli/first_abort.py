"""The first thing that `palpd abort` does: one line to the daemon, before the modules are imported that say how it went.

On a busy machine most of an abort is the start of Python and its imports. So this file imports only what Python has loaded already, and the
socket in C. The daemon carries out an abort whose client has gone, and a second abort changes nothing: at_once.py sends it and answers.
What is not plain here is left to at_once.py altogether.
"""

import _socket  # the module socket would import six others, 6 ms of them
import os

TYPE_CHECKING = False  # typing takes 6 ms
if TYPE_CHECKING:
    from collections.abc import Sequence

SEND_S = 0.1
"""Longest wait for the daemon to accept. It accepts at once unless a thousand others wait."""
REQUEST = b'{"do": "abort"}\n'
DEFAULT_CONFIG = "config.yaml"
INSTALLED_SOCKET = "/run/palpd/palpd.sock"
"""Control socket of the service that `palpd install` puts into place."""
MOST_LETTERS = 262_144
"""Longest configuration, as for every YAML file."""
LETTERS = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-./")
NOT_NAMES = frozenset(("null", "true", "false", "yes", "no", "on", "off", "y", "n"))
"""What YAML reads as something else than a text."""


def send_first_abort(arguments: "Sequence[str]") -> bool:
    """Send an abort to the daemon and wait for nothing; without a configuration, to each daemon at a usual socket.

    Args:
        arguments: What stands on the command line after `palpd abort`.

    Returns:
        Whether it was sent.
    """
    sent = False
    for path in socket_paths(arguments):
        sent = send_abort(path) or sent
    return sent


def send_abort(path: str) -> bool:
    """Send an abort to the daemon at that control socket and wait for nothing. Returns whether it was sent."""
    try:
        connection = _socket.socket(_socket.AF_UNIX, _socket.SOCK_STREAM)
        try:
            connection.settimeout(SEND_S)
            connection.connect(path)
            return connection.send(REQUEST) == len(REQUEST)
        finally:
            connection.close()
    except OSError:
        return False


def socket_paths(arguments: "Sequence[str]") -> list[str]:
    """Where the daemon listens, by `--socket PATH`, `--config FILE` or ./config.yaml; none where that is not plain."""
    if len(arguments) == 2 and arguments[0] == "--socket":
        return [arguments[1]]
    if arguments and (len(arguments) != 2 or arguments[0] != "--config"):
        return []
    config = arguments[1] if arguments else DEFAULT_CONFIG
    path = configured_path(config)
    if path is None:
        return []
    return [path] if os.path.lexists(config) else [path, *default_sockets(config)]


def default_sockets(config: str) -> list[str]:
    """Where a daemon listens by default: in the folder of its configuration, and where it is installed."""
    return [os.path.join(_folder(config), "state/palpd.sock"), INSTALLED_SOCKET]  # noqa: PTH118


def configured_path(config: str) -> str | None:
    """Where the daemon of that configuration listens, by environment and plain lines; None where they are not plain."""
    overrides = _plain_environment()
    lines = _plain_lines(config)
    if overrides is None or (lines is None and "socket" not in overrides):
        return None
    paths = {**(lines or {}), **overrides}
    return os.path.join(_folder(config), paths.get("socket") or paths.get("state", "state") + "/palpd.sock")  # noqa: PTH118


def _plain_environment() -> dict[str, str] | None:
    """What the environment says in place of paths; None where it is not plain."""
    stated = {name.upper(): value for name, value in os.environ.items() if name.upper().startswith("PALPD_PATHS")}
    if "null" in stated.values():
        return None
    return _plain_values([f"{name.removeprefix('PALPD_PATHS__').lower()}: {value}" for name, value in stated.items()])


def _folder(config: str) -> str:
    return os.path.dirname(os.path.realpath(config))  # noqa: PTH120


def _plain_lines(config: str) -> dict[str, str] | None:
    """What a configuration says of paths; nothing where it is absent, None where it is not spelled plainly."""
    if not os.path.isfile(config):  # noqa: PTH113 - pathlib takes 4 ms to import; a pipe or a device would keep the abort waiting
        return None if os.path.lexists(config) or "\0" in config else {}
    try:
        with open(config, encoding="utf-8") as file:  # noqa: PTH123
            text = file.read(MOST_LETTERS + 1)
    except (OSError, ValueError):
        return None
    return _plain_paths(text) if len(text) <= MOST_LETTERS else None


def _plain_paths(text: str) -> dict[str, str] | None:
    """Keys and values of the block `paths` of a YAML file, those that are null left out; None where it is not spelled plainly."""
    inside, entries, blocks = False, list[str](), 0
    for line in text.splitlines():
        content = line.partition(" #")[0].rstrip()
        if not content or line.startswith("#"):
            continue
        if line[0] != " ":
            key, colon, rest = content.partition(":")
            if not colon or not LETTERS.issuperset(key) or rest[:1].strip():
                return None
            inside = key == "paths"
            blocks += inside
            rest = rest.strip()
            if inside and rest:
                if rest[0] + rest[-1] != "{}":
                    return None
                entries += [entry for entry in rest[1:-1].split(",") if entry.strip()]
        elif inside:
            entries.append(content)
    return _plain_values(entries) if blocks <= 1 else None


def _plain_values(entries: list[str]) -> dict[str, str] | None:
    values: dict[str, str] = {}
    for entry in entries:
        key, colon, value = (part.strip() for part in entry.partition(": "))
        if (key, value) == ("socket", "null"):
            continue
        plain = LETTERS.issuperset(value) and value[:1].isalpha() | (value[:1] in ("/", "_")) and value.lower() not in NOT_NAMES
        if not colon or key in values or key not in ("runs", "state", "socket") or not plain:
            return None
        values[key] = value
    return values
