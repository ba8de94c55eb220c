"""Curves of atomic force microscopes and nanoindenters, through `afmformats`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpd.errors import RecordingError
from palpd.files import opened
from palpd.interchange.channels import Channel, ChannelData, library, refuse_empty, refuse_not_finite, understanding

KIND = "a file of an AFM or a nanoindenter"
ENDINGS = (".jpk-force", ".jpk-force-map", ".jpk-force-qi", ".jpk-qi-image", ".jpk-qi-series", ".ibw", ".tab", ".h5")
TEXT_MARKS = (b"Device:\tChiaro", b"NT-MDT")
"""What stands in the first bytes of text that an instrument wrote and afmformats reads."""
HEAD_BYTES = 4096
TIP = "tip position"
"""Height of the tip: of the base of the cantilever, and up by its deflection."""
UNITS = {"force": "N", "height (measured)": "m", "height (piezo)": "m", TIP: "m", "time": "s"}
BETWEEN = "#"
"""Between a column and the number of its curve, in a file of several curves: force#3."""


class AfmReader:
    """Reads force-distance, creep and relaxation curves; in a file of several, COLUMN#3 is a column of the third."""

    name = f"{KIND} ({', '.join(ENDINGS)}, Chiaro .txt)"

    def reads(self, path: Path) -> bool:
        """Whether a file has the ending or the first words of an instrument."""
        if not path.is_file():
            return False
        if path.suffix.lower() in ENDINGS:
            return True
        if path.suffix.lower() != ".txt":
            return False
        with opened(path, error=RecordingError) as stream:
            head = stream.read(HEAD_BYTES)
        return any(mark in head for mark in TEXT_MARKS)

    def channels(self, path: Path) -> Sequence[Channel]:
        """List the columns of the curves."""
        curves = _curves(path)
        with understanding(path, KIND):
            return [
                Channel(_name(column, number, len(curves)), "column", UNITS[column], _rate_Hz(curve), len(curve))
                for number, curve in enumerate(curves, start=1)
                for column in _columns(curve)
            ]

    def columns(self, path: Path, names: Sequence[str]) -> dict[str, ChannelData]:
        """Read columns by their names.

        Args:
            names: Names of channels.

        Raises:
            RecordingError: A column is absent, or holds what is no number.
        """
        curves = _curves(path)
        every = {
            _name(column, number, len(curves)): (curve, column)
            for number, curve in enumerate(curves, start=1)
            for column in _columns(curve)
        }
        columns = {}
        for name in names:
            if name not in every:
                raise RecordingError(
                    f"{path.name} has no column {name}; it holds {len(curves)} curve{'s' if len(curves) > 1 else ''} with "
                    f"{', '.join(list(every)[:12])}"
                )
            curve, column = every[name]
            with understanding(path, KIND):
                columns[name] = ChannelData(_values(curve, column))
            refuse_not_finite(path, name, columns[name].values)
        return columns


READER = AfmReader()


def _curves(path: Path) -> list[Any]:
    refuse_empty(path)
    afmformats = library(path, KIND, "afmformats", "afmformats")
    with understanding(path, KIND):
        try:
            curves = list(afmformats.load_data(path))
        except (
            afmformats.errors.AFMFileFormatError,
            afmformats.errors.MissingMetaDataError,
            afmformats.meta.MetaDataMissingError,
        ) as failure:  # which are no Exception
            raise ValueError(f"no format of its ending fits what is in it: {failure}") from failure
    if not curves:
        raise RecordingError(f"{path.name} holds no curve; export it again")
    return curves


def _columns(curve: Any) -> list[str]:
    """Columns that an import can use: those of the file, and the tip's height where the cantilever's stiffness is known."""
    columns = [column for column in UNITS if column in curve.columns]
    known = {"force", "height (measured)"} <= set(columns) and _stiffness_N_per_m(curve) is not None
    return [*columns, *([TIP] if known and TIP not in columns else [])]


def _values(curve: Any, column: str) -> Any:
    if column != TIP or TIP in curve.columns:
        return np.asarray(curve[column], dtype=float)
    stiffness_N_per_m = _stiffness_N_per_m(curve)
    assert stiffness_N_per_m is not None
    return np.asarray(curve["height (measured)"], dtype=float) + np.asarray(curve["force"], dtype=float) / stiffness_N_per_m


def _stiffness_N_per_m(curve: Any) -> float | None:
    value = float(curve.metadata.get("spring constant", np.nan))
    return value if np.isfinite(value) and value > 0.0 else None


def _rate_Hz(curve: Any) -> float | None:
    if "time" not in curve.columns or len(curve) < 2:
        return None
    step_s = float(np.median(np.diff(curve["time"])))
    return 1.0 / step_s if step_s > 0.0 else None


def _name(column: str, number: int, curves: int) -> str:
    return column if curves == 1 else f"{column}{BETWEEN}{number}"
