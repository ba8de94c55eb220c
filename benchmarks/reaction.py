"""How soon the daemon answers a force, and how far the force runs past its limit.

Loop, guard and drivers push again and again into a wall of unknown height on emulated wires (benchmarks/direct_cell.py). The emulator notes
when each sample of the sensor went out and when each command came in, on CLOCK_MONOTONIC, in one process. The daemon's own row says which
sample crossed the limit. So a reaction is from the sensor's byte to the first command that no longer goes down. The emulator looks at its
sockets once a millisecond: up to that much of a figure is its own. Two rates, 125 and 500 Hz: no UR sends its state at more than 500 Hz,
and palpd refuses a `robot.rate_Hz` above it. The loop alone at 1000 Hz is in benchmarks/rate.py.

`python benchmarks/reaction.py [--model ur5,ur5e] [--pushes 220] [--each 5] [--speed m/s,…] [--stiffness N/m,…]` prints two markdown tables.
Ends with 1 where a target is missed. Fewer than 100 pushes are no p99: they judge the force alone.
"""

import argparse
import os
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.direct_cell import DirectCell, PushOutcome, opened
from palpd.daemon.overshoot import overshoot_N
from palpd.testing.emulated_cell import emulated_cell

CONTACT_LIMIT_N = 12.0
ABSOLUTE_LIMIT_N = 60.0
ABOVE_M, SPREAD_M = 0.003, 0.002
MACHINE_LATE_S = 0.002
LEAST = 100  # pushes from which on their p99 is more than the worst of them
BEFORE_S, REST_S = 0.02, 0.05
CYCLE_S = {"ur5": 0.008, "ur5e": 0.002}


class Reaction(NamedTuple):
    """One push into a wall: ms from byte to command, and N past the limit in truth.

    `late` says that the machine itself was late, between just before the byte and the arm's rest.
    """

    reaction_ms: float
    past_N: float
    late: bool


def pushed(direct: DirectCell, speed_m_per_s: float, stiffness_N_per_m: float) -> Reaction | None:
    """Push once; None where the guard ended it for another reason than the force, which only a machine that stands still brings about."""
    cell = direct.cell
    cell.wires.ask("wall", z_m=cell.truth()["tip_z_m"] - ABOVE_M - random.uniform(0.0, SPREAD_M), stiffness_N_per_m=stiffness_N_per_m)
    cell.truth(reset=True)
    push = direct.push(speed_m_per_s)
    seen = answered(direct, push)
    time.sleep(REST_S)
    past_N = cell.truth()["peak_contact_N"] - CONTACT_LIMIT_N
    direct.home()
    if seen is None:
        return None
    sent_s, heard_s = seen
    late_s = cell.lateness_s(sent_s - BEFORE_S, BEFORE_S + heard_s - sent_s + REST_S)
    return Reaction((heard_s - sent_s) * 1e3, past_N, late_s > MACHINE_LATE_S)


def answered(direct: DirectCell, push: PushOutcome) -> tuple[float, float] | None:
    """When the sensor's byte went out and when the command came in, of a push that the contact limit ended."""
    if not [trip for trip in push.outcome.trips if trip.trip.name == "CONTACT_FORCE"] or len(push.outcome.trips) > 1:
        return None
    row = push.rows[np.flatnonzero(push.rows["trip"])[0]]
    n = int(row["frames"])
    force_N = row["tared"][:n, 2] - row["inertial_N"][:n]
    counter = int(row["counter"][:n][np.argmax(force_N >= CONTACT_LIMIT_N)])
    wire = direct.cell.wires.ask("wire", since_s=float(row["now_s"]) - 0.1)
    sent_s = next(t_s for t_s, number in wire["sent"] if number == counter)
    return sent_s, next(t_s for t_s, vz in wire["heard"] if t_s >= sent_s and vz >= 0.0)


def measure(model: str, speeds: list[float], stiffnesses: list[float], each: int, pushes: int) -> tuple[list[str], list[str]]:
    """Lines of the two tables."""
    reactions: list[Reaction] = []
    overshoots: list[str] = []
    attempts = 0
    with tempfile.TemporaryDirectory() as name, emulated_cell(Path(name), model) as base:
        safety = {"contact_limit_N": CONTACT_LIMIT_N, "absolute_limit_N": ABSOLUTE_LIMIT_N}
        cell = base.anew(Path(name), 1000.0, safety=safety)
        with opened(cell) as direct:
            for stiffness in stiffnesses:
                for speed in speeds:
                    tried = [pushed(direct, speed, stiffness) for _ in range(each)]
                    came = [one for one in tried if one is not None]
                    attempts += each
                    reactions += came
                    on_time = [one.past_N for one in came if not one.late]
                    if on_time:
                        bound_N = overshoot_N(direct.config, speed, stiffness)
                        kept = "yes" if max(on_time) <= 1.1 * bound_N else "**no**"
                        overshoots.append(
                            f"| {model} | {stiffness / 1e3:g} N/mm | {speed * 1e3:g} mm/s | {np.mean(on_time):.2f} | {max(on_time):.2f} | "
                            f"{bound_N:.2f} | {max(on_time) / bound_N:.2f} | {kept} | {len(on_time)} |"
                        )
            while len(reactions) < pushes and attempts < 2 * pushes:
                attempts += 1
                one = pushed(direct, 0.01, 5000.0)
                reactions += [one] if one is not None else []
    on_time_ms = [one.reaction_ms for one in reactions if not one.late]
    allowed_ms = CYCLE_S[model] * 1e3 + 1.0
    if not on_time_ms:
        return [f"| {model} | the machine was late in all {len(reactions)} |" + " |" * 8], overshoots
    p50, p99 = np.percentile(on_time_ms, [50, 99])
    all_p99 = np.percentile([one.reaction_ms for one in reactions], 99)
    verdict = "too few to judge" if len(on_time_ms) < LEAST else "yes" if p99 <= allowed_ms else "**no**"
    left_out = f"{len(reactions) - len(on_time_ms)} (with them p99 {all_p99:.1f})"
    line = (
        f"| {model}, {1 / CYCLE_S[model]:g} Hz | {p50:.1f} | {p99:.1f} | {max(on_time_ms):.1f} | {allowed_ms:g} | "
        f"{verdict} | {len(on_time_ms)} | {left_out} | "
        f"{attempts - len(reactions)} | {os.getloadavg()[0]:.1f} |"
    )
    return [line], overshoots


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="ur5,ur5e")
    parser.add_argument("--pushes", type=int, default=220)
    parser.add_argument("--each", type=int, default=5, help="pushes for each speed and stiffness")
    parser.add_argument("--speed", default="0.002,0.005,0.01,0.02")
    parser.add_argument("--stiffness", default="1000,5000,10000,20000")
    options = parser.parse_args()
    speeds, stiffnesses = ([float(number) for number in text.split(",")] for text in (options.speed, options.stiffness))
    lines: list[str] = []
    overshoots: list[str] = []
    for model in options.model.split(","):
        some, more = measure(model, speeds, stiffnesses, options.each, options.pushes)
        lines += some
        overshoots += more
    print("| sensor byte → first command that does not go down | p50, ms | p99 | worst | a tick and 1 ms | kept | n | "
          "left out: the machine was late | ended otherwise | load |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|")
    print("\n".join(lines))
    print("\n| robot | wall | speed | past the limit, mean, N | worst, N | arithmetic, N | worst ÷ arithmetic | within 1.1 × | n |")
    print("|---|---|---|---|---|---|---|---|---|")
    print("\n".join(overshoots))
    sys.exit(1 if any("**no**" in line for line in lines + overshoots) else 0)


if __name__ == "__main__":
    main()
