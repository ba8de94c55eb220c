"""Moduli of plain elastic sites by a sensor with two slopes of Fz, on both laws of the sensor, with the right and with the wrong setting.

The slopes part where the sensor carries nothing, or where it reads zero untared. `sensor.fz_slopes` is `both` or `pressed`. The daemon
palpates over emulated wires. Each recording is exported and diagnosed site by site against a cell that is right in everything else.

`python -m benchmarks.slopes [--kept FOLDER] [--without-wires] [--no-diagnosis] [--seed N]` prints a markdown table. It ends with 1 where
the right setting misses 1 %, or a diagnosis with the wrong one does not name `sensor.asymmetry`, alone or in a group of at most three.
"""

import argparse
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from hw.emulators.hex_pty import PartsAt
from palpd.analysis import results
from palpd.cell.cell_file import CellFile, SensorBlock, save_cell
from palpd.config import Config, Plan
from palpd.daemon.motion_job import Job
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.recording.reader import Recording, export
from palpd.recording.samples import read_csv
from palpd.testing.emulated_cell import ATTEMPTS, PATIENT, emulated_cell
from palpd.testing.parted_sensor import pressed

Setting = Literal["both", "pressed"]
RIGHT: dict[PartsAt, Setting] = {"load": "both", "reading": "pressed"}
MODULI_PA = {"A": 60e3, "B": 100e3, "C": 140e3}
"""Young's moduli of the three sites: the forces at 4 to 8 mm are 2 to 13 N, on both sides of the weight of the probe."""
APART_M = 0.03
PLAN: dict[str, Any] = {
    "sites": [{"name": name, "x_m": APART_M * index} for index, name in enumerate(MODULI_PA)],
    "mode": "static",
    "depths_m": [0.004, 0.006, 0.008],
    "hold_s": 2.0,
    "search": {"speed_m_per_s": 0.005, "max_travel_m": 0.04},
}
RUN_S = 600.0
"""Longest run over wires: two minutes on a machine with nothing else to do."""
WITHIN = 0.01
"""Largest relative error of a static modulus with the right setting."""
LARGEST_GROUP = 3
"""Largest group of effects that a diagnosis may not tell apart and still counts as an answer."""
NAME = "sensor.asymmetry"


@dataclass(frozen=True, slots=True)
class SlopesRun:
    """A recording of the three sites."""

    law: PartsAt
    setting: Setting
    recording: Recording


def cell_of(modulus_Pa: float | None = None) -> CellFile:
    """The cell with three sites, or one that is all of one modulus, as the simulator believes it."""
    content: dict[str, Any] = {"sensor": SensorBlock(rate_Hz=1000.0).model_dump()}
    if modulus_Pa is not None:
        return CellFile.model_validate(content | {"tissue": {"youngs_modulus_Pa": modulus_Pa}})
    sites = [
        {"name": name, "x_m": APART_M * index, "tissue": {"youngs_modulus_Pa": modulus_Pa}}
        for index, (name, modulus_Pa) in enumerate(MODULI_PA.items())
    ]
    return CellFile.model_validate(content | {"sites": sites})


def over_wires(folder: Path, law: PartsAt, settings: Sequence[Setting], kept: Path) -> Iterator[SlopesRun]:
    """Palpate by the daemon over emulated wires, again where a run was ended: on a busy machine it may stand still for too long.

    Args:
        folder: For everything that is written.
        law: Where the slopes of the emulated sensor part.
        settings: Of `sensor.fz_slopes`, one run each.
        kept: Folder for the recordings; one that is there already is not made again.

    Yields:
        The recordings.
    """
    save_cell(folder / "cell.yaml", cell_of())
    for setting in settings:
        recording = kept / f"{law}-{setting}.mcap"
        if recording.exists():
            yield SlopesRun(law, setting, Recording.load(recording))
            continue
        for left in reversed(range(ATTEMPTS)):
            own = folder / f"{setting}-{left}"
            own.mkdir()
            with emulated_cell(own, "ur5", folder / "cell.yaml", "--fz-parts-at", law) as base:
                daemon = replace(base, blocks=PATIENT | {"sensor": {"fz_slopes": setting}}).run(PLAN)
                code = daemon.wait(RUN_S)
            if code == 0:
                shutil.copy(daemon.report["recording"], recording)
                yield SlopesRun(law, setting, Recording.load(recording))
                break
            print(f"The run on the law {law} with {setting} was ended: {daemon.stderr.strip()}", file=sys.stderr, flush=True)
        else:
            raise RuntimeError(f"{ATTEMPTS} runs on the law {law} with {setting} were ended")


def without_wires(folder: Path, law: PartsAt, setting: Setting, seed: int, plan: dict[str, Any] = PLAN) -> list[SlopesRun]:
    """Palpate by the daemon's loop on the cell's physics, each site in a run of its own.

    Args:
        folder: Where the recordings would lie.
        law: Where the slopes of the sensor part.
        setting: Of `sensor.fz_slopes`.
        seed: Of the noise.
        plan: What is pressed at each site.

    Returns:
        The recordings, one a site.
    """
    config = Config.model_validate(PATIENT | {"sensor": {"fz_slopes": setting}})
    palpated = []
    for index, (name, modulus_Pa) in enumerate(MODULI_PA.items()):
        job = Job("palpation", config, Plan.model_validate(plan | {"sites": [{"name": name}]}))
        done = pressed(job, cell_of(modulus_Pa), law, config.cell.probe.mass_kg, seed + index)
        palpated.append(SlopesRun(law, setting, Recording(folder / f"{law}-{setting}-{name}", done.rows, done.header, {}, None)))
    return palpated


def diagnosed(palpated: SlopesRun, site: str, folder: Path) -> Diagnosis:
    """Export one site of a recording and diagnose it.

    Args:
        palpated: The recording.
        site: The site.
        folder: Where its CSV is written.

    Returns:
        The diagnosis, against a cell that knows the tissue and believes in one slope.
    """
    csv = folder / f"{palpated.law}-{palpated.setting}-{site}.csv"
    export(palpated.recording, csv, site)
    return diagnose([read_csv(csv)], cell_of(MODULI_PA[site]), propose=False)


def answer(diagnosis: Diagnosis) -> tuple[str, bool]:
    """What a diagnosis names, and whether that is the asymmetry, alone or in a small group."""
    if not diagnosis.effects:
        return diagnosis.verdict, False
    groups = [{effect.id, *effect.indistinguishable_from} for effect in diagnosis.effects]
    named = " and ".join(effect.id + "".join(f" or {other}" for other in effect.indistinguishable_from) for effect in diagnosis.effects)
    return named, len(groups) == 1 and NAME in groups[0] and len(groups[0]) <= LARGEST_GROUP


def lines_of(palpated: SlopesRun, folder: Path, with_diagnosis: bool) -> Iterator[tuple[str, bool]]:
    """One line of the table a site, and whether it is as required."""
    right = RIGHT[palpated.law] == palpated.setting
    for site in results.sites(palpated.recording.rows, palpated.recording.header):
        true_Pa, static_Pa, ci95_Pa = MODULI_PA[site["name"]], site["static_youngs_modulus_Pa"], site["static_ci95_Pa"]
        assert static_Pa is not None
        assert ci95_Pa is not None
        error = static_Pa / true_Pa - 1.0
        named, good = answer(diagnosed(palpated, site["name"], folder)) if with_diagnosis else ("–", True)
        good = abs(error) <= WITHIN if right else good
        setting = palpated.setting + ("" if right else " (wrong)")
        moduli = f"{true_Pa / 1e3:.1f} | {static_Pa / 1e3:.1f} | {error:+.1%} | ± {(ci95_Pa[1] - ci95_Pa[0]) / 2 / true_Pa:.1%}"
        yield f"| {palpated.law} | {setting} | {site['name']} | {moduli} | {named} | {'yes' if good else '**no**'} |", good


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--without-wires", action="store_true", help="the daemon's loop on the cell's physics: processor time only")
    parser.add_argument("--kept", type=Path, help="folder for the recordings; those that are there are used")
    parser.add_argument("--no-diagnosis", action="store_true", help="the moduli only")
    parser.add_argument("--seed", type=int, default=1, help="of the noise, without wires")
    options = parser.parse_args()
    print("| slopes part at | `fz_slopes` | site | true, kPa | static, kPa | error | 95 % | diagnosis names | as required |")
    print("|---|---|---|---|---|---|---|---|---|")
    settings: tuple[Setting, ...] = ("pressed", "both")
    laws: tuple[PartsAt, ...] = ("load", "reading")
    all_good = True
    with tempfile.TemporaryDirectory() as name:
        kept = options.kept or Path(name)
        kept.mkdir(parents=True, exist_ok=True)
        for law in laws:
            folder = Path(name) / law
            folder.mkdir()
            if options.without_wires:
                runs: Iterator[SlopesRun] = (one for setting in settings for one in without_wires(folder, law, setting, options.seed))
            else:
                runs = over_wires(folder, law, settings, kept)
            for palpated in runs:
                for line, good in lines_of(palpated, folder, not options.no_diagnosis):
                    print(line, flush=True)
                    all_good &= good
    sys.exit(not all_good)


if __name__ == "__main__":
    main()
