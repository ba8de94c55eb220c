"""What another configuration would have done in a recorded run, as far as the recording can know it.

What is recorded of robot and force answered the recorded commands. So everything is known up to the first command that differs, and nothing
of the motion behind it.
"""

from typing import Any, Literal, TypedDict

import numpy as np

from palpd.config import Config
from palpd.control.loop import Loop
from palpd.control.safety import sentence
from palpd.control.sequence import SOFT_END
from palpd.daemon.job_progress import ACTIVITIES
from palpd.history.comparison import different_settings
from palpd.recording.reader import Recording
from palpd.tick import Action, Phase, TickRecord, Trip

TESTED = (
    "safety.", "model.", "machine.", "sensor.rotation_about_flange_z_rad", "sensor.capacity_N", "cell.probe.tip_radius_m",
    "cell.probe.mass_kg",
)  # fmt: skip
"""Keys that only the loop reads, so a replay shows what they do.

All others act before the recording or outside of the loop. Devices, rates, filter and calibration formed what was recorded, watchdog and
acceleration act in the controller, `check` acts before a run, `page` and `alarms` in other processes, and the rest of `cell` is a belief.
"""
SAME_M_PER_S = 1e-9
"""Difference of two commands below which they move the arm alike: in a run of an hour it adds up to 4 µm."""


class ChangedSetting(TypedDict):
    """A setting that differs from the recording's own, and whether a replay shows what it does."""

    key: str
    recorded: Any
    given: Any
    tested: bool


class DifferentCommand(TypedDict):
    """The first command to the arm that differs; a velocity of None is a stop, and `force_N` the contact force as replayed.

    `margin_N` is how far the force was below the limit of the other configuration where another limit ended the recorded run or press. The
    recorded peak is the largest contact force from there on, `recorded_more_N` the rise to it.
    """

    tick: int
    t_s: float
    site: str | None
    phase: str
    force_N: float
    recorded_m_per_s: list[float] | None
    given_m_per_s: list[float] | None
    margin_N: float | None
    recorded_peak_N: float
    recorded_peak_t_s: float
    recorded_more_N: float


class WouldHave(TypedDict):
    """What another configuration would have done; the verdict is `unknown` where its first different command does not end the run.

    `reason` is why it would have ended run or press, or why the recorded one did.
    """

    verdict: str
    reason: str
    would_have: Literal["moved_the_same", "ended", "ended_press", "gone_on", "moved_otherwise"] | None
    first_different_command: DifferentCommand | None
    sentences: list[str]


def changed_settings(own: Config, given: Config) -> list[ChangedSetting]:
    """Compare another configuration, `given`, with the recording's own; paths and ports are left out."""
    pairs = different_settings({"config": own.model_dump(mode="json")}, {"config": given.model_dump(mode="json")})
    unknown = ("machine.stiffness_N_per_m", None)  # a run then takes the last measured one, which the recording does not hold
    tested = [pair.key.startswith(TESTED) and (pair.key, pair.other) != unknown for pair in pairs]
    return [{"key": pair.key, "recorded": pair.one, "given": pair.other, "tested": each} for pair, each in zip(pairs, tested, strict=True)]


def as_tested(own: Config, given: Config) -> Config:
    """The recording's own configuration with the `TESTED` settings of another one, `given`."""
    of_sensor = {"rotation_about_flange_z_rad": given.sensor.rotation_about_flange_z_rad, "capacity_N": given.sensor.capacity_N}
    blocks = {"safety": given.safety, "model": given.model, "machine": given.machine}
    cell = own.cell.model_copy(update={"probe": given.cell.probe})
    return own.model_copy(update={**blocks, "sensor": own.sensor.model_copy(update=of_sensor), "cell": cell})


def same_command(row: np.void, record: TickRecord) -> bool:
    """Whether the same goes out to the arm in a recorded tick and in its replay."""
    command, away_m_per_s = record.verdict.command, np.abs(row["command_m_per_s"] - record.verdict.command.velocity_m_per_s)
    return command.stop == bool(row["command_stop"]) and bool((away_m_per_s < SAME_M_PER_S).all())


def would_have(recording: Recording, at: int, record: TickRecord, goes_on: bool, loop: Loop) -> WouldHave:
    """Say what another configuration would have done at its first different command, and what the recorded run did.

    Args:
        at: The row where the replay ended: that command, or the end of the run.
        record: The same tick, replayed.
        goes_on: Whether the replay would go on.
        loop: The loop that replayed it, under the other configuration.
    """
    rows, verdict, contact, limits = recording.rows, record.verdict, record.observation.contact, loop.limits
    row, trip, phase, last = rows[at], Trip(int(rows["trip"][at])), Phase(int(rows["phase"][at])), at + 1 == len(rows)
    ended_here = row["action"] == Action.STOP or phase == Phase.DONE  # else a device or a loss of power ended it
    if same_command(row, record) and last and not (goes_on and ended_here):
        same = "Every command would have been the same, to the end of the run."
        recorded_verdict = recording.footer.get("verdict", "stopped")
        return {
            "verdict": recorded_verdict if goes_on else loop.outcome.verdict, "reason": loop.outcome.reason,
            "would_have": "moved_the_same", "first_different_command": None, "sentences": [same],
        }  # fmt: skip
    peak_at = at + int(rows["force_N"][at:].argmax())
    peak_N, more_N = float(rows["force_N"][peak_at]), float(rows["force_N"][peak_at] - row["force_N"])
    t_s, peak_t_s = (float(rows["now_s"][number] - rows["now_s"][0]) for number in (at, peak_at))
    recorded = None if row["command_stop"] else row["command_m_per_s"].tolist()
    given = None if verdict.command.stop else list(verdict.command.velocity_m_per_s)
    did = f"the command would have been {_words(given)} in place of {_words(recorded)}"
    then = f"The recorded run went on, up to {peak_N:.2f} N at {peak_t_s:.2f} s ({_place(recording, peak_at)}): {more_N:.2f} N more."
    soft_end = f"{SOFT_END * limits.contact_N:.3g} N, {SOFT_END:g} of the contact limit"
    recorded_end = recording.footer.get("reason") or "the script was done" if trip or phase == Phase.DONE else ""
    cut_short, margin_N, reason, ends = int(record.proposal.progress.cut_short) - int(row["cut_short"]), None, "", "unknown"
    outcome: Literal["ended", "ended_press", "gone_on", "moved_otherwise"] = "moved_otherwise"
    if verdict.trip or not goes_on:
        outcome, ends = "ended", "stopped" if verdict.trip else loop.outcome.verdict
        reason = sentence(verdict) if verdict.trip else loop.outcome.reason or "the script was done"
        did, then = f"the run would have ended: {reason}", f"The recorded run ended there too: {recorded_end}." if recorded_end else then
    elif recorded_end or cut_short < 0:
        outcome, reason = "gone_on", recorded_end or "it neared its contact limit"
        margin_N = {
            Trip.ABSOLUTE_FORCE: limits.absolute_N - contact.absolute_N,
            Trip.LATERAL_FORCE: limits.lateral_N - contact.lateral_N,
            Trip.CONTACT_FORCE if recorded_end else Trip.NONE: limits.contact_N - contact.force_N,
        }.get(trip)
        did = f"the recorded {'run' if recorded_end else 'press'} ended: {reason}. With this configuration {did}"
        then = "" if margin_N is None else f"The limit of this configuration is {margin_N:.2f} N above the force there."
    elif cut_short > 0:
        outcome, reason = "ended_press", f"it reached {soft_end}"
        did = f"the press would have ended: {reason}"
    elif phase in (Phase.PRESS, Phase.HOLD) and row["site"] >= 0 and peak_N > SOFT_END * limits.contact_N:
        then += f" A press of this configuration ends at {soft_end}."
    not_known = "Motion and force after that command are not known: the recording holds the answers to another one."
    return {
        "verdict": ends, "reason": reason, "would_have": outcome,
        "first_different_command": {
            "tick": int(row["index"]), "t_s": t_s, "site": recording.site_name(int(row["site"])) if row["site"] >= 0 else None,
            "phase": phase.name.lower(), "force_N": contact.force_N, "recorded_m_per_s": recorded, "given_m_per_s": given,
            "margin_N": margin_N, "recorded_peak_N": peak_N, "recorded_peak_t_s": peak_t_s, "recorded_more_N": more_N,
        },
        "sentences": [f"At {t_s:.2f} s ({_place(recording, at)}, {contact.force_N:.2f} N) {did}.", *filter(None, [then]), not_known],
    }  # fmt: skip


def _place(recording: Recording, at: int) -> str:
    site, activity = int(recording.rows["site"][at]), ACTIVITIES[Phase(int(recording.rows["phase"][at]))]
    return f"site {recording.site_name(site)}: {activity}" if site >= 0 else activity


def _words(velocity_m_per_s: list[float] | None) -> str:
    return "a stop" if velocity_m_per_s is None else "({}, {}, {}) mm/s".format(*(round(1e3 * each, 6) + 0.0 for each in velocity_m_per_s))
