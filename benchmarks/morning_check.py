"""How often the morning check warns without a reason, finds a change within two days, and names it: on simulated days.

    python -m benchmarks.morning_check --docs docs         (20 cells of 50 days; the diagnosis of 188 days takes most of the time)

A day is the motion of one check, made once by the sequence on a simulated cell, and the physics of the cell on that motion with the
numbers of that day. So the motion does not answer to the change, as it does on a cell: there the search finds the surface anew. Zero and
temperature are drawn.
"""

import argparse
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

from benchmarks.marked_text import write_marked
from palpd.analysis.results import Track, track
from palpd.cell.cell_file import cell_from
from palpd.cell.simulation import simulate
from palpd.config import CheckConfig, CheckTolerances, Config, Plan
from palpd.daemon.motion_job import Job
from palpd.daemon.required_check import check_plan
from palpd.daemon.simulated_run import SimulatedRecording, run
from palpd.files import write_json
from palpd.gap.commands import library, since_healthy
from palpd.gap.diagnosis import diagnose
from palpd.history.check_days import HEALTHY_COMPARED
from palpd.history.check_features import link_figures, measured
from palpd.history.control_charts import CheckedDay, judged
from palpd.quantities import wilson
from palpd.recording.samples import WRENCH_COLUMNS, Samples
from palpd.tick import Floats, Phase
from palpd.workers import pool

CONFIG = Config(check=CheckConfig(plate=True))
MACHINE_N_PER_M, PLATE_N_PER_M, FILTER_S = 50e3, 1e6, 1.0 / (2.0 * np.pi * 150.0)
ZERO_SD_N, ZERO_N_PER_K, ROOM_SD_K = 0.05, 0.03, 2.0
"""Scatter of the zero from day to day, how it follows the temperature, and how that changes."""
HEALTHY_SD: Mapping[str, float] = {
    "gain": 0.001,
    "delay_s": 3e-4,
    "play_m": 2e-6,
    "machine": 0.005,
    "puck": 0.003,
    "servo": 0.01,
    "noise": 0.03,
}
"""Scatter of the other numbers from day to day: relative, or in the unit."""
PUCK_PER_K = -0.002
"""How the puck's modulus follows the temperature."""
FIRST_FAULT_DAY = 20
ALARMED, QUIET = "a false alarm", "nothing"
"""Truth of a healthy day that the charts warned of, and of another one."""
DIAGNOSED = re.compile(r"cell \d+: ([\w ]+), the diagnosis names (.*)")


@dataclass(frozen=True)
class Fault:
    """A change of one number of a cell; `gain`, `machine` are relative, and `zero_sd` counts healthy standard deviations."""

    gain: float = 0.0
    delay_s: float = 0.0
    play_m: float = 0.0
    machine: float = 0.0
    zero_sd: float = 0.0


HEALTHY = Fault()
FAULTS: Mapping[str, tuple[str, Fault, str | None]] = {
    "gain": ("2 % in gain", Fault(gain=0.02), "sensor.gain"),
    "zero": ("3 healthy standard deviations of the zero (0.15 N)", Fault(zero_sd=3.0), None),
    "delay": ("10 ms in latency", Fault(delay_s=0.01), "sensor.latency"),
    "play": ("0.1 mm of play", Fault(play_m=1e-4), "robot.backlash"),
    "machine": ("10 % in machine stiffness", Fault(machine=-0.1), "robot.compliance"),
}
"""Each change by its cause: in words, in numbers, and the effect that a diagnosis should name. It sees no zero, which is tared away."""


@dataclass(frozen=True)
class Template:
    """The motion of a check: commanded heights (n,) at the times (n,) of the sensor's samples, and the frames that they belong to."""

    t_s: Floats
    z_cmd_m: Floats
    frames: Track
    site: slice

    @staticmethod
    def of(simulated: SimulatedRecording) -> "Template":
        """The motion of a simulated run."""
        rows = simulated.rows
        states_s, first = np.unique(rows["robot_t_s"], return_index=True)
        frames = track(rows, FILTER_S)
        z_cmd_m = np.interp(frames.t_s, states_s, rows["target_pose"][first, 2])
        own = np.flatnonzero(~np.isin(frames.phase, (Phase.IDLE, Phase.TARE, Phase.TRAVEL)) & (frames.site >= 0))
        return Template(frames.t_s, z_cmd_m, frames, slice(own[0], own[-1] + 1) if len(own) else slice(None))


class SimulatedCell:
    """One cell: its own numbers, and the days that it draws."""

    def __init__(self, number: int, puck: Template, plate: Template, link: Mapping[str, float]) -> None:
        self._rng = np.random.default_rng([76, number])
        self._puck, self._plate, self._link, self._seed = puck, plate, link, 10_000 * number
        self._own = {name: float(self._rng.normal()) for name in ("machine", "puck", "zero", "delay")}

    def day(self, date: str, fault: Fault = HEALTHY) -> tuple[CheckedDay, Samples]:
        """The figures of one day, and the recording of the puck for a diagnosis."""
        draw = {name: sd * float(self._rng.normal()) for name, sd in HEALTHY_SD.items()}
        warmer_by_k, zero_N = ROOM_SD_K * float(self._rng.normal()), ZERO_SD_N * float(self._rng.normal())
        effects = {
            "robot.compliance": {
                "stiffness_N_per_m": MACHINE_N_PER_M * (1.0 + 0.1 * self._own["machine"]) * (1.0 + draw["machine"]) * (1.0 + fault.machine)
            },
            "sensor.gain": {"error": (1.0 + fault.gain) * (1.0 + draw["gain"]) - 1.0},
            "sensor.latency": {"delay_s": max(0.0, 1e-3 + 2e-4 * self._own["delay"] + draw["delay_s"] + fault.delay_s)},
            "robot.backlash": {"width_m": abs(5e-6 + draw["play_m"]) + fault.play_m},
            "robot.lag": {"bandwidth_ratio": 1.0 + draw["servo"]},
        }
        modulus_Pa = 72e3 * (1.0 + 0.05 * self._own["puck"]) * (1.0 + draw["puck"] + PUCK_PER_K * warmer_by_k)
        common = {"sensor": {"noise_rms_N": 0.05 * (1.0 + draw["noise"])}, "effects": effects}
        at_m = 0.5 * fault.play_m  # where the search would find the surface
        surface_m = at_m + 2e-5 * float(self._rng.normal())
        puck = self._simulated(self._puck, common | {"tissue": {"youngs_modulus_Pa": modulus_Pa, "surface_z_m": surface_m}})
        plate = self._simulated(self._plate, common | {"wall": {"z_m": at_m, "stiffness_N_per_m": PLATE_N_PER_M}})
        zero_N += self._link["zero_N"] + ZERO_N_PER_K * warmer_by_k + 5.0 * self._own["zero"] + fault.zero_sd * ZERO_SD_N
        link = {**self._link, "zero_N": zero_N}
        frames = (_frames(self._puck, puck), _frames(self._plate, plate))
        features = measured(frames[0], frames[1], link, CONFIG.cell.probe.tip_radius_m, 0.5)
        whole = self._puck.site
        site = slice(whole.start, whole.stop, max(1, round(puck.rate_Hz / CONFIG.robot.rate_Hz)))  # as the reports of the robot
        begin_s = float(puck.t_s[site][0])
        cut = {
            field.name: (np.asarray(getattr(puck, field.name))[site] if getattr(puck, field.name) is not None else None)
            for field in fields(Samples)
            if field.name in ("z_cmd_m", "z_m", "vz_m_per_s", "wrench")
        }
        return CheckedDay(date, features, 21.0 + warmer_by_k), Samples(t_s=puck.t_s[site] - begin_s, **cut)  # type: ignore[arg-type]

    def _simulated(self, motion: Template, content: Mapping[str, Any]) -> Samples:
        self._seed += 1
        t_s = motion.t_s - motion.t_s[0]
        out = simulate(cell_from(content, "a day"), t_s, z_cmd_m=motion.z_cmd_m, noise_seed=self._seed)
        return Samples(t_s, motion.z_cmd_m, out["z_m"], out["vz_m_per_s"], np.column_stack([out[name] for name in WRENCH_COLUMNS]))


def _frames(motion: Template, samples: Samples) -> Track:
    """The frames of the motion with that day's heights, as the robot reports them, and forces."""
    reported = slice(None, None, 8)
    z_m = np.interp(motion.t_s - FILTER_S, motion.t_s[reported], samples.z_m[reported])
    return replace(motion.frames, tip_z_m=z_m, fz_N=samples.wrench[:, 2])


@dataclass(frozen=True)
class Episode:
    """A change on one cell: whether it was found within two days, what the charts named, and the recording of the day that found it."""

    cause: str
    within_two: bool
    named: str | None
    recording: Samples


@dataclass(frozen=True)
class CellOutcome:
    """What one cell gave: days judged and warned of without a reason, changes, and recordings of healthy days."""

    judged: int
    false_alarms: tuple[str, ...]
    episodes: tuple[Episode, ...]
    healthy: tuple[Samples, ...]
    alarmed: tuple[Samples, ...]
    quiet: tuple[Samples, ...]


def outcome_of(cell: SimulatedCell, number: int, days: int) -> CellOutcome:
    """Live through the days of a cell, and through two days of each change that begins on some of them.

    Args:
        number: Number of the cell.
        days: Number of healthy days.
    """
    rng, tolerances = np.random.default_rng([77, number]), CheckTolerances()
    drawn = [cell.day(f"day {k}") for k in range(days)]
    lived, recordings = [day for day, _ in drawn], [samples for _, samples in drawn]
    verdicts = judged(lived, tolerances)
    false = tuple(verdict.causes[0] for verdict in verdicts if verdict.level != "ok")
    episodes = []
    for cause, (_, fault, _) in FAULTS.items():
        begins = int(rng.integers(FIRST_FAULT_DAY, days))
        after = [cell.day(f"day {begins + k}", fault) for k in range(2)]
        seen = judged([*lived[:begins], *(day for day, _ in after)], tolerances)[begins:]
        first = next((k for k, verdict in enumerate(seen) if verdict.level != "ok"), None)
        episodes.append(
            Episode(cause, first is not None, seen[first].causes[0] if first is not None else None, after[1 if first is None else first][1])
        )
    later = list(zip(verdicts, recordings, strict=True))[HEALTHY_COMPARED:]
    alarmed = tuple(samples for verdict, samples in later if verdict.level != "ok")
    quiet = tuple(samples for verdict, samples in later[FIRST_FAULT_DAY - HEALTHY_COMPARED :] if verdict.level == "ok")
    return CellOutcome(days, false, tuple(episodes), tuple(recordings[:HEALTHY_COMPARED]), alarmed, quiet)


def diagnosed(outcomes: Sequence[CellOutcome], quiet: int, jobs: int) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Diagnose days of cells against their first days: what truly was, and the effects that were named.

    Args:
        quiet: Number of healthy days a cell without an alarm.
        jobs: Cells that are diagnosed at a time.
    """
    with pool(jobs) as workers:
        for number, answers in enumerate(workers.map(partial(_diagnosed, quiet), outcomes)):
            for truth, named in answers:
                print(f"cell {number}: {truth}, the diagnosis names {', '.join(named) or 'nothing'}", flush=True)
                yield truth, named


def _diagnosed(quiet: int, outcome: CellOutcome) -> list[tuple[str, tuple[str, ...]]]:
    known = library(None)
    asked = [(each.cause, each.recording) for each in outcome.episodes if each.within_two and each.cause != "zero"]
    asked += [(ALARMED, samples) for samples in outcome.alarmed]
    asked += [(QUIET, samples) for samples in outcome.quiet[:quiet]]
    nominal, simulators = since_healthy(list(outcome.healthy), None, known, [samples for _, samples in asked])
    answers = [diagnose([day], nominal, known, propose=False, simulators=[own]) for (_, day), own in zip(asked, simulators, strict=True)]
    return [(truth, tuple(effect.id for effect in answer.effects)) for (truth, _), answer in zip(asked, answers, strict=True)]


def found_at_best(false_alarms: float, cells: int = 4000, days: int = 300) -> dict[str, float]:
    """Share of steps of three known standard deviations that a rule finds within two days.

    Args:
        false_alarms: Share of healthy days on which the rule warns.
        cells: Cells that are drawn.
        days: Days of each.
    """
    healthy = np.random.default_rng(0).standard_normal((cells, days))
    changed = healthy.copy()
    changed[:, -2:] += 3.0

    def two_days(q: Floats) -> Floats:
        return np.abs(q[:, 1:] + q[:, :-1]) / np.sqrt(2.0)

    def ewma(q: Floats, weight: float) -> Floats:
        return np.asarray(np.abs(lfilter([weight], [1.0, weight - 1.0], q)) / np.sqrt(weight / (2.0 - weight)))

    rules: dict[str, Callable[[Floats], Floats]] = {"mean of two days": two_days}
    rules |= {f"EWMA of weight {weight}": partial(ewma, weight=weight) for weight in (0.4, 0.5, 0.6, 0.7)}
    limits = {name: np.quantile(rule(healthy)[:, 20:], 1.0 - false_alarms) for name, rule in rules.items()}
    return {name: float((rule(changed)[:, -2:] > limits[name]).any(axis=1).mean()) for name, rule in rules.items()}


def main() -> None:
    """Simulate, measure, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--days", type=int, default=50)
    parser.add_argument("--diagnosed-cells", type=int, default=20, help="cells whose changes and healthy days are diagnosed; 0: none")
    parser.add_argument("--quiet", type=int, default=5, help="healthy days a cell that are diagnosed, beside those of false alarms")
    parser.add_argument("--jobs", type=int, default=1, help="cells that are diagnosed at a time")
    parser.add_argument("--log", type=Path, help="output of an earlier run, whose diagnoses count in place of new ones")
    parser.add_argument("--docs", type=Path, help="folder of the pages; the table is written there")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--rules", action="store_true", help="only say what rules find at best")
    given = parser.parse_args()
    if given.rules:
        for rule, share in found_at_best(0.0075).items():
            print(f"{rule}: {100.0 * share:.0f} %")
        return
    at_rest = {"effects": {"robot.compliance": {"stiffness_N_per_m": MACHINE_N_PER_M}}}
    puck = run(Job("palpation", CONFIG, check_plan(CONFIG), lifts_first=True), cell_from(at_rest, "the motion"), home_above_m=0.008)
    wall = at_rest | {"wall": {"z_m": 0.0, "stiffness_N_per_m": PLATE_N_PER_M}}
    plate = run(Job("stiffness", CONFIG, Plan(), lifts_first=True), cell_from(wall, "the motion"), home_above_m=0.005)
    motion_s = (len(puck.rows) + len(plate.rows)) / CONFIG.robot.rate_Hz
    print(f"the motion of a check takes {motion_s:.0f} s", flush=True)
    templates, link = (Template.of(puck), Template.of(plate)), link_figures(puck.rows)
    outcomes = []
    for number in range(given.cells):
        outcomes.append(outcome_of(SimulatedCell(number, *templates, link), number, given.days))
        print(f"cell {number}: false {outcomes[-1].false_alarms}, {[(e.cause, e.named) for e in outcomes[-1].episodes]}", flush=True)
    if given.log:
        named = [
            (truth, tuple(names.replace("nothing", "").replace(",", "").split()))
            for truth, names in DIAGNOSED.findall(given.log.read_text())
        ]
    else:
        named = list(diagnosed(outcomes[: given.diagnosed_cells], given.quiet, given.jobs))
    table = table_of(outcomes, named)
    print(table)
    if given.json:
        write_json(given.json, {"table": table, "diagnosed": named})
    if given.docs:
        write_marked(given.docs / "how-to" / "morning-check.md", "morning-check", table)


def table_of(outcomes: Sequence[CellOutcome], named: Sequence[tuple[str, tuple[str, ...]]]) -> str:
    """The table of the page, in Markdown."""
    days = sum(outcome.judged for outcome in outcomes)
    false = Counter(cause for outcome in outcomes for cause in outcome.false_alarms)
    healthy = [effects for truth, effects in named if truth in (ALARMED, QUIET)]
    lines = [
        "| what changes | n | found within two days | named by the charts | named by the diagnosis of the puck |",
        "|---|---|---|---|---|",
    ]
    for cause, (words, _, effect) in FAULTS.items():
        episodes = [each for outcome in outcomes for each in outcome.episodes if each.cause == cause]
        seen = [each for each in episodes if each.within_two]
        answers = [effects for truth, effects in named if truth == cause]
        by_diagnosis = _share(sum(effects[:1] == (effect,) for effects in answers), len(answers)) if answers else "not asked"
        right = sum(each.named == cause for each in seen)
        lines.append(f"| {words} | {len(episodes)} | {_share(len(seen), len(episodes))} | {_share(right, len(seen))} | {by_diagnosis} |")
    which = ", ".join(f"{count} {cause}" for cause, count in false.most_common())
    nothing = _share(sum(not effects for effects in healthy), len(healthy)) if healthy else "not asked"
    total = sum(false.values())
    lines.append(f"| nothing | {days} | {total} false alarms, {100.0 * total / days:.1f} in 100 days ({which or 'none'}) | | {nothing} |")
    return "\n".join(lines)


def _share(right: int, n: int) -> str:
    low, high = wilson(right, n)
    return f"{100.0 * right / n:.0f} % ({100.0 * low:.0f} to {100.0 * high:.0f}), n = {n}" if n else "none"


if __name__ == "__main__":
    main()
