"""A thousand presses with faults at random moments: is the force ever beyond its limit and what the arithmetic adds?

`python benchmarks/presses.py [--presses 1000] [--seed N] [--json FILE]`. There are no wires: the cell's physics stands directly behind the
daemon's own loop, sequence and guard (palpd/daemon/simulated_run.py), with tissues, walls, and walls that appear under way. In nearly
every press sensor, robot, model or clock fails at a random moment. Prints a table; ends with 1 if a press went beyond its bound.
On real wires benchmarks/reaction.py does the same without faults and benchmarks/faults.py with them.

The bound is the contact limit and the predicted overshoot (palpd/daemon/overshoot.py), which counts one more tick for each fault below:
BLIND_S says for how long the guard may be blind before it must see a fault. A sensor that reads wrong but plausible values is bounded by
depth alone: the force at the commanded depth, 0.5 mm and the way of a stop below it. Where such a fault began in the search, the surface
was found too late. The error is at most what the fault can hide between the two forces that end a search (contact, and the same pull).
"""

import argparse
import json
import math
import random
import sys
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from palpd.cell.cell_file import CellFile
from palpd.config import CONTACT_FORCE_N, Config, Plan, Search, filter_delay_s
from palpd.control.loop import Loop
from palpd.control.safety import DEPTH_MARGIN_M
from palpd.daemon.clock import SimClock
from palpd.daemon.motion_job import Job, explainer_of, limits_of, sequence_of
from palpd.daemon.overshoot import delays, overshoot_N
from palpd.daemon.sim_cell import FZ_OFFSET_N, SimCell
from palpd.daemon.simulated_run import RowList
from palpd.tick import NO_FRAMES, Request, RobotMode, RobotState, SafetyMode, SensorFrames, Timing

RATE_HZ = 125.0
SPEED_M_PER_S = 0.01
LAST_TICK = 1000
BLIND_S = {"sensor silent": 0.05, "sensor sticks": 0.2, "robot state sticks": 0.05, "ticks missed": 0.05, "model hides": 0.0}
LIES = ("sensor drifts pressed", "sensor drifts pulled", "sensor reads half")

Spoil = Callable[[RobotState, SensorFrames, float], tuple[RobotState, SensorFrames]]
"""(state, frames, seconds since it began) → what the loop gets to see."""


def _with_fz(frames: SensorFrames, fz_N: Callable[[np.ndarray], np.ndarray]) -> SensorFrames:
    wrench = frames.wrench.copy()
    wrench[:, 2] = fz_N(wrench[:, 2])
    return replace(frames, wrench=wrench)


def _nan(frames: SensorFrames) -> SensorFrames:
    return _with_fz(frames, lambda fz: np.full_like(fz, np.nan))


class Stuck:
    """Shows for ever what it saw first."""

    def __init__(self) -> None:
        self.state: RobotState | None = None
        self.wrench: np.ndarray | None = None

    def sensor(self, state: RobotState, frames: SensorFrames, _: float) -> tuple[RobotState, SensorFrames]:
        """All frames equal to the last digit."""
        self.wrench = frames.wrench[-1:] if self.wrench is None else self.wrench
        return state, replace(frames, wrench=np.repeat(self.wrench, len(frames), axis=0))

    def robot(self, state: RobotState, frames: SensorFrames, _: float) -> tuple[RobotState, SensorFrames]:
        """The state that was."""
        self.state = self.state or state
        return self.state, frames


def spoils(rng: random.Random, drift: float) -> dict[str, Callable[[], Spoil]]:
    """Everything that can go wrong, by name; `drift` in N/s."""
    return {
        "nothing": lambda: lambda state, frames, _s: (state, frames),
        "sensor silent": lambda: lambda state, _frames, _s: (state, NO_FRAMES),
        "sensor sticks": lambda: Stuck().sensor,
        "sensor loses frames": lambda: lambda state, frames, _s: (state, frames if rng.random() < 0.4 else NO_FRAMES),
        "sensor status": lambda: lambda state, frames, _s: (state, replace(frames, status=np.full(len(frames), 1 << 10, np.uint16))),
        "sensor rejects": lambda: lambda state, frames, _s: (state, replace(frames, rejected=6)),
        "sensor not finite": lambda: lambda state, frames, _s: (state, _nan(frames)),
        "sensor drifts pressed": lambda: lambda state, frames, s: (state, _with_fz(frames, lambda fz: fz - drift * s)),
        "sensor drifts pulled": lambda: lambda state, frames, s: (state, _with_fz(frames, lambda fz: fz + drift * s)),
        "sensor reads half": lambda: lambda state, frames, _s: (state, _with_fz(frames, lambda fz: FZ_OFFSET_N + 0.5 * (fz - FZ_OFFSET_N))),
        "robot state sticks": lambda: Stuck().robot,
        "robot protective stop": lambda: lambda state, frames, _s: (replace(state, safety_mode=SafetyMode.PROTECTIVE_STOP), frames),
        "robot power off": lambda: lambda state, frames, _s: (replace(state, robot_mode=RobotMode.POWER_OFF), frames),
        "robot program stopped": lambda: lambda state, frames, _s: (replace(state, runtime_state=1), frames),
        "robot disconnected": lambda: lambda state, frames, _s: (replace(state, connected=False), frames),
        "ticks missed": lambda: lambda state, frames, _s: (state, frames),
        "model hides": lambda: lambda state, frames, _s: (state, frames),
        "operator aborts": lambda: lambda state, frames, _s: (state, frames),
    }


class ForceHidingModel:
    """An inertial model that says the whole force is inertia: the worst that one can say."""

    card: dict[str, str] = {}  # noqa: RUF012
    warnings: tuple[str, ...] = ()
    not_finite = 0

    def predict(self, features: list[tuple[float, ...]]) -> list[float]:
        """Newtons."""
        return [1e3] * len(features)

    def out_of_range(self, _features: object) -> int:
        """None, it says."""
        return 0


class Spoilt:
    """Robot, sensor and clock of a simulated cell; one of them begins to fail at a tick."""

    def __init__(self, cell: SimCell, fault: str, spoil: Spoil, at_tick: int, stalls: int) -> None:
        self._cell, self._fault, self._spoil, self._at, self._stalls = cell, fault, spoil, at_tick, stalls
        self.tick = -1
        self._frames = NO_FRAMES
        self._clock = SimClock(RATE_HZ)

    def wait(self) -> Timing:
        """The tick; `stalls` of them are slept through."""
        self.tick += 1
        timing = self._clock.wait()
        if self._fault != "ticks missed" or self.tick < self._at or (self.tick - self._at) % 40:
            return timing
        for _ in range(self._stalls):
            self._cell.robot.read()
            timing = self._clock.wait()
        return replace(timing, missed=self._stalls)

    def elapsed_us(self) -> float:
        """No time passes within a tick."""
        return 0.0

    def read(self) -> RobotState:
        """What is seen of the robot; of the sensor see `frames`."""
        state, frames = self._cell.robot.read(), self._cell.sensor.read()
        if self.tick >= self._at:
            state, frames = self._spoil(state, frames, (self.tick - self._at) / RATE_HZ)
        self._frames = frames
        return state

    def frames(self) -> SensorFrames:
        """What is seen of the sensor."""
        return self._frames

    def move(self, velocity_m_per_s: tuple[float, float, float]) -> None:
        """A controller that has stopped its program moves nothing."""
        stopped = self.tick >= self._at and self._fault in ("robot protective stop", "robot power off", "robot program stopped")
        self._cell.robot.move((0.0, 0.0, 0.0) if stopped else velocity_m_per_s)

    def stop(self) -> None:
        """Ramp to rest."""
        self._cell.robot.stop()

    def end(self) -> None:
        """Nothing to let go of."""


class SpoiltSensor:
    """The other face of `Spoilt`."""

    def __init__(self, spoilt: Spoilt) -> None:
        self._spoilt = spoilt

    def read(self) -> SensorFrames:
        """Frames of this tick."""
        return self._spoilt.frames()

    def close(self) -> None:
        """Nothing to let go of."""


class Press(NamedTuple):
    """Outcome of one press; forces in N."""

    fault: str
    under: str
    stiffness_N_per_m: float
    peak_N: float
    bound_N: float
    end: str


def press(seed: int) -> Press:
    """One press of a random cell with a random fault."""
    rng = random.Random(seed)
    speed, depth = rng.choice((0.002, 0.005, SPEED_M_PER_S)), rng.uniform(0.002, 0.012)
    wall = rng.random() < 0.5
    appears = wall and rng.random() < 0.5
    stiffness = 10 ** rng.uniform(3.0, 4.0) if wall else 0.0
    modulus = 10 ** rng.uniform(4.3, 5.5)
    plan = Plan(
        mode="dynamic", depths_m=(round(depth, 6),), press_speed_m_per_s=speed, repeats=1, search=Search(speed_m_per_s=SPEED_M_PER_S)
    )
    config = Config.model_validate({"safety": {"expected_stiffness_N_per_m": 1000.0}})
    contact_with = {"tissue": {"youngs_modulus_Pa": modulus}}
    if wall and not appears:
        contact_with |= {"wall": {"z_m": 0.0, "stiffness_N_per_m": stiffness}}
    cell_file = CellFile.model_validate(contact_with)
    sensor = cell_file.sensor.model_copy(update={"filter_cutoff_Hz": config.sensor.filter_cutoff_Hz, "rate_Hz": 1000.0})
    cell = SimCell(cell_file.model_copy(update={"sensor": sensor}), RATE_HZ, config.robot.acceleration_m_per_s2, seed)
    drift = rng.uniform(1.0, 100.0)
    choices = spoils(rng, drift)
    fault = rng.choice(sorted(choices))
    at_tick, wall_tick = rng.randrange(130, LAST_TICK), rng.randrange(LAST_TICK // 2, LAST_TICK)
    spoilt = Spoilt(cell, fault, choices[fault](), at_tick, rng.randrange(1, 20))
    physics = cell._cell  # noqa: SLF001 - walls appear under way, which no cell does by itself
    stepped, peak = physics.step, [0.0]

    def step(target_m: np.ndarray) -> object:
        if appears and spoilt.tick == wall_tick:
            physics.place_wall(min(0.0, float(target_m[-1, 2]) - 0.0005), stiffness)
        block = stepped(target_m)
        peak[0] = max(peak[0], float(block.contact_N.max()))
        return block

    physics.step = step  # type: ignore[method-assign, assignment]
    job = Job("palpation", config, plan, reference=(0.0, 0.0, FZ_OFFSET_N, 0.0, 0.0, 0.0))
    delay_s = filter_delay_s(config.sensor.filter_cutoff_Hz)
    explainer = explainer_of(job, {}, delay_s)
    if fault == "model hides":
        explainer.model = ForceHidingModel()  # type: ignore[assignment]
        explainer.correction_limit_N = config.model.correction_limit_N
    aborts = {at_tick: Request.ABORT} if fault == "operator aborts" else {}
    record = RowList()
    sequence = sequence_of(job, delay_s)
    loop = Loop(spoilt, SpoiltSensor(spoilt), spoilt, sequence, explainer, limits_of(config), record,
                request=lambda: aborts.get(len(record.rows), Request.NONE))  # fmt: skip
    outcome = loop.run()
    for _ in range(25):
        cell.advance()  # until the arm is at rest
    end = outcome.trips[-1].trip.name if outcome.trips else "refused" if outcome.refused else outcome.verdict
    hardest = max(stiffness, 1.5 * _hertz_N(cell_file, depth) / depth)
    bound_N = bound(config, fault, hardest, speed, cell_file, depth, stiffness, drift)
    return Press(fault, "wall" if wall and not appears else "wall appears" if wall else "tissue", stiffness, peak[0], bound_N, end)


def _hertz_N(cell: CellFile, depth_m: float) -> float:
    assert cell.tissue is not None
    modulus = cell.tissue.youngs_modulus_Pa / (1 - cell.tissue.poisson_ratio**2)
    return 4 / 3 * modulus * math.sqrt(cell.probe.tip_radius_m) * depth_m**1.5


def bound(
    config: Config,
    fault: str,
    hardest_N_per_m: float,
    speed_m_per_s: float,
    cell: CellFile,
    depth_m: float,
    wall_N_per_m: float,
    drift_N_per_s: float,
) -> float:
    """The most that this press may reach, in N."""
    fastest = max(speed_m_per_s, SPEED_M_PER_S)
    seen_N = config.safety.contact_limit_N + overshoot_N(config, fastest, hardest_N_per_m)
    seen_N += hardest_N_per_m * fastest * BLIND_S.get(fault, 0.0) + (config.model.correction_limit_N if fault == "model hides" else 0.0)
    if fault not in LIES:
        return seen_N

    def pressing_N(way_m: float) -> float:
        return max(_hertz_N(cell, way_m), wall_N_per_m * way_m)

    way_m = depth_m + DEPTH_MARGIN_M + 0.0005 + fastest * math.fsum(term["duration_s"] for term in delays(config, fastest))
    way_m += found_late_m(pressing_N, drift_N_per_s) if fault == "sensor drifts pulled" else 0.0
    return max(seen_N, pressing_N(way_m))


def found_late_m(pressing_N: Callable[[float], float], drift_N_per_s: float) -> float:
    """How far the search may go on in what presses while the zero falls: it ends where contact is seen, or as much of a pull."""
    lowest_N = 0.0
    for way_m in np.arange(0.0, Search().max_travel_m, SPEED_M_PER_S / RATE_HZ).tolist():
        seen_N = pressing_N(way_m) - drift_N_per_s * way_m / SPEED_M_PER_S
        lowest_N = min(lowest_N, seen_N)
        if seen_N >= lowest_N + 2.0 * CONTACT_FORCE_N:
            return way_m
    return Search().max_travel_m


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--presses", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=random.randrange(2**31))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    done = [press(options.seed + number) for number in range(options.presses)]
    by_fault: dict[str, list[Press]] = defaultdict(list)
    for one in done:
        by_fault[one.fault].append(one)
    print(
        f"| fault, seeds from {options.seed} | presses | over 12 N | highest peak, N | nearest to its bound | beyond it | how they ended |"
    )
    print("|---|---|---|---|---|---|---|")
    for fault, presses in sorted(by_fault.items()):
        ends: dict[str, int] = defaultdict(int)
        for one in presses:
            ends[one.end.lower().replace("_", " ")] += 1
        summary = ", ".join(f"{end} {number}" for end, number in sorted(ends.items(), key=lambda item: -item[1]))
        nearest = max(one.peak_N / one.bound_N for one in presses)
        beyond = sum(one.peak_N > one.bound_N for one in presses)
        over = sum(one.peak_N > 12.0 for one in presses)
        print(f"| {fault} | {len(presses)} | {over} | {max(one.peak_N for one in presses):.1f} | {nearest:.0%} | {beyond} | {summary} |")
    if options.json:
        options.json.write_text(json.dumps([one._asdict() for one in done]))
    sys.exit(1 if any(one.peak_N > one.bound_N for one in done) else 0)


if __name__ == "__main__":
    main()
