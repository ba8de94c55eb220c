"""Recordings of free motion as an inertial model is trained on them: of one sensor, with the configured probe."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from palpd.compensation.refusals import refuse_other_probe
from palpd.config import Config, filter_delay_s
from palpd.errors import BadInput
from palpd.recording.reader import Recording, holds_ticks, samples_of
from palpd.recording.samples import Samples, read


@dataclass(frozen=True)
class TrainingData:
    """Recordings, the serial number of their sensor where they name it, and the delay of its filter."""

    recordings: list[Samples]
    sensor_serial: str | None
    sensor_delay_s: float


def load_training_data(paths: Sequence[Path], config: Config) -> TrainingData:
    """Read recordings of free motion.

    Args:
        paths: Recordings, .mcap or tables.
        config: Says the probe's mass, and the filter where a table does not.

    Returns:
        The recordings with what they say of their sensor.

    Raises:
        BadInput: Where a recording cannot be read, has another probe, or another sensor than the rest.
    """
    recordings, serials, delay_s = [], set(), filter_delay_s(config.sensor.filter_cutoff_Hz)
    for path in paths:
        if not holds_ticks(path):
            recordings.append(read(path))
            continue
        recording = Recording.load(path)
        recording.refuse_injected()
        recordings.append(samples_of(recording))
        about = recording.header.get("about", {})
        serials.add(about.get("sensor_serial"))
        refuse_other_probe(recording, config.cell.probe.mass_kg)
        delay_s = about.get("delay_s", delay_s)
    if len(serials) > 1:
        names = ", ".join(map(str, sorted(serials, key=str)))
        raise BadInput(f"the recordings come from different sensors ({names}); train on the recordings of one sensor")
    return TrainingData(recordings, next(iter(serials), None), delay_s)
