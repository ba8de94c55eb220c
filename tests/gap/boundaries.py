"""What a diagnosis may answer when one deviation of a healthy cell reaches its tolerance and leaves it."""

from dataclasses import dataclass

import numpy as np

from palpd.cell.cell_file import Estimated
from palpd.cell.effects import EFFECTS
from palpd.gap.data.noise import FZ
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.gaussian.nuisances import nuisances
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import NOMINAL_ETA, Problem, tolerance_key
from palpd.testing.plain_cells import cell_of, recording

KEYS = {effect.tolerance: effect.id for effect in EFFECTS.values() if effect.tolerance is not None}
"""Effect of every tolerance that has one."""

SILENT_SD, NAMED_SD = 2.0, 4.0
"""Standard deviations up to which a cell is healthy, and beyond which its deviation is named or reported."""

LEAST_SNR = 10.0
"""Signal-to-noise ratio beside the other tolerances from which a deviation must be seen."""


@dataclass(frozen=True)
class Boundary:
    """One recording: its controller, the deviation by its tolerance's key, and how many standard deviations that is off."""

    controller: str
    key: str
    off_sd: float
    seed: int = 101


@dataclass(frozen=True)
class BoundaryOutcome:
    """What was answered, the signal-to-noise ratio of the deviation beside the other tolerances, and whether the answer is right."""

    answer: str
    snr: float
    right: bool


def answer_to(boundary: Boundary, max_bins: int = 900) -> BoundaryOutcome:
    """Diagnose one recording and judge the answer.

    Args:
        boundary: The recording.
        max_bins: Largest number of bins of the diagnosis.

    Returns:
        The outcome.
    """
    cell = cell_of(boundary.controller)
    tolerance = getattr(cell.tolerances, boundary.key)
    value = boundary.off_sd * tolerance
    deviations = Estimated(**{boundary.key: (value, -value, value, -value) if boundary.key == "crosstalk" else value})
    diagnosis = diagnose([recording(boundary.controller, boundary.seed, deviations)], cell, max_bins=max_bins, propose=False)
    snr = boundary.off_sd * signal_to_noise(diagnosis.problem, boundary.key)
    named = {name for effect in diagnosis.effects for name in (effect.id, *effect.indistinguishable_from)}
    groups = [{effect.id, *effect.indistinguishable_from} for effect in diagnosis.effects]
    only_own = len(groups) == 1 and KEYS[boundary.key] in groups[0]
    reported = any(f"tolerances.{boundary.key} " in note for note in diagnosis.notes)
    silent = diagnosis.verdict == "none"
    if boundary.off_sd <= SILENT_SD:
        right = silent
    elif boundary.off_sd <= NAMED_SD:
        right = silent or only_own
    else:
        right = (KEYS[boundary.key] in named or reported) if snr >= LEAST_SNR else silent or only_own
    return BoundaryOutcome(_answer(diagnosis, reported), snr, right)


def signal_to_noise(problem: Problem, key: str) -> float:
    """Size of one standard deviation of a deviation, in sigmas, with everything else within specification projected out.

    Args:
        problem: The recording.
        key: Key of its tolerance.

    Returns:
        The size.
    """
    around = linearise(problem, {}, NOMINAL_ETA)
    own = [
        k
        for k, label in enumerate(around.labels)
        if tolerance_key(label.name) == key and (label.scope == "cell" or (label.scope == "recording" and label.channel == FZ))
    ]
    signs = [1.0, -1.0, 1.0, -1.0] if key == "crosstalk" else [1.0]
    coefficients = np.zeros(around.space.size)
    coefficients[own] = signs
    change = around.space.columns.times(coefficients)
    others = nuisances(around.space.columns.without(np.array(own))[0])
    return float(np.sqrt((change**2).sum() - (others.against(change) ** 2).sum()))


def _answer(diagnosis: Diagnosis, reported: bool) -> str:
    names = [" or ".join((effect.id, *effect.indistinguishable_from)) for effect in diagnosis.effects]
    return diagnosis.verdict + (f": {', '.join(names)}" if names else "") + (" (reported)" if reported else "")
