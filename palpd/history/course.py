"""Force and height of a run over time, thinned to a bounded number of points: what a time slider shows.

A recording is read chunk by chunk, so a run of a day needs no more memory than one of a minute. Each point keeps the least and the largest
value of its ticks: a peak of one tick is seen in every thinning.
"""

import io
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpd.errors import BadInput, RecordingError
from palpd.files import opened, writing
from palpd.recording import cdr
from palpd.recording.mcap_file import Contents

POINT = np.dtype(
    [
        ("t_s", "<f8"), ("force_low_N", "<f4"), ("force_high_N", "<f4"), ("z_low_m", "<f8"), ("z_high_m", "<f8"), ("surface_z_m", "<f8"),
        ("phase", "u1"), ("site", "<i2"),
    ]
)  # fmt: skip
"""One point: `t_s` since the first tick, the range of force and height of its ticks, and surface, phase and site of the first of them."""
MOST_POINTS = 100_000
"""Most points of a course, 5 MB: 13 minutes at 125 Hz are kept tick by tick."""
SHOWN_POINTS = 1500
"""Most points of a window: a wide screen has fewer columns than twice that."""
MOST_BYTES = 10_000_000
"""Largest file of a course."""

Course = NDArray[np.void]


def course_of(recording: Path) -> Course:
    """Read force and height of a recording over time.

    Returns:
        Points (n,) of POINT, at most MOST_POINTS.

    Raises:
        RecordingError: The recording cannot be read to its end.
    """
    contents, pieces, ticks_a_point = Contents(), list[Course](), 1
    for batch in filter(None, contents.batches(recording)):
        pieces.append(merged(points_of(cdr.unpack_ticks(batch, contents.absent)), ticks_a_point))
        while sum(map(len, pieces)) > MOST_POINTS:
            pieces, ticks_a_point = [merged(np.concatenate(pieces), 2)], 2 * ticks_a_point
    contents.refuse_foreign(recording)
    if contents.torn:
        raise RecordingError(f"{recording} is truncated or corrupt {contents.torn}; palpd recover saves what is whole")
    if not pieces:
        raise RecordingError(f"{recording} holds no tick; give a recording of a run that began")
    points = np.concatenate(pieces)
    points["t_s"] -= points["t_s"][0]
    return points


def points_of(rows: NDArray[np.void]) -> Course:
    """One point a tick.

    Args:
        rows: Ticks (n,) with the fields of ROW of palpd.tick.

    Returns:
        Points (n,); their times are those of the rows.
    """
    points = np.zeros(len(rows), POINT)
    points["t_s"] = rows["now_s"]
    points["force_low_N"] = points["force_high_N"] = rows["force_N"]
    points["z_low_m"] = points["z_high_m"] = rows["tcp_pose"][:, 2]
    for name in ("surface_z_m", "phase", "site"):
        points[name] = rows[name]
    return points


def merged(points: Course, size: int) -> Course:
    """Make one point of each `size` neighbours, the last of fewer.

    Args:
        points: Points (n,).

    Returns:
        Points (ceil(n / size),).
    """
    if size == 1 or not len(points):
        return points
    begins = np.arange(0, len(points), size)
    out = points[begins].copy()
    for low in ("force_low_N", "z_low_m"):
        high = low.replace("low", "high")
        out[low], out[high] = np.fmin.reduceat(points[low], begins), np.fmax.reduceat(points[high], begins)
    return out


def window(course: Course, begin_s: float, end_s: float, most: int = SHOWN_POINTS) -> Course:
    """The part of a course between two times, thinned for a screen.

    Args:
        course: Points (n,).
        begin_s: Its first time.
        end_s: Its last time.
        most: Most points to give.

    Returns:
        Points (at most `most`,).
    """
    begin, end = np.searchsorted(course["t_s"], (begin_s, end_s))
    chosen = course[begin : end + 1]
    return merged(chosen, -(-len(chosen) // most))


def as_columns(course: Course) -> dict[str, list[float | None]]:
    """A course as JSON can hold it: a list a column, null where a value is unknown, and the depth below the surface besides.

    Args:
        course: Points (n,).

    Returns:
        The columns by name; `depth_low_m` and `depth_high_m` are positive in the tissue.
    """
    surface_m = course["surface_z_m"]
    columns = {name: course[name] for name in POINT.names or () if name != "surface_z_m"}
    columns |= {"depth_low_m": surface_m - course["z_high_m"], "depth_high_m": surface_m - course["z_low_m"]}
    return {name: [_known(value) for value in values.tolist()] for name, values in columns.items()}


def _known(value: float) -> float | None:
    return float(f"{value:.7g}") if math.isfinite(value) else None  # 5 letters a number less to send


def write_course(path: Path, course: Course) -> None:
    """Write a course as an array file (.npy).

    Args:
        path: The file; one that exists is replaced.
        course: Points (n,).

    Raises:
        BadInput: The file cannot be written.
    """
    content = io.BytesIO()
    np.save(content, course, allow_pickle=False)
    with writing(path) as stream:
        stream.write(content.getbuffer())


def read_course(path: Path) -> Course:
    """Read what `write_course` wrote.

    Returns:
        Points (n,).

    Raises:
        BadInput: The file is none of these.
    """
    with opened(path, most_bytes=MOST_BYTES) as stream:
        try:
            course: Course = np.load(stream, allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise BadInput(f"{path} is no course of a run ({error}); make it again") from error
    if course.dtype != POINT:
        raise BadInput(f"{path} holds {course.dtype}, expected points of a course; make it again")
    return course
