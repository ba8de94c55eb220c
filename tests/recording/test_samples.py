"""A recording is read exactly, or refused with one sentence."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from palpd.errors import BadInput, RecordingError
from palpd.recording.samples import COLUMNS, WRENCH_COLUMNS, Samples, numbers_of, read, read_csv, runs_of_true, write_csv


def recording(n: int = 40) -> Samples:
    rng = np.random.default_rng(1)
    t_s = np.cumsum(rng.uniform(0.001, 0.003, n))
    return Samples(t_s, rng.normal(size=n), rng.normal(size=n), rng.normal(size=n), rng.normal(size=(n, 6)))


def table(samples: Samples) -> list[list[str]]:
    assert samples.z_cmd_m is not None
    values = np.column_stack([samples.t_s, samples.z_cmd_m, samples.z_m, samples.vz_m_per_s, samples.wrench])
    return [list(COLUMNS), *[[repr(float(x)) for x in row] for row in values]]


def save(path: Path, rows: list[list[str]]) -> Path:
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")
    return path


@pytest.mark.parametrize("commanded", [True, False])
def test_what_is_written_is_read_back_to_the_last_bit(tmp_path: Path, commanded: bool) -> None:
    samples = recording()
    if not commanded:
        samples = Samples(samples.t_s, None, samples.z_m, samples.vz_m_per_s, samples.wrench)
    write_csv(tmp_path / "a.csv", samples)
    back = read_csv(tmp_path / "a.csv")
    assert (back.z_cmd_m is None) is not commanded
    for one, other in [(samples.t_s, back.t_s), (samples.z_m, back.z_m), (samples.wrench, back.wrench)]:
        np.testing.assert_array_equal(one, other)
    assert back.t_s.base is None, "a column does not keep the whole table in memory"


def test_a_table_that_is_spelled_otherwise_than_by_palpd_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_csv(path, recording())
    write_csv(path, recording(50))
    assert len(read_csv(path)) == 50
    header = path.read_text().splitlines()[0]
    path.write_text(f"{header}\n{','.join(['0.000000'] * 10)}\n")
    with pytest.raises(BadInput, match="exists and is not overwritten"):
        write_csv(path, recording())


def test_extra_columns_any_order_a_byte_order_mark_and_windows_line_ends_are_read(tmp_path: Path) -> None:
    rows = [["note", *reversed(row)] for row in table(recording())]
    path = tmp_path / "a.csv"
    path.write_bytes(("\ufeff" + "\r\n".join(",".join(row) for row in rows) + "\r\n").encode())
    np.testing.assert_array_equal(read_csv(path).wrench, recording().wrench)


def test_a_missing_column_is_named(tmp_path: Path) -> None:
    rows = [[*row[:6], *row[7:]] for row in table(recording())]
    with pytest.raises(RecordingError, match="fz_N is missing"):
        read_csv(save(tmp_path / "a.csv", rows))


@pytest.mark.parametrize("absent", [("fx_N", "fy_N"), ("tx_Nm", "ty_Nm", "tz_Nm"), ("fx_N", "fy_N", "tx_Nm", "ty_Nm", "tz_Nm")])
def test_lateral_forces_and_torques_may_be_absent_together_and_are_zero(tmp_path: Path, absent: tuple[str, ...]) -> None:
    header, *rows = table(recording())
    kept = [k for k, name in enumerate(header) if name not in absent]
    read_back = read_csv(save(tmp_path / "a.csv", [[row[k] for k in kept] for row in (header, *rows)]))
    gone = [WRENCH_COLUMNS.index(name) for name in absent]
    assert not read_back.wrench[:, gone].any()
    others = [k for k in range(6) if k not in gone]
    np.testing.assert_array_equal(read_back.wrench[:, others], recording().wrench[:, others])


def test_a_single_lateral_force_or_torque_that_is_missing_is_named_since_its_name_may_be_misspelled(tmp_path: Path) -> None:
    for name in ("fx_N", "ty_Nm"):
        header, *rows = table(recording())
        header[header.index(name)] = name.lower()
        with pytest.raises(RecordingError, match=f"column {name} is missing"):
            read_csv(save(tmp_path / "a.csv", [header, *rows]))


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_dates_as_times_count_in_their_own_unit(unit: str) -> None:
    start, each = np.datetime64("2026-05-01T12:00:00", unit), np.timedelta64(2, "s")
    times = start + np.arange(40) * each
    np.testing.assert_array_equal(numbers_of(times, "a", "t_s"), 2.0 * np.arange(40))
    np.testing.assert_array_equal(numbers_of(times - start, "a", "t_s"), 2.0 * np.arange(40))
    with pytest.raises(RecordingError, match="z_m holds dates"):
        numbers_of(times, "a", "z_m")
    times[3] = np.datetime64("NaT")
    with pytest.raises(RecordingError, match="no time in row 4"):
        numbers_of(times, "a", "t_s")


def test_dates_with_a_time_zone_count_as_times() -> None:
    """A column of pandas with a time zone is an array of such dates."""
    dates = [datetime(2026, 5, 1, 12, tzinfo=UTC) + timedelta(seconds=0.25 * step) for step in range(40)]
    np.testing.assert_array_equal(numbers_of(dates, "a", "t_s"), 0.25 * np.arange(40))
    with pytest.raises(RecordingError, match="z_m holds dates"):
        numbers_of(dates, "a", "z_m")


@pytest.mark.parametrize("text", ["nan", "inf", "", "1,2"[:1] + "x"])
def test_a_value_that_is_not_a_finite_number_is_named_with_column_and_row(tmp_path: Path, text: str) -> None:
    rows = table(recording())
    rows[17][6] = text
    with pytest.raises(RecordingError, match=r"fz_N .* row 17 \(line 18"):
        read_csv(save(tmp_path / "a.csv", rows))


def test_time_that_runs_backwards_or_stands_still_is_named_with_its_row(tmp_path: Path) -> None:
    for step, word in [(-1.0, "backwards"), (0.0, "stands still")]:
        rows = table(recording())
        rows[20][0] = repr(float(rows[19][0]) + step)
        with pytest.raises(RecordingError, match=rf"t_s (runs )?{word} in row 20"):
            read_csv(save(tmp_path / "a.csv", rows))


def test_too_few_rows_no_rows_and_no_file_are_refused(tmp_path: Path) -> None:
    for rows in (table(recording())[:20], table(recording())[:1]):
        with pytest.raises(RecordingError, match="rows"):
            read_csv(save(tmp_path / "a.csv", rows))
    with pytest.raises(RecordingError, match="missing"):
        read_csv(save(tmp_path / "empty.csv", []))
    with pytest.raises(RecordingError, match="cannot be read"):
        read_csv(tmp_path / "absent.csv")


def test_a_short_row_is_refused_with_its_number(tmp_path: Path) -> None:
    rows = table(recording())
    rows[5] = rows[5][:7]
    with pytest.raises(RecordingError, match=r"tx_Nm is empty in row 5"):
        read_csv(save(tmp_path / "a.csv", rows))


def test_parquet_gives_the_same_samples(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    samples = recording()
    rows = table(samples)
    columns = {name: [float(row[k]) for row in rows[1:]] for k, name in enumerate(rows[0])}
    parquet.write_table(pyarrow.table(columns), tmp_path / "a.parquet")
    np.testing.assert_array_equal(read(tmp_path / "a.parquet").wrench, samples.wrench)
    (tmp_path / "b.parquet").write_bytes(b"no parquet")
    with pytest.raises(RecordingError, match="Parquet"):
        read(tmp_path / "b.parquet")


def test_runs_of_true_touch_both_ends_of_a_mask() -> None:
    first, end = runs_of_true(np.array([True, True, False, True, False, False, True]))
    assert (first.tolist(), end.tolist()) == ([0, 3, 6], [2, 4, 7])
    assert [len(edges) for edges in runs_of_true(np.zeros(3, dtype=bool))] == [0, 0]


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("commented", [False, True])
def test_other_delimiters_and_comments_change_no_number(tmp_path: Path, delimiter: str, commented: bool) -> None:
    rows = [delimiter.join(row) for row in table(recording())]
    if commented:
        rows = ["# by hand; on a Monday, at noon", rows[0], "# a note", *rows[1:]]
    (tmp_path / "some.csv").write_text("\n".join(rows) + "\n")
    assert np.array_equal(read_csv(tmp_path / "some.csv").wrench, recording().wrench)


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_decimal_commas_are_read_where_something_else_separates_the_cells(tmp_path: Path, delimiter: str) -> None:
    rows = [delimiter.join(row).replace(".", ",") for row in table(recording())]
    (tmp_path / "some.csv").write_text("\n".join(rows) + "\n")
    assert np.array_equal(read_csv(tmp_path / "some.csv").wrench, recording().wrench)


def test_decimal_commas_between_commas_are_named_as_the_cause(tmp_path: Path) -> None:
    path = save(tmp_path / "some.csv", [[cell.replace(".", ",") for cell in row] for row in table(recording())])
    with pytest.raises(RecordingError, match="a row has 20 cells and the header 10; if its commas are decimal"):
        read_csv(path)


def test_a_number_that_no_rig_measures_is_refused(tmp_path: Path) -> None:
    rows = table(recording())
    rows[5][4] = "1e300"
    with pytest.raises(RecordingError, match=r"fx_N is 1e\+300 in row 5 .*up to 1e\+12"):
        read_csv(save(tmp_path / "some.csv", rows))
