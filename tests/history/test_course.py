"""The course of a run: bounded in size, and no peak is lost in it."""

from pathlib import Path

import numpy as np
import pytest

from palpd.errors import BadInput, RecordingError
from palpd.history import course as module
from palpd.history.course import course_of, read_course, window, write_course
from palpd.recording.reader import Recording


def test_a_short_run_is_kept_tick_by_tick_and_read_back_equal(runs: Path, tmp_path: Path) -> None:
    rows = Recording.load(runs / "day-0.mcap").rows
    course = course_of(runs / "day-0.mcap")
    assert len(course) == len(rows)
    np.testing.assert_allclose(course["t_s"], rows["now_s"] - rows["now_s"][0])
    np.testing.assert_allclose(course["force_high_N"], rows["force_N"], rtol=1e-6)
    write_course(tmp_path / "course.npy", course)
    assert read_course(tmp_path / "course.npy").tobytes() == course.tobytes()


def test_a_long_run_is_thinned_while_it_is_read_and_keeps_its_peak(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = Recording.load(runs / "day-0.mcap").rows
    monkeypatch.setattr(module, "MOST_POINTS", 40)
    course = course_of(runs / "day-0.mcap")
    assert 10 < len(course) <= 40
    assert np.all(np.diff(course["t_s"]) > 0.0)
    assert course["force_high_N"].max() == pytest.approx(rows["force_N"].max(), rel=1e-6)
    assert course["z_low_m"].min() == pytest.approx(rows["tcp_pose"][:, 2].min())


def test_a_window_holds_its_time_only_and_no_more_points_than_asked_for(runs: Path) -> None:
    course = course_of(runs / "day-0.mcap")
    end_s = float(course["t_s"][-1])
    part = window(course, end_s / 3, 2 * end_s / 3, most=50)
    assert 25 <= len(part) <= 50
    assert part["t_s"][0] >= end_s / 3
    assert part["t_s"][-1] <= 2 * end_s / 3
    assert len(window(course, 0.0, end_s, most=len(course))) == len(course)
    assert len(window(course, end_s + 1.0, end_s + 2.0)) == 0
    assert len(window(course, 2.0, 1.0)) <= 1


def test_a_torn_recording_and_a_file_that_is_no_course_are_refused(runs: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes((runs / "day-0.mcap").read_bytes()[:20_000])
    with pytest.raises(RecordingError, match="truncated or corrupt"):
        course_of(torn)
    other = tmp_path / "other.npy"
    np.save(other, np.zeros(3))
    with pytest.raises(BadInput, match="expected points of a course"):
        read_course(other)
    other.write_bytes(b"<script>")
    with pytest.raises(BadInput, match="no course of a run"):
        read_course(other)
