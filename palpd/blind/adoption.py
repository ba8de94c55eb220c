"""A cause outside the list that repeats: its law is adopted from one recording, and must be named in another one of the same cell."""

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from palpd.blind.stated_cell import rounded
from palpd.cell.cell_file import CellFile
from palpd.gap.adoption import adopt
from palpd.gap.commands import library, write_answer
from palpd.gap.diagnosis import diagnose
from palpd.gap.model.problem import MAX_BINS
from palpd.recording.samples import Samples


@dataclass(frozen=True)
class AdoptionOutcome:
    """What became of a law.

    Attributes:
        law: Name of the law that the first recording gave; None where none was accepted, and nothing else is known.
        secondary: Whether the first recording named a listed cause, and the law only what that leaves.
        verdict: The verdict on the second recording.
        effects: The effects that it named.
        named: Whether the law is among them.
        in_group: Whether it is among them, or among those that they cannot be distinguished from.
        factor: Its strength in the second recording, 1 as learned; None where it is not named.
        again: The law that the second recording gave beside it, in words; None where it gave none.
    """

    law: str | None
    what: str = ""
    secondary: bool = False
    verdict: str = ""
    effects: tuple[str, ...] = ()
    named: bool = False
    in_group: bool = False
    factor: float | None = None
    again: str | None = None


def adopt_and_name(first: Samples, second: Samples, cell: CellFile, max_bins: int = MAX_BINS) -> AdoptionOutcome:
    """Diagnose a recording, adopt the law that it gives into a library of its own, and diagnose another recording with that.

    Args:
        first: A recording of a cell.
        second: Another recording of the same cell, of another motion.
        cell: The cell as the simulator knows it.
        max_bins: Largest number of bins of each diagnosis, about.
    """
    learning = diagnose([first], cell, max_bins=max_bins, propose=False)
    law = learning.decision.law
    if law is None:
        return AdoptionOutcome(None)
    with TemporaryDirectory() as folder:
        write_answer(Path(folder) / "first.json", learning)
        return name_again(Path(folder) / "first.learned.yaml", second, cell, secondary=law.secondary, max_bins=max_bins)


def name_again(learned: Path, second: Samples, cell: CellFile, *, secondary: bool = False, max_bins: int = MAX_BINS) -> AdoptionOutcome:
    """Adopt a learned law into a library of its own, and diagnose another recording with that.

    Args:
        second: Another recording of the cell that gave it.
        cell: The cell as the simulator knows it.
        secondary: Whether the law is only what a named listed cause leaves.
        max_bins: Largest number of bins of the diagnosis, about.
    """
    with TemporaryDirectory() as folder:
        law = adopt(learned, Path(folder) / "library", None, cell).law
        known = library(None, adopted=Path(folder) / "library")
    answer = diagnose([second], cell, known, max_bins=max_bins, propose=False)
    mine = next((one for one in answer.effects if one.id == law.id), None)
    groups = {name for one in answer.effects for name in (one.id, *one.indistinguishable_from)}
    again = answer.decision.learned
    return AdoptionOutcome(
        law.id,
        law.what,
        secondary,
        answer.verdict,
        tuple(one.id for one in answer.effects),
        named=mine is not None and answer.verdict != "none",
        in_group=law.id in groups and answer.verdict != "none",
        factor=mine.parameters["strength"][0] if mine is not None else None,
        again=again.what if again is not None else None,
    )


def recorded(noise_free: Samples, cell: CellFile, seed: int) -> Samples:
    """The recording that a cell makes of noise-free rows: stated noise, white, and stated rounding.

    Args:
        cell: The cell, which states both.
    """
    r, robot, sensor = np.random.default_rng([seed, 19]), cell.robot, cell.sensor
    n = len(noise_free)
    sigma = np.array([sensor.noise_rms_N] * 3 + [sensor.noise_rms_Nm] * 3)
    wrench = noise_free.wrench + sigma * r.standard_normal((n, 6))
    steps = np.array([sensor.resolution_fxy_N, sensor.resolution_fxy_N, sensor.resolution_fz_N, *[sensor.resolution_Nm] * 3])
    return replace(
        noise_free,
        z_m=noise_free.z_m + robot.position_noise_rms_m * r.standard_normal(n),
        vz_m_per_s=noise_free.vz_m_per_s + robot.velocity_noise_rms_m_per_s * r.standard_normal(n),
        wrench=rounded(wrench, steps),
    )
