"""What another configuration would have done in a recorded run, as far as the recording can know it.

What is recorded of robot and force answered the recorded commands. So everything is known up to the first command that differs, and nothing
of the motion behind it.
"""

from typing import Any, Literal, TypedDict

from palpd.config import Config
from palpd.control.loop import Loop
from palpd.control.safety import sentence
from palpd.control.sequence import SOFT_END
from palpd.daemon.job_progress import ACTIVITIES
from palpd.history.comparison import different_settings
from palpd.recording.reader import Recording
from palpd.tick import Phase, TickRecord, Trip

TESTED = (
    "safety.", "model.", "machine.", "sensor.rotation_about_flange_z_rad", "sensor.capacity_N", "cell.probe.tip_radius_m",
    "cell.probe.mass_kg",
)  # fmt: skip
"""Keys that only the loop reads, so a replay shows what they do.

All others act before the recording or outside of the loop. Devices, rates, filter and calibration formed what was recorded, watchdog and
acceleration act in the controller, `check` acts before a run, `page` and `alarms` in other processes, and the rest of `cell` is a belief.
"""


class ChangedSetting(TypedDict):
    """A setting that differs from the recording's own, and whether a replay shows what it does."""

    key: str
    recorded: Any
    given: Any
    tested: bool


class DifferentCommand(TypedDict):
    """The first command to the arm that differs; of the two velocities, None is a stop. `force_N` is the contact force as replayed.

    Where the recorded run or press ended and would have gone on, `margin_N` is the limit that ended it, of the other configuration, less
    the force; None where no force ended it. The recorded peak is the largest contact force from there on, `recorded_more_N` the rise to it.
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
    """What another configuration would have done: `reason` is why it would have ended run or press, or why the recorded one did.

    The verdict is `unknown` where the first different command does not end the run.
    """

    verdict: str
    reason: str
    would_have: Literal["moved_the_same", "ended", "ended_press", "gone_on", "moved_otherwise"] | None
    first_different_command: DifferentCommand | None
    sentences: list[str]


def changed_settings(own: Config, given: Config) -> list[ChangedSetting]:
    """Compare another configuration with the recording's own; paths and ports are left out.

    Args:
        given: The other one.
    """
    pairs = different_settings({"config": own.model_dump(mode="json")}, {"config": given.model_dump(mode="json")})
    unknown = ("machine.stiffness_N_per_m", None)  # a run then takes the last measured one, which the recording does not hold
    tested = [pair.key.startswith(TESTED) and (pair.key, pair.other) != unknown for pair in pairs]
    return [{"key": pair.key, "recorded": pair.one, "given": pair.other, "tested": each} for pair, each in zip(pairs, tested, strict=True)]


def as_tested(own: Config, given: Config) -> Config:
    """The recording's own configuration with the `TESTED` settings of another one.

    Args:
        given: The other one.
    """
    of_sensor = {"rotation_about_flange_z_rad": given.sensor.rotation_about_flange_z_rad, "capacity_N": given.sensor.capacity_N}
    blocks = {"safety": given.safety, "model": given.model, "machine": given.machine}
    cell = own.cell.model_copy(update={"probe": given.cell.probe})
    return own.model_copy(update={**blocks, "sensor": own.sensor.model_copy(update=of_sensor), "cell": cell})


def would_have(recording: Recording, at: int, record: TickRecord, over: bool, loop: Loop) -> WouldHave:
    """Say what another configuration would have done at its first different command, and what the recorded run did.

    Args:
        at: Number of the row.
        record: The same tick, replayed.
        over: Whether the replay ended there.
        loop: The loop that replayed it.
    """
    rows, verdict, contact, limits = recording.rows, record.verdict, record.observation.contact, loop.limits
    row, peak_at, trip = rows[at], at + int(rows["force_N"][at:].argmax()), Trip(int(rows["trip"][at]))
    peak_N, more_N = float(rows["force_N"][peak_at]), float(rows["force_N"][peak_at] - row["force_N"])
    t_s, peak_t_s = (float(rows["now_s"][number] - rows["now_s"][0]) for number in (at, peak_at))
    recorded = None if row["command_stop"] else row["command_m_per_s"].tolist()
    given = None if verdict.command.stop else list(verdict.command.velocity_m_per_s)
    commands = f"the command would have been {_words(given)} in place of {_words(recorded)}"
    soft_end = f"{SOFT_END * limits.contact_N:.3g} N, {SOFT_END:g} of the contact limit"
    then = f"The recorded run went on, up to {peak_N:.2f} N at {peak_t_s:.2f} s ({_place(recording, peak_at)}): {more_N:.2f} N more."
    recorded_end = recording.footer.get("reason") or "the script was done" if trip or row["phase"] == Phase.DONE else ""
    cut_short, margin_N, reason = int(record.proposal.progress.cut_short) - int(row["cut_short"]), None, ""
    did, ends = commands, "unknown"
    outcome: Literal["ended", "ended_press", "gone_on", "moved_otherwise"] = "moved_otherwise"
    if over or verdict.trip:
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
        did = f"the recorded {'run' if recorded_end else 'press'} ended: {reason}. With this configuration {commands}"
        then = "" if margin_N is None else f"The limit of this configuration is {margin_N:.2f} N above the force there."
    elif cut_short > 0:
        outcome, reason = "ended_press", f"it reached {soft_end}"
        did = f"the press would have ended: {reason}"
    elif row["phase"] in (Phase.PRESS, Phase.HOLD) and row["site"] >= 0:
        then += f" A press of this configuration ends at {soft_end}."
    return {
        "verdict": ends,
        "reason": reason,
        "would_have": outcome,
        "first_different_command": {
            "tick": int(row["index"]), "t_s": t_s, "site": recording.site_name(int(row["site"])) if row["site"] >= 0 else None,
            "phase": Phase(int(row["phase"])).name.lower(), "force_N": contact.force_N,
            "recorded_m_per_s": recorded, "given_m_per_s": given,
            "margin_N": margin_N, "recorded_peak_N": peak_N, "recorded_peak_t_s": peak_t_s, "recorded_more_N": more_N,
        },
        "sentences": [
            f"At {t_s:.2f} s ({_place(recording, at)}, {contact.force_N:.2f} N) {did}.",
            *([then] if then else []),
            "Motion and force after that command are not known: the recording holds the answers to another one.",
        ],
    }  # fmt: skip


def _place(recording: Recording, at: int) -> str:
    site, activity = int(recording.rows["site"][at]), ACTIVITIES[Phase(int(recording.rows["phase"][at]))]
    return f"site {recording.site_name(site)}: {activity}" if site >= 0 else activity


def _words(velocity_m_per_s: list[float] | None) -> str:
    return "a stop" if velocity_m_per_s is None else "({}, {}, {}) mm/s".format(*(round(1e3 * each, 6) + 0.0 for each in velocity_m_per_s))
