"""What a file is, by its content: an output that palpd made, or a kind of file that was given for another.

Every output of palpd has a mark: a key in JSON, a tag in HTML, the program's name in figures, models and Parquet, and in YAML a comment
with a checksum. CSV has its header and the spelling of its numbers. So palpd knows a file under any name, and edited YAML is the user's.
"""

import hashlib
import re
from pathlib import Path

RECORDING, JSON, CSV, YAML, HTML, PICTURE, PARQUET, MODEL, COURSE, PAGE = (
    "a recording", "JSON", "CSV", "YAML", "HTML", "a figure", "Parquet", "a model", "a course", "Markdown",
)  # fmt: skip
"""Kinds of the files that palpd makes."""
MADE_BY = {"made_by": "palpd"}
"""Mark of JSON, and in the metadata of Parquet."""
PAGE_MARK = "<!-- made by palpd -->"
"""Mark of Markdown; its first line."""
PICTURE_MARKS = {
    "png": {"Software": "palpd"},
    "pdf": {"Creator": "palpd", "CreationDate": None},
    "svg": {"Creator": "palpd", "Date": None},
}
"""Metadata of a figure by its format; a date would make the same figure other bytes."""
HEAD_BYTES, TAIL_BYTES = 8192, 65_536
"""What is read of a file; the metadata of Parquet and PDF stand at the end, and that of an exported recording has some 10 kB."""
_COMMENT = re.compile(rb"# made by palpd, which replaces it while it is unchanged \(([0-9a-f]{16})\)\n")
_NUMBER = rb"-?\d+(?:\.\d*[1-9]|\.0)?(?:e[-+]?\d+)?"
"""A number as palpd spells it: with no more digits than it needs."""
_TABLE = (
    rb"t_s,(?:z_cmd_m,)?z_m,vz_m_per_s,fx_N,fy_N,fz_N,tx_Nm,ty_Nm,tz_Nm[^\r\n]*\n(?:NUMBER,){8}"
    rb"|t_s,z_cmd_m\nNUMBER,NUMBER\n"
    rb"|x_m,y_m,youngs_modulus_Pa\n(?:-?\d+\.\d{4},-?\d+\.\d{4},\d+\.\d\n|\Z)"
).replace(b"NUMBER", _NUMBER)
"""Header and first row of the tables that palpd writes: recordings, motions to record next, and the presses of a map."""
_MARKS = {
    kind: re.compile(mark, re.DOTALL)
    for kind, mark in {
        CSV: _TABLE,
        JSON: rb'\{\s*"(made_by": "palpd"|schema": "palpd\.)',
        HTML: (
            rb'<!doctype html>\s*<html[^>]*><head><meta charset="utf-8">'
            rb'(<meta name="generator" content="palpd">|<meta name="viewport"[^>]*>\s*<title>[^<]{0,200}: (run|diagnosis)</title>)'
        ),
        PAGE: PAGE_MARK.encode(),
        PICTURE: rb"\x89PNG.*Software\0palpd|%PDF-.*/Creator \(palpd\)|<\?xml.*<dc:creator>\s*<cc:Agent>\s*<dc:title>palpd</dc:title>",
        PARQUET: rb"PAR1.*made_by\x18\x05palpd",
        MODEL: rb"\x08.\x12\x05palpd",
        COURSE: rb"\x93NUMPY.{1,20}'descr': \[\('t_s', '<f8'\), \('force_low_N'",
        RECORDING: rb"\x89MCAP0\r\n",
    }.items()
}
"""How each kind begins; HTML without the tag is that of an older palpd."""
_OTHERS = {
    b"PK\x03\x04": "a zip archive", b"\x1f\x8b": "a gzip archive", b"\x89PNG": "a PNG picture", b"%PDF": "a PDF document",
    b"\x89MCAP": "an MCAP recording", b"\x89HDF": "an HDF5 file", b"PAR1": "a Parquet file", b"\x93NUMPY": "a NumPy array",
    b"\xff\xd8\xff": "a JPEG picture", b"\xff\xfe": "text in UTF-16", b"\xfe\xff": "text in UTF-16",
}  # fmt: skip
"""What else is given for text by mistake, by how it begins."""


def kind_made(path: Path) -> str | None:
    """Tell which output of palpd a file is, by its content.

    Args:
        path: A regular file that exists.

    Returns:
        One of the kinds above; None where palpd did not make it, or where a user has changed it since. Any MCAP file counts as a recording.

    Raises:
        OSError: It cannot be read.
    """
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
        size = stream.seek(0, 2)
        stream.seek(max(len(head), size - TAIL_BYTES))
        tail = stream.read() if head.startswith((b"PAR1", b"%PDF")) else b""
        if comment := _COMMENT.match(head):
            stream.seek(comment.end())
            return YAML if _checksum(stream.read()).encode() == comment[1] else None
    return next((kind for kind, mark in _MARKS.items() if mark.match(head + tail)), None)


def marked_json(content: object) -> object:
    """The same data with the mark of JSON as its first key, where it is an object that has none."""
    if not isinstance(content, dict) or (next(iter(content), "") == "schema" and str(content["schema"]).startswith("palpd.")):
        return content
    return {**MADE_BY, **content}


def marked_text(text: str) -> str:
    """The same text below a comment with its checksum: for YAML, and what else takes comments that begin with #."""
    return f"# made by palpd, which replaces it while it is unchanged ({_checksum(text.encode())})\n{text}"


def what_it_is(head: bytes) -> str:
    """Say what bytes are that are no text, by how their file begins; empty where that is not known."""
    return next((kind for start, kind in _OTHERS.items() if head.startswith(start)), "")


def _checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
