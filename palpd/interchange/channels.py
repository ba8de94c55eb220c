"""What a foreign file holds, and what a reader of such files is.

A reader is one object that fits the protocol `FileReader`. Those of other packages are entry points of `palpd.readers`.
"""

import logging
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from palpd.errors import PalpdError, RecordingError
from palpd.tick import Floats

Kind = Literal["column", "wrench", "pose", "command", "twist", "transforms", "other"]
"""What a channel is: one number a sample, or a vector: wrench (n, 6), pose and commanded pose (n, 7), twist (n, 6). `transforms` are the
poses of several frames in one topic; `other` is nothing that an import could use."""

MOST_CHANNELS = 10_000
"""Largest number of channels of a file; a controller's log has some 200."""
MOST_LISTED = 12
"""Number of channels that an error lists; the rest is counted."""


@dataclass(frozen=True)
class Channel:
    """A channel of a file, by its name there.

    `unit` is what the file says, empty where it says nothing; `type` is the file's own word for what it holds, if it has one. `rate_Hz`
    and `samples` are None where only the numbers would tell.
    """

    name: str
    kind: Kind = "column"
    unit: str = ""
    rate_Hz: float | None = None
    samples: int | None = None
    type: str = ""

    def __str__(self) -> str:
        what = self.unit or (self.type if self.kind != "column" else "")
        rate = f"{self.rate_Hz:.4g} Hz" if self.rate_Hz is not None else ""
        name = shlex.quote(self.name)  # so that it can be pasted behind an option
        return f"{name} ({', '.join(filter(None, (what, rate)))})" if what or rate else name


@dataclass(frozen=True)
class ChannelData:
    """The numbers of a channel: `values` (n,) or (n, k) as they stand in the file, vectors in SI.

    `t_s` (n,) are the times of a channel that has its own, from `origin_ns` on: nanoseconds since 1970 lose digits as seconds. Poses are
    x, y, z and the quaternion x, y, z, w. `frame` names the axes of a vector, empty where nothing tells. `messages` came in the order of
    their sending and may be sorted; rows of a table may not. `notes` are sentences for the user.
    """

    values: Floats
    t_s: Floats | None = None
    origin_ns: int = 0
    frame: str = ""
    messages: bool = False
    notes: tuple[str, ...] = ()


class FileReader(Protocol):
    """Reads one kind of file."""

    name: str
    """What people call such files: "rosbag"."""

    def reads(self, path: Path) -> bool:
        """Whether a file, by its name and first bytes, is of this kind."""

    def channels(self, path: Path) -> Sequence[Channel]:
        """List what a file holds. Raises RecordingError where it cannot be read."""

    def columns(self, path: Path, names: Sequence[str]) -> dict[str, ChannelData]:
        """Read channels by their names.

        Args:
            names: Names of channels, as `channels` lists them.

        Raises:
            RecordingError: A channel is absent or damaged; the sentence names column and row.
        """


def listing(channels: Sequence[Channel]) -> str:
    """Name channels in an error.

    Returns:
        Their names with units and rates, cut short.
    """
    shown = [str(channel) for channel in channels[:MOST_LISTED]]
    more = len(channels) - len(shown)
    return (", ".join(shown) or "nothing") + (f" and {more} more" if more > 0 else "")


def refuse_many(path: Path, number: int) -> None:
    """Refuse a file with more channels than any instrument has.

    Raises:
        RecordingError: There are too many.
    """
    if number > MOST_CHANNELS:
        raise RecordingError(f"{path.name} has {number} columns, expected at most {MOST_CHANNELS}; are rows and columns exchanged?")


def refuse_not_finite(path: Path, name: str, values: Floats) -> None:
    """Refuse a channel that holds what is no finite number.

    Args:
        values: Its numbers (n,).

    Raises:
        RecordingError: A number is not finite; the sentence names the row.
    """
    wrong = np.flatnonzero(~np.isfinite(values))
    if len(wrong):
        raise RecordingError(
            f"{path.name}: {name} is {values[wrong[0]]} in row {wrong[0] + 1}; every value must be a finite number, so leave it out"
        )


@contextmanager
def understanding(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a library raises over a damaged file into one sentence, and keep what it logs off the terminal.

    Args:
        kind: What the file should be.

    Yields:
        Nothing.

    Raises:
        RecordingError: The library raised an error of any class.
    """
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    except PalpdError:
        raise
    except (Exception, SystemError) as failure:  # a library that reads a truncated file raises anything
        what = " ".join(str(failure).split())[:160] or type(failure).__name__
        raise RecordingError(
            f"{path.name} cannot be read as {kind} ({what}); it is truncated, damaged or something else: copy or export it again"
        ) from failure
    finally:
        logging.disable(before)


def refuse_empty(path: Path) -> None:
    """Refuse a file without a byte. Raises RecordingError."""
    if path.is_file() and path.stat().st_size == 0:
        raise RecordingError(f"{path.name} is empty (0 bytes); copy or export it again")


def library(path: Path, kind: str, package: str, module: str) -> Any:
    """Import the library that reads a file.

    Args:
        kind: What the file is, such as "a ROS bag".
        package: Name of the package, as it is installed.
        module: The module of it that is wanted.

    Raises:
        RecordingError: It is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        raise RecordingError(f"{path.name} is {kind} and {package} is not installed: install palpd[readers]") from None
