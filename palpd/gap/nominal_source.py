"""A user's own simulator as the nominal of a diagnosis: whether its output fits the recordings, and what to say of it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import Effect
from palpd.cell.lattice import lattice_step
from palpd.errors import RecordingError
from palpd.gap.data.noise import CHANNELS, FZ, declared_rms
from palpd.gap.data.plausibility import SHAPE_CORRELATION, WRONG_UNIT_RATIO
from palpd.gap.data.prepare import PreparedRecording
from palpd.gap.user_simulator import SimulatedNominal, unjudged
from palpd.recording.oddities import CLEAR_NOISES, correlation, dead, measured_rms
from palpd.recording.samples import Samples

UNITS = {"fz_N": ("mN", "kN"), "z_m": ("mm", "km")}
"""Units that a column may have by mistake: of numbers that are too large, and too small."""

NOISY_SHARE, STEP_SHARE = 0.3, 1.0
"""White noise of an output, and the step to which it is rounded, over the stated noise of the sensor, above which it is no prediction: the
noise adds a twentieth to that of the gap."""

FIRST_SHARE = 0.01
"""Share of the rows at the beginning over which the zeros of both forces are compared."""


@dataclass(frozen=True)
class NominalSource:
    """A user's simulator as the nominal of a diagnosis.

    Attributes:
        names: What sentences call it, for each recording.
        any_motion: Whether it can be asked for any motion; a file holds the output for a single motion.
        channels: Channels that it predicts for all recordings.
        healthy: Whether it was learned from recordings of the healthy cell.
        unjudged: Effects that cannot be judged with it, by the reason.
        notes: A sentence for everything that is odd about its output.
        onsets_s: When in each recording the change from the healthy cell begins; None where no begin shows.
    """

    names: tuple[str, ...]
    any_motion: bool
    channels: tuple[str, ...]
    healthy: bool
    unjudged: Mapping[str, tuple[str, ...]]
    notes: tuple[str, ...]
    onsets_s: tuple[float | None, ...] = ()

    @property
    def not_judged(self) -> tuple[str, ...]:
        """Effects that cannot be judged with it."""
        return tuple(name for names in self.unjudged.values() for name in names)

    @property
    def not_judged_sentences(self) -> str:
        """What could not be judged, as sentences that follow another sentence; empty where everything could be judged."""
        return "".join(f" It was not judged whether {' or '.join(names)} is there: {why}." for why, names in self.unjudged.items())

    @property
    def sentences(self) -> list[str]:
        """What to know about it."""
        began = [
            f"The change in recording {number} begins at {onset_s:.2f} s; what comes before it is as in the healthy cell."
            for number, onset_s in enumerate(self.onsets_s, 1)
            if onset_s is not None
        ]
        others = [channel for channel in CHANNELS if channel not in self.channels]
        own = f" palpd's own cell predicts {', '.join(others)}." if others else ""
        named = ", ".join(dict.fromkeys(self.names))
        out = [f"The nominal prediction of {', '.join(self.channels)} is that of {named}.{own}", *began, *self.notes]
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
        } | ({"healthy": True, "onset_s": list(self.onsets_s)} if self.healthy else {})


def nominal_source(recordings: Sequence[PreparedRecording], cell: CellFile, library: Mapping[str, Effect]) -> NominalSource | None:
    """Check the output of a user's simulator against the recordings.

    Args:
        cell: It states the noise of the sensor.
        library: The effects that may be present.

    Returns:
        What to say of the simulator; None where palpd itself simulates the nominal cell.

    Raises:
        RecordingError: The output has another unit or sign, is for another motion, or has noise or steps.
    """
    given = [(its.samples, its.simulated) for its in recordings if its.simulated is not None]
    if not given:
        return None
    notes: list[str] = []
    for samples, simulated in given:
        _refuse_misfit(samples, simulated)
        if simulated.doubt is None:  # what was learned states its own errors
            _refuse_noise(simulated, cell)
        notes += [*_zero_notes(samples, simulated, cell), *_doubt_notes(samples, simulated)]
    notes += dict.fromkeys(sentence for _, simulated in given for sentence in simulated.simulator.about)
    predicted = [simulated.channels for _, simulated in given]
    return NominalSource(
        names=tuple(simulated.simulator.name for _, simulated in given),
        any_motion=all(simulated.simulator.any_motion for _, simulated in given),
        channels=tuple(channel for channel in CHANNELS if all(channel in each for each in predicted)),
        healthy=all(simulated.doubt is not None for _, simulated in given),
        unjudged=unjudged([simulated for _, simulated in given], cell, library),
        notes=tuple(notes),
        onsets_s=tuple(simulated.simulator.onset_s for _, simulated in given),
    )


def _refuse_misfit(samples: Samples, simulated: SimulatedNominal) -> None:
    """Refuse another unit, another sign and another motion."""
    name = simulated.simulator.name
    for column, measured in (("z_m", samples.z_m), ("fz_N", samples.wrench[:, FZ - 1])):
        predicted = simulated.output.get(column)
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


def _zero_notes(samples: Samples, simulated: SimulatedNominal, cell: CellFile) -> Iterator[str]:
    """A force that does not begin where the recording begins: gravity, or another tare."""
    first = slice(0, max(1, int(FIRST_SHARE * len(samples))))
    apart_N = float(np.median(simulated.output["fz_N"][first] - samples.wrench[first, FZ - 1]))
    if abs(apart_N) > CLEAR_NOISES * float(declared_rms(cell)[FZ]):
        yield (
            f"fz_N of {simulated.simulator.name} begins {apart_N:+.3g} N beside the recording, which is tared with the probe free and "
            "still; subtract gravity, or what your simulator reads there."
        )


def _doubt_notes(samples: Samples, simulated: SimulatedNominal) -> Iterator[str]:
    """Rows at which a simulator was not learned."""
    judged = samples.t_s >= (simulated.simulator.onset_s or -np.inf)
    unknown = 0.0 if simulated.doubt is None else 1.0 - float(simulated.doubt.known[judged].mean())
    if unknown > 0.0:
        yield f"{unknown:.1%} of the rows lie beyond the heights and speeds of {simulated.simulator.name}; nothing is judged there."


def _refuse_noise(simulated: SimulatedNominal, cell: CellFile) -> None:
    """Refuse a force with noise of its own, or with steps: effects act on it as on a prediction."""
    name, fz_N = simulated.simulator.name, simulated.output["fz_N"]
    noise_N, stated_N = measured_rms(fz_N), float(declared_rms(cell)[FZ])
    step_N = lattice_step(fz_N)
    if noise_N > NOISY_SHARE * stated_N:
        raise RecordingError(
            f"fz_N of {name} has {noise_N:.2g} N of noise and the cell file states {stated_N:.2g} N, expected none in a prediction; switch "
            "the noise of your simulator off, and drive it with a smooth motion."
        )
    if step_N > STEP_SHARE * stated_N:
        raise RecordingError(
            f"fz_N of {name} stands on steps of {step_N:.3g} N, expected none in a prediction; switch the rounding of your simulator off."
        )
