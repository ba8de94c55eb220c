"""A user's own simulator as the nominal of a diagnosis: whether its output fits the recordings, and what to say of it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpd.errors import RecordingError
from palpd.gap.data.noise import CHANNELS, FZ, declared_rms
from palpd.gap.data.plausibility import SHAPE_CORRELATION, WRONG_UNIT_RATIO
from palpd.gap.data.prepare import PreparedRecording
from palpd.gap.user_simulator import NominalDifference
from palpd.recording.oddities import CLEAR_NOISES, correlation, dead, measured_rms
from palpd.recording.samples import Samples

UNITS = {"fz_N": ("mN", "kN"), "z_m": ("mm", "km")}
"""Units that a column may have by mistake: of numbers that are too large, and too small."""

NOISY_SHARE = 0.3
"""White noise of an output over the stated noise of the sensor above which it gets a note: it adds a twentieth to the noise of the gap."""

FIRST_SHARE = 0.01
"""Share of the rows at the beginning over which the zeros of both forces are compared."""


@dataclass(frozen=True)
class NominalSource:
    """A user's simulator as the nominal of a diagnosis.

    Attributes:
        names: What sentences call it, for each recording.
        any_motion: Whether it can be asked for any motion; a file holds the output for a single motion.
        channels: Channels that it predicts for all recordings.
        not_judged: Effects about which a file cannot be asked.
        notes: A sentence for everything that is odd about its output.
    """

    names: tuple[str, ...]
    any_motion: bool
    channels: tuple[str, ...]
    not_judged: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def unjudged(self) -> str:
        """What could not be judged, as a sentence that follows another sentence; empty where everything could be judged."""
        if not self.not_judged:
            return ""
        return f" It was not judged whether {' or '.join(self.not_judged)} is there: {self.names[0]} holds no motion but the recorded one."

    @property
    def sentences(self) -> list[str]:
        """What to know about it."""
        others = [channel for channel in CHANNELS if channel not in self.channels]
        own = f" palpd's own cell predicts {', '.join(others)}." if others else ""
        named = ", ".join(dict.fromkeys(self.names))
        out = [f"The nominal prediction of {', '.join(self.channels)} is that of {named}.{own}", *self.notes]
        if not self.any_motion:
            out.append(
                "A prediction on another motion needs your simulator's output for that motion: palpd simulate MOTION --cell ENRICHED "
                "--simulated OUTPUT --nominal CELL."
            )
        return out

    def to_json(self) -> dict[str, Any]:
        """The block `simulated` of out.json."""
        return {
            "names": list(self.names),
            "other_motions": self.any_motion,
            "channels": list(self.channels),
            "not_judged": list(self.not_judged),
        }


def nominal_source(recordings: Sequence[PreparedRecording], not_judged: Sequence[str]) -> NominalSource | None:
    """Check the output of a user's simulator against the recordings.

    Args:
        not_judged: Effects that were left out.

    Returns:
        What to say of the simulator; None where palpd itself simulates the nominal cell.

    Raises:
        RecordingError: The output has another unit or sign, or is for another motion.
    """
    given = [(its.samples, its.nominal_difference) for its in recordings if its.nominal_difference is not None]
    if not given:
        return None
    notes = []
    for samples, beyond in given:
        _refuse_misfit(samples, beyond)
        notes += [*_zero_notes(samples, beyond), *_noise_notes(beyond)]
    predicted = [beyond.channels for _, beyond in given]
    return NominalSource(
        names=tuple(beyond.simulator.name for _, beyond in given),
        any_motion=all(beyond.simulator.any_motion for _, beyond in given),
        channels=tuple(channel for channel in CHANNELS if all(channel in each for each in predicted)),
        not_judged=tuple(not_judged),
        notes=tuple(notes),
    )


def _refuse_misfit(samples: Samples, beyond: NominalDifference) -> None:
    """Refuse another unit, another sign and another motion."""
    name = beyond.simulator.name
    for column, measured in (("z_m", samples.z_m), ("fz_N", samples.wrench[:, FZ - 1])):
        predicted = beyond.output.get(column)
        if predicted is None or dead(predicted) or dead(measured):
            continue
        alike, ratio = correlation(predicted, measured), float(np.std(predicted) / np.std(measured))
        if column == "z_m" and abs(alike) < SHAPE_CORRELATION:
            raise RecordingError(
                f"z_m of {name} and z_m of the recording have a correlation of {alike:.2f}, expected nearly 1; the output is for another "
                "motion: simulate the recorded one."
            )
        if alike < -SHAPE_CORRELATION:
            raise RecordingError(
                f"{column} of {name} falls where {column} of the recording rises (correlation {alike:.2f}), expected to rise with it; "
                f"multiply {column} of {name} by -1."
            )
        if abs(alike) > SHAPE_CORRELATION and not 1.0 / WRONG_UNIT_RATIO < ratio < WRONG_UNIT_RATIO:
            large, small = UNITS[column]
            unit = f"it looks like {large}, divide by 1000" if ratio > 1.0 else f"it looks like {small}, multiply by 1000"
            raise RecordingError(f"{column} of {name} is {ratio:.3g} times {column} of the recording, expected about 1; {unit}.")


def _zero_notes(samples: Samples, beyond: NominalDifference) -> Iterator[str]:
    """A force that does not begin where the recording begins: gravity, or another tare."""
    first = slice(0, max(1, int(FIRST_SHARE * len(samples))))
    apart_N = float(np.median(beyond.output["fz_N"][first] - samples.wrench[first, FZ - 1]))
    if abs(apart_N) > CLEAR_NOISES * float(declared_rms(beyond.cell)[FZ]):
        yield (
            f"fz_N of {beyond.simulator.name} begins {apart_N:+.3g} N beside the recording, which is tared with the probe free and still; "
            "subtract gravity, or what your simulator reads there."
        )


def _noise_notes(beyond: NominalDifference) -> Iterator[str]:
    """A force with noise of its own."""
    noise_N, stated_N = measured_rms(beyond.output["fz_N"]), float(declared_rms(beyond.cell)[FZ])
    if noise_N > NOISY_SHARE * stated_N:
        yield (
            f"fz_N of {beyond.simulator.name} has {noise_N:.2g} N of noise and the cell file states {stated_N:.2g} N, expected none in a "
            "prediction; switch the noise of your simulator off, and drive it with a smooth motion."
        )
