"""A user's own simulator as the nominal: are single effects named as often as with palpd's own nominal?

`python -m benchmarks.my_simulator [--cells 20] [--resume FILE]`. The cells are single-effect cells of the blind check's MuJoCo source. The
user's simulator is the MuJoCo model without effects and deviations: the rig as it is designed, with the numbers of the cell file. Each cell
is diagnosed with palpd's own nominal, with that simulator as a function, and with its output as a file. A cell takes some half a minute
of processor time; 200 are needed for a verdict. `--resume` keeps one line a cell and continues after the last; with `--part 1/2` and
`--part 2/2` two processes share the work, and a run without it then gives the verdict.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import yaml

from palpd.blind.check import make_case
from palpd.blind.diagnose_case import diagnose_case
from palpd.blind.mujoco.plant import simulate
from palpd.blind.mujoco.sensor import low_pass
from palpd.blind.mujoco.setup import Array, PlantSetup, PressPath, ServoDesign
from palpd.blind.outcome import CaseOutcome, score_case
from palpd.blind.plans import plan
from palpd.blind.score import alone, first_right, wilson
from palpd.blind.truth import CaseSpec
from palpd.cell.cell_file import load_cell, save_cell
from palpd.cell.effects import EFFECTS
from palpd.cell.tip_motion import estimate_tip_motion
from palpd.gap.commands import write_answer
from palpd.gap.diagnosis import diagnose
from palpd.gap.user_simulator import UserSimulator, asked
from palpd.recording.samples import WRENCH_COLUMNS, read_csv

NOMINALS = ("palpd", "function", "file")
LEAST_CELLS, POINTS = 200, 0.03
"""Number of cells for a verdict, and largest difference of the shares."""

FOLLOWER = ServoDesign("second order", 12.0, 1.0, 37.0, 0.002)
"""Servo of the rig that follows a measured motion; its own lag is taken out of the command."""

RIGID = 25.0
"""Factor on the moving mass of that rig, and so on the stiffness of its drive: the give of the real one is in the measured motion."""

JUDGED_BY_A_FILE = {name for name, effect in EFFECTS.items() if effect.site != "tip" and not effect.moves_surface}
"""Effects that a diagnosis with a file can name."""


class NominalComparison(TypedDict):
    """One cell: what was planted, and for each nominal whether it was named first, whether it was named alone, and the cost."""

    case: str
    planted: str
    snr: float | None
    first: dict[str, bool]
    alone: dict[str, bool]
    named: dict[str, list[str]]
    cpu_s: dict[str, float]


def specs(cells: int, seed: int) -> list[CaseSpec]:
    """The first single-effect cells of the blind check.

    Args:
        cells: Their number.
        seed: Seed of the check.

    Returns:
        Their specifications.
    """
    return [spec for spec in plan("mujoco", 5 * cells + 20, seed) if spec.kind in ("library", "foreign")][:cells]


def mujoco_simulator(cell: Mapping[str, Any], about: Mapping[str, Any]) -> Callable[[Mapping[str, Array]], dict[str, Array]]:
    """A user's simulator of a drawn cell: its rig in MuJoCo, with the numbers of the cell file and no effect.

    Args:
        cell: The blocks of the cell file.
        about: What the truth says about the rig: its kind, its controller, its contact, its time step.

    Returns:
        A function from a motion to heights and wrench.
    """
    tissue, probe, sensor = cell["tissue"], cell["probe"], cell["sensor"]
    hertz = 4 / 3 * tissue["youngs_modulus_Pa"] / (1 - tissue["poisson_ratio"] ** 2) * probe["tip_radius_m"] ** 0.5
    servo = ServoDesign(**about["controller"])
    rig = PlantSetup(
        about["rig"], about["physics_step_s"], servo, 80.0 * (37 / servo.inner_frequency_Hz) ** 2, probe["mass_kg"], probe["tip_length_m"],
        hertz, tissue["surface_z_m"], probe["tip_radius_m"], engine_contact=about["contact"].startswith("MuJoCo"),
    )  # fmt: skip
    follower = replace(rig, servo=FOLLOWER, moving_mass_kg=RIGID * 80.0)
    reported: dict[bytes, Array] = {}

    def run(motion: Mapping[str, Array]) -> dict[str, Array]:
        t_s, omega = motion["t_s"], 2 * np.pi * FOLLOWER.natural_frequency_Hz
        lead = 2 * FOLLOWER.damping_ratio / omega * motion["vz_m_per_s"] + motion["az_m_per_s2"] / omega**2
        deepest_m = max(tissue["surface_z_m"] - float(motion["z_m"].min()), 1e-4)
        out = simulate(replace(follower, deepest_m=deepest_m), _path(t_s, motion["z_m"] + lead, deepest_m))
        wrench = low_pass(out.wrench, sensor["filter_cutoff_Hz"], rig.step_s)
        columns = {name: np.interp(t_s, out.t_s, wrench[:, axis]) for axis, name in enumerate(WRENCH_COLUMNS)}
        command = motion["z_cmd_m"]
        stroke = (command - command[0]).round(9).tobytes()
        if stroke not in reported:  # the robot hardly feels at which height it moves
            moved = simulate(replace(rig, deepest_m=deepest_m), _path(t_s, command, deepest_m))
            reported[stroke] = np.interp(t_s, moved.t_s, moved.z_m) - command[0]
        return columns | {"z_m": reported[stroke] + command[0]}

    return run


def _path(t_s: Array, z_m: Array, deepest_m: float) -> PressPath:
    """A motion without press scatter."""
    return PressPath(t_s, z_m, np.empty(0), np.zeros(1), np.zeros(1), deepest_m)


def compare_nominals(spec: CaseSpec, seed: int) -> NominalComparison:
    """Draw a cell, diagnose it with each nominal, and score the answers.

    Args:
        spec: What the cell is.
        seed: Seed of the check.

    Returns:
        The scores.
    """
    with tempfile.TemporaryDirectory() as folder:
        recordings, sealed = Path(folder) / "recordings", Path(folder) / "sealed"
        recordings.mkdir()
        sealed.mkdir()
        make_case(spec, seed, recordings, sealed)
        recording, cell_file = recordings / f"{spec.name}.csv", recordings / f"{spec.name}.yaml"
        about = json.loads((sealed / f"{spec.name}.json").read_text(encoding="utf-8"))["about"]
        function = mujoco_simulator(yaml.safe_load(cell_file.read_text(encoding="utf-8")), about)
        outcomes: dict[str, CaseOutcome] = {}
        for nominal in NOMINALS:
            if nominal == "palpd":
                diagnose_case(recording)
            else:
                _diagnose_with(recording, cell_file, function, nominal)
            outcomes[nominal] = score_case(recordings, sealed, spec)
    first = outcomes["palpd"]
    return {
        "case": spec.name,
        "planted": first["planted"][0],
        "snr": first["snr"],
        "first": {nominal: first_right(one) for nominal, one in outcomes.items()},
        "alone": {nominal: alone(one) for nominal, one in outcomes.items()},
        "named": {nominal: one["named"] for nominal, one in outcomes.items()},
        "cpu_s": {nominal: one["cost"]["cpu_s"] if "cost" in one else 0.0 for nominal, one in outcomes.items()},
    }


def _diagnose_with(recording: Path, cell_file: Path, function: Callable[[Mapping[str, Array]], dict[str, Array]], nominal: str) -> None:
    """Write the answer with the user's simulator in place of the last one."""
    samples, cell, began = read_csv(recording), load_cell(cell_file), os.times()
    simulator = UserSimulator.of_function(function, "mujoco")
    if nominal == "file":
        motion = estimate_tip_motion(cell, samples.t_s, samples.z_m, samples.vz_m_per_s, samples.z_cmd_m)
        output = function(asked(motion, samples.z_cmd_m)) | {"t_s": samples.t_s}
        simulator = UserSimulator.of_columns(output, samples.t_s, "mujoco.csv")
    answer = diagnose([samples], cell, propose=False, simulators=[simulator])
    ended, out = os.times(), recording.with_suffix(".json")
    write_answer(out, answer)
    save_cell(recording.with_suffix(".enriched.yaml"), answer.enriched_cell())
    cost = {"cpu_s": ended.user + ended.system - began.user - began.system, "wall_s": 0.0, "peak_MB": 0.0}
    out.write_text(json.dumps(json.loads(out.read_text(encoding="utf-8")) | {"cost": cost}), encoding="utf-8")


def lines(cells: Sequence[NominalComparison]) -> list[str]:
    """The shares of right answers, and whether the target is met.

    Args:
        cells: The cells.

    Returns:
        Sentences for people.
    """
    out = []
    for nominal in NOMINALS[1:]:
        mine = [one for one in cells if nominal != "file" or one["planted"] in JUDGED_BY_A_FILE]
        for what, key in (("named first", "first"), ("named and nothing else", "alone")):
            right = {each: sum(one[key][each] for one in mine) for each in ("palpd", nominal)}  # type: ignore[literal-required]
            if not mine:
                continue
            shares = {each: count / len(mine) for each, count in right.items()}
            low, high = wilson(right[nominal], len(mine))
            apart = shares[nominal] - shares["palpd"]
            verdict = "" if len(cells) < LEAST_CELLS else f": {'met' if round(apart, 9) >= -POINTS else 'missed'}"
            out.append(
                f"{what}, MuJoCo as a {nominal}: {shares[nominal]:.1%} ({low:.1%} to {high:.1%}) of {len(mine)} cells, palpd's own nominal "
                f"{shares['palpd']:.1%}, difference {100 * apart:+.1f} points (target: within {100 * POINTS:.0f}){verdict}"
            )
    cpu = {nominal: float(np.median([one["cpu_s"][nominal] for one in cells])) for nominal in NOMINALS} if cells else {}
    return [*out, "median CPU seconds of a diagnosis: " + ", ".join(f"{nominal} {seconds:.1f}" for nominal, seconds in cpu.items())]


def main() -> None:
    """Print one line a cell and the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--resume", type=Path, help="keep one line a cell here, and continue after the last")
    parser.add_argument("--part", default="1/1", help="K/N: each N-th cell from the K-th on, for N processes with one file to resume from")
    options = parser.parse_args()
    part, parts = map(int, options.part.split("/"))
    kept: dict[str, NominalComparison] = {}
    if options.resume is not None and options.resume.exists():
        kept = {
            one["case"]: one
            for one in map(json.loads, options.resume.read_text(encoding="utf-8").splitlines())
            if one["seed"] == options.seed
        }
    compared = []
    for spec in specs(options.cells, options.seed)[part - 1 :: parts]:
        one = kept.get(spec.name) or compare_nominals(spec, options.seed)
        compared.append(one)
        print(
            f"{one['case']} {one['planted']}: "
            + ", ".join(f"{nominal} {' and '.join(one['named'][nominal]) or 'nothing'}" for nominal in NOMINALS)
        )
        sys.stdout.flush()
        if options.resume is not None and spec.name not in kept:
            with options.resume.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps({"seed": options.seed} | one) + "\n")
    print("\n".join(lines(compared)))


if __name__ == "__main__":
    main()
