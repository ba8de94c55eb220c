"""A UR controller's wires: RTDE v2 on port 30004, script upload on 30003, dashboard on 29999.

Every socket is non-blocking and hangs on one selector; `publish` is called once a controller cycle.
"""

import contextlib
import selectors
import socket
import struct
from collections.abc import Iterable
from itertools import chain, islice

from hw.emulators.controller import Controller
from hw.emulators.controller_state import EMERGENCY, FIT, ControllerState, Power, Runtime, Safety

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
SEND_BUFFER = 65536
UNREAD_S = 10.0
"""A client that leaves its packages unread for this long is disconnected."""

PACKING = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "INT32": "i",
    "UINT64": "Q",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
Values = dict[str, tuple[float, ...]]


def _of_type(kind: str, names: str) -> dict[str, str]:
    return dict.fromkeys(names.split(), kind)


def outputs(e_series: bool) -> dict[str, str]:
    """Return the type of every output field that a controller of the generation knows (UR's RTDE guide)."""
    known = {
        **_of_type(
            "DOUBLE",
            "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum actual_main_voltage "
            "actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1 standard_analog_output0 "
            "standard_analog_output1 tool_analog_input0 tool_analog_input1 tool_output_current tool_temperature "
            "tcp_force_scalar payload io_current euromap67_24V_voltage euromap67_24V_current",
        ),
        **_of_type(
            "VECTOR6D",
            "target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current "
            "joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed "
            "joint_temperatures actual_joint_voltage payload_inertia",
        ),
        **_of_type("VECTOR3D", "actual_tool_accelerometer elbow_position elbow_velocity payload_cog"),
        **_of_type("UINT64", "actual_digital_input_bits actual_digital_output_bits"),
        **_of_type("INT32", "robot_mode safety_mode tool_output_voltage"),
        **_of_type(
            "UINT32",
            "runtime_state robot_status_bits safety_status_bits analog_io_types tool_analog_input_types "
            "input_bit_registers0_to_31 input_bit_registers32_to_63 output_bit_registers0_to_31 "
            "output_bit_registers32_to_63",
        ),
        **_of_type("VECTOR6INT32", "joint_mode"),
        **{f"output_int_register_{i}": "INT32" for i in range(48)},
        **{f"output_double_register_{i}": "DOUBLE" for i in range(48)},
        **{f"output_bit_register_{i}": "BOOL" for i in range(64, 128)},
        **INPUTS,
    }
    if e_series:
        known["ft_raw_wrench"] = "VECTOR6D"
    return known


INPUTS: dict[str, str] = {
    **{f"input_int_register_{i}": "INT32" for i in range(48)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(48)},
    **{f"input_bit_register_{i}": "BOOL" for i in range(64, 128)},
    **_of_type("UINT32", "speed_slider_mask"),
    **_of_type("DOUBLE", "speed_slider_fraction standard_analog_output_0 standard_analog_output_1"),
    **_of_type(
        "UINT8",
        "standard_digital_output_mask configurable_digital_output_mask tool_digital_output_mask standard_digital_output "
        "configurable_digital_output tool_digital_output standard_analog_output_mask standard_analog_output_type",
    ),
    **_of_type("VECTOR6D", "external_force_torque"),
}


class Recipe:
    """An agreed list of fields and how they are packed (big endian, in that order)."""

    def __init__(self, number: int, names: list[str], kinds: list[str], every: int = 1) -> None:
        self.number, self.names, self.every = number, names, every
        self.counts = [1 if PACKING[kind][0] not in "36" else int(PACKING[kind][0]) for kind in kinds]
        self._body = struct.Struct(">B" + "".join(PACKING[kind] for kind in kinds))
        self._package = struct.Struct(">HBB" + "".join(PACKING[kind] for kind in kinds))

    def package(self, values: Values) -> bytes:
        """Pack one output data package."""
        numbers = chain.from_iterable(values[name] for name in self.names)
        return self._package.pack(self._package.size, ord("U"), self.number, *numbers)

    def read(self, body: bytes) -> Values:
        """Unpack one input data package; struct.error where it has the wrong length."""
        _, *numbers = self._body.unpack(body)
        left = iter(numbers)
        return {name: tuple(islice(left, count)) for name, count in zip(self.names, self.counts, strict=True)}


class Wire:
    """One accepted connection: bytes in to `take`, bytes out as far as the other end reads."""

    def __init__(self, server: "Server", connection: socket.socket) -> None:
        self.server, self.connection, self.robot = server, connection, server.robot
        self.inbox = b""
        self.outbox = b""
        self.unread_since_s: float | None = None

    def take(self, now_s: float) -> None:
        """Act on the bytes in the inbox."""

    def send(self, data: bytes, now_s: float) -> None:
        """Queue bytes and send as many as fit; the rest goes out later.

        Args:
            now_s: host time.
        """
        self.outbox += data
        self.flush(now_s)

    def flush(self, now_s: float) -> None:
        """Send the queued bytes; close a connection that leaves them unread."""
        if not self.outbox:
            return
        try:
            self.outbox = self.outbox[self.connection.send(self.outbox) :]
        except BlockingIOError:
            pass
        except OSError:
            self.close()
            return
        self.unread_since_s = (self.unread_since_s or now_s) if self.outbox else None
        if self.unread_since_s is not None and now_s - self.unread_since_s > UNREAD_S:
            self.close()

    def close(self) -> None:
        """Close the connection and free the variables that it owned."""
        if self in self.server.wires:
            self.server.wires.remove(self)
            with contextlib.suppress(KeyError, ValueError):
                self.server.selector.unregister(self.connection)
            self.connection.close()


class Server:
    """One listening port."""

    def __init__(self, robot: "UrWires", selector: selectors.BaseSelector, host: str, port: int, wire: type[Wire]) -> None:
        self.robot, self.selector, self.host, self.port, self._wire = robot, selector, host, port, wire
        self.wires: list[Wire] = []
        self._listener: socket.socket | None = None
        self.listen()

    def listen(self) -> None:
        """Open the port; OSError if it is taken."""
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((self.host, self.port))
            listener.listen(8)
        except OSError:
            listener.close()
            raise
        listener.setblocking(False)
        self._listener = listener
        self.selector.register(listener, selectors.EVENT_READ, self._accept)

    def _accept(self, _now_s: float) -> None:
        assert self._listener is not None
        with contextlib.suppress(BlockingIOError):
            connection, _ = self._listener.accept()
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            wire = self._wire(self, connection)
            self.wires.append(wire)
            self.selector.register(connection, selectors.EVENT_READ, lambda now_s: self._receive(wire, now_s))

    def _receive(self, wire: Wire, now_s: float) -> None:
        try:
            data = wire.connection.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            wire.close()
            return
        wire.inbox += data
        wire.take(now_s)

    def drop(self) -> None:
        """Close every connection; the port stays open."""
        for wire in list(self.wires):
            wire.close()

    def close(self) -> None:
        """Close the port and every connection."""
        self.drop()
        if self._listener is not None:
            self.selector.unregister(self._listener)
            self._listener.close()
            self._listener = None


class RtdeWire(Wire):
    """One RTDE client."""

    def __init__(self, server: Server, connection: socket.socket) -> None:
        super().__init__(server, connection)
        self.recipes: list[Recipe] = []
        self.inputs: dict[int, Recipe] = {}
        self.owned: set[str] = set()
        self.streaming = False

    def take(self, now_s: float) -> None:
        """Act on every whole message."""
        while len(self.inbox) >= 3:
            size, kind = struct.unpack_from(">HB", self.inbox)
            if size < 3:
                self.close()
                return
            if len(self.inbox) < size:
                return
            body, self.inbox = self.inbox[3:size], self.inbox[size:]
            try:
                self._message(chr(kind), body, now_s)
            except (struct.error, UnicodeDecodeError):
                self.text(f"Malformed package of type {kind}", 1, now_s)

    def reply(self, kind: str, body: bytes, now_s: float) -> None:
        """Send one message.

        Args:
            kind: letter of the package type.
            body: bytes behind the header.
            now_s: host time.
        """
        self.send(struct.pack(">HB", 3 + len(body), ord(kind)) + body, now_s)

    def text(self, message: str, level: int, now_s: float) -> None:
        """Send a text message.

        Args:
            message: the text, cut at 255 bytes.
            level: 0 exception, 1 error, 2 warning, 3 information.
            now_s: host time.
        """
        text, source = message.encode()[:255], b"RTDE"
        self.reply("M", bytes([len(text)]) + text + bytes([len(source)]) + source + bytes([level]), now_s)

    def _message(self, kind: str, body: bytes, now_s: float) -> None:
        model = self.robot.controller.state.model
        match kind:
            case "V":
                (version,) = struct.unpack(">H", body)
                self.reply("V", bytes([version == 2 and not self.robot.refuse_version]), now_s)
            case "v":
                self.reply("v", struct.pack(">4I", *model.version), now_s)
            case "O":
                (rate_Hz,) = struct.unpack_from(">d", body)
                self._set_outputs(rate_Hz, _names(body[8:]), now_s)
            case "I":
                self._set_inputs(_names(body), now_s)
            case "S":
                accepted = bool(self.recipes)
                if not accepted:
                    self.text("No output recipe: nothing to start", 1, now_s)
                self.streaming = accepted
                self.reply("S", bytes([accepted]), now_s)
            case "P":
                self.streaming = False
                self.reply("P", b"\x01", now_s)
            case "U":
                recipe = self.inputs.get(body[0]) if body else None
                if recipe is None:
                    self.text("Data package of an unknown recipe", 1, now_s)
                else:
                    self.robot.controller.write(recipe.read(body), now_s)
            case "M":
                pass
            case _:
                self.text(f"Unknown package type {ord(kind)}", 2, now_s)

    def _set_outputs(self, rate_Hz: float, names: list[str], now_s: float) -> None:
        kinds = [self.robot.outputs.get(name, "NOT_FOUND") for name in names]
        number = 0
        if "NOT_FOUND" not in kinds:
            number = len(self.recipes) + 1
            fastest_Hz = 1.0 / self.robot.controller.state.model.cycle_s
            every = max(1, round(fastest_Hz / rate_Hz)) if rate_Hz > 0 else 1
            self.recipes.append(Recipe(number, names, kinds, every))
        self.reply("O", bytes([number]) + ",".join(kinds).encode(), now_s)

    def _set_inputs(self, names: list[str], now_s: float) -> None:
        others = {name for wire in self.robot.clients() if wire is not self for name in wire.owned}
        kinds = ["IN_USE" if name in others else INPUTS.get(name, "NOT_FOUND") for name in names]
        number = 0
        if not {"IN_USE", "NOT_FOUND"} & set(kinds):
            number = len(self.inputs) + 1
            self.inputs[number] = Recipe(number, names, kinds)
            self.owned.update(names)
        self.reply("I", bytes([number]) + ",".join(kinds).encode(), now_s)


def _names(text: bytes) -> list[str]:
    return [name for name in text.decode("ascii").strip().split(",") if name]


class ScriptWire(Wire):
    """One client of the script port: text in, nothing out."""

    def take(self, now_s: float) -> None:
        """A script ends with a line that is exactly `end`."""
        end = b"\nend\n"
        while (at := self.inbox.find(end)) >= 0:
            script, self.inbox = self.inbox[: at + len(end)], self.inbox[at + len(end) :]
            self.robot.controller.upload(script.decode("utf-8", "replace"), now_s)


class DashboardWire(Wire):
    """One client of the dashboard server: a line in, a line out."""

    def __init__(self, server: Server, connection: socket.socket) -> None:
        super().__init__(server, connection)
        self.send(b"Connected: Universal Robots Dashboard Server\n", 0.0)

    def take(self, now_s: float) -> None:
        """Answer every whole line."""
        while b"\n" in self.inbox:
            line, _, self.inbox = self.inbox.partition(b"\n")
            asked = line.decode("utf-8", "replace").strip()
            if asked == "quit":
                self.send(b"Disconnected\n", now_s)
                self.close()
                return
            self.send(self.robot.controller.dashboard.answer(asked, now_s).encode() + b"\n", now_s)


class UrWires:
    """All ports of one controller."""

    def __init__(self, controller: Controller, selector: selectors.BaseSelector, host: str) -> None:
        self.controller = controller
        self.outputs = outputs(controller.state.model.e_series)
        self.refuse_version = False
        self.keep_every = 1
        self._index = 0
        self.rtde = Server(self, selector, host, RTDE_PORT, RtdeWire)
        self.script = Server(self, selector, host, SCRIPT_PORT, ScriptWire)
        self.dashboard = Server(self, selector, host, DASHBOARD_PORT, DashboardWire)

    def clients(self) -> Iterable[RtdeWire]:
        """Every connected RTDE client."""
        return (wire for wire in self.rtde.wires if isinstance(wire, RtdeWire))

    def publish(self, values: Values, now_s: float) -> None:
        """Send one package of each recipe that is due. A client that does not read loses packages, and then its connection.

        Args:
            values: value of each output field.
            now_s: host time.
        """
        self._index += 1
        messages, self.controller.state.messages = self.controller.state.messages, []
        for wire in [wire for wire in self.clients() if wire.streaming]:
            for text, level in messages:  # only after a client has started: ur_rtde would take a message for the answer to its handshake
                wire.text(text, level, now_s)
            if self._index % self.keep_every:
                continue
            wire.flush(now_s)
            if not wire.outbox:
                for recipe in wire.recipes:
                    if self._index % recipe.every == 0:
                        wire.send(recipe.package(values), now_s)

    def servers(self) -> tuple[Server, Server, Server]:
        """The three ports."""
        return self.rtde, self.script, self.dashboard


def status_bits(state: ControllerState) -> tuple[int, int]:
    """Return `robot_status_bits` and `safety_status_bits`."""
    robot = int(state.power >= Power.POWER_ON) | int(state.runtime is Runtime.PLAYING) << 1
    mode = 1 << (state.safety - 1 if state.safety <= Safety.ROBOT_EMERGENCY_STOP else state.safety)
    stopped = state.safety not in (*FIT, Safety.RECOVERY)
    return robot, mode | int(state.safety in EMERGENCY) << 7 | int(stopped) << 10
