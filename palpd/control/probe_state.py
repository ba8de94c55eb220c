"""Is the probe free? One pure function answers for tare, calibration, arming, start, doctor, retract and the page (docs/probe-state.md).

What is known from before is a `ProbeRecord`, what the devices say now is `ProbeEvidence`. A marker on disk, written before the first motion
of a run, stands for a contact that nobody has excluded since. Only a confirmed `free` removes it.
"""

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

SMALLEST_DRIFT_N = 0.3
"""Force off the reference that is always expected: two counts of Fz, the bias after a tare, and warmth within minutes."""
LARGEST_DRIFT_N = 0.82
"""Largest force off the reference that an age may excuse: the drift of a HEX-E v2 from cold in 90 minutes (docs/probe-state.md)."""
MOVED_M = 0.002
"""Distance of the tip from where palpd left it beyond which somebody moved the arm: a stop from 10 mm/s ends within 0.5 mm."""
TURNED_RAD = math.radians(1.0)
"""Largest change of the tool's tilt that keeps a reference valid: 1 degree of a probe of 0.2 kg weighs 0.03 N sideways."""
MOST_MOVED_REFERENCE_N = 3.0
"""Farthest that an operator's yes may move the reference from the first one of this sensor with this probe."""

Way = Literal["move", "retract", "level_test", "calibrate", "confirm"]
"""What an answer allows: runs, the way out, the test, a new reference, and a new reference with an operator's yes."""
EVERYTHING: frozenset[Way] = frozenset(("move", "retract", "level_test", "calibrate", "confirm"))


class ProbeState(StrEnum):
    """Whether the probe touches something."""

    FREE = "free"
    PRESSED = "pressed"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class ProbeIdentity:
    """What a reference tare belongs to: sensor, probe (mass in kg, radius and length of the tip in m) and TCP, as far as known."""

    sensor_serial: str | None
    probe: tuple[float, ...] | None
    tcp: tuple[float, ...] | None

    def differences(self, now: "ProbeIdentity") -> list[str]:
        """Sentences for what has changed since; what either does not know cannot have changed."""
        changes = []
        if self.sensor_serial and now.sensor_serial and self.sensor_serial != now.sensor_serial:
            changes.append(f"the reference tare is of sensor {self.sensor_serial}, but {now.sensor_serial} is connected")
        if self.probe is not None and now.probe is not None and self.probe != now.probe:
            changes.append(f"the probe is {_probe(now.probe)}, and was {_probe(self.probe)} at the reference tare")
        if self.tcp is not None and now.tcp is not None and self.tcp != now.tcp:
            changes.append("robot.tcp is not the one of the reference tare")
        return changes


@dataclass(frozen=True, slots=True)
class Reference:
    """The reference tare: `wrench` (6,) in the sensor's axes, with what it belongs to.

    `tilt_rad` None: not known. `drift_N` is the drift expected for its age.
    """

    wrench: tuple[float, ...]
    identity: ProbeIdentity
    tilt_rad: float | None = None
    drift_N: float = SMALLEST_DRIFT_N


@dataclass(frozen=True, slots=True)
class ContactMarker:
    """An unfinished contact: written before the first motion of a run, and removed by a confirmed free probe only.

    `pose` (6,) is where palpd last knew the tip. `at_rest` says that palpd brought it to rest there; a run that died cannot say so.
    `start_pose` is where the run began, and `start_free` whether its first way up showed that place to be free. `surface_z_m` is the
    highest surface that the run has seen, None before the first. `reference` (6,) is the tare that its absolute force refers to.
    """

    date: str
    run: str
    pose: tuple[float, ...]
    start_pose: tuple[float, ...]
    clear_height_m: float
    reference: tuple[float, ...]
    identity: ProbeIdentity
    site: str | None = None
    surface_z_m: float | None = None
    start_free: bool = False
    at_rest: bool = False

    @property
    def clear_z_m(self) -> float | None:
        """Height above which the tip touches nothing where the run has been; None where no surface is known."""
        return None if self.surface_z_m is None else self.surface_z_m + self.clear_height_m


@dataclass(frozen=True, slots=True)
class LevelTested:
    """A way up over which the raw force stayed level: `pose` (6,) and `wrench` (6,) at its end."""

    date: str
    pose: tuple[float, ...]
    wrench: tuple[float, ...]
    identity: ProbeIdentity


@dataclass(frozen=True, slots=True)
class ProbeRecord:
    """What is known from before a run."""

    absolute_limit_N: float
    tip_length_m: float
    reference: Reference | None = None
    marker: ContactMarker | None = None
    level: LevelTested | None = None


@dataclass(frozen=True, slots=True)
class ProbeEvidence:
    """What the devices say: `fault` is a sentence where their data cannot be used.

    `pose` (6,) is that of the tip, `wrench` (6,) the mean raw reading in the sensor's axes.
    """

    pose: tuple[float, ...]
    wrench: tuple[float, ...]
    tilt_rad: float
    identity: ProbeIdentity
    fault: str = ""


@dataclass(frozen=True, slots=True)
class ProbeAnswer:
    """The state of the probe, why, and what it allows. `away_N` is the force off the reference; None where there is none."""

    state: ProbeState
    reasons: tuple[str, ...] = ()
    ways: frozenset[Way] = field(default=EVERYTHING)
    away_N: float | None = None

    @property
    def head(self) -> str:
        """The state in words."""
        return "whether the probe is free is not known" if self.state == ProbeState.UNKNOWN else f"the probe is {self.state}"

    @property
    def sentence(self) -> str:
        """State, reasons and what to do, for people."""
        return self.head if self.state == ProbeState.FREE else f"{self.head}: {'; '.join(self.reasons)}; {self.advice}"

    @property
    def advice(self) -> str:
        """What the operator may do, in the order of what helps most."""
        advice = {
            "retract": "palpd retract leaves the tissue",
            "level_test": "palpd level-test goes 5 mm up and tells",
            "confirm": "palpd calibrate --probe-free takes your word for it",
        }
        offers = [words for way, words in advice.items() if way in self.ways]
        return ", ".join(offers) if offers else "nothing may move: free the probe by hand at the pendant, and check the devices"


def probe_state(record: ProbeRecord, evidence: ProbeEvidence) -> ProbeAnswer:
    """Answer whether the probe is free. The first row of docs/probe-state.md that holds decides.

    Args:
        record: What is known from before.
        evidence: What the devices say now.
    """
    if evidence.fault:
        return ProbeAnswer(ProbeState.UNKNOWN, (evidence.fault,), frozenset())
    marker = record.marker
    zeros = [known.wrench for known in (record.reference,) if known is not None] + ([marker.reference] if marker is not None else [])
    away_N = max((math.dist(evidence.wrench[:3], zero[:3]) for zero in zeros), default=None)
    if away_N is not None and away_N >= record.absolute_limit_N:
        reason = f"{away_N:.1f} N stand against the reference tare, above the absolute limit of {record.absolute_limit_N:g} N"
        return ProbeAnswer(ProbeState.PRESSED, (reason,), frozenset(), away_N)
    level = record.level if record.level is not None and _still_there(record.level, evidence) else None
    if marker is not None and level is None and not _at_free_start(marker, evidence):
        unfinished = f"the {marker.run} of {marker.date} is unfinished"
        z_m, clear_z_m = evidence.pose[2], marker.clear_z_m
        if clear_z_m is not None and z_m < clear_z_m and _same_place(marker, evidence):
            reason = f"{unfinished}, and the tip at z = {z_m:.4f} m is not above the {clear_z_m:.4f} m that clear its highest surface"
            return ProbeAnswer(ProbeState.PRESSED, (reason,), frozenset(("retract",)), away_N)
        if (open_question := _open_question(marker, evidence)) is not None:
            reason = f"{unfinished}, and {open_question}"
            return ProbeAnswer(ProbeState.UNKNOWN, (reason,), frozenset(("retract", "level_test")), away_N)
    if level is not None:
        return ProbeAnswer(ProbeState.FREE, (f"the force stayed level over a way up on {level.date}",), EVERYTHING, away_N)
    doubts = _doubts(record, evidence)
    if doubts:
        return ProbeAnswer(ProbeState.UNKNOWN, tuple(doubts), frozenset(("level_test", "confirm")), away_N)
    return ProbeAnswer(ProbeState.FREE, (), EVERYTHING, away_N)


def expected_drift_N(age_s: float, drift_N_per_min: float) -> float:
    """Force off the reference that its age excuses, between the two bounds.

    Args:
        age_s: Age of the reference; a negative one means that the clock was set back.
        drift_N_per_min: Drift within tolerance.
    """
    return min(max(abs(age_s) / 60.0 * drift_N_per_min, SMALLEST_DRIFT_N), LARGEST_DRIFT_N)


def _doubts(record: ProbeRecord, evidence: ProbeEvidence) -> list[str]:
    """Why the reference does not show that the probe is free."""
    reference = record.reference
    if reference is None:
        return ["there is no reference tare"]
    doubts = reference.identity.differences(evidence.identity)
    if reference.tilt_rad is not None and abs(evidence.tilt_rad - reference.tilt_rad) > TURNED_RAD:
        turned_deg = math.degrees(abs(evidence.tilt_rad - reference.tilt_rad))
        doubts.append(f"the tool is tilted by {turned_deg:.1f} degrees more or less than at the reference tare")
    away_N = math.dist(evidence.wrench[:3], reference.wrench[:3])
    away_Nm = math.dist(evidence.wrench[3:], reference.wrench[3:])
    if not away_N <= reference.drift_N:
        doubts.append(f"the force is {away_N:.2f} N off the reference tare, expected at most {reference.drift_N:.2f} N for its age")
    elif not away_Nm <= reference.drift_N * record.tip_length_m:
        most_Nm = reference.drift_N * record.tip_length_m
        doubts.append(f"the torque is {away_Nm:.4f} Nm off the reference tare, expected at most {most_Nm:.4f} Nm for its age")
    return doubts


def _open_question(marker: ContactMarker, evidence: ProbeEvidence) -> str | None:
    """Why the place of the tip does not show that the contact of the marker is over."""
    if not marker.at_rest:
        return "where it brought the arm to rest is not known"
    moved_m = math.dist(marker.pose[:3], evidence.pose[:3])
    if moved_m > MOVED_M:
        return f"the arm was moved by {moved_m * 1e3:.0f} mm since"
    return "it had found no surface yet" if marker.surface_z_m is None else None


def _at_free_start(marker: ContactMarker, evidence: ProbeEvidence) -> bool:
    """Whether the tip rests where the first way up of the run showed the place to be free."""
    return marker.start_free and marker.at_rest and math.dist(marker.start_pose[:3], evidence.pose[:3]) <= MOVED_M


def _same_place(marker: ContactMarker, evidence: ProbeEvidence) -> bool:
    """Whether the tip may stand over what the run pressed: sideways where palpd left it, or anywhere where a run died."""
    return not marker.at_rest or math.dist(marker.pose[:2], evidence.pose[:2]) <= MOVED_M


def _still_there(level: LevelTested, evidence: ProbeEvidence) -> bool:
    """Whether nothing has changed since the force was level: sensor, probe, place and force."""
    return (
        not level.identity.differences(evidence.identity)
        and math.dist(level.pose[:3], evidence.pose[:3]) <= MOVED_M
        and math.dist(level.wrench[:3], evidence.wrench[:3]) <= SMALLEST_DRIFT_N
    )


def _probe(probe: tuple[float, ...]) -> str:
    mass_kg, radius_m, length_m = probe
    return f"one of {mass_kg:g} kg with a tip of {radius_m * 1e3:g} mm radius, {length_m * 1e3:g} mm long"
