"""The steps in which the arm stands: devices, tool, noise, signs, files, reference tare, service."""

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from palpd.config import HEX_70, filter_delay_s
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
from palpd.daemon.setup.commission import seen
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
SLOWEST_FILTER_MS = 3.2
"""Largest delay of a filter that is small beside the loop's: that of 50 Hz."""


def find_robot(cell: SetupCell) -> Sequence[Finding]:
    """Find the controller, write the first files, and count the states."""
    known = cell.config.robot.host if cell.config_file.exists() else ""
    host = cell.robot or cell.operator.ask("Address of the robot's controller", known)
    about = wiring.controller_about(host)
    if not cell.config_file.exists():
        (limit_N,) = cell.numbers("Contact limit in N: the force at which the guard ends a press", "12")
        write_starting_files(cell.folder, about.model, limit_N, ())
    cell.change({("robot", "host"): host})
    stated, measured = cell.config.robot.model, f"software {'.'.join(map(str, about.version))} at {host}: an {about.model}"
    kind = seen("robot model", measured, f"{stated}, as robot.model says")
    if stated != about.model:
        if not cell.agrees(f"It has {measured}, but robot.model is {stated}. Set robot.model to {about.model}?"):
            return [
                replace(kind, verdict="fail", advice=f"set robot.model to {about.model}: rates and delays of an {stated} are wrong for it")
            ]
        cell.change({("robot", "model"): about.model})
        kind = replace(kind, verdict="warn", advice=f"robot.model is set to {about.model} now; redo the steps that were done before")
    config = cell.config
    with closing(wiring.open_reader(config)) as reader:
        record = observed(None, reader, STATES_S)
    rate_Hz, expected_Hz = len(record.state_s) / record.duration_s, config.robot.rate_Hz
    advice = (
        "the loop would take old states for new ones: use a cable straight to the controller, and end other clients that slow it; "
        f"or set robot.rtde_rate_Hz to {expected_Hz / max(2, round(expected_Hz / max(rate_Hz, 1.0))):g}"
    )
    slow = rate_Hz < RATE_SHARE * expected_Hz
    states = seen("robot states", f"{rate_Hz:.0f} states/s", f"{expected_Hz:g} states/s", advice, fails=slow, state_rate_Hz=rate_Hz)
    return [kind, states, *judge_robot(record, config)]


def find_sensor(cell: SetupCell) -> Sequence[Finding]:
    """Find the sensor, take its calibration, open it."""
    ports = [str(each) for each in sensor_ports()]
    where = cell.sensor or (ports[0] if len(ports) == 1 else cell.operator.choose("Which sensor?", ports) if ports else "")
    if not where:
        where = cell.operator.ask("No DAQ answers to the USB identity 04d8:000a. Port or address of the sensor", cell.config.sensor.port)
    local = Path(where).absolute()
    cell.change({("sensor", "port"): str(local) if local.exists() else where})
    if cell.config.sensor.kind == HEX_70 and cell.operator.choose("Where is the calibration?", ("registers", "sheet")) == "sheet":
        counts_per_N = cell.numbers("Counts per N of fx, fy, fz on the sheet", "", 3)
        counts_per_Nm = cell.numbers("Counts per Nm of tx, ty, tz on the sheet", "", 3)
        cell.change({("sensor", "counts_per_N"): counts_per_N, ("sensor", "counts_per_Nm"): counts_per_Nm})
    config = cell.config
    with closing(wiring.open_sensor(config)) as sensor:
        which, from_registers = identified(sensor, config), int(sensor.calibration_source == "registers")
        counts = ", ".join(f"{value:.2f}" for value in sensor.counts_per_N)
    cutoff_Hz, delay_ms = config.sensor.filter_cutoff_Hz, 1e3 * filter_delay_s(config.sensor.filter_cutoff_Hz)
    measured, slow = f"{cutoff_Hz or 'no'} Hz, {delay_ms:.1f} ms of delay", delay_ms > SLOWEST_FILTER_MS
    advice = f"each reaction is {delay_ms:.0f} ms late: set sensor.filter_cutoff_Hz to 150"
    return [
        which,
        seen("calibration", f"{counts} counts per N", "those on the unit's sheet, within 1 %", from_registers=from_registers),
        seen("sensor filter", measured, "150 Hz, 1.1 ms of delay", advice, warns=slow, filter_cutoff_Hz=cutoff_Hz),
        *port(config.sensor.port),
    ]


def compare_tool(cell: SetupCell) -> Sequence[Finding]:
    """Compare TCP and payload of the controller with what ruler and scales say."""
    config = cell.config
    usual_mm = 1e3 * (SENSOR_BODY_M + config.cell.probe.tip_length_m)
    tip_mm = cell.numbers("Tip of the probe from the middle of the flange, x, y, z in mm, by a ruler", f"0, 0, {usual_mm:g}", 3)
    (mass_kg,) = cell.numbers("Mass of all that hangs on the flange in kg, by scales: mount, sensor, probe", "")
    offset = wiring.tool_offset(config)
    off_m, turned_rad = math.dist(offset[:3], [each / 1e3 for each in tip_mm]), math.hypot(*offset[3:])
    tcp = seen(
        "TCP",
        f"({', '.join(f'{1e3 * each:.1f}' for each in offset[:3])}) mm, turned by {math.degrees(turned_rad):.1f}°",
        f"({', '.join(f'{each:.1f}' for each in tip_mm)}) mm within {TCP_M * 1e3:g} mm, not turned",
        "correct the TCP at the pendant (Installation), or set robot.tcp; depths and torques are wrong by the difference",
        fails=off_m > TCP_M or turned_rad > TCP_RAD,
        tcp_off_m=off_m,
        tcp_turned_rad=turned_rad,
    )
    payload_kg, expected = wiring.controller_about(config.robot.host).payload_kg, f"{mass_kg:g} kg within {PAYLOAD_KG:g} kg"
    advice = f"set the payload to {mass_kg:g} kg at the pendant (Installation): without it the arm sags or rises"
    if payload_kg is None:
        return [tcp, seen("payload", "this software does not say it", expected, advice, warns=True)]
    wrong = abs(payload_kg - mass_kg) > PAYLOAD_KG
    return [tcp, seen("payload", f"{payload_kg:.2f} kg", expected, advice, fails=wrong, payload_kg=payload_kg)]


def look(cell: SetupCell) -> Sequence[Finding]:
    """Judge this PC and both devices, as `palpd doctor` does, but for what later steps bring."""
    findings = examined(cell.config, wiring.open_sensor, wiring.open_reader, LOOK_S, None, cell.operator.ask)
    return [finding for finding in findings if finding.name not in ("reference tare", "machine stiffness", "inertial model", "latch")]


def hang_weight(cell: SetupCell) -> Sequence[Finding]:
    """Check sign, size and slopes with a known weight."""
    config = cell.config
    (weight_N,) = cell.numbers("Weight in N that you will hang on the probe (mass in kg × 9.81)", "5")

    def ask(what: str) -> None:
        cell.operator.choose(what, ("done",))

    with closing(wiring.open_reader(config)) as reader, closing(wiring.open_sensor(config)) as sensor:
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
    return [seen("files", measured, f"below the sensor's {config.sensor.capacity_N:g} N", overshoot_N=beyond_N)]


def take_reference(cell: SetupCell) -> Sequence[Finding]:
    """Take the reference tare, as `palpd calibrate` does."""
    try:
        taken = calibrate(cell.host)
    except Refused as refused:
        if "--probe-free" not in str(refused) or not cell.confirms(f"{refused}. Is the probe free? Look at it."):
            raise
        taken = calibrate(cell.host, probe_free=True)
    forces = ", ".join(f"{force:.2f}" for force in taken.wrench[:3])
    return [seen("reference tare", f"({forces}) N of sensor {taken.sensor_serial or 'unknown'}", "", wrench=list(taken.wrench))]


def install_service(cell: SetupCell) -> Sequence[Finding]:
    """Put the files of the service into place, as `palpd install` does."""
    number = len(installed(Path("/")))
    cell.operator.say(NEXT_STEPS)
    advice = f"copy the blocks robot, sensor and model of {cell.config_file} into /etc/palpd/config.yaml before you start it"
    return [seen("service", f"{number} files are in place", "", advice, warns=True)]
