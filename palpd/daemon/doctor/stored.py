"""The stored state: reference tare, latch and inertial model."""

from palpd.config import Config
from palpd.control.inertial import InertialModel
from palpd.daemon.finding import Finding
from palpd.daemon.stored_state import State
from palpd.errors import PalpdError


def examine_stored(config: Config) -> list[Finding]:
    """Reference tare, latch and inertial model."""
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
