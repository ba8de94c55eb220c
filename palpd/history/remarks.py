"""Tags and notes of a run, in a file beside its recording.

They stand there and not in the catalogue, which is made from the files again at any time, and not in the recording, which is evidence.
"""

import fcntl
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from palpd.documents import Document, read_json, refusal
from palpd.errors import BadInput
from palpd.files import write_json
from palpd.history.stored import RECORDING, REMARKS, beside

TAG = re.compile(r"[^\W_][\w.+-]{0,39}")
"""A tag is one word: it stands on a command line and in a list with commas."""
MOST_LETTERS = 2000
"""Longest note; a page has some 3000 letters."""
MOST_NOTES = 200
MOST_BYTES = 2_000_000
"""Largest file of remarks: the most notes of the greatest length, four bytes a letter."""


class Note(BaseModel):
    """A sentence of a user, and when it was written (ISO 8601)."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    date: str = Field(max_length=40)
    text: str = Field(max_length=MOST_LETTERS)


class Remarks(BaseModel):
    """What users say of a run."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    tags: tuple[Annotated[str, Field(max_length=40)], ...] = Field(default=(), max_length=100)
    notes: tuple[Note, ...] = Field(default=(), max_length=MOST_NOTES)


def remarks_of(recording: Path) -> Remarks:
    """Tags and notes of a run; none where nobody has written any.

    Raises:
        BadInput: The file beside the recording is damaged.
    """
    path = beside(recording, REMARKS)
    if not os.path.lexists(path):
        return Remarks()
    content = read_json(path, most_bytes=MOST_BYTES)
    try:
        return Remarks.model_validate(content)
    except ValidationError as error:
        raise BadInput(f"{refusal(error, Remarks, Document(str(path), content))}; correct the file, or move it away") from error


def refuse_remarks(tags: Sequence[str], untag: Sequence[str], note: str) -> None:
    """Refuse what can be no tag or no note.

    Args:
        tags: Tags to add.
        untag: Tags to take away.
        note: A note to add; empty for none.

    Raises:
        BadInput: A tag is no word, or the note is too long.
    """
    for tag in (*tags, *untag):
        if not TAG.fullmatch(tag):
            raise BadInput(f"the tag is {tag!r}, expected one word of letters, digits and . + - _, at most 40; a sentence is a note")
    if len(note) > MOST_LETTERS:
        raise BadInput(f"the note has {len(note)} letters, expected at most {MOST_LETTERS}; write it shorter")


def remark(recording: Path, date: str, tags: Sequence[str] = (), untag: Sequence[str] = (), note: str = "") -> Remarks:
    """Add tags and a note to a run, or take tags away.

    Args:
        recording: Its recording, which must exist.
        date: Date and time of now, ISO 8601.
        note: A note to add; empty for none.

    Returns:
        The remarks as they are then.

    Raises:
        BadInput: It is no recording, a tag is no word, a note is too long, the run has no such tag, or the file cannot be read or written.
    """
    refuse_remarks(tags, untag, note)
    if recording.suffix not in (RECORDING, ".part"):
        raise BadInput(f"{recording} is no recording (.mcap), and only runs have tags and notes; palpd runs lists them")
    note = note.strip()
    with _alone(recording):
        before = remarks_of(recording)
        if absent := [tag for tag in untag if tag not in before.tags]:
            raise BadInput(f"{recording.name} has no tag {absent[0]!r}; it has {', '.join(before.tags) or 'none'}")
        if note and len(before.notes) == MOST_NOTES:
            raise BadInput(f"{recording.name} has {MOST_NOTES} notes, the most that a run can have; write on in a file of your own")
        kept = dict.fromkeys((*before.tags, *tags))
        after = Remarks(
            tags=tuple(tag for tag in kept if tag not in untag),
            notes=(*before.notes, Note(date=date, text=note)) if note else before.notes,
        )
        if after != before:
            write_json(beside(recording, REMARKS), after.model_dump(mode="json"), own=True)
    return after


@contextmanager
def _alone(recording: Path) -> Iterator[None]:
    """Keep others from changing the remarks meanwhile: a lock on the recording, which is there and is not written to."""
    try:
        descriptor = os.open(recording, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise BadInput(f"{recording} cannot be read ({error.strerror}); give a recording that exists") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
