"""Recordings that were cut off or damaged: FILE.part becomes FILE.mcap with all that is whole."""

import contextlib
import itertools
import math
from dataclasses import dataclass
from pathlib import Path

from palpd.errors import RecordingError
from palpd.files import is_growing
from palpd.recording import cdr
from palpd.recording.header import RecordingFooter
from palpd.recording.mcap_file import HEADER_LOST, Contents, RecordingWriter


@dataclass(frozen=True, slots=True)
class LostTicks:
    """Ticks that no whole chunk holds: their number, and the times since the first restored tick between which they are missing.

    `begin_s` is NaN for those before it.
    """

    ticks: int
    begin_s: float
    end_s: float

    @property
    def place(self) -> str:
        """Where they are missing, in words."""
        return "at the begin" if math.isnan(self.begin_s) else f"from {self.begin_s:.2f} s to {self.end_s:.2f} s"


@dataclass(frozen=True, slots=True)
class Recovered:
    """What `recover` restored, and what it could not. `torn` says where the file is damaged; it is empty for a whole one."""

    path: Path
    ticks: int
    duration_s: float
    lost: tuple[LostTicks, ...] = ()
    torn: str = ""

    @property
    def sentence(self) -> str:
        """What was restored, and which ticks are missing at what time."""
        restored = f"{self.ticks} ticks, {self.duration_s:.1f} s restored."
        if self.lost:
            places = ", ".join(f"{one.ticks} {one.place}" for one in self.lost)
            return f"{restored} {sum(one.ticks for one in self.lost)} ticks are missing ({places}): the file is damaged {self.torn}."
        return f"{restored} The file is damaged {self.torn}; what stood there or after the last tick is lost." if self.torn else restored


def recover(part: Path) -> Recovered:
    """Write FILE.mcap with all whole chunks of FILE.part, and keep FILE.part. Raises RecordingError, also where FILE.mcap exists."""
    path = part.parent / f"{part.name.removesuffix('.part').removesuffix('.mcap')}.mcap"
    if part.suffix != ".part":
        raise RecordingError(f"{part} is not called .part; give the unfinished file, or rename a damaged one to .part")
    _refuse_growing(part)
    contents = Contents()
    batches = contents.batches(part, skip_damaged=True)
    first = next((batch for batch in batches if batch), [])
    if first and (contents.torn or contents.header is None):
        contents.restore(part, first[0])
    contents.refuse_foreign(part)
    assert contents.header is not None
    if not first:
        raise RecordingError(f"{part} holds no whole tick ({contents.torn or 'it ends after the header'}); there is nothing to recover")
    recovering = part.with_suffix(".recovering")
    with contextlib.suppress(OSError):  # usually there is none; one that nobody writes is of a recovery that was cut off itself
        if not is_growing(recovering):
            recovering.unlink()
    try:
        writer = RecordingWriter(path, contents.header, contents.model_bytes, part=recovering)
    except OSError as error:
        recovering.unlink(missing_ok=True)
        raise _no_room(path, error) from error
    begin_s, end_s, ticks, last = float("nan"), float("nan"), 0, -1
    lost: list[LostTicks] = []
    try:
        for batch in filter(None, itertools.chain([first], batches)):
            rows = cdr.unpack_ticks(batch, contents.absent)
            writer.write(rows)
            writer.flush()
            begin_s = float(rows["now_s"][0]) if ticks == 0 else begin_s
            # A tick that was late counts those before it as missed: they never were.
            absent = int(rows["index"][0]) - last - 1 - int(rows["missed"][0])
            if contents.torn and absent > 0:
                lost.append(LostTicks(absent, end_s - begin_s, float(rows["now_s"][0]) - begin_s))
            end_s, ticks, last = float(rows["now_s"][-1]), ticks + len(rows), int(rows["index"][-1])
        unclosed: RecordingFooter = {
            "verdict": "unfinished",
            "reason": "the recording was not closed, or its end is damaged; recovered from what was whole",
        }
        footer = contents.footer or unclosed
        if lost:
            footer["damaged_ticks"] = sum(one.ticks for one in lost)
        if contents.header_lost:
            footer["reason"] = f"{footer.get('reason', '')}; {HEADER_LOST}".removeprefix("; ")
        writer.close(footer)
    except BaseException as error:
        writer.abandon()
        recovering.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise _no_room(path, error) from error
        raise
    torn = f"{contents.torn}; {HEADER_LOST}" if contents.header_lost else contents.torn
    return Recovered(path, ticks, end_s - begin_s, tuple(lost), torn)


def _no_room(path: Path, error: OSError) -> RecordingError:
    return RecordingError(f"{path} cannot be written ({error.strerror or error}); make room, or recover a copy on another disk")


def _refuse_growing(part: Path) -> None:
    with contextlib.suppress(OSError):  # the reader refuses a file that does not exist
        if not part.is_file():
            part.stat()
            raise RecordingError(f"{part} is no regular file; give the unfinished recording of a run")
        if is_growing(part):
            raise RecordingError(f"{part} is still being written; wait for the run to end")
