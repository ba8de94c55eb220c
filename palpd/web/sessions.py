"""Who may use the page: one token in a file opens it, and a signed cookie keeps it open for a shift.

A session needs no memory of the server: its cookie holds when it began, signed with a key that comes from the token. So the page of an
earlier server process, or one that has expired, is still recognised where it asks for an abort.
"""

import hashlib
import hmac
import os
import secrets
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from palpd.errors import BadInput, Refused

SESSION_S = 12 * 3600.0
"""How long a page stays open after the token was given: a shift. Then the token is asked for again, except for an abort."""
LEAST_LETTERS = 16
"""Shortest token that is accepted in a file that somebody wrote by hand."""
CREDENTIAL = "palpd-web-token"
"""Name of the systemd credential that holds the token, where the unit sets one."""


@dataclass(frozen=True, slots=True)
class Session:
    """One browser that has shown the token. `id` names it in the log; `csrf` must stand in each of its requests that changes something."""

    id: str
    csrf: str
    expired: bool


class Sessions:
    """Opens sessions with the token and recognises their cookies. The time is that of this computer, never that of a browser."""

    def __init__(self, token: str, clock: Callable[[], float] = time.time) -> None:
        self._token, self._clock = token, clock
        self._key = hashlib.sha256(b"palpd page " + token.encode()).digest()

    def opened_by(self, token: str) -> bool:
        """Whether that is the token; takes equally long for every wrong one."""
        return hmac.compare_digest(token.encode(), self._token.encode())

    def begin(self) -> str:
        """Begin a session and return its cookie."""
        begun = f"{secrets.token_hex(4)}.{int(self._clock())}"
        return f"{begun}.{self._signed('session', begun)}"

    def known(self, cookie: str) -> Session | None:
        """The session of a cookie; None where the cookie is not one of ours."""
        begun, _, signature = cookie.rpartition(".")
        if not begun or not hmac.compare_digest(signature.encode(), self._signed("session", begun).encode()):
            return None
        name, _, at_s = begun.partition(".")
        return Session(name, self._signed("csrf", begun), not 0.0 <= self._clock() - int(at_s) + 1.0 <= SESSION_S)

    def _signed(self, purpose: str, text: str) -> str:
        return hmac.new(self._key, f"{purpose} {text}".encode(), hashlib.sha256).hexdigest()


def read_token(path: Path) -> str:
    """Read the token, from the credential of systemd where there is one, else from a file, which is written where it does not exist.

    Args:
        path: The file. Nobody but its owner may have any right to it.

    Raises:
        BadInput: The file is open to others, or holds no token.
        Refused: The file cannot be written.
    """
    credentials = os.environ.get("CREDENTIALS_DIRECTORY")
    if credentials and Path(credentials, CREDENTIAL).exists():
        return _token_in(Path(credentials, CREDENTIAL))
    try:
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        if not path.is_file():
            raise BadInput(f"{path} is no regular file, expected one that holds the token; name another place with --token-file") from None
        mode = stat.S_IMODE(path.stat().st_mode)
        if mode & 0o077:
            raise BadInput(f"{path} has mode {mode:o}, expected 600, since it opens the page; run chmod 600 {path}") from None
        return _token_in(path)
    except OSError as error:
        raise Refused(f"{path} cannot be written ({error.strerror}); name another place with --token-file") from error
    token = secrets.token_urlsafe(24)
    with os.fdopen(file, "w") as stream:
        stream.write(token + "\n")
    return token


def _token_in(path: Path) -> str:
    try:
        token = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path} cannot be read as a token ({error}); delete it, and a new one is made") from error
    if len(token) < LEAST_LETTERS or not token.isprintable():
        raise BadInput(f"{path} holds {len(token)} letters, expected a token of at least {LEAST_LETTERS}; delete it, and a new one is made")
    return token
