"""Where injections are kept, one file NAME.injection.json beside each recording, and what they say of this cell.

A run of `palpd inject` has a second channel with a sealed effect. The diagnosis has read that channel, then the seal was opened. Many such
runs show from which size on this cell's diagnosis names an effect, and whether its probabilities are right.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from palpd.documents import read_json
from palpd.errors import BadInput
from palpd.files import write_json
from palpd.history.stored import INJECTION, beside, stored_beside
from palpd.quantities import quantity, wilson
from palpd.recording.second_channel import SealedAnswer

ENOUGH = 30
"""Injections after which limits and calibration are worth reading: some four an effect."""
MOST_BYTES = 50_000
SPREADS = (0.05, 0.1, 0.2, 0.4)
"""Decades over which the share of named effects rises, as a logistic curve; equally likely at first."""
BEYOND = 1.0
"""Decades below the smallest and above the largest size in which a limit may be."""


@dataclass(frozen=True, slots=True)
class SizeOfEffect:
    """Which parameter is the size of an effect, its unit (% for a ratio), and words for people. `falls`: a smaller one does more."""

    parameter: str
    unit: str
    words: str
    falls: bool = False

    def of(self, planted: SealedAnswer) -> float:
        """Size, larger for more; of a filter its period at the cutoff."""
        value = abs(planted.parameters[self.parameter])
        return 1.0 / value if self.falls else value

    def text(self, size: float, ci95: tuple[float, float] | None = None) -> str:
        """A size for people.

        Args:
            size: In the SI unit of its parameter.
            ci95: Its interval, in the same unit; None: without one.
        """
        scale = 100.0 if self.unit == "%" else 1.0
        return quantity(scale * size, self.unit, None if ci95 is None else (scale * ci95[0], scale * ci95[1]))


SIZES = {
    "sensor.gain": SizeOfEffect("error", "%", "error of the scale"),
    "sensor.bias": SizeOfEffect("offset_N", "N", "offset of the zero"),
    "sensor.drift": SizeOfEffect("rate_N_per_s", "N/s", "drift of the zero"),
    "sensor.latency": SizeOfEffect("delay_s", "s", "delay"),
    "sensor.filter": SizeOfEffect("cutoff_Hz", "s", "period at the cutoff of the filter", falls=True),
    "sensor.hysteresis": SizeOfEffect("amplitude_N", "N", "half the width of the loop"),
}
"""The effects that are planted."""


@dataclass(frozen=True, slots=True)
class Injection:
    """One injection, opened.

    Attributes:
        date: Of the diagnosis, ISO 8601.
        seal: SHA-256 of the sealed text, as it was shown before the run.
        planted: What was planted.
        verdict: Of the diagnosis; empty where there was none.
        named: Effects that the diagnosis names.
        probability: What it states for its verdict: of the least likely effect that it names, of no gap, or of something unknown. None
            where there was no diagnosis.
        reason: Why there was no diagnosis.
    """

    date: str
    seal: str
    planted: SealedAnswer
    verdict: str = ""
    named: tuple[str, ...] = ()
    probability: float | None = None
    reason: str = ""

    @property
    def is_named(self) -> bool:
        """Whether what was planted is named; with nothing planted, whether nothing is."""
        return self.planted.effect in self.named if self.planted.effect else self.verdict == "none"

    @property
    def right(self) -> bool:
        """Whether what was planted is named, and nothing else, and nothing outside the list: all that is planted stands on it."""
        return self.is_named and len(self.named) <= 1 and self.verdict != "unknown"


@dataclass(frozen=True, slots=True)
class DetectionLimit:
    """From which size on an effect is named: the size named in half of the runs with its 95 % interval, in the SI unit of its parameter.

    `low` is None where none was missed, `high` where none was named: only one bound is known then.
    """

    effect: str
    injections: int
    named: int
    limit: float
    low: float | None
    high: float | None


_FILE = TypeAdapter(Injection)


def keep_injection(recording: Path, injection: Injection) -> Path:
    """Write an opened injection beside its recording. Raises BadInput where it cannot be written."""
    path = beside(recording, INJECTION)
    write_json(path, asdict(injection), own=True)
    return path


def kept_injections(folder: Path) -> list[Injection]:
    """All opened injections in a folder of runs, oldest first, each once. Raises BadInput where a file is damaged or was altered."""
    kept = {injection.seal: injection for injection in map(_read, stored_beside(folder, INJECTION))}  # a copy has the same seal
    return sorted(kept.values(), key=lambda each: each.date)


def _read(path: Path) -> Injection:
    try:
        injection = _FILE.validate_python(read_json(path, most_bytes=MOST_BYTES))
    except ValidationError as error:
        raise BadInput(f"{path} holds no injection ({error.error_count()} faults); move it away") from error
    if injection.planted.effect not in {"", *SIZES} or injection.planted.seal != injection.seal:
        raise BadInput(f"{path} holds another answer than the one that was sealed; move it away")
    if bool(injection.verdict) != (injection.probability is not None):
        raise BadInput(f"{path} holds a verdict or a probability without the other; move it away")
    return injection


def detection_limits(injections: Sequence[Injection]) -> list[DetectionLimit]:
    """The limit of each effect that was planted and judged.

    Without a limit in advance each place on a logarithmic axis is equally likely, from a decade below the smallest size to one above the
    largest; so is each of `SPREADS`.
    """
    limits = []
    for effect, size in SIZES.items():
        mine = [each for each in injections if each.planted.effect == effect and each.verdict]
        if not mine:
            continue
        sizes, named = np.log10([size.of(each.planted) for each in mine]), np.array([each.is_named for each in mine])
        places = np.linspace(sizes.min() - BEYOND, sizes.max() + BEYOND, 401)
        shares = 1.0 / (1.0 + np.exp((places[:, None, None] - sizes) / np.array(SPREADS)[:, None]))
        weight = np.where(named, shares, 1.0 - shares).prod(axis=2).sum(axis=1).cumsum()
        low, limit, high = (float(10.0 ** np.interp(share * weight[-1], weight, places)) for share in (0.025, 0.5, 0.975))
        bounds = None if named.all() else low, high if named.any() else None
        limits.append(DetectionLimit(effect, len(mine), int(named.sum()), limit, *bounds))
    return limits


def injection_report(folder: Path) -> dict[str, Any]:
    """What the injections of a folder say, for `--json` and for a page.

    Args:
        folder: The folder of the runs.

    Returns:
        `injections`, `judged` and `enough`; `limits` with numbers, `words` and `text` of each effect; `silent` of `healthy` runs without
        an effect; `right`, its interval `right_ci95`, and the mean `stated` probability; `sentences` on these; `last`, one on the newest.

    Raises:
        BadInput: A file is damaged, or the folder cannot be read.
    """
    kept = kept_injections(folder)
    judged = [each for each in kept if each.verdict]
    healthy = [each for each in judged if not each.planted.effect]
    right, limits = sum(each.right for each in judged), detection_limits(judged)
    silent, low_high = sum(each.is_named for each in healthy), wilson(right, len(judged)) if judged else None
    stated = float(np.mean([each.probability for each in judged])) if judged else None
    needed = f" of the {ENOUGH} runs that limits and probabilities of this cell need" if len(judged) < ENOUGH else " runs"
    sentences = [f"Judged: {len(judged)}{needed}."]
    if low_high is not None and stated is not None:
        interval = " to ".join(f"{100.0 * share:.0f}" for share in low_high)
        sentences.append(f"Right in {right} of {len(judged)} runs ({interval} %); the mean stated probability is {100.0 * stated:.0f} %.")
    if healthy:
        sentences.append(f"Silent in {silent} of {len(healthy)} runs with nothing planted.")
    return {
        "injections": len(kept),
        "judged": len(judged),
        "enough": ENOUGH,
        "limits": [asdict(each) | {"words": SIZES[each.effect].words, "text": limit_text(each)} for each in limits],
        "healthy": len(healthy),
        "silent": silent,
        "right": right,
        "right_ci95": low_high,
        "stated": stated,
        "sentences": sentences,
        "last": injection_sentence(kept[-1]) if kept else "",
    }


def limit_text(limit: DetectionLimit) -> str:
    """The size named in half of the runs, with its interval or its only bound."""
    size = SIZES[limit.effect]
    if limit.low is None:
        return f"below {size.text(limit.high or limit.limit)}"
    return f"above {size.text(limit.low)}" if limit.high is None else size.text(limit.limit, (limit.low, limit.high))


def injection_sentence(injection: Injection) -> str:
    """What was planted and what the diagnosis said."""
    effect = injection.planted.effect
    size = f" ({SIZES[effect].words} {SIZES[effect].text(SIZES[effect].of(injection.planted))})" if effect else ""
    planted = f"Planted was {effect or 'nothing'}{size}"
    if not injection.verdict:
        return f"{planted}; it was not judged: {injection.reason}."
    outside = {"none": ["no gap"], "unknown": ["an unknown cause"]}.get(injection.verdict, [])
    words = " and ".join([*injection.named, *outside])
    return f"{planted}; the diagnosis says {words} ({injection.probability:.2f}): {'right' if injection.right else 'wrong'}."
