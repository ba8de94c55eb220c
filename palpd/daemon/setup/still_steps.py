"""The steps in which the arm stands: devices, tool, noise, signs, files, reference tare, service."""

import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from palpd.config import HEX_70, UR_RTDE, Config, filter_delay_s
from palpd.daemon import wiring
from palpd.daemon.doctor import examined
from palpd.daemon.doctor.devices import identified, judge_robot, observed
from palpd.daemon.doctor.machine import port
from palpd.daemon.doctor.weight import check_weight
from palpd.daemon.finding import Finding
from palpd.daemon.install import NEXT_STEPS, installed
from palpd.daemon.overshoot import overshoot_N
from palpd.daemon.session import calibrate
from palpd.daemon.setup.cell import SetupCell
from palpd.daemon.setup.discovery import sensor_ports
from palpd.daemon.starting_files import checked, write_starting_files
from palpd.errors import Refused

STATES_S = 2.0
"""How long states are counted: 250 at 125 Hz."""
RATE_SHARE = 0.9
"""Share of the expected states that must come; a factor of two or four is what goes wrong."""
LOOK_S = 10.0
"""How long noise and drift are observed, as by `palpd doctor`."""
SENSOR_BODY_M = 0.035
"""Height of a HEX-70 (data sheet): with the probe's length the usual distance from the flange to the tip."""
TCP_M, TCP_RAD = 0.002, math.radians(0.5)
"""Differences of a TCP that a ruler shows; a probe of 115 mm that is turned by 0.5° misses by 1 mm."""
PAYLOAD_KG = 0.1
"""Difference of a payload below which a UR's torques do not show it (assumed)."""
SLOWEST_FILTER_HZ = 50.0
"""Lowest cutoff whose delay of 3 ms is small beside the loop's."""


def find_robot(cell: SetupCell) -> Sequence[Finding]:
    """Find the controller, write the first files, and count the states."""
    known = cell.config.robot.host if cell.config_file.exists() else ""
    host = cell.robot or cell.operator.ask("Address of the robot's controller", known)
    if cell.config_file.exists() and cell.config.robot.kind != UR_RTDE:
        cell.change({("robot", "host"): host})
        return [_states(cell.config), Finding("robot", "ok", f"{cell.config.robot.kind} at {host}; its version is not read")]
    about = wiring.controller_about(host)
    if not cell.config_file.exists():
        (limit_N,) = cell.numbers("Contact limit in N: the force at which the guard ends a press", "12")
        write_starting_files(cell.folder, about.model, limit_N, ())
    model, version = cell.config.robot.model, ".".join(map(str, about.version))
    findings = [Finding("robot", "ok", f"software {version} at {host}, {about.model}", "", {}, "3.x for ur5, 5.x for ur5e")]
    if model != about.model:
        measured, expected = f"software {version}, an {about.model}", f"{model}, as robot.model says"
        if not cell.agrees(f"The controller is an {about.model}, and robot.model says {model}. Set robot.model to {about.model}?"):
            advice = f"set robot.model to {about.model}: rates and delays of an {model} are wrong for it"
            return [Finding("robot model", "fail", measured, advice, {}, expected)]
        cell.change({("robot", "model"): about.model})
        advice = f"robot.model is set to {about.model} now; redo the steps that were done before"
        findings = [Finding("robot model", "warn", measured, advice, {}, expected)]
    cell.change({("robot", "host"): host})
    with closing(wiring.open_reader(cell.config)) as reader:
        record = observed(None, reader, STATES_S)
    return [*findings, _states(cell.config, len(record.state_s) / record.duration_s), *judge_robot(record, cell.config)]


def _states(config: Config, rate_Hz: float | None = None) -> Finding:
    """Whether the states come as often as the loop ticks."""
    if rate_Hz is None:
        with closing(wiring.open_reader(config)) as reader:
            record = observed(None, reader, STATES_S)
        rate_Hz = len(record.state_s) / record.duration_s
    expected_Hz = config.robot.rate_Hz
    enough = rate_Hz >= RATE_SHARE * expected_Hz
    advice = (
        f"the loop would take old states for new ones: a cable straight to the controller, no other client that slows it; "
        f"or set robot.rtde_rate_Hz to {125 if rate_Hz > 0.9 * 125 else 62.5:g}"
    )
    figures = {"state_rate_Hz": rate_Hz}
    return Finding(
        "robot states",
        "ok" if enough else "fail",
        f"{rate_Hz:.0f} states/s",
        "" if enough else advice,
        figures,
        f"{expected_Hz:g} states/s",
    )


def find_sensor(cell: SetupCell) -> Sequence[Finding]:
    """Find the sensor, take its calibration, open it."""
    ports = [str(each) for each in sensor_ports()]
    where = cell.sensor or (ports[0] if len(ports) == 1 else cell.operator.choose("Which sensor?", ports) if ports else "")
    if not where:
        where = cell.operator.ask("No DAQ answers to the USB identity 04d8:000a. Port or address of the sensor", cell.config.sensor.port)
    local = Path(where).absolute()
    cell.change({("sensor", "port"): str(local) if local.exists() else where})
    if cell.config.sensor.kind == HEX_70 and cell.operator.choose("Where is the calibration?", ("registers", "sheet")) == "sheet":
        sheet = {
            ("sensor", "counts_per_N"): cell.numbers("Counts per N of fx, fy, fz on the sheet", "", 3),
            ("sensor", "counts_per_Nm"): cell.numbers("Counts per Nm of tx, ty, tz on the sheet", "", 3),
        }
        cell.change(sheet)
    config = cell.config
    with closing(wiring.open_sensor(config)) as sensor:
        counts = ", ".join(f"{value:.2f}" for value in sensor.counts_per_N)
        findings = [
            identified(sensor, config),
            Finding(
                "calibration", "ok", f"{counts} counts per N", "", {"from_registers": int(sensor.calibration_source == "registers")},
                "those on the unit's sheet, within 1 %",
            ),
        ]  # fmt: skip
    cutoff_Hz, delay_ms = config.sensor.filter_cutoff_Hz, 1e3 * filter_delay_s(config.sensor.filter_cutoff_Hz)
    slow = cutoff_Hz is not None and cutoff_Hz < SLOWEST_FILTER_HZ
    advice = f"each reaction is {delay_ms:.0f} ms late: set sensor.filter_cutoff_Hz to 150" if slow else ""
    measured = f"{cutoff_Hz:g} Hz, {delay_ms:.1f} ms of delay" if cutoff_Hz is not None else "none"
    findings.append(
        Finding("sensor filter", "warn" if slow else "ok", measured, advice, {"filter_cutoff_Hz": cutoff_Hz}, "150 Hz, 1.1 ms of delay")
    )
    return [*findings, *port(config.sensor.port)]


def compare_tool(cell: SetupCell) -> Sequence[Finding]:
    """Compare TCP and payload of the controller with what ruler and scales say."""
    config = cell.config
    if config.robot.kind != UR_RTDE:
        return [Finding("TCP", "warn", f"not read from a {config.robot.kind}", "compare it with a ruler")]
    usual_mm = 1e3 * (SENSOR_BODY_M + config.cell.probe.tip_length_m)
    tip_mm = cell.numbers("Tip of the probe from the middle of the flange, x, y, z in mm, by a ruler", f"0, 0, {usual_mm:g}", 3)
    (mass_kg,) = cell.numbers("Mass of all that hangs on the flange in kg, by scales: mount, sensor, probe", "")
    x_m, y_m, z_m, *turn_rad = wiring.tool_offset(config)
    off_m, off_rad = math.dist((x_m, y_m, z_m), [each / 1e3 for each in tip_mm]), math.hypot(*turn_rad)
    wrong = off_m > TCP_M or off_rad > TCP_RAD
    measured = f"({x_m * 1e3:.1f}, {y_m * 1e3:.1f}, {z_m * 1e3:.1f}) mm, turned by {math.degrees(off_rad):.1f}°"
    advice = (
        "correct the TCP at the pendant (Installation), or set robot.tcp; depths and torques are wrong by the difference" if wrong else ""
    )
    expected = f"({', '.join(f'{each:.1f}' for each in tip_mm)}) mm within {TCP_M * 1e3:g} mm, not turned"
    findings = [Finding("TCP", "fail" if wrong else "ok", measured, advice, {"tcp_off_m": off_m, "tcp_turned_rad": off_rad}, expected)]
    payload_kg = wiring.controller_about(config.robot.host).payload_kg
    if payload_kg is None:
        return [*findings, Finding("payload", "warn", "not told by this software", f"set {mass_kg:g} kg at the pendant")]
    wrong = abs(payload_kg - mass_kg) > PAYLOAD_KG
    unset = "it is not set: " if payload_kg == 0.0 else ""
    advice = f"{unset}set the payload to {mass_kg:g} kg at the pendant (Installation); the arm sags or rises without it" if wrong else ""
    expected = f"{mass_kg:g} kg within {PAYLOAD_KG:g} kg"
    figures = {"payload_kg": payload_kg}
    return [*findings, Finding("payload", "fail" if wrong else "ok", f"{payload_kg:.2f} kg", advice, figures, expected)]


def look(cell: SetupCell) -> Sequence[Finding]:
    """Judge this PC and both devices, as `palpd doctor` does, but for what later steps bring."""
    findings = examined(cell.config, wiring.open_sensor, wiring.open_reader, LOOK_S, None, cell.operator.ask)
    return [finding for finding in findings if finding.name not in ("reference tare", "inertial model", "latch")]


def hang_weight(cell: SetupCell) -> Sequence[Finding]:
    """Check sign, size and slopes with a known weight."""
    config = cell.config
    (weight_N,) = cell.numbers("Weight in N that you will hang on the probe (mass in kg × 9.81)", "5")
    with closing(wiring.open_reader(config)) as reader, closing(wiring.open_sensor(config)) as sensor:

        def ask(what: str) -> None:
            cell.operator.ask(f"{what} Then press Enter.")

        finding = check_weight(sensor, reader.read(), config.sensor, weight_N, ask, sensor.pulled_over_pressed)
        ask("Take the weight off.")
    slopes = {"load": "both", "reading": "pressed"}.get(str(finding.figures.get("slopes_part_at")), config.sensor.fz_slopes)
    if slopes != config.sensor.fz_slopes and cell.agrees(f"{finding.advice}. Set sensor.fz_slopes to {slopes}?"):
        cell.change({("sensor", "fz_slopes"): slopes})
    return [finding]


def check_files(cell: SetupCell) -> Sequence[Finding]:
    """Judge config.yaml and plan.yaml together, as `palpd check-config` does."""
    plan_file = cell.folder / "plan.yaml"
    config, plan = checked(cell.config_file, plan_file if plan_file.exists() else None)
    beyond_N = overshoot_N(config, plan.press_speed_m_per_s, config.safety.expected_stiffness_N_per_m)
    measured = f"a press of {plan.press_speed_m_per_s * 1e3:g} mm/s may run {beyond_N:.1f} N past {config.safety.contact_limit_N:g} N"
    return [Finding("files", "ok", measured, "", {"overshoot_N": beyond_N}, f"below the sensor's {config.sensor.capacity_N:g} N")]


def take_reference(cell: SetupCell) -> Sequence[Finding]:
    """Take the reference tare, as `palpd calibrate` does."""
    try:
        taken = calibrate(cell.host)
    except Refused as refused:
        if "--probe-free" not in str(refused) or not cell.agrees(f"{refused}. Is the probe free? Look at it."):
            raise
        taken = calibrate(cell.host, probe_free=True)
    forces = ", ".join(f"{force:.2f}" for force in taken.wrench[:3])
    return [
        Finding("reference tare", "ok", f"({forces}) N of sensor {taken.sensor_serial or 'unknown'}", "", {"wrench": list(taken.wrench)})
    ]


def install_service(cell: SetupCell) -> Sequence[Finding]:
    """Put the files of the service into place, as `palpd install` does."""
    paths = installed(Path("/"))
    cell.operator.say(NEXT_STEPS)
    advice = f"copy the blocks robot, sensor and model of {cell.config_file} into /etc/palpd/config.yaml before you start it"
    return [Finding("service", "warn", f"{len(paths)} files are in place", advice)]
