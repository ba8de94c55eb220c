"""MATLAB's .mat files, through scipy."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpd.errors import RecordingError
from palpd.files import opened
from palpd.interchange.channels import Channel, ChannelData, listing, refuse_empty, refuse_many, refuse_not_finite, understanding
from palpd.tick import Floats

KIND = "a MATLAB file"
HDF5_MAGIC = b"\x89HDF"
HEAD_BYTES = 1024
MOST_COLUMNS = 64
"""Largest number of columns of a matrix that are listed one by one; a matrix with more is no table."""
DEEPEST = 4
"""Deepest nesting of structures that is searched for numbers."""


class MatlabReader:
    """Reads .mat files up to version 7: vectors by name, columns of a matrix as NAME(:,2), fields of a structure as NAME.FIELD."""

    name = "a MATLAB file (.mat)"

    def reads(self, path: Path) -> bool:
        """Whether a file has MATLAB's ending."""
        return path.is_file() and path.suffix.lower() == ".mat"

    def channels(self, path: Path) -> Sequence[Channel]:
        """List all vectors of numbers."""
        return [Channel(name, samples=len(values)) for name, values in _vectors(path).items()]

    def columns(self, path: Path, names: Sequence[str]) -> dict[str, ChannelData]:
        """Read vectors by their names.

        Args:
            names: Names of channels.

        Raises:
            RecordingError: A vector is absent, or holds what is no number.
        """
        vectors = _vectors(path)
        for name in names:
            if name not in vectors:
                raise RecordingError(
                    f"{path.name} has no vector {name}; it holds {listing([Channel(name, samples=len(v)) for name, v in vectors.items()])}"
                )
            refuse_not_finite(path, name, vectors[name])
        return {name: ChannelData(vectors[name]) for name in names}


READER = MatlabReader()


def _vectors(path: Path) -> dict[str, Floats]:
    refuse_empty(path)
    with opened(path, error=RecordingError) as stream:
        if HDF5_MAGIC in stream.read(HEAD_BYTES):
            raise RecordingError(f"{path.name} is a MATLAB file of version 7.3; save it with save(…, '-v7') and import it again")
    with understanding(path, KIND):
        from scipy.io import loadmat

        content = loadmat(path, squeeze_me=True, chars_as_strings=True)
    vectors: dict[str, Floats] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            vectors |= dict(_flat(path, name, value, 0))
    refuse_many(path, len(vectors))
    if not vectors:
        raise RecordingError(f"{path.name} holds no vector of numbers; save force, height and time as vectors")
    return vectors


def _flat(path: Path, name: str, value: Any, level: int) -> Iterator[tuple[str, Floats]]:
    """Names and numbers of all vectors in a variable."""
    array = np.asarray(value)
    if array.dtype.names and array.ndim == 0 and level < DEEPEST:
        for field in array.dtype.names:
            yield from _flat(path, f"{name}.{field}", array[field].item(), level + 1)
    elif array.dtype.kind in "fiub" and array.ndim == 1 and len(array) > 1:
        yield name, array.astype(float)
    elif array.dtype.kind in "fiub" and array.ndim == 2:
        if array.shape[1] > MOST_COLUMNS:
            refuse_many(path, array.shape[1])
            return
        for column in range(array.shape[1]):
            yield f"{name}(:,{column + 1})", array[:, column].astype(float)
