"""Reads what the controller says after a stop. A process of its own does it, so that the service stays free of ur_rtde.

The connection cannot move the arm. The process tells its reader what it saw, and ends with it. A connection that was lost is never taken
up again by the same process.
"""

import math
import multiprocessing
import os
import signal
import time
from contextlib import suppress
from multiprocessing.connection import Connection

from palpd.config import Config
from palpd.daemon.devices import OpenController
from palpd.daemon.interrupts import shielded
from palpd.daemon.robot_stops import AGAIN_S, ControllerSeen, StopName, stop_of
from palpd.errors import PalpdError

READ_EVERY_S = 0.1
"""Pause between two readings: a step at the pendant is seen at once."""
ASK_EVERY_S = 1.0
"""Pause between two questions for remote control."""
SILENT_S = 1.0
"""Age of the newest state from which the link counts as lost: a machine that stands still may take 0.1 s."""
HUNG_S = 15.0
"""Silence of the process after which it is replaced: opening takes at most some seconds."""


def serve(open_controller: OpenController, config: Config, pipe: Connection) -> None:
    """Send what the controller says, until nobody hears it.

    Args:
        open_controller: Opens the controller for reading.
        config: The configuration of the cell.
        pipe: Takes a `ControllerSeen` each `READ_EVERY_S`.
    """
    for number in (signal.SIGINT, signal.SIGHUP):  # who hears this gets them too, and ends it
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGHUP, signal.SIGTERM))
    try:
        _send(open_controller, config, pipe)
    finally:
        os._exit(0)  # not through ur_rtde's destructors


def _send(open_controller: OpenController, config: Config, pipe: Connection) -> None:
    reader = None
    while reader is None:
        try:
            reader = open_controller(config)
        except PalpdError as error:
            pipe.send(ControllerSeen(connected=False, reason=str(error).rstrip(".")))
            time.sleep(ASK_EVERY_S)
    asked_s, takes_programs = -math.inf, None
    while True:
        state, now_s = reader.robot.read(), time.monotonic()
        if not state.connected or now_s - state.t_s > SILENT_S:
            pipe.send(ControllerSeen(connected=False))
            return
        if now_s - asked_s > ASK_EVERY_S:
            asked_s, takes_programs = now_s, reader.takes_programs()
        pipe.send(ControllerSeen(True, state.robot_mode, state.safety_mode, state.runtime_state, takes_programs))
        time.sleep(READ_EVERY_S)


class ControllerWatch:
    """What the controller says, as long as that matters: from a stop until `AGAIN_S` after the arm may move again. `poll` never waits.

    `seen` is None while nothing is known.
    """

    def __init__(self, config: Config, open_controller: OpenController) -> None:
        self._config, self._open = config, open_controller
        self._process: multiprocessing.process.BaseProcess | None = None
        self._pipe: Connection | None = None
        self._heard_s, self._until_s = 0.0, -math.inf
        self.seen: ControllerSeen | None = None

    def begin(self, seen: ControllerSeen | None = None) -> None:
        """Watch from now on.

        Args:
            seen: What is known already; None leaves that as it is.
        """
        self.seen, self._until_s = seen or self.seen, time.monotonic() + AGAIN_S
        if self._process is None:
            self._start()

    @property
    def stop(self) -> StopName | None:
        """What stands against a motion; None where nothing does, or nothing is known."""
        return stop_of(self.seen) if self.seen is not None else None

    def poll(self) -> None:
        """Take in what the process has sent; replace it where it has ended, and end it when nothing needs it."""
        now_s = time.monotonic()
        if self._process is None or self._pipe is None:
            if self._heard_s + ASK_EVERY_S < now_s < self._until_s:  # this computer had no process left for it
                self._start()
            return
        alive = self._process.is_alive()
        try:
            while self._pipe.poll():
                self.seen, self._heard_s = self._pipe.recv(), now_s
        except (EOFError, OSError):
            alive = False
        if self.stop is not None:
            self._until_s = now_s + AGAIN_S
        if now_s > self._until_s:
            self.end()
        elif not alive or now_s - self._heard_s > HUNG_S:
            self._end_process()
            self._start()

    def end(self) -> None:
        """Watch no longer, and forget what was seen: it grows old."""
        self._end_process()
        self.seen, self._until_s = None, -math.inf

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._heard_s = time.monotonic()
        with suppress(OSError), shielded():
            pipe, far = context.Pipe(duplex=False)
            process = context.Process(target=serve, args=(self._open, self._config, far), name="palpd-controller", daemon=True)
            process.start()
            far.close()
            self._pipe, self._process = pipe, process

    def _end_process(self) -> None:
        if self._process is not None and self._pipe is not None:
            self._process.kill()
            self._process.join()
            self._pipe.close()
        self._process = self._pipe = None
