"""One cell with a robot's controller and a force sensor before it, millisecond by millisecond.

Each cycle the controller decides the target's way until the next one. The cell computes that cycle at once, and its samples leave
through the sensor one by one, each at its time. So both see one physics and neither sees the future.
"""

import selectors
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hw.emulators.controller import Controller, TruthSample
from hw.emulators.controller_state import ControllerCycle, ControllerModel
from hw.emulators.hex_pty import Daq, PartsAt, TerminalLine
from hw.emulators.net_ft import NetBox
from hw.emulators.pose import Floats, rotation
from hw.emulators.ur import UrWires, Values, outputs, status_bits
from palpd.cell.cell_file import CellFile
from palpd.cell.effects import EFFECTS
from palpd.cell.physics import Library, true_surface_m
from palpd.cell.stepped import SampleBlock, SteppedCell

SAMPLE_S = 0.001
START_HEIGHT_M = 0.03
"""Height of the tip above the surface at power-up."""
FLANGE_TO_TIP_M = 0.035  # the sensor's body; the probe's length comes on top
GRAVITY_M_PER_S2 = 9.81
SENSOR_KG = 0.2
"""Mass of the sensor (data sheet of the nearest model). The emulated installation has the payload of sensor and probe, as it should be."""
UP_M_PER_S2 = np.array([0.0, 0.0, GRAVITY_M_PER_S2])  # what an accelerometer at rest feels
LOGGED_S = 30.0


class Rig:
    """Everything behind the wires of one emulated cell; `tick` advances it by one millisecond."""

    def __init__(
        self,
        model: ControllerModel,
        cell_file: CellFile,
        host: str,
        link: Path | None,
        *,
        seed: int = 0,
        mount_rotation_rad: float = 0.0,
        fz_parts_at: PartsAt = "reading",
        library: Library = EFFECTS,
        net_ft_port: int | None = None,
    ) -> None:
        self.cell_file, self.model, self._library = cell_file, model, library
        self.cell = SteppedCell(cell_file, seed=seed, step_s=SAMPLE_S, library=library)
        self._wall_z_m: float | None = None
        self.steps = round(model.cycle_s / SAMPLE_S)
        self._random = np.random.default_rng(seed + 1)
        site = cell_file.sites[0] if cell_file.sites else None
        x_m, y_m = (site.x_m, site.y_m) if site else (0.0, 0.0)
        start = np.array([x_m, y_m, self.surface_m(x_m, y_m) + START_HEIGHT_M, np.pi, 0.0, 0.0])
        self._tcp = np.array([0.0, 0.0, FLANGE_TO_TIP_M + cell_file.probe.tip_length_m, 0.0, 0.0, 0.0])
        self.hung_N = 0.0  # a weight that an operator hangs on the probe
        self.axes, self.signs = (0, 1, 2), np.ones(3)  # which of its axes the mounted sensor shows as x, y, z, and with which sign
        self.latency_ms, self._held = 1, b""  # the USB adapter hands bytes on in bursts of this length
        self.controller = Controller(model, start, self._tcp, self.cell.begin, self.cell.rest)
        self.install(self._tcp, SENSOR_KG + cell_file.probe.mass_kg)
        self.network = selectors.DefaultSelector()
        self.wires = UrWires(self.controller, self.network, host)
        self.daq, self.line = Daq(fz_parts_at=fz_parts_at), TerminalLine(link)
        self.box = NetBox(host, net_ft_port, self.network) if net_ft_port is not None else None
        """A Net F/T in place of the HEX-70, which then hangs on its line all the same; its page is on this port."""
        self._mount = rotation([0.0, 0.0, mount_rotation_rad])
        self._orientation = start[3:].copy()
        self._turn(start[3:])
        self._filter = self.daq.filter_code
        self.cell.set_filter(self.box.cutoff_Hz if self.box is not None else self.daq.cutoff_Hz)
        self._fractions = np.arange(1, self.steps + 1) / self.steps
        self._ticks = 0
        self._booted_s: float | None = None
        self._published_s = 0.0
        self._away_until_s = 0.0
        self.frozen_until_s = 0.0  # until then nothing is read or sent, and connections stay open
        self.deaf_until_s = 0.0  # until then nothing is read, and states are still sent
        self.keep_every, self.slow_until_s = 1, 0.0  # until then only one package of this many is sent
        self._on_arming: tuple[float, Callable[[float], object]] | None = None
        self.samples: deque[TruthSample] = deque(maxlen=round(LOGGED_S / SAMPLE_S))
        self.sent: deque[tuple[float, int]] = deque(maxlen=round(LOGGED_S / SAMPLE_S))
        """Host time and counter of each sensor sample, taken just before its bytes went out."""
        self.peak_contact_N = 0.0
        self._values = _power_up_values(model)
        self._last_speed = np.zeros(3)
        self._last_joint_speed = np.zeros(6)
        self._advance(ControllerCycle(start, np.zeros(6), np.zeros(6), np.zeros(6)))

    def surface_m(self, x_m: float, y_m: float) -> float:
        """Return the height of the true surface or wall.

        Args:
            x_m: place in base axes.
            y_m: place in base axes.

        Returns:
            The height in m; 0 where no tissue is defined.
        """
        if self._wall_z_m is not None:
            return self._wall_z_m
        sites = self.cell_file.sites
        near = min(sites, key=lambda site: (site.x_m - x_m) ** 2 + (site.y_m - y_m) ** 2).name if sites else None
        surface_m = true_surface_m(self.cell_file, near, self._library)
        return surface_m if np.isfinite(surface_m) else 0.0

    # One millisecond -----------------------------------------------------------------------------------------------------

    def tick(self, planned_s: float, now_s: float, *, late: bool = False) -> None:
        """Advance by one millisecond: read the wires and send what is due.

        Args:
            planned_s: host time at which this millisecond was due.
            now_s: host time.
            late: the next cycle is due already, so this cycle's package may be skipped.
        """
        if self._away_until_s and now_s >= self._away_until_s:
            self._away_until_s = 0.0
            for server in self.wires.servers():
                server.listen()
        self._meet_arming(now_s)
        if now_s >= max(self.frozen_until_s, self.deaf_until_s):
            for key, _ in self.network.select(0):
                key.data(now_s)
        self._sense(planned_s, now_s)
        self._ticks += 1
        if self._ticks % self.steps == 0:
            self._cycle(planned_s, now_s, late)

    def skip(self, samples: int) -> None:
        """Advance the devices' clocks over milliseconds in which the process stood still."""
        self.controller.state.fed_s += samples * SAMPLE_S  # the whole controller stood still: none of it is the watchdog's
        self.daq.counter = (self.daq.counter + samples) % 65536
        if self.box is not None:
            self.box.skip(samples)

    def _sense(self, planned_s: float, now_s: float) -> None:
        self.daq.take(self.line.receive())
        packet = self.daq.sample(self._counts[self._ticks % self.steps], planned_s)
        if self.daq.answers:
            packet, self.daq.answers = self.daq.answers + packet, b""
        self.sent.append((now_s, self.daq.counter))
        self._held += packet
        if self._ticks % self.latency_ms == 0:
            self.line.send(self._held)
            self._held = b""
        if self.box is not None:
            self.box.sample(self._sensed[self._ticks % self.steps], planned_s)

    def _cycle(self, planned_s: float, now_s: float, late: bool) -> None:
        if self._booted_s is None:
            self._booted_s = planned_s - self.model.cycle_s
        reported = self._block
        self._log(planned_s)
        cycle = self.controller.cycle(planned_s)
        self._publish(planned_s, now_s, reported, cycle, late)
        if self.box is None and self.daq.filter_code != self._filter:
            self._filter = self.daq.filter_code
            self.cell.set_filter(self.daq.cutoff_Hz)
        self._advance(cycle)

    def _log(self, planned_s: float) -> None:
        """Keep the samples of the cycle that ends now."""
        speed, runtime = np.linalg.norm(self._target_speed, axis=1).tolist(), int(self.controller.state.runtime)
        vz, target, tip = self._target_speed[:, 2].tolist(), self._target[:, 2].tolist(), self._block.tip_m[:, 2].tolist()
        contact = self._block.contact_N.tolist()
        for k in range(self.steps):
            t_s = planned_s - (self.steps - 1 - k) * SAMPLE_S
            self.samples.append(TruthSample(t_s, speed[k], vz[k], target[k], tip[k], contact[k], runtime))

    def _advance(self, cycle: ControllerCycle) -> None:
        share, settled = self._fractions, max(cycle.settled, 1e-9)
        change = cycle.speed_after[:3] - cycle.speed_before[:3]
        reached = np.minimum(share / settled, 1.0)
        ramped = np.where(share < settled, share * share / (2.0 * settled), share - 0.5 * settled)
        way = self.model.cycle_s * (np.outer(share, cycle.speed_before[:3]) + np.outer(ramped, change))
        self._target = cycle.start[:3] + way + np.outer(share, cycle.shift[:3] - way[-1])
        self._target_speed = cycle.speed_before[:3] + np.outer(reached, change)
        self._block = self.cell.step(self._target)
        pose = self.controller.state.pose
        if not np.array_equal(pose[3:], self._orientation):
            self._turn(pose[3:])
        wrench = self._block.wrench.copy()
        wrench[:, 2] -= self.cell_file.probe.mass_kg * GRAVITY_M_PER_S2 + self.hung_N
        axes, signs = list(self.axes), self.signs
        forces, torques = wrench[:, :3] @ self._to_sensor.T, wrench[:, 3:] @ self._to_sensor.T
        self._sensed = np.concatenate([forces[:, axes] * signs, torques[:, axes] * signs], axis=1)
        self._counts = self.daq.measure(self._sensed)
        self.peak_contact_N = max(self.peak_contact_N, float(self._block.contact_N.max()))

    def _turn(self, orientation: Floats) -> None:
        """Set the tool's orientation; the sensor's z is the tool's, rotated about it by the mount."""
        self._orientation = orientation.copy()
        self._to_tool = rotation(orientation).T
        self._to_sensor = self._mount.T @ self._to_tool

    # RTDE output -----------------------------------------------------------------------------------------------------

    def _publish(self, planned_s: float, now_s: float, block: SampleBlock, cycle: ControllerCycle, late: bool) -> None:
        robot, values = self.controller.state, self._values
        if now_s < self.frozen_until_s:
            return
        actual = np.concatenate([block.position_m[-1], cycle.start[3:]])
        speed = np.concatenate([block.velocity_m_per_s[-1], cycle.speed_before[3:]])
        noise_N = 0.2 if self.model.e_series else 1.0  # rms: of a wrist sensor, or of an estimate from joint currents (assumed)
        force = np.zeros(6)
        force[2] = block.contact_N[-1]
        force += self._random.standard_normal(6) * noise_N
        acceleration = (speed[:3] - self._last_speed) / self.model.cycle_s
        self._last_speed = speed[:3]
        joint_speed = robot.arm.joint_speed(cycle.speed_before)
        robot_bits, safety_bits = status_bits(robot)
        values |= {
            "timestamp": (planned_s - (self._booted_s or 0.0),),
            "actual_TCP_pose": tuple(robot.tcp_pose(actual)),
            "target_TCP_pose": tuple(robot.tcp_pose(cycle.start)),
            "actual_TCP_speed": tuple(speed),
            "target_TCP_speed": tuple(cycle.speed_before),
            "actual_TCP_force": tuple(force),
            "tcp_force_scalar": (float(np.linalg.norm(force[:3])),),
            "actual_tool_accelerometer": tuple(self._to_tool @ (acceleration + UP_M_PER_S2)),
            "target_q": tuple(robot.arm.joints(cycle.start)),
            "actual_q": tuple(robot.arm.joints(actual)),
            "target_qd": tuple(joint_speed),
            "actual_qd": tuple(robot.arm.joint_speed(speed)),
            "target_qdd": tuple((joint_speed - self._last_joint_speed) / self.model.cycle_s),
            "robot_mode": (int(robot.power),),
            "safety_mode": (int(robot.safety),),
            "runtime_state": (int(robot.runtime),),
            "robot_status_bits": (robot_bits,),
            "safety_status_bits": (safety_bits,),
            "payload": (robot.payload_kg,),
            "payload_cog": robot.payload_cog,
        }
        self._last_joint_speed = joint_speed
        if self.model.e_series:
            values["ft_raw_wrench"] = tuple(force)
        values |= robot.inputs
        values |= robot.outputs
        if not late or now_s - self._published_s >= self.model.cycle_s:
            self._published_s = now_s
            self.wires.keep_every = self.keep_every if now_s < self.slow_until_s else 1
            self.wires.publish(values, now_s)

    # Faults and truth --------------------------------------------------------------------------------------------------------------

    def on_arming(self, after_s: float, action: Callable[[float], object]) -> None:
        """Do something once, when the control program has set its watchdog.

        Args:
            after_s: time between the two; at 0 it happens before the controller reads anything more.
            action: what is done, with the host time.
        """
        self._on_arming = (after_s, action)

    def _meet_arming(self, now_s: float) -> None:
        program = self.controller.state.program
        if self._on_arming is None or program is None or program.watchdog_set_s is None:
            return
        after_s, action = self._on_arming
        if now_s >= program.watchdog_set_s + after_s:
            self._on_arming = None
            action(now_s)

    def restart(self, until_s: float) -> None:
        """Restart the controller's computer: connections and faults of its network end, registers are empty, no port answers until then."""
        self.frozen_until_s = self.deaf_until_s = 0.0
        for server in self.wires.servers():
            server.close()
        self.controller.state.stop_program(until_s, "restart")
        fresh = Controller(self.model, self.controller.state.pose, self._tcp, self.cell.begin, self.cell.rest)
        fresh.state.stops, fresh.state.armings = self.controller.state.stops, self.controller.state.armings
        self._on_arming = None
        self.controller = self.wires.controller = fresh
        self.install(*self._installed)
        self._values = _power_up_values(self.model)
        self._booted_s = self._away_until_s = until_s

    def install(self, tcp: Floats, payload_kg: float) -> None:
        """Set what the pendant's installation says of the tool; it survives a restart.

        Args:
            tcp: pose (6,) of the active TCP in axes of the flange.
        """
        self._installed = tcp, payload_kg
        self.controller.state.tcp, self.controller.state.payload_kg = np.array(tcp, dtype=float), payload_kg

    def place_wall(self, z_m: float, stiffness_N_per_m: float) -> None:
        """Replace the tissue by a linear wall.

        Args:
            z_m: height of the wall.
        """
        self.cell.place_wall(z_m, stiffness_N_per_m)
        self._wall_z_m = z_m

    @property
    def tip(self) -> tuple[float, float]:
        """True height of the tip in m and true contact force in N, at most one controller cycle ahead of the wires."""
        return float(self._block.tip_m[-1, 2]), float(self._block.contact_N[-1])

    def close(self) -> None:
        """Close every wire."""
        for server in self.wires.servers():
            server.close()
        if self.box is not None:
            self.box.close()
        self.network.close()
        self.line.unplug()


def _power_up_values(model: ControllerModel) -> Values:
    """Return a value for every output field, as of a UR5 at rest."""
    known = outputs(model.e_series)
    sizes = {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6, "VECTOR6UINT32": 6}
    values: Values = {name: (0,) * sizes.get(kind, 1) for name, kind in known.items()}
    currents = (0.0, -1.9, -1.4, -0.3, 0.0, 0.0)
    values |= {
        "target_current": currents,
        "actual_current": currents,
        "joint_control_output": currents,
        "target_moment": (0.0, -28.0, -17.0, -1.5, 0.0, 0.0),
        "joint_temperatures": (29.0, 30.0, 30.5, 32.0, 33.0, 33.5),
        "actual_joint_voltage": (47.5,) * 6,
        "joint_mode": (253,) * 6,
        "actual_main_voltage": (48.0,),
        "actual_robot_voltage": (47.9,),
        "actual_robot_current": (0.6,),
        "actual_execution_time": (0.4,),
        "speed_scaling": (1.0,),
        "target_speed_fraction": (1.0,),
    }
    return values
