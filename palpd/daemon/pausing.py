"""Pauses of a run: a request is answered when a tick shows its effect."""

import time
from dataclasses import dataclass
from typing import Literal

from palpd.daemon.control_socket import Later
from palpd.daemon.run_under_way import RunUnderWay
from palpd.tick import Phase, Request

PATIENCE_S = 1.0
"""Longest wait for the arm to rest in a pause. The sequence takes it within a tick, but not before the tare is over."""


@dataclass(frozen=True, slots=True)
class PendingPause:
    """A pause or a resume whose effect was not seen yet. `ticks` is the number of ticks when it was asked for."""

    later: Later
    wish: Literal[Request.PAUSE, Request.RESUME]
    ticks: int
    until_s: float


class Pausing:
    """Whether the run was asked to pause and not to resume (`asked`), and who waits to see it."""

    def __init__(self) -> None:
        self.asked = False
        self._pending: PendingPause | None = None

    @property
    def pending(self) -> bool:
        """Whether somebody waits for the effect of a pause or a resume."""
        return self._pending is not None

    def begin(self, wish: Literal[Request.PAUSE, Request.RESUME], ticks: int) -> Later:
        """Note a request that was passed to the loop after that number of ticks. Returns its answer to come."""
        self.asked = wish == Request.PAUSE
        self._pending = PendingPause(Later(), wish, ticks, time.monotonic() + PATIENCE_S)
        return self._pending.later

    def poll(self, runs: RunUnderWay) -> None:
        """Answer as soon as a tick shows it, or the run has ended. Where the arm leaves the tissue first, say so."""
        if self._pending is None:
            return
        pending, row = self._pending, runs.newest()
        phase = Phase(int(row["phase"])) if row is not None else Phase.TARE
        pausing, late = pending.wish == Request.PAUSE, time.monotonic() > pending.until_s
        seen = phase == Phase.PAUSED if pausing else phase not in (Phase.PAUSED, Phase.PAUSE_RETRACT)
        if runs.current is None:
            pending.later.answer = {"ok": False, "error": "the run ended meanwhile; see palpd status"}
        elif runs.ticks > pending.ticks and seen and row is not None:
            pending.later.answer = {"ok": True, "state": "paused" if pausing else "running", **runs.answer()}
        elif late and phase != Phase.TARE:
            pending.later.answer = {"ok": True, "state": "pausing" if pausing else "resuming", **runs.answer()}
        elif late:
            done = "paused" if pausing else "resumed"
            reason = f"the run was not {done} within {PATIENCE_S:g} s: it still opens its devices or tares; try again"
            pending.later.answer = {"ok": False, "error": reason}
        if pending.later.answer is not None:
            self._pending = None
