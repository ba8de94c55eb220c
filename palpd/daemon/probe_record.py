"""What is known of the probe before a run, from configuration and state folder, and what the devices say of it."""

import datetime

from palpd.config import Config
from palpd.control.probe_state import ProbeEvidence, ProbeIdentity, ProbeRecord, Reference, expected_drift_N
from palpd.control.tare import tilt_rad
from palpd.daemon.stored_state import Calibration, State
from palpd.recording.header import RunAbout


def identity_of(config: Config, about: RunAbout | None = None) -> ProbeIdentity:
    """Sensor, probe and TCP as the configuration and the opened devices tell.

    Args:
        about: What the opened devices say of themselves; None: the serial number of the sensor is not known.
    """
    probe = config.cell.probe
    return ProbeIdentity(
        (about or {}).get("sensor_serial") or None, (probe.mass_kg, probe.tip_radius_m, probe.tip_length_m), config.robot.tcp
    )


def probe_record(config: Config, state: State) -> ProbeRecord:
    """What is known of the probe before a run.

    Args:
        state: The state folder.

    Raises:
        ConfigError: A file of the state folder is damaged.
    """
    calibration = state.calibration()
    return ProbeRecord(
        absolute_limit_N=config.safety.absolute_limit_N,
        tip_length_m=config.cell.probe.tip_length_m,
        reference=_reference(config, calibration) if calibration is not None else None,
        marker=state.marker(),
        level=state.level(),
    )


def evidence_of(config: Config, about: RunAbout, pose: tuple[float, ...], wrench: tuple[float, ...], fault: str = "") -> ProbeEvidence:
    """What the devices say of the probe.

    Args:
        about: What the opened devices say of themselves.
        pose: Pose (6,) of the tip.
        wrench: Mean raw wrench (6,) in the sensor's axes.
        fault: Why the data cannot be used; empty where they can.
    """
    return ProbeEvidence(pose, wrench, tilt_rad(pose[3:]), identity_of(config, about), fault)


def _reference(config: Config, calibration: Calibration) -> Reference:
    drift_N = expected_drift_N(age_s(calibration.date), config.cell.tolerances.drift_N_per_min)
    return Reference(calibration.wrench, calibration.identity, calibration.tilt_rad, drift_N)


def age_s(date: str) -> float:
    """Age of a date of ours; one that cannot be read is taken for now, so that its age excuses nothing."""
    now = datetime.datetime.now().astimezone()
    try:
        return (now - datetime.datetime.fromisoformat(date).astimezone()).total_seconds()
    except ValueError:
        return 0.0
