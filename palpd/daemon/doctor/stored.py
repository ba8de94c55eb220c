"""The stored state: reference tare, stiffness of the machine, latch and inertial model."""

from palpd.config import Config
from palpd.control.inertial import InertialModel
from palpd.daemon.finding import Finding
from palpd.daemon.motion_job import other_machine
from palpd.daemon.probe_record import age_s
from palpd.daemon.stored_state import State
from palpd.errors import PalpdError

OLD_DAYS = 365.0
"""Age of a machine's stiffness beyond which it is measured again: screws and mount settle in years, not in days (assumed)."""


def examine_stored(config: Config) -> list[Finding]:
    """Reference tare, stiffness of the machine, latch and inertial model; of what else is kept only what cannot be read."""
    state = State(config.paths.state)
    findings = []
    try:
        calibration = state.calibration()
    except PalpdError as error:
        findings.append(Finding("reference tare", "fail", str(error)))
    else:
        findings.append(
            Finding("reference tare", "ok", f"of {calibration.date}, sensor {calibration.sensor_serial or 'unknown'}")
            if calibration
            else Finding("reference tare", "warn", "none", "run palpd calibrate with the probe free and still")
        )
    findings += examine_machine_stiffness(config)
    for name, read in (
        ("contact", state.marker),
        ("level test", state.level),
        ("last place", state.place),
        ("last check", state.last_check),
    ):
        try:
            read()
        except PalpdError as error:
            findings.append(Finding(name, "fail", str(error)))
    latch = state.latch()
    if latch is not None:
        findings.append(Finding("latch", "warn", f"{latch.reason} ({latch.date})", "inspect the cell, then palpd clear"))
    if config.model.path is None:
        findings.append(Finding("inertial model", "ok", "none configured: inertia is not corrected"))
    else:
        try:
            InertialModel.load(config.model.path, probe_mass_kg=config.cell.probe.mass_kg, sensor_serial=None)
            findings.append(Finding("inertial model", "ok", str(config.model.path.name)))
        except PalpdError as error:
            findings.append(Finding("inertial model", "fail", str(error)))
    return findings


def examine_machine_stiffness(config: Config) -> list[Finding]:
    """The stiffness of the machine that a run would count with, against the sensor of the reference tare; nothing where it is stated."""
    state, name = State(config.paths.state), "machine stiffness"
    if config.machine.stiffness_N_per_m is not None:
        return []
    try:
        machine = state.machine_stiffness()
    except PalpdError as error:
        return [Finding(name, "fail", str(error))]
    if machine is None:
        return [Finding(name, "warn", "none: arm, mount and sensor count as rigid", "put a rigid plate under the probe; palpd stiffness")]
    try:
        calibration = state.calibration()
    except PalpdError:  # the finding on the reference tare says it
        calibration = None
    serial = calibration.sensor_serial if calibration is not None else None
    if machine.sensor_serial and serial and machine.sensor_serial != serial:
        return [Finding(name, "fail", other_machine(machine.sensor_serial, serial))]
    measured = f"{machine.stiffness_N_per_m / 1e3:.3g} N for 1 mm, of {machine.date}, sensor {machine.sensor_serial or 'unknown'}"
    if age_s(machine.date) > OLD_DAYS * 86400.0:
        return [Finding(name, "warn", measured, "it is more than a year old and counts all the same: run palpd stiffness again")]
    return [Finding(name, "ok", measured)]
