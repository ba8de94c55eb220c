"""LabVIEW's TDMS files, through `npTDMS`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpd.errors import RecordingError
from palpd.interchange.channels import (
    Channel,
    ChannelData,
    library,
    listing,
    refuse_empty,
    refuse_many,
    refuse_not_finite,
    understanding,
)

KIND = "a TDMS file of LabVIEW"


class TdmsReader:
    """Reads TDMS files; a channel is called GROUP/CHANNEL, and a waveform brings its own times."""

    name = "a TDMS file of LabVIEW (.tdms)"

    def reads(self, path: Path) -> bool:
        """Whether a file has LabVIEW's ending."""
        return path.is_file() and path.suffix.lower() == ".tdms"

    def channels(self, path: Path) -> Sequence[Channel]:
        """List the channels of numbers."""
        return [_channel(name, each) for name, each in _numeric(path).items()]

    def columns(self, path: Path, names: Sequence[str]) -> dict[str, ChannelData]:
        """Read channels by their names.

        Raises:
            RecordingError: A channel is absent, damaged, or holds what is no number.
        """
        every = _numeric(path)
        columns = {}
        for name in names:
            if name not in every:
                raise RecordingError(f"{path.name} has no channel {name}; it holds {listing([_channel(*each) for each in every.items()])}")
            with understanding(path, KIND):
                values = np.asarray(every[name][:], dtype=float)
                step_s = every[name].properties.get("wf_increment")
                offset_s = float(every[name].properties.get("wf_start_offset", 0.0))
                t_s = offset_s + float(step_s) * np.arange(len(values), dtype=np.float64) if step_s else None
                start = np.datetime64(every[name].properties.get("wf_start_time", 0), "ns")
            refuse_not_finite(path, name, values)
            columns[name] = ChannelData(values, t_s, max(int(start.astype(np.int64)), 0))  # LabVIEW's own zero is in 1904
        return columns


READER = TdmsReader()


def _numeric(path: Path) -> dict[str, Any]:
    refuse_empty(path)
    nptdms = library(path, KIND, "npTDMS", "nptdms")
    with understanding(path, KIND):
        file = nptdms.TdmsFile.read(path)
        every = {f"{group.name}/{channel.name}": channel for group in file.groups() for channel in group.channels()}
        refuse_many(path, len(every))
        numeric = {name: each for name, each in every.items() if each.dtype is not None and np.issubdtype(each.dtype, np.number)}
    if not any(len(each) for each in numeric.values()):
        raise RecordingError(f"{path.name} holds no channel with numbers; it is truncated, or another file is meant")
    return numeric


def _channel(name: str, each: Any) -> Channel:
    step_s = each.properties.get("wf_increment")
    unit = str(each.properties.get("unit_string", each.properties.get("NI_UnitDescription", "")))
    return Channel(name, unit=unit, rate_Hz=1.0 / float(step_s) if step_s else None, samples=len(each))
