"""Who holds the controls: one operator at a time may change what the service does, others watch, and everyone may abort.

Nobody has to hold them. While nobody does, each request of the socket is carried out. The time is an argument, but for
the requests of the socket.
"""

import secrets
import time
from dataclasses import dataclass, replace

import structlog

from palpd.daemon.socket_client import ControlAnswer, ControlRequest
from palpd.errors import BadInput, Refused

LEASE_S = 10.0
"""Time after the last renewal at which the controls are free again: an operator whose terminal has died must not lock others out."""
LONGEST_NAME = 64
"""Most letters of a holder's name: it stands in one line of the status."""


@dataclass(frozen=True, slots=True)
class Lease:
    """The controls in one hand. `token` proves it: only the holder has received it."""

    name: str
    token: str
    until_s: float


class Controls:
    """The lease of the service's controls. `lost` holds why each former lease ended, by its token."""

    def __init__(self) -> None:
        self._lease: Lease | None = None
        self._lost: dict[str, str] = {}

    def holder(self, now_s: float) -> str | None:
        """Name of who holds the controls; None where nobody does."""
        lease = self._lease
        if lease is not None and now_s > lease.until_s:
            self._end(lease, f"were not renewed within {LEASE_S:g} s")
        return self._lease.name if self._lease is not None else None

    def asking(self, now_s: float) -> str:
        """Who asks for something that needs the controls, for people."""
        return self.holder(now_s) or "a client without the controls"

    def answer(self, request: ControlRequest) -> ControlAnswer:
        """Carry out a request to take, renew or release the controls. Raises BadInput and Refused."""
        now_s, log = time.monotonic(), structlog.get_logger("palpd.service")
        match request["do"]:
            case "take":
                token, loser = self.take(request.get("name"), request.get("force") is True, now_s)
                log.info("controls taken", by=self.asking(now_s), by_force_from=loser)
                return {"lease": token, "lease_s": LEASE_S}
            case "renew":
                self.require(request.get("lease", ""), now_s)
                return {"lease_s": LEASE_S}
        holder = self.asking(now_s)
        self.release(request.get("lease", ""), now_s)
        log.info("controls released", by=holder)
        return {"controls": None}

    def take(self, name: object, force: bool, now_s: float) -> tuple[str, str | None]:
        """Take the controls.

        Args:
            name: Who takes them, for people.
            force: Whether to take them from somebody else.
            now_s: The time.

        Returns:
            The token of the lease, and who lost the controls by it; None where nobody held them.

        Raises:
            BadInput: The name is none.
            Refused: Somebody else holds them.
        """
        if not isinstance(name, str) or not name.strip() or len(name) > LONGEST_NAME or not name.isprintable():
            raise BadInput(f"the controls are taken under a name of 1 to {LONGEST_NAME} printable letters; give one")
        holder, lease = self.holder(now_s), self._lease
        if lease is not None and not force:
            raise Refused(_held_by(holder))
        if lease is not None:
            self._end(lease, f"were taken by {name}")
        self._lease = Lease(name, secrets.token_hex(8), now_s + LEASE_S)
        return self._lease.token, holder

    def release(self, token: object, now_s: float) -> None:
        """Let the controls go.

        Args:
            token: Of the lease.
            now_s: The time.

        Raises:
            Refused: Another lease holds, or none.
        """
        self.require(token, now_s)
        if self._lease is None:
            raise Refused("nobody holds the controls, so there is nothing to release")
        self._end(self._lease, "were released")

    def require(self, token: object, now_s: float) -> None:
        """Renew the lease of that token.

        Args:
            token: Of the lease; None from a client that has taken none, which is enough while nobody holds the controls.
            now_s: The time.

        Raises:
            Refused: The controls are somebody else's, or the lease has ended.
        """
        holder, lease = self.holder(now_s), self._lease
        if lease is not None and token == lease.token:
            self._lease = replace(lease, until_s=now_s + LEASE_S)
        elif token is not None:
            reason = self._lost.get(str(token), "were never yours")
            raise Refused(f"the controls {reason}; take them again")
        elif lease is not None:
            raise Refused(_held_by(holder))

    def _end(self, lease: Lease, reason: str) -> None:
        self._lost = {lease.token: reason, **dict(list(self._lost.items())[:99])}
        self._lease = None


def _held_by(holder: str | None) -> str:
    return f"{holder} holds the controls; wait until they are free, or free them by force (palpd controls --free)"
