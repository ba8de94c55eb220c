"""Test cells with independent physics: MuJoCo moves a rig, this code presses it into tissue, and the truth is sealed.

One case is a recording and a cell.yaml as the contract asks, a second recording of the same cell on another motion, and the truth:
which effects act, how large they are (§5), and where they show. `draw_case(seed, index)` is deterministic.

Rigs: a vertical slide, and a six-axis arm with the UR5's lengths and link masses. Five controllers: second order; its targets held at
125 or 500 Hz; a third pole; a jerk-limiting average. The stated servo is a second-order fit to a noisy free motion of the healthy cell.
Contact: Hertz from the contract's formula, applied by `xfrc_applied` at the tip; on a part of the slides the engine's own soft contact,
whose impedance is fitted so that it stays inside the tolerances of E and surface (the truth says which).

SNR: the contract says that tolerances are projected out. Then the listed effects that are the tolerances themselves (bias, drift,
gain, crosstalk, latency, filter, mass, modulus, surface) have none at any size. So `snr` takes every tolerance as normal with its
declared standard deviation (generalised least squares), and `snr_projected` beside it is the strict reading. A sigma is that of a
20 ms mean, from white noise and rounding.

How exact healthy cells are, their tolerances fitted (seed 1, cases 0 to 29, `healthy_mismatch` of the truth), rms in standard
deviations of one sample: z 0.02 to 0.45 (median 0.08), fz 0.002 to 0.11 (median 0.008), fx and ty at most 0.005. Most of z is the
third order, the jerk limit or the 125 Hz hold, which no second-order servo has, and the give of the position loops under load. Over a
whole recording this z is a signal-to-noise ratio of 1.3 to 68 (median 7.5): a judge of such cells needs a floor for it.

What MuJoCo cannot make, and what stands in its place:
- Hertz, thickness, inclusion, Mullins softening, adhesion and plasticity: the engine's contact has no memory and few shapes; own code.
- A force that a joint limit, a tendon or a joint's friction exerts on the probe is not in the force sensor (only contacts,
  `xfrc_applied` and connect constraints are); cables are therefore bodies of their own, connected to the probe.
- Implicit integration: the force sensor reads an acceleration that is then not integrated; the integrator is explicit Euler.
- Integral action of a real servo: the position loops are stiff instead, with armatures above a real UR5's.
- Sensor effects (clock, filter, hysteresis, creep, zero) have no primitive; own sensor model.
- Not made: `sensor.noise` and `sensor.quantization` (they have no noise-free change, hence no SNR); a leak from torque into fz (a
  healthy cell has no torque).
"""

import argparse
import json
import os
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import yaml

from palpd.blind.mujoco.cases import EFFECTS, KINDS, MujocoCase, change_by, draw_case, healthy_mismatch, sealed_truth
from palpd.recording.samples import write_csv

__all__ = ["EFFECTS", "KINDS", "MujocoCase", "change_by", "draw_case", "healthy_mismatch", "main", "sealed_truth", "write_case"]


def write_case(index: int, seed: int, directory: Path, effects: tuple[str, ...] | None = None) -> str:
    """Draw one case and write its recordings, its cell file and its truth.

    Args:
        index: number of the case.
        seed: seed of the set.
        directory: where the files go.
        effects: ids of effects to plant; None: drawn.

    Returns:
        The name that the files begin with.
    """
    case = draw_case(seed, index, effects=effects)
    name = f"mujoco_{seed}_{index:04d}"
    write_csv(directory / f"{name}.csv", case.recording())
    write_csv(directory / f"{name}_other.csv", case.recording(other=True))
    (directory / f"{name}.yaml").write_text(yaml.safe_dump(case.stated.as_yaml(), sort_keys=False), encoding="utf-8")
    (directory / f"{name}.truth.json").write_text(json.dumps(sealed_truth(case), indent=1), encoding="utf-8")
    return name


def main(arguments: list[str] | None = None) -> None:
    """Write cases from the command line.

    Args:
        arguments: command line; None: the process's own.
    """
    parser = argparse.ArgumentParser(prog="python -m palpd.blind.mujoco_cells", description="Draw test cells with MuJoCo's physics.")
    parser.add_argument("--cases", type=int, default=20, help="number of cases")
    parser.add_argument("--seed", type=int, default=0, help="seed of the set")
    parser.add_argument("--out", type=Path, required=True, help="directory for the files")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    parser.add_argument("--effects", nargs="+", choices=sorted(EFFECTS), help="plant these in every case (default: drawn)")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    work = partial(write_case, seed=options.seed, directory=options.out, effects=tuple(options.effects) if options.effects else None)
    if options.jobs == 1:
        for index in range(options.cases):
            print(work(index))
        return
    with ProcessPoolExecutor(options.jobs) as pool:
        for name in pool.map(work, range(options.cases)):
            print(name)


if __name__ == "__main__":
    main()
