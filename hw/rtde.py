"""A UR controller behind ur_rtde 1.6.5: states out, tip speeds in, under a watchdog. UR5 (CB3, 125 Hz) and UR5e (e-Series, 500 Hz).

What the library does, measured, and what follows here:

- Its constructors hold the GIL and may wait for ever. So a bounded handshake of our own comes first, and no constructor runs beside
  the loop.
- speedL never ends by itself, and a killed client leaves the arm moving. So no speed goes out unless the controller's watchdog is
  set, and it is set again after every upload of the control script, because it ends with the script.
- kickWatchdog keeps an old speed alive. So while the arm may move only speed commands feed the watchdog.
- After a lost connection the library uploads its script again on its own, without watchdog, hangs or crashes. So a connection
  that was lost once is lost for good: `RobotState.connected` stays false, the driver sends nothing more, the watchdog stops the arm,
  and the process must end; a fresh one connects anew. Objects of a lost connection are never destroyed (that crashes).
- The control object is not thread-safe. One thread calls; a call that might block is made by a second one while the first waits.
- A command that waits for the control script waits 4 s and more where the script was stopped, was replaced, or hears nothing. Speeds wait
  after another command only. So whatever waits is given up as soon as the state says why, at the latest after half a second.
- It waits for a script that is not ready without a pause, and its own thread must hear that it is. At the priority of the loop such a
  wait keeps that thread from a processor, on a single one for its whole 4 s. So whatever may wait runs at a priority below that thread's.
- Getters lock one variable each and repeat old values for ever without an error. So a snapshot lies between two equal
  timestamps, and its age comes from the controller's timestamp.
"""

import contextlib
import ctypes
import math
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from typing import Any, Literal, NamedTuple

try:
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface
except ImportError:  # its wheels are for Linux on x86-64 up to Python 3.12; all else of palpd works without
    RTDEControlInterface = RTDEReceiveInterface = None

from hw.host_time import MinimumDelayClock
from palpd.errors import RobotError
from palpd.tick import PROGRAM_PLAYING, RobotKind, RobotMode, RobotSettings, RobotState, SafetyMode

RobotModel = Literal["ur5", "ur5e"]
MAX_RATE_HZ: dict[RobotModel, float] = {"ur5": 125.0, "ur5e": 500.0}

RTDE_PORT = 30004
SCRIPT_PORT = 30003
DASHBOARD_PORT = 29999

VARIABLES = [
    "timestamp",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "target_TCP_pose",
    "target_TCP_speed",
    "actual_tool_accelerometer",
    "robot_mode",
    "safety_mode",
    "runtime_state",
    "safety_status_bits",
]
"""All of them exist on CB3 from 3.10 and on e-Series; a short list keeps the packages small."""

WATCH_EVERY_S = 1.0
"""Pause between two arrivals that the second thread watches: in it the clocks drift apart by 0.1 ms at most."""
WATCH_STEP_S = 0.0002
"""Sleep between two reads of the timestamp while that thread waits for an arrival."""
OFFSET_STEP_S = 0.00005
"""Sleep between two reads while the first offset is searched: among 60 arrivals the shortest way still shows.

A real-time thread that spins for half a second starves ordinary threads. Linux then suspends all real-time threads of the core, for 50 ms
at a time."""
CLOCK_LEAK = 1e-4
"""Largest relative drift of a slower controller clock: two crystals, and the host's clock being slewed."""
CLOCK_JUMP_S = 1.0
"""A timestamp that is further off was started anew with the controller."""
CONNECT_TIMEOUT_S = 2.0
STOP_TIMEOUT_S = 0.25
SCRIPT_TIMEOUT_S = 0.5
"""Longest wait for an answer of the control script, which takes two controller cycles. A machine that stands still may take 0.1 s more."""
SILENT_S = 0.1
"""Age from which a state explains why a command was not taken: twelve frames at 125 Hz."""
CLOSE_TIMEOUT_S = 1.5
STOP_M_PER_S2 = 10.0
"""Deceleration of a stop, speedStop's own default; the controller limits it to what the joints can do."""


def require_library() -> None:
    """Refuse, with a RobotError, a machine on which ur-rtde is not installed."""
    if RTDEControlInterface is None:
        raise RobotError(
            "the library ur-rtde, which speaks to the robot, is not installed; its wheels are for Linux on x86-64 with Python 3.11 or "
            "3.12, so run this command with such a Python"
        )


class UrReader:
    """Reads the state of a UR controller and cannot command it.

    `t_s` of a state is the controller's timestamp plus the smallest (host time - timestamp) seen. Half a second of reads at the start
    finds the shortest way (0.2 to 0.4 ms on a loopback). Then a second thread watches one arrival every `WATCH_EVERY_S`. The loop alone
    is not enough: it always reads at the same phase of the frame period, so the offset would creep up to that phase and slide through
    a whole period as the clocks drift apart. The error is one-sided: t_s is late by the shortest way and about 0.2 ms.

    Raises RobotError in one sentence when the controller cannot be reached, is silent, or is not of this model.
    """

    def __init__(self, host: str, *, model: RobotModel, rate_Hz: float) -> None:
        if not 0 < rate_Hz <= MAX_RATE_HZ[model]:
            raise RobotError(f"an RTDE rate of {rate_Hz:g} Hz is not possible on a {model}; it has up to {MAX_RATE_HZ[model]:g} Hz.")
        require_library()
        self.host = host
        self.period_s = 1.0 / rate_Hz
        self._clock = MinimumDelayClock(CLOCK_LEAK, CLOCK_JUMP_S)
        self._timestamp_s = math.nan
        self._lost = False
        _greet(host, model)
        try:
            self._receive = RTDEReceiveInterface(host, rate_Hz, VARIABLES, rt_priority=_PRIORITY_UNTOUCHED)
        except RuntimeError as error:
            raise RobotError(f"robot at {host} does not send its state ({_first_line(error)}); check its RTDE settings.") from None
        self._find_offset(0.5)
        self._closed = threading.Event()
        threading.Thread(target=self._watch_arrivals, daemon=True).start()

    @property
    def connected(self) -> bool:
        """Whether the connection has stood without a break since it was made."""
        if not self._lost and not self._receive.isConnected():
            self._lost = True
        return not self._lost

    def read(self) -> RobotState:
        """Return the newest untorn state without waiting. An old state looks like any other: judge its age by `t_s`."""
        receive = self._receive
        for _ in range(_TRIES):
            before_s = receive.getTimestamp()
            pose, speed = receive.getActualTCPPose(), receive.getActualTCPSpeed()
            target_pose, target_speed = receive.getTargetTCPPose(), receive.getTargetTCPSpeed()
            acceleration = receive.getActualToolAccelerometer()
            robot_mode, safety_mode = receive.getRobotMode(), receive.getSafetyMode()
            runtime_state, safety_bits = receive.getRuntimeState(), receive.getSafetyStatusBits()
            if receive.getTimestamp() == before_s:
                break
        else:
            raise RobotError(f"robot at {self.host} gave no untorn state in {_TRIES} attempts; lower the load of this machine.")
        self._timestamp_s = before_s
        return RobotState(
            self._clock.host_s(before_s), before_s,
            tuple(pose), tuple(speed), tuple(target_pose), tuple(target_speed), tuple(acceleration),
            robot_mode, safety_mode, safety_bits, runtime_state, self.connected,
        )  # fmt: skip

    def close(self) -> None:
        """Disconnect; takes half a second."""
        self._closed.set()
        _bounded(self._receive.disconnect, CLOSE_TIMEOUT_S)

    def _watch_arrivals(self) -> None:
        """Every `WATCH_EVERY_S` read often enough to see one frame arrive: 40 reads of 0.3 µs, with sleep between them."""
        while not self._closed.wait(WATCH_EVERY_S):
            last_s, until_s = self._receive.getTimestamp(), time.monotonic() + 2.0 * self.period_s
            while time.monotonic() < until_s:
                timestamp_s = self._receive.getTimestamp()
                if timestamp_s != last_s:
                    self._clock.see(timestamp_s, time.monotonic())  # after the read: a pause between makes it late, never early
                    break
                time.sleep(WATCH_STEP_S)

    def _find_offset(self, duration_s: float) -> None:
        until_s = time.monotonic() + duration_s
        while time.monotonic() < until_s:
            timestamp_s = self._receive.getTimestamp()
            if timestamp_s != self._timestamp_s:
                if not math.isnan(self._timestamp_s):  # the first may be old
                    self._clock.see(timestamp_s, time.monotonic())
                self._timestamp_s = timestamp_s
            time.sleep(OFFSET_STEP_S)
        if not self._clock.synchronised:
            raise RobotError(f"robot at {self.host} has not sent a new state for {duration_s:g} s; restart its controller.")


class UrRobot:
    """Reads a UR controller and moves its tip; the one owner of the control connection.

    Nothing moves and no watchdog runs until `arm` or the first `move`. From then on a command must go out `watchdog_Hz` times a
    second, or the controller stops the program by itself.

    Raises RobotError in one sentence when the controller cannot be reached, is not ready to move, or has another master.
    """

    def __init__(
        self,
        host: str,
        *,
        model: RobotModel,
        rate_Hz: float,
        watchdog_Hz: float,
        acceleration_m_per_s2: float,
        tcp: Sequence[float] | None = None,
    ) -> None:
        if not 0 < watchdog_Hz <= rate_Hz:
            raise RobotError(
                f"a watchdog of {watchdog_Hz:g} Hz would trip between two commands at {rate_Hz:g} Hz; choose half of that or less."
            )
        self.host = host
        self._watchdog_Hz = watchdog_Hz
        self._acceleration_m_per_s2 = acceleration_m_per_s2
        self._tcp = None if tcp is None else [float(number) for number in tcp]
        self._armed = False
        self._moving = False
        self._lost = False
        self._fed_s = math.nan
        self._priority = max(0, os.sched_getparam(0).sched_priority - 1)  # the library's threads inherit that of this one
        for port in (SCRIPT_PORT, DASHBOARD_PORT):
            _connect(host, port).close()
        self._reader = UrReader(host, model=model, rate_Hz=rate_Hz)
        try:
            _refuse_unready(self._reader.read(), host)
            self._control = _control(host, rate_Hz)
            _send_at_once(host)
            try:
                self._set_tcp()
            except BaseException:
                _bounded(self._control.disconnect, CLOSE_TIMEOUT_S)
                raise
        except BaseException:
            self._reader.close()
            raise

    @property
    def connected(self) -> bool:
        """Whether both connections have stood without a break since they were made; once false, false for good."""
        if not self._lost and not (self._reader.connected and self._control.isConnected()):
            self._give_up()
        return not self._lost

    @property
    def period_s(self) -> float:
        """Time between two frames."""
        return self._reader.period_s

    def read(self) -> RobotState:
        """Return the newest untorn state without waiting."""
        state = self._reader.read()
        if state.connected and not self._lost and self._control.isConnected():
            return state
        self._give_up()
        return replace(state, connected=False)

    def arm(self) -> None:
        """Set the controller's watchdog, which `move` must feed from now on. Takes two controller cycles. RobotError with the reason."""
        self._refuse_lost()
        self._armed, self._fed_s = True, time.monotonic()
        self._await_script("does not set its watchdog", lambda: self._control.setWatchdog(self._watchdog_Hz))

    def move(self, velocity_m_per_s: tuple[float, float, float]) -> None:
        """Command a tip speed in base axes and keep the orientation; feeds the watchdog.

        True from the library only means "written to the socket"; `read` shows whether the arm follows. RobotError if it was not written.
        """
        self._refuse_lost()
        if not self._armed:
            self.arm()
        refused, speed = "does not take a speed command", [*velocity_m_per_s, 0.0, 0.0, 0.0]
        if not self._moving:
            self._moving = True
            self._await_script(refused, lambda: self._control.speedL(speed, self._acceleration_m_per_s2))
            return
        try:
            written = self._control.speedL(speed, self._acceleration_m_per_s2)
        except RuntimeError:  # the library's own thread is connecting anew
            written = False
        if not written:
            raise RobotError(self._why_not(refused))
        self._fed_s = time.monotonic()

    def tool_offset(self) -> tuple[float, ...]:
        """Pose (6,) of the active TCP in axes of the flange, m and rad. The control script is asked; nothing moves. RobotError."""
        offset: list[float] = []

        def ask() -> bool:
            offset.extend(self._control.getTCPOffset())
            return len(offset) == 6

        self._await_script("does not tell its TCP", ask)
        return tuple(offset)

    def stop(self) -> None:
        """Bring the tip to rest: speed zero at once, then the end of speed control, within 0.25 s. Never raises.

        At rest it feeds the watchdog, so that the program goes on. If the controller does not answer, the driver sends nothing more and
        the watchdog stops the arm.
        """
        with contextlib.suppress(Exception):
            if not self.connected:
                return
            if self._moving:
                self._control.speedL([0.0] * 6, STOP_M_PER_S2)
                if not _bounded(self._giving_way(lambda: self._control.speedStop(STOP_M_PER_S2)), STOP_TIMEOUT_S):
                    self._give_up()
                self._moving = False
            elif self._armed:
                if not _bounded(self._giving_way(self._control.kickWatchdog), STOP_TIMEOUT_S):
                    self._give_up()
                self._fed_s = time.monotonic()

    def end(self) -> None:
        """Stop and end the control script, at most 5 s. Never raises. For a process that ends next, and its connections with it."""
        self.stop()
        if not (self._lost or _bounded(self._giving_way(self._end_script), CLOSE_TIMEOUT_S)):
            self._give_up()

    def close(self) -> None:
        """Stop, end the control script and disconnect: half a second, at most 5 s. Never raises.

        Of a lost connection only the reader is closed.
        """
        self.end()
        reader = threading.Thread(target=self._reader.close, daemon=True)
        reader.start()  # each connection takes half a second to close
        if not (self._lost or _bounded(self._control.disconnect, CLOSE_TIMEOUT_S)):
            self._give_up()
        reader.join()
        self._lost = True

    def _end_script(self) -> None:
        """End the control script if it plays: the library waits a second for one that does not."""
        if self._reader.read().runtime_state == PROGRAM_PLAYING:
            self._control.stopScript()

    def _set_tcp(self) -> None:
        if self._tcp is not None:
            self._await_script("does not take the configured TCP", lambda: self._control.setTcp(self._tcp))

    def _await_script(self, what: str, command: Callable[[], bool]) -> None:
        """Send a command that the control script must answer, and wait until it has, or until the state says that it cannot.

        A command that is still waiting then is left alone, and the control object is used no more.

        Args:
            what: What the robot does not do if it does not answer, for the sentence.
            command: The library's call; false where it was refused.

        Raises:
            RobotError: It was not answered.
        """
        answers: list[bool] = []

        def send() -> None:
            with contextlib.suppress(RuntimeError):  # the library's own thread is connecting anew
                answers.append(command())

        sender = threading.Thread(target=self._giving_way(send), daemon=True)
        sender.start()
        until_s, unfit = time.monotonic() + SCRIPT_TIMEOUT_S, False
        while sender.is_alive() and not unfit and time.monotonic() < until_s:
            sender.join(self.period_s)
            unfit = sender.is_alive() and self._unfit(self._reader.read()) is not None
        if not sender.is_alive() and answers == [True] and self.connected:
            self._fed_s = time.monotonic()
            return
        why = self._why_not(what)
        sender.join(_GRACE_S)
        if sender.is_alive():
            self._give_up()
        raise RobotError(why)

    def _giving_way(self, call: Callable[[], object]) -> Callable[[], None]:
        """A call for a thread of its own, which runs below the priority of the library's thread that hears the answer."""

        def run() -> None:
            if os.sched_getparam(0).sched_priority > self._priority:  # inherited from the thread that starts this one
                os.sched_setscheduler(0, os.SCHED_FIFO if self._priority else os.SCHED_OTHER, os.sched_param(self._priority))
            call()

        return run

    def _give_up(self) -> None:
        """Keep the control object for ever and use it no more: its destruction crashes the process, because its thread reconnects."""
        if not self._lost:
            self._lost = True
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._control))

    def _refuse_lost(self) -> None:
        if not self.connected:
            raise RobotError(
                f"the connection to the robot at {self.host} was lost, and is not taken up again while the arm may move; "
                "check cable and controller, then start anew."
            )

    def _why_not(self, what: str) -> str:
        """One sentence. The control connection may know of a stop some cycles before the reader, so a state that explains it is awaited."""
        until_s = time.monotonic() + SILENT_S
        while (reason := self._unfit(self._reader.read())) is None and time.monotonic() < until_s:
            time.sleep(self.period_s / 2.0)
        age_s = time.monotonic() - self._reader.read().t_s
        if reason is None and age_s > SILENT_S:
            reason = f"its newest state is {age_s:.2f} s old, expected one every {self.period_s:g} s; check cable and controller"
        return f"robot at {self.host} {what}: {reason or _NO_ANSWER}."

    def _unfit(self, state: RobotState) -> str | None:
        """Why the control script cannot answer, as far as the state says it."""
        if self._lost or not state.connected:
            return "the connection was lost; check cable and controller, then start anew"
        if state.safety_mode not in (SafetyMode.NORMAL, SafetyMode.REDUCED):
            return f"its safety mode is {_name(SafetyMode, state.safety_mode)}; clear it at the teach pendant"
        if state.robot_mode != RobotMode.RUNNING:
            return f"its mode is {_name(RobotMode, state.robot_mode)}, RUNNING is needed; switch it on and release its brakes"
        if state.runtime_state != PROGRAM_PLAYING:
            runtime = f"runtime state {state.runtime_state}, {PROGRAM_PLAYING} expected"
            return f"its control script was stopped ({runtime}) {self._stopped_by(state)}"
        return None

    def _stopped_by(self, state: RobotState) -> str:
        """Whether the watchdog can have stopped the control script, by the time from the last command to the first state without it."""
        waited_s, allowed_s = state.t_s - self._fed_s, 1.0 / self._watchdog_Hz
        if not self._armed or waited_s <= 0.0:
            return "before this command: at the pendant, or by another client; start anew"
        measured = f"{waited_s * 1e3:.0f} ms after the last command, and its watchdog allows {allowed_s * 1e3:.0f} ms"
        if waited_s < allowed_s - self.period_s:
            return f"{measured}: so at the pendant, or by another client; start anew"
        return f"{measured}: so by its watchdog; lower the load of this machine and of the network, or robot.watchdog_Hz, and start anew"


_NO_ANSWER = (
    "a program plays there and does not answer, so another client or the pendant has replaced the control script, or commands are lost "
    "on their way; look at the pendant, end the other client and start anew"
)
_TRIES = 20
_GRACE_S = 0.05  # for a call of the library that sees by itself, some cycles later, that it cannot be answered
_PRIORITY_UNTOUCHED = -1  # else the library takes FIFO 90 for the thread that constructs, which is the loop's


def _connect(host: str, port: int) -> socket.socket:
    """Return an open connection, or raise RobotError: the library would wait for ever."""
    try:
        return socket.create_connection((host, port), CONNECT_TIMEOUT_S)
    except (OSError, UnicodeError) as error:  # a name that is none of a host fails in its encoding
        why = "does not answer" if isinstance(error, TimeoutError) else f"cannot be reached ({getattr(error, 'strerror', None) or error})"
        raise RobotError(
            f"robot at {host} {why} on port {port} within {CONNECT_TIMEOUT_S:g} s; "
            "check robot.host, the cable and that the controller is on."
        ) from None


Ask = Callable[[bytes, bytes, bytes], bytes]
"""Sends a package of a type with a body, and returns the body of the next package of the type that answers it."""


class ControllerAbout(NamedTuple):
    """What a controller says of itself: software version, and the payload of its installation, None where it is older than that field."""

    version: tuple[int, int, int]
    payload_kg: float | None

    @property
    def model(self) -> RobotModel:
        """The generation that the version belongs to."""
        return "ur5" if self.version[0] == 3 else "ur5e"


def controller_about(host: str) -> ControllerAbout:
    """Ask a controller for its version and its payload, without a library, a program or a motion. Raises RobotError."""
    with _spoken(host) as ask:
        major, minor, bugfix, _ = struct.unpack(">4I", ask(b"v", b"", b"v"))
        known = b"NOT_FOUND" not in ask(b"O", struct.pack(">d", 10.0) + b"payload", b"O")
        payload_kg = struct.unpack(">Bd", ask(b"S", b"", b"U"))[1] if known else None
        return ControllerAbout((major, minor, bugfix), payload_kg)


def _greet(host: str, model: RobotModel) -> None:
    """Speak RTDE until the first data package, each answer within 2 s, and check the controller's generation."""
    with _spoken(host) as ask:
        major, minor, bugfix, _ = struct.unpack(">4I", ask(b"v", b"", b"v"))
        if (major == 3) != (model == "ur5"):
            generation = "3.x" if model == "ur5" else "5.x"
            raise RobotError(
                f"robot at {host} runs software {major}.{minor}.{bugfix}, but robot.model is {model}, which has {generation}; "
                "correct robot.model."
            )
        kinds = ask(b"O", struct.pack(">d", 10.0) + ",".join(VARIABLES).encode(), b"O")[1:].decode().split(",")
        missing = [name for name, kind in zip(VARIABLES, kinds, strict=False) if kind == "NOT_FOUND"]
        if missing:
            raise RobotError(f"robot at {host} with software {major}.{minor} has no {', '.join(missing)}; 3.10 or newer is needed.")
        ask(b"S", b"", b"U")


@contextlib.contextmanager
def _spoken(host: str) -> Iterator[Ask]:
    """Speak RTDE version 2 within the context, each answer within 2 s.

    Packages are `size u16 | type u8 | body`, big-endian (UR's RTDE guide).
    """
    try:
        with _connect(host, RTDE_PORT) as connection, connection.makefile("rb") as stream:

            def ask(kind: bytes, body: bytes, answer: bytes) -> bytes:
                connection.sendall(struct.pack(">Hc", 3 + len(body), kind) + body)
                for _ in range(_TRIES):  # text messages may come first
                    size, got = struct.unpack(">Hc", stream.read(3))
                    payload: bytes = stream.read(size - 3)
                    if got == answer:
                        return payload
                raise ValueError(f"no answer to {kind!r}")

            if ask(b"V", struct.pack(">H", 2), b"V") != b"\x01":
                raise RobotError(f"robot at {host} does not speak RTDE version 2; its software must be 3.10 or newer.")
            yield ask
    except (OSError, struct.error, ValueError) as error:
        why = (
            f"does not answer on port {RTDE_PORT} within {CONNECT_TIMEOUT_S:g} s" if isinstance(error, TimeoutError) else "breaks off RTDE"
        )
        raise RobotError(f"robot at {host} {why} after the connection was made; restart its controller.") from None


def _control(host: str, rate_Hz: float) -> Any:
    """Construct the library's control object; its script plays then. Holds the GIL for 0.1 to 5 s."""
    try:
        return RTDEControlInterface(host, rate_Hz, rt_priority=_PRIORITY_UNTOUCHED)
    except RuntimeError as error:
        text = _first_line(error)
        if "in use" in text:
            text = "its input registers are owned by another program; end that, or disable EtherNet/IP, PROFINET and MODBUS"
        elif "remote control" in text:
            text = "it is not in remote control; switch it at the teach pendant"
        elif "before timeout" in text:
            text = "the control script did not start within 5 s; check that the robot is on, released and has no popup open"
        raise RobotError(f"robot at {host} cannot be controlled: {text}.") from None


def _send_at_once(host: str) -> None:
    """Turn Nagle's algorithm off on every RTDE connection of this process.

    The library (1.6.5) sets the option on a socket that its connect call then replaces. Without it a command waits for the acknowledgement
    of the command before, which travels with the controller's next package: 6 ms at 125 Hz.
    """
    address = (socket.gethostbyname(host), RTDE_PORT)
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # no socket, not connected, or closed meanwhile
            connection = socket.socket(fileno=int(entry.name))
            try:
                if connection.family == socket.AF_INET and connection.getpeername() == address:
                    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            finally:
                connection.detach()  # the library still owns it


def _refuse_unready(state: RobotState, host: str) -> None:
    if state.robot_mode != RobotMode.RUNNING:
        raise RobotError(
            f"robot at {host} is in mode {_name(RobotMode, state.robot_mode)}, RUNNING is needed; switch it on and release its brakes."
        )
    if state.safety_mode not in (SafetyMode.NORMAL, SafetyMode.REDUCED):
        raise RobotError(
            f"robot at {host} is in safety mode {_name(SafetyMode, state.safety_mode)}, NORMAL or REDUCED is needed; "
            "clear it at the teach pendant."
        )


def _name(kind: type[IntEnum], value: int) -> str:
    return kind(value).name if value in list(kind) else str(value)


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0].rstrip(".!")


def _bounded(call: Callable[[], object], timeout_s: float) -> bool:
    """Make a call that might block for minutes. Returns false if it is not back in time, and drops its exceptions."""

    def run() -> None:
        with contextlib.suppress(Exception):
            call()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(timeout_s)
    return not thread.is_alive()


def _open(settings: RobotSettings) -> UrRobot:
    _refuse_options(settings)
    return UrRobot(
        settings.host,
        model=settings.model,
        rate_Hz=settings.rate_Hz,
        watchdog_Hz=settings.watchdog_Hz,
        acceleration_m_per_s2=settings.acceleration_m_per_s2,
        tcp=settings.tcp,
    )


def _open_reader(settings: RobotSettings) -> UrReader:
    _refuse_options(settings)
    return UrReader(settings.host, model=settings.model, rate_Hz=settings.rate_Hz)


def _refuse_options(settings: RobotSettings) -> None:
    if settings.options:
        raise RobotError(f"robot.options holds {', '.join(settings.options)}, but a UR has no options; remove them.")


def _takes_programs(settings: RobotSettings) -> bool | None:
    """Ask the dashboard of an e-Series for its mode; a CB3 has none. None where it does not say."""
    if settings.model == "ur5":
        return None
    try:
        with socket.create_connection((settings.host, DASHBOARD_PORT), CONNECT_TIMEOUT_S) as connection, connection.makefile("rb") as lines:
            lines.readline()
            connection.sendall(b"is in remote control\n")
            return {b"true": True, b"false": False}.get(lines.readline().strip().lower())
    except OSError:
        return None


UR_RTDE = RobotKind(_open, _open_reader, require_library, _takes_programs)
"""Entry point `ur-rtde`."""
