"""The emulators' process: an absolute grid of milliseconds, and a control channel for faults and truth.

Tests and demonstrations use `started`, which talks to the process only over its two lines and the control channel.
"""

import contextlib
import gc
import itertools
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hw.emulators.controller import TruthSample
from hw.emulators.controller_state import MODELS
from hw.emulators.hex_pty import PartsAt
from hw.emulators.rig import SAMPLE_S, Rig
from hw.emulators.verbs import VERBS, obey
from palpd.cell.cell_file import PHANTOM, load_cell
from palpd.cell.effects import load_effects
from palpd.cell.effects.learned import held_sentence
from palpd.errors import PalpdError
from palpd.files import clear_socket

GIVEN_UP_S = 0.1
"""Lateness beyond which the process skips time instead of catching up; target and tip stand still meanwhile."""
PRIORITY = 70
"""FIFO priority, above the daemon's threads: a real controller and sensor have processors of their own.

At 50, behind the receive threads of ur_rtde, an emulated UR5e lost a fifth of its cycles for a while, and its states were up to 0.1 s late.
"""


class ControlChannel:
    """A unix socket: one JSON object a line in, one a line out."""

    def __init__(self, path: Path, rig: Rig) -> None:
        self._path, self._rig = path, rig
        self._selector = selectors.DefaultSelector()
        clear_socket(path)
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen(8)
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ, None)
        self._inbox: dict[socket.socket, bytes] = {}
        self._later: list[tuple[float, dict[str, Any]]] = []

    def serve(self, now_s: float, lateness_s: Sequence[float]) -> None:
        """Answer the requests that came, and carry out the delayed ones that are due.

        Args:
            now_s: host time.
            lateness_s: lateness of the latest ticks.
        """
        for due in [entry for entry in self._later if entry[0] <= now_s]:
            self._later.remove(due)
            with contextlib.suppress(ValueError, TypeError, KeyError):  # its answer was sent long ago
                obey(self._rig, due[1], now_s, lateness_s)
        for key, _ in self._selector.select(0):
            if key.data is None:
                connection, _ = self._listener.accept()
                self._selector.register(connection, selectors.EVENT_READ, connection)
                self._inbox[connection] = b""
                continue
            self._hear(key.data, now_s, lateness_s)

    def _hear(self, connection: socket.socket, now_s: float, lateness_s: Sequence[float]) -> None:
        data = connection.recv(65536)
        if not data:
            self._selector.unregister(connection)
            del self._inbox[connection]
            connection.close()
            return
        *lines, self._inbox[connection] = (self._inbox[connection] + data).split(b"\n")
        for line in lines:
            try:
                answer = self._obey(json.loads(line), now_s, lateness_s)
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                answer = {"ok": False, "error": f"{type(error).__name__}: {error}"}
            with contextlib.suppress(OSError):
                connection.sendall(json.dumps(answer).encode() + b"\n")

    def _obey(self, request: dict[str, Any], now_s: float, lateness_s: Sequence[float]) -> dict[str, Any]:
        after_s = request.pop("after_s", None)
        if after_s is None:
            return obey(self._rig, request, now_s, lateness_s)
        if request["do"] not in VERBS:
            raise ValueError(f"there is no verb {request['do']!r}")
        self._later.append((now_s + after_s, request))
        return {"ok": True, "t_s": now_s + after_s}

    def close(self) -> None:
        """Close the socket and remove it."""
        for connection in list(self._inbox):
            connection.close()
        self._listener.close()
        self._selector.close()
        self._path.unlink(missing_ok=True)


def emulate(
    model: str = "ur5",
    cell: Path | None = None,
    host: str = "127.0.0.1",
    sensor_link: Path | None = None,
    control: Path | None = None,
    *,
    seed: int = 0,
    mount_rotation_rad: float = 0.0,
    realtime: bool = True,
    end_with_parent: bool = False,
    effects: Path | None = None,
    fz_parts_at: PartsAt = "reading",
    net_ft_port: int | None = None,
) -> None:
    """Emulate a controller and a sensor until SIGTERM or SIGINT; print `robot HOST` and `sensor DEVICE` when ready.

    Args:
        model: "ur5" or "ur5e".
        cell: cell file; None uses the paper's phantom.
        host: address that the controller listens on.
        sensor_link: link to create to the sensor's terminal device; None for none.
        control: unix socket for faults and truth; None for none.
        seed: seed of every random number.
        mount_rotation_rad: rotation of the sensor about the flange's z.
        realtime: ask for SCHED_FIFO.
        end_with_parent: also end, within a second, when the parent process is gone.
        effects: Python file of a user's effects, or a file of learned ones, which the cell file may name; None for none.
        fz_parts_at: where the sensor's slopes for pressing and pulling part.
        net_ft_port: port of the page of a Net F/T in place of the HEX-70; None for none.

    Raises:
        PalpdError: the cell file is wrong, or a port is taken.
    """
    parent = os.getppid() if end_with_parent else None
    library = load_effects(effects)
    cell_file = load_cell(cell, library) if cell is not None else PHANTOM
    try:
        rig = Rig(
            MODELS[model], cell_file, host, sensor_link,
            seed=seed, mount_rotation_rad=mount_rotation_rad, fz_parts_at=fz_parts_at, library=library,
            net_ft_port=net_ft_port,
        )  # fmt: skip
    except OSError as error:
        raise PalpdError(
            f"the emulators cannot listen on {host}, ports 29999, 30003, 30004 and those of a Net F/T ({error.strerror}); "
            "end what uses them or choose another --host."
        ) from None
    stopping: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: stopping.append(number))
    channel = ControlChannel(control, rig) if control is not None else None
    try:
        gc.collect()
        gc.freeze()
        gc.disable()
        if realtime:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        print(f"robot {host}\nsensor {rig.box.address if rig.box is not None else rig.line.path}", flush=True)
        _run(rig, channel, stopping, parent)
        for name, share in rig.cell.shares_held().items():
            if share > 0.0:
                print(held_sentence(name, share, "samples since the last start"), file=sys.stderr)
    finally:
        rig.close()
        if channel is not None:
            channel.close()


def _run(rig: Rig, channel: ControlChannel | None, stopping: Sequence[int], parent: int | None) -> None:
    lateness_s: deque[float] = deque(maxlen=60_000)
    planned_s = time.monotonic()
    for tick in itertools.count():
        if stopping or (parent is not None and tick % 1000 == 0 and os.getppid() != parent):
            return
        planned_s += SAMPLE_S
        early_s = planned_s - time.monotonic()
        if early_s > 0:
            time.sleep(early_s)
        now_s = time.monotonic()
        lateness_s.append(now_s - planned_s)
        if now_s - planned_s > GIVEN_UP_S:
            skipped = int((now_s - planned_s) / SAMPLE_S)
            planned_s += skipped * SAMPLE_S
            rig.skip(skipped)
        if channel is not None:
            channel.serve(now_s, lateness_s)
        rig.tick(planned_s, now_s, late=now_s - planned_s > rig.model.cycle_s)


@dataclass(frozen=True)
class Emulated:
    """A running pair of emulators."""

    host: str
    sensor: str
    pid: int
    control: Path

    def ask(self, verb: str, **arguments: Any) -> dict[str, Any]:
        """Carry out a verb of the control channel.

        Returns:
            The answer.

        Raises:
            RuntimeError: the process refused it.
        """
        with socket.socket(socket.AF_UNIX) as channel:
            channel.settimeout(5.0)
            channel.connect(str(self.control))
            channel.sendall(json.dumps({"do": verb, **arguments}).encode() + b"\n")
            with channel.makefile("rb") as lines:
                answer: dict[str, Any] = json.loads(lines.readline())
        if not answer.pop("ok"):
            raise RuntimeError(answer["error"])
        return answer

    def log(self, since_s: float) -> list[TruthSample]:
        """Return target and truth of each millisecond after this host time; the process keeps 30 s."""
        samples: list[TruthSample] = []
        more = True
        while more:
            answer = self.ask("log", since_s=since_s)
            samples += [TruthSample(*row) for row in answer["samples"]]
            since_s, more = samples[-1].t_s if samples else since_s, answer["more"]
        return samples


@contextlib.contextmanager
def started(folder: Path, model: str = "ur5", cell: Path | None = None, host: str = "127.0.0.1", *options: str) -> Iterator[Emulated]:
    """Run emulators in a process of their own, and end it on leaving.

    Args:
        folder: where link and control socket stand.
        model: "ur5" or "ur5e".
        cell: cell file; None uses the paper's phantom.
        host: address that the controller listens on.
        options: more options of `python -m hw.emulators`.

    Yields:
        The running emulators.

    Raises:
        PalpdError: the process is not ready; the text is its own sentence.
        RuntimeError: the process did not end with exit code 0.
    """
    control = folder / "control"
    command = [sys.executable, "-m", "hw.emulators", "--model", model, "--host", host]
    command += ["--sensor-link", str(folder / "hex"), "--control", str(control), "--end-with-parent", *options]
    if cell is not None:
        command += ["--cell", str(cell)]
    # a session of its own: Ctrl-C must not end the robot before the daemon has stopped it
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        words = [process.stdout.readline().split() for _ in range(2)]
        if [word[0] for word in words if word] != ["robot", "sensor"]:
            process.wait(timeout=5.0)
            raise PalpdError(process.stderr.read().strip() or "the emulators ended before they were ready")
        yield Emulated(words[0][1], words[1][1], process.pid, control)
        process.terminate()
        if process.wait(timeout=5.0):
            raise RuntimeError(f"the emulators ended with exit code {process.returncode}: {process.stderr.read().strip()}")
    finally:
        process.terminate()
        process.wait(timeout=5.0)
        process.stdout.close()
        process.stderr.close()
