"""What an operator does where this computer stood still and the guard rightly ended a run: begin it again."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from palpd.errors import Refused
from palpd.testing.processes import until

TRIES = 4
Status = Mapping[str, Any]
"""What `status` answers."""


@dataclass(frozen=True)
class Operator:
    """Presses the buttons of a service.

    Attributes:
        do: Sends a request to the service and returns its answer; raises Refused.
    """

    do: Callable[..., dict[str, Any]]

    def start(self, plan: Mapping[str, Any], reached: Callable[[Status], bool], what: str) -> None:
        """Arm, start, and wait until the run is as far; where this computer stood still meanwhile, begin again.

        Args:
            reached: Whether the run is as far, by the status.
            what: That moment in words, for who waits in vain.

        Raises:
            AssertionError: The run ended for another reason, or each time.
        """
        for _ in range(TRIES):
            self.arm()
            self.do("start", plan=plan)
            status = until(lambda: self._once(lambda now: now["state"] == "disarmed" or reached(now)), what)
            if status["state"] != "disarmed":
                return
            assert "this computer" in status["last"]["reason"], f"the run ended before {what}: {status['last']}"
            if status["probe"]["state"] != "free":
                self.retract()
            if status["latched"]:
                self.do("clear")
        raise AssertionError(f"the run ended before {what}, {TRIES} times: {status['last']}")

    def arm(self) -> None:
        """Arm; again, where what the devices said was rightly found too old."""
        for _ in range(TRIES):
            try:
                self.do("arm")
                return
            except Refused as refused:
                if " s old, expected at most" not in str(refused):
                    raise
                time.sleep(1.0)
        self.do("arm")

    def retract(self) -> None:
        """Leave the tissue, and wait until the service is disarmed."""
        self.do("retract")
        status = until(lambda: self._once(lambda now: now["state"] == "disarmed"), "the probe leaves the tissue", every_s=0.05)
        assert status["probe"]["state"] == "free", status

    def _once(self, true: Callable[[Status], bool]) -> dict[str, Any] | None:
        """The status, once it is so."""
        now = self.do("status")
        return now if true(now) else None
