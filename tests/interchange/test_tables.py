"""Tables of text and files of instruments: layouts, units that are shown and confirmed, two clocks, a tare, and bad input."""

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from palpd.analysis.curves import Mapping, analyse_curve, read_curve
from palpd.errors import BadInput, PalpdError, RecordingError
from palpd.interchange.import_files import ImportOptions, import_files, read_files, source_of
from palpd.interchange.units import unit_named
from palpd.recording.samples import read_csv

N = 400
T_S = np.arange(N) * 0.002
DEPTH_M = 0.002 * np.sin(np.pi * T_S / T_S[-1]) - 0.0005
FORCE_N = 16.0 / 9.0 * 8e4 * math.sqrt(0.005) * np.maximum(DEPTH_M, 0.0) ** 1.5


def written(folder: Path, text: str, name: str = "curve.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def table(header: str, *columns: np.ndarray, separator: str = ",", comma: bool = False, after: str = "") -> str:
    rows = [separator.join(repr(float(value)) for value in row) for row in zip(*columns, strict=True)]
    if comma:
        rows = [row.replace(".", ",") for row in rows]
    return "\n".join([header, *rows, after])


def millimetres(folder: Path, separator: str = ",", comma: bool = False, above: str = "", after: str = "") -> Path:
    names = separator.join(("Time (s)", "F (mN)", "Z (mm)")) if separator != " " else "Time(s) F(mN) Z(mm)"
    return written(folder, above + table(names, T_S, FORCE_N * 1e3, -DEPTH_M * 1e3, separator=separator, comma=comma, after=after))


def chosen(**changes: object) -> ImportOptions:
    return ImportOptions(**{"force_column": "F (mN)", "height_column": "Z (mm)", "time_columns": ("Time (s)",)} | changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("separator", "comma"), [(",", False), (";", False), (";", True), ("\t", False), ("\t", True), ("|", True), (" ", False), (" ", True)]
)
def test_separators_decimal_commas_comments_and_other_rows(tmp_path: Path, separator: str, comma: bool) -> None:
    above = f"# a comment\nMachine{separator if separator != ' ' else ','}ZHU\nDate 2025-10-30\n\n"
    path = millimetres(tmp_path, separator, comma, above, "Total time 65.7\n")
    options = chosen(units_confirmed=True)
    if separator == " ":
        options = chosen(force_column="F(mN)", height_column="Z(mm)", time_columns=("Time(s)",), units_confirmed=True)
    imported = read_files([path], options)
    np.testing.assert_allclose(imported.samples.wrench[:, 2], FORCE_N, rtol=0, atol=1e-12)
    np.testing.assert_allclose(imported.samples.z_m, -DEPTH_M, rtol=0, atol=1e-15)
    assert any("4 rows before and after the numbers were skipped" in note for note in imported.notes)


def test_guessed_units_are_shown_and_applied_only_when_confirmed(tmp_path: Path) -> None:
    path, out = millimetres(tmp_path), tmp_path / "out.csv"
    with pytest.raises(BadInput, match=r"F \(mN\) is a force in mN") as refusal:
        import_files([path], chosen(force_unit=None), out)
    assert "--units confirmed" in str(refusal.value)
    assert "or give --length-unit mm and --force-unit mN" in str(refusal.value)
    with pytest.raises(BadInput, match=r"guesses that Z \(mm\) is a length in mm; repeat .* or give --length-unit mm"):
        import_files([path], chosen(force_unit="mN"), out)
    assert not out.exists()
    imported = import_files([path], chosen(force_unit="mN", length_unit="mm"), out)
    assert "F (mN): force in mN (as given)." in imported.notes
    assert read_csv(out).wrench[:, 2].max() == pytest.approx(FORCE_N.max())
    confirmed = read_files([path], chosen(units_confirmed=True))
    assert np.array_equal(confirmed.samples.wrench, imported.samples.wrench)
    assert "Z (mm): length in mm (guessed and confirmed)." in confirmed.notes


def test_an_unnamed_unit_is_si_and_said_and_a_size_that_is_impossible_is_questioned(tmp_path: Path) -> None:
    path = written(tmp_path, table("t,F,z", T_S, FORCE_N, -DEPTH_M))
    imported = read_files([path], ImportOptions("F", height_column="z", time_columns=("t",)))
    assert "F: force in N (assumed, the file states no unit)." in imported.notes
    deep = written(tmp_path, table("t,F,z", T_S, FORCE_N, -DEPTH_M * 2e3), "deep.csv")
    with pytest.raises(BadInput, match=r"deep\.csv: palpd guesses that z is a length in mm"):
        read_files([deep], ImportOptions("F", height_column="z", time_columns=("t",)))
    with pytest.raises(BadInput, match=r"the stroke of z_m is 4 m, expected 0 to 1 m .* or accept it with --accept-implausible"):
        read_files([deep], ImportOptions("F", height_column="z", time_columns=("t",), length_unit="m"))
    odd = written(tmp_path, table("t,F (cps),z", T_S, FORCE_N, -DEPTH_M), "odd.csv")
    with pytest.raises(BadInput, match=r"palpd guesses that F \(cps\) is a force in N; .* or give --force-unit N"):
        read_files([odd], ImportOptions("F (cps)", height_column="z", time_columns=("t",)))
    late = written(tmp_path, table("t,F,z", T_S * 1e3, FORCE_N, -DEPTH_M), "late.csv")
    with pytest.raises(BadInput, match="t is a time in ms"):
        read_files([late], ImportOptions("F", height_column="z", time_columns=("t",)))


@pytest.mark.parametrize(
    ("header", "factor", "options"),
    [
        ("t_s,Load (kip),z_m", 1.0 / 4448.2216152605, {"units_confirmed": True}),
        ("t_s,load [nN],z_m", 1e9, {"units_confirmed": True}),
        ("t_s,load_uN,z_m", 1e6, {"units_confirmed": True}),
        ("t_s,load,z_m", 0.1, {"force_unit": "V", "force_N_per_V": 10.0}),
        ("t_s,load (V),z_m", 0.1, {"force_N_per_V": 10.0}),
        ("t_s,LOAD (KIP),z_m", 1.0 / 4448.2216152605, {"force_unit": "kip"}),
        ("t_s,Load (KN),z_m", 1e-3, {"units_confirmed": True}),
        ("t_s,Force (g),z_m", 1.0 / 9.80665e-3, {"units_confirmed": True}),
        ("t_s,Load_kg,z_m", 1.0 / 9.80665, {"units_confirmed": True}),
        ("t_s,Force [cN],z_m", 100.0, {"units_confirmed": True}),
        ("t_s,F,z_m,T\ns,mN,m,°C", 1e3, {"units_confirmed": True}),
    ],
)
def test_forces_in_other_units(tmp_path: Path, header: str, factor: float, options: dict[str, object]) -> None:
    path = written(tmp_path, table(header, T_S, FORCE_N * factor, -DEPTH_M, *[T_S] * (header.partition("\n")[0].count(",") - 2)))
    force = header.split(",")[1]
    imported = read_files([path], ImportOptions(force, height_column="z_m", time_columns=("t_s",), **options))  # type: ignore[arg-type]
    np.testing.assert_allclose(imported.samples.wrench[:, 2], FORCE_N, rtol=1e-12, atol=1e-12)


def test_volts_ask_for_their_factor_and_a_wrong_quantity_for_another_column(tmp_path: Path) -> None:
    path = written(tmp_path, table("t_s,F (V),z_mm,h", T_S, FORCE_N, -DEPTH_M, DEPTH_M))
    with pytest.raises(BadInput, match=r"column F \(V\) is in V; give --force-N-per-V"):
        read_files([path], ImportOptions("F (V)", height_column="h", time_columns=("t_s",)))
    for unit, hint in (("Nm", "or give --joint"), ("ounces", "correct the unit")):
        with pytest.raises(BadInput, match=f"{unit} is given for column h, expected a force in N, cN, .*{hint}"):
            read_files([path], ImportOptions("h", height_column="z_mm", time_columns=("t_s",), force_unit=unit))
    with pytest.raises(BadInput, match="column z_mm is in mm, expected a force in N, cN, mN"):
        read_files([path], ImportOptions("z_mm", height_column="h", time_columns=("t_s",)))


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("F (mN)", "mN"), ("Z[µm]", "um"), ("depth_um", "um"), ("fz_N", "N"), ("Force", None), ("Load, kip", "kip"), ("t (sec)", "s"),
        ("force_min", None), ("Extension (in)", "in"), ("TIME(MS)", None), ("Force(Newton)", "N"), ("Fz", None),
        ("vz_m_per_s", "m/s"), ("speed mm/s", "mm/s"), ("v (µm/s)", "um/s"), ("tx_Nm", "Nm"),
    ],
)  # fmt: skip
def test_units_in_names(name: str, unit: str | None) -> None:
    assert unit_named(name) == unit


@pytest.mark.parametrize("header", ["\tt_s\tz_m\tfz_N", "# n\tt_s\tz_m\tfz_N"])
def test_an_index_without_a_name_is_a_column(tmp_path: Path, header: str) -> None:
    path = written(tmp_path, table(header, np.arange(N), T_S, -DEPTH_M, FORCE_N, separator="\t"), "frame.tsv")
    np.testing.assert_allclose(read_files([path], ImportOptions()).samples.wrench[:, 2], FORCE_N, rtol=0, atol=1e-12)


def test_a_row_of_units_below_the_header_and_two_vectors_more(tmp_path: Path) -> None:
    text = table("t;F;z;v;fx\n(s);(mN);(mm);(mm/s);(mN)", T_S, FORCE_N * 1e3, -DEPTH_M * 1e3, -np.gradient(DEPTH_M, T_S) * 1e3, T_S,
                 separator=";")  # fmt: skip
    options = ImportOptions("F", height_column="z", time_columns=("t",), columns={"vz_m_per_s": "v", "fx_N": "fx"}, units_confirmed=True)
    imported = read_files([written(tmp_path, text)], options)
    np.testing.assert_allclose(imported.samples.wrench[:, 2], FORCE_N, rtol=0, atol=1e-12)
    np.testing.assert_allclose(imported.samples.wrench[:, 0], T_S * 1e-3, rtol=0, atol=1e-12)
    np.testing.assert_allclose(imported.samples.vz_m_per_s, -np.gradient(DEPTH_M, T_S), rtol=0, atol=1e-12)
    assert not any("slope of the heights" in note for note in imported.notes)


def test_our_own_columns_in_another_layout_are_taken_with_all_axes(tmp_path: Path) -> None:
    speed_m_per_s = -np.gradient(DEPTH_M, T_S)
    text = table("t_s;z_m;vz_m_per_s;fx_N;fz_N;tx_Nm", T_S, -DEPTH_M, speed_m_per_s, T_S, FORCE_N, T_S * 0.1, separator=";", comma=True)
    samples = read_files([written(tmp_path, text)], ImportOptions()).samples
    assert np.array_equal(samples.vz_m_per_s, speed_m_per_s)
    assert np.array_equal(samples.wrench[:, [0, 2]], np.column_stack([T_S, FORCE_N]))
    assert np.array_equal(samples.wrench[:, 3], T_S * 0.1)


def test_our_own_table_of_several_sites_is_refused_and_of_one_is_read(tmp_path: Path) -> None:
    header, *rows = table("t_s,z_m,fz_N", T_S, -DEPTH_M, FORCE_N).splitlines()
    half = len(rows) // 2

    def sites(*names: str) -> Path:
        lines = [f"{row},{names[number > half]}" for number, row in enumerate(rows)]
        return written(tmp_path, "\n".join([f"{header},site", *lines]) + "\n")

    assert len(read_files([sites("A", "A")], ImportOptions()).samples) == len(rows)
    with pytest.raises(RecordingError, match=r"holds 2 sites \(A, B\), expected one"):
        read_files([sites("A", "B")], ImportOptions())


def test_a_further_column_keeps_the_unit_that_it_states(tmp_path: Path) -> None:
    speed_m_per_s = -np.gradient(DEPTH_M, T_S)
    path = written(tmp_path, table("t_s,z,v (m/s),w,F (N)", T_S, -DEPTH_M * 1e3, speed_m_per_s, speed_m_per_s * 1e3, FORCE_N))
    for name in ("v (m/s)", "w"):
        options = ImportOptions("F (N)", height_column="z", time_columns=("t_s",), length_unit="mm", columns={"vz_m_per_s": name})
        np.testing.assert_allclose(read_files([path], options).samples.vz_m_per_s, speed_m_per_s, rtol=1e-12)


@pytest.mark.parametrize(
    ("encoding", "force"),
    [
        ("latin-1", "F (µN)"), ("cp1252", "Größe (µN)"), ("cp1252", "Größe – uN"), ("utf-16", "F (µN)"), ("utf-16-le", "F (µN)"),
        ("utf-16-be", "力 (µN)"), ("utf-8-sig", "F (µN)"), ("gbk", "压力 (uN)"), ("gb2312", "下降力"),
    ],
)  # fmt: skip
def test_encodings_are_found(tmp_path: Path, encoding: str, force: str) -> None:
    text = table(f"t (s),{force},z (m)", T_S, FORCE_N * 1e6, -DEPTH_M)
    path = tmp_path / "curve.csv"
    path.write_bytes(text.encode(encoding))
    imported = read_files([path], ImportOptions(force, height_column="z (m)", time_columns=("t (s)",), force_unit="uN"))
    np.testing.assert_allclose(imported.samples.wrench[:, 2], FORCE_N, rtol=0, atol=1e-12)


OPTICS11 = """Date\t01/02/2024\tTime\t10:11:12\tStatus\tOK
X-position (um)\t120.0
k (N/m)\t0.019
Tip radius (um)\t27.5

Piezo Indentation Sweep Settings
Profile:\tDisplacement control
D[Z1] (nm)\t5000\tt[1] (s)\t2.0
D[Z2] (nm)\t0\tt[2] (s)\t1.0
Step absolute start times (s)\t0.5,2.5,3.5

"""


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_a_text_file_of_an_optics11_indenter_needs_no_names(tmp_path: Path, encoding: str) -> None:
    """The tip is where the piezo has moved the cantilever, less its deflection; the column of the indentation is zero before the touch."""
    deflection_m = FORCE_N / 0.5
    piezo_m = DEPTH_M + deflection_m
    columns = (T_S, 1e6 * FORCE_N, 1e9 * np.maximum(DEPTH_M, 0.0), 1e9 * deflection_m, 1e9 * piezo_m, np.full(N, np.nan))
    names = "Time (s)\tLoad (uN)\tIndentation (nm)\tCantilever (nm)\tPiezo (nm)\tAuxiliary"
    path = tmp_path / "indentation_002.txt"
    path.write_bytes((OPTICS11 + table(names, *columns, separator="\t")).encode(encoding))
    imported = read_files([path], ImportOptions(units_confirmed=True))
    np.testing.assert_allclose(imported.samples.wrench[:, 2], FORCE_N, rtol=0, atol=1e-12)
    np.testing.assert_allclose(imported.samples.z_m, -DEPTH_M, rtol=0, atol=1e-12)
    assert any("height is tip height (nm)" in note for note in imported.notes)


def test_a_rate_stands_for_times_that_a_table_does_not_hold(tmp_path: Path) -> None:
    path = written(tmp_path, table("F (N),z (m)", FORCE_N, -DEPTH_M))
    options = ImportOptions("F (N)", height_column="z (m)")
    with pytest.raises(BadInput, match="give --time-column, or --rate-Hz"):
        read_files([path], options)
    np.testing.assert_allclose(read_files([path], replace(options, rate_Hz=500.0)).samples.t_s, T_S, rtol=0, atol=1e-12)
    with pytest.raises(BadInput, match="--rate-Hz is 0, expected above 0"):
        read_files([path], replace(options, rate_Hz=0.0))
    with pytest.raises(BadInput, match="--rate-Hz stands for times that no column holds"):
        read_files([path], replace(options, rate_Hz=500.0, time_columns=("z (m)",)))


@pytest.mark.parametrize(
    ("names", "of"),
    [
        (("tool qx", "tool qy", "tool qz", "tool qw"), Rotation.as_quat),
        (("RX", "RY", "RZ"), Rotation.as_rotvec),
        (("TCP_pose_3", "TCP_pose_4", "TCP_pose_5"), Rotation.as_rotvec),
        (("roll (deg)", "pitch (deg)", "yaw (deg)"), lambda turn: turn.as_euler("xyz", degrees=True)),
    ],
)
def test_a_tool_that_turns_is_refused_from_a_table_too(
    tmp_path: Path, names: tuple[str, ...], of: Callable[[Rotation], np.ndarray]
) -> None:
    for most_deg, refused in ((1.0, False), (10.0, True)):
        angles = np.column_stack([np.radians(most_deg) * T_S / T_S[-1], np.zeros((N, 2))])
        turn = Rotation.from_rotvec(angles) * Rotation.from_rotvec([math.pi, 0.0, 0.0])
        path = written(tmp_path, table(",".join(("t (s)", "F (N)", "z (m)", *names)), T_S, FORCE_N, -DEPTH_M, *of(turn).T))
        options = ImportOptions("F (N)", height_column="z (m)", time_columns=("t (s)",))
        with pytest.raises(RecordingError, match=r"the tool turns by 10\.0°") if refused else nullcontext():
            read_files([path], options)


def test_an_imported_curve_is_a_recording_that_is_not_overwritten(tmp_path: Path) -> None:
    """A preamble, compression negative, forces in mN, and a recording that `palpd analyse` reads without options."""
    text = "Well,E5\nForce_Limit(N),10.0\n\n" + table("Time(s),Z(mm),F(mN)", T_S, -74.0 - DEPTH_M * 1e3, -FORCE_N * 1e3) + "Total(s),6\n"
    path, out = written(tmp_path, text), tmp_path / "out.csv"
    options = ImportOptions("F(mN)", height_column="Z(mm)", time_columns=("Time(s)",), force_unit="mN", length_unit="mm",
                            compression_negative=True)  # fmt: skip
    samples = import_files([path], options, out).samples
    again = read_csv(out)
    assert np.array_equal(again.wrench, samples.wrench)
    assert again.z_cmd_m is None
    np.testing.assert_allclose(again.vz_m_per_s, -np.gradient(DEPTH_M, T_S), rtol=0, atol=1e-9)
    result = analyse_curve(read_curve(out, Mapping()), tip_radius_m=0.005)
    assert result["youngs_modulus_Pa"] == pytest.approx(8e4, rel=1e-3)
    with pytest.raises(BadInput, match="exists and is not overwritten"):
        import_files([path], options, path)


def test_time_that_runs_backwards_is_refused_with_its_row(tmp_path: Path) -> None:
    t_s = T_S.copy()
    t_s[20] = T_S[3]
    path, out = written(tmp_path, table("t,z,f", t_s, -DEPTH_M, FORCE_N)), tmp_path / "out.csv"
    with pytest.raises(RecordingError, match=r"curve\.csv: t runs backwards in row 21 of the numbers"):
        import_files([path], ImportOptions("f", height_column="z", time_columns=("t",)), out)
    assert not out.exists()


def two_files(folder: Path, begin_s: float = 0.0) -> list[Path]:
    robot = written(folder, table("t_s,z_m", T_S[::4], -DEPTH_M[::4]), "robot.csv")
    sensor = written(folder, table("t_s,fz_N", T_S[:-3] + begin_s, FORCE_N[:-3] + 12.0), "sensor.csv")
    return [robot, sensor]


def test_two_files_with_one_clock_or_with_an_offset(tmp_path: Path) -> None:
    options = ImportOptions("fz_N", height_column="z_m", time_columns=("t_s",))
    samples = read_files(two_files(tmp_path), options).samples
    np.testing.assert_allclose(samples.z_m[::4], -DEPTH_M[: len(samples) : 4], rtol=0, atol=1e-15)
    assert np.array_equal(samples.wrench[:, 2], FORCE_N[: len(samples)] + 12.0)
    with pytest.raises(BadInput, match=r"robot\.csv and sensor\.csv: the motion spans 0 to .*; give --offset-s"):
        read_files(two_files(tmp_path, 500.0), options)
    shifted = read_files(two_files(tmp_path, 512.0), ImportOptions("fz_N", height_column="z_m", time_columns=("t_s",), offset_s=-512.0))
    np.testing.assert_allclose(shifted.samples.z_m, samples.z_m, rtol=0, atol=1e-12)


def test_a_tare_takes_the_mean_of_a_still_start_and_refuses_a_moving_one(tmp_path: Path) -> None:
    z_m = np.concatenate([np.full(N, -DEPTH_M[0]), -DEPTH_M])
    fz_N = np.concatenate([np.zeros(N), FORCE_N]) + 3.5
    t_s = np.arange(2 * N) * 0.002
    path = written(tmp_path, table("t_s,fz_N,z_m", t_s, fz_N, z_m))
    imported = read_files([path], ImportOptions(tare_s=0.5))
    np.testing.assert_allclose(imported.samples.wrench[:, 2], fz_N - 3.5, rtol=0, atol=1e-12)
    assert any("fz_N begins at 3.5 N" in note for note in read_files([path], ImportOptions()).notes)
    with pytest.raises(BadInput, match=r"the tip moves by .* in the first 1\.2 s, expected at most 1 % of its stroke"):
        read_files([path], ImportOptions(tare_s=1.2))
    with pytest.raises(BadInput, match="holds 1 samples, expected 2 or more"):
        read_files([path], ImportOptions(tare_s=1e-6))


def test_a_force_of_the_wrong_sign_is_noticed(tmp_path: Path) -> None:
    path = written(tmp_path, table("t_s,fz_N,z_m", T_S, -FORCE_N, -DEPTH_M))
    with pytest.raises(BadInput, match=r"pressing gives a positive force \(--compression-negative\)"):
        read_files([path], ImportOptions())
    assert any("Accepted although implausible: " in note for note in read_files([path], ImportOptions(accept_implausible=True)).notes)
    fixed = read_files([path], ImportOptions(compression_negative=True))
    assert fixed.samples.wrench[:, 2].max() == FORCE_N.max()


@pytest.mark.parametrize(
    ("force_N", "height_m", "options", "question"),
    [
        (-FORCE_N, DEPTH_M, {}, "both signs look wrong"),
        (FORCE_N, -DEPTH_M, {"time_unit": "us"}, "the speed vz_m_per_s is .*the rate of t_s is 5e\\+08 Hz"),
    ],
)
def test_values_that_no_palpation_has_are_questioned(
    tmp_path: Path, force_N: np.ndarray, height_m: np.ndarray, options: dict[str, str], question: str
) -> None:
    path = written(tmp_path, table("t_s,fz_N,z_m", T_S, force_N, height_m))
    with pytest.raises(BadInput, match=f"{question}.*--accept-implausible"):
        read_files([path], ImportOptions(**options))  # type: ignore[arg-type]


def test_times_in_another_unit_than_the_speeds_are_questioned(tmp_path: Path) -> None:
    speed = np.gradient(-DEPTH_M, T_S)
    path = written(tmp_path, table("t_s,fz_N,z_m,vz_m_per_s", 0.04 * np.arange(N), FORCE_N, -DEPTH_M, speed / 20.0))
    assert len(read_files([path], ImportOptions()).samples) == N
    with pytest.raises(BadInput, match=r"z_m changes 1e\+03 times as fast as vz_m_per_s says"):
        read_files([path], ImportOptions(time_unit="ms"))


def test_a_force_that_never_changes_is_refused_and_nobody_can_accept_it(tmp_path: Path) -> None:
    path = written(tmp_path, table("t_s,fz_N,z_m", T_S, 0.0 * T_S, -DEPTH_M))
    with pytest.raises(RecordingError, match="no other axis of the force changes"):
        read_files([path], ImportOptions(accept_implausible=True))


@pytest.mark.parametrize("tare_s", [T_S[-1] - T_S[0], 1e4])
def test_a_tare_over_the_presses_or_beyond_the_file_is_refused(tmp_path: Path, tare_s: float) -> None:
    path = written(tmp_path, table("t_s,fz_N,z_m", T_S, FORCE_N, -DEPTH_M))
    with pytest.raises(BadInput, match=r"the tip moves by|the recording lasts"):
        read_files([path], ImportOptions(tare_s=tare_s))


def ur_log(folder: Path, separator: str, turn_deg: float = 0.0) -> Path:
    names = ["timestamp", *(f"actual_q_{k}" for k in range(6))]
    names += [
        f"{vector}_{k}" for vector in ("actual_TCP_pose", "actual_TCP_speed", "target_TCP_pose", "actual_TCP_force") for k in range(6)
    ]
    down = Rotation.from_rotvec([math.pi, 0.0, 0.0])
    turn = Rotation.from_rotvec(np.column_stack([np.radians(turn_deg) * T_S / T_S[-1], np.zeros(N), np.zeros(N)])) * down
    place = np.column_stack([np.full(N, 0.4), np.full(N, -0.1), 0.2 - DEPTH_M])
    pose = np.column_stack([place, turn.as_rotvec()])
    speed = np.zeros((N, 6))
    speed[:, 2] = -np.gradient(DEPTH_M, T_S)
    wrench = np.zeros((N, 6))
    wrench[:, 2] = FORCE_N
    columns = np.column_stack([1000.0 + T_S, np.zeros((N, 6)), pose, speed, pose, wrench])
    return written(folder, table(separator.join(names), *columns.T, separator=separator), "robot_data.csv")


@pytest.mark.parametrize("separator", [" ", ","])
def test_logs_of_ur_controllers_need_no_options(tmp_path: Path, separator: str) -> None:
    samples = read_files([ur_log(tmp_path, separator)], ImportOptions()).samples
    np.testing.assert_allclose(samples.wrench[:, 2], FORCE_N, rtol=0, atol=1e-12)
    np.testing.assert_allclose(samples.z_m, 0.2 - DEPTH_M, rtol=0, atol=1e-12)
    np.testing.assert_allclose(samples.vz_m_per_s, -np.gradient(DEPTH_M, T_S), rtol=0, atol=1e-12)
    assert samples.z_cmd_m is not None
    with pytest.raises(RecordingError, match=r"the tool turns by 10\.0°"):
        read_files([ur_log(tmp_path, separator, 10.0)], ImportOptions())


def test_matlab_files(tmp_path: Path) -> None:
    path = tmp_path / "press.mat"
    savemat(path, {"rec": {"t": T_S, "z_mm": -DEPTH_M * 1e3}, "data": np.column_stack([T_S, FORCE_N]), "title": "press"})
    assert {each.name for each in source_of(path).channels} == {"rec.t", "rec.z_mm", "data(:,1)", "data(:,2)"}
    options = ImportOptions("data(:,2)", height_column="rec.z_mm", time_columns=("rec.t",), units_confirmed=True)
    samples = read_files([path], options).samples
    np.testing.assert_allclose(samples.wrench[:, 2], FORCE_N, rtol=0, atol=1e-12)
    np.testing.assert_allclose(samples.z_m, -DEPTH_M, rtol=0, atol=1e-15)
    with pytest.raises(BadInput, match=r"there is no Fz in press\.mat; it holds rec\.t, rec\.z_mm, 'data\(:,1\)', 'data\(:,2\)'"):
        read_files([path], ImportOptions("Fz", height_column="rec.z_mm"))
    (tmp_path / "new.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n")
    with pytest.raises(RecordingError, match=r"version 7\.3; save it with save"):
        source_of(tmp_path / "new.mat")


def test_labview_files(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    path = tmp_path / "press.tdms"
    step = {"wf_increment": 0.002, "wf_start_offset": 0.0}
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([
            nptdms.ChannelObject("Press", "Force", FORCE_N * 1e3, {"unit_string": "mN", **step}),
            nptdms.ChannelObject("Press", "Height", -DEPTH_M, {"unit_string": "m", **step}),
        ])  # fmt: skip
    listed = {each.name: each for each in source_of(path).channels}
    assert (listed["Press/Force"].unit, listed["Press/Force"].rate_Hz) == ("mN", pytest.approx(500.0))
    options = ImportOptions("Press/Force", height_column="Press/Height", units_confirmed=True)
    samples = read_files([path], options).samples
    np.testing.assert_allclose(samples.wrench[:, 2], FORCE_N, rtol=0, atol=1e-12)
    np.testing.assert_allclose(samples.t_s, T_S, rtol=0, atol=1e-12)


def test_waveforms_of_labview_that_began_at_different_times_are_aligned(tmp_path: Path) -> None:
    """The force of a second task, which began 0.2 s later, stood 0.2 s too early beside the motion."""
    nptdms = pytest.importorskip("nptdms")
    later = T_S - T_S[0] >= 0.1999
    for name, values, start_ms in (("Height", -DEPTH_M, 0), ("Force", FORCE_N[later], 200)):
        start = np.datetime64("2026-03-01T10:00:00", "ms") + np.timedelta64(start_ms, "ms")
        properties = {"unit_string": "m" if name == "Height" else "N", "wf_increment": 0.002, "wf_start_time": start}
        with nptdms.TdmsWriter(tmp_path / f"{name}.tdms") as writer:
            writer.write_segment([nptdms.ChannelObject("Press", name, values, properties)])
    paths = [tmp_path / "Height.tdms", tmp_path / "Force.tdms"]
    samples = read_files(paths, ImportOptions("Press/Force", height_column="Press/Height")).samples
    np.testing.assert_allclose(samples.z_m, -DEPTH_M[later], rtol=0, atol=1e-9)


def test_afm_curves(tmp_path: Path) -> None:
    afmformats = pytest.importorskip("afmformats")
    stiffness_N_per_m = 0.02
    force_N, tip_m = FORCE_N * 1e-9, -DEPTH_M * 1e-3
    data = {"force": force_N, "height (measured)": tip_m - force_N / stiffness_N_per_m, "time": T_S,
            "segment": (np.arange(N) > N // 2).astype(np.uint8)}  # fmt: skip
    metadata = {"path": tmp_path / "x", "enum": 0, "spring constant": stiffness_N_per_m, "imaging mode": "force-distance"}
    path = tmp_path / "curve.tab"
    afmformats.AFMForceDistance(data, metadata).export_data(path, fmt="tab")
    imported = read_files([path], ImportOptions())
    np.testing.assert_allclose(imported.samples.wrench[:, 2], force_N, rtol=1e-4, atol=1e-16)
    np.testing.assert_allclose(imported.samples.z_m, tip_m, rtol=0, atol=1e-9)
    assert "curve.tab: force is force, height is tip position." in imported.notes


BAD = {
    "empty.csv": (b"", "is empty"),
    "blank.csv": (b"\n \n", "holds no text"),
    "binary.csv": (bytes(range(256)) * 40, "no text and no file of a known kind"),
    "words.csv": (b"one,two\nthree,four\n", "none of its first 2 rows holds two numbers"),
    "text.csv": (
        b"t_s,fz_N,z_m\n" + b"0,1,2\n" * 40 + b"0,oops,3\n" + b"0,1,2\n" * 3,
        r"fz_N is 'oops' in row 42, between rows of numbers",
    ),
    "hole.csv": (b"t_s,fz_N,z_m\n" + b"0,1,2\n" * 4 + b"0,,3\n" + b"0,1,2\n" * 3, r"fz_N is empty in row 6"),
    "nan.csv": (b"t_s,fz_N,z_m\n" + b"0,1,2\n" * 4 + b"0,nan,3\n" + b"0,1,2\n" * 3, r"fz_N is 'nan' in row 6"),
    "still.csv": (b"t_s,fz_N,z_m\n" + b"0,1,0.1\n" * 40, r"t_s stands still in row 2 of the numbers"),
    "short.csv": (b"t_s,fz_N,z_m\n0,1,0.1\n1,1,0.2\n", "2 samples of force and motion overlap, 30 or more"),
    "locale.csv": (b"t_s,fz_N,z_m\n" + b"0,5,1,0,0,2\n" * 40, "if its commas are decimal, separate the cells with semicolons"),
    "wide.csv": (b",".join(b"c%d" % k for k in range(120_000)) + b"\n" + b",".join([b"1"] * 120_000) + b"\n", "has 120000 columns"),
    "million.csv": (b",".join([b"1"] * 1_000_000) + b"\n", r"row 1 has 1999999 letters"),
    "broken.mat": (b"MATLAB 5.0 MAT-file" + b"\0" * 200, "cannot be read as a MATLAB file"),
    "broken.tdms": (b"TDSm" + b"\1" * 64, "cannot be read as a TDMS file|holds no channel"),
    "broken.h5": (b"\x89HDF" + b"\1" * 64, "cannot be read as a file of an AFM"),
    "broken.bag": (b"#ROSBAG V2.0\n" + b"\1" * 64, "cannot be read as a ROS bag"),
    "broken.db3": (b"SQLite format 3\0" + b"\1" * 64, "cannot be read as a ROS bag"),
    "broken.jpk-force": (b"PK\3\4" + b"\1" * 64, "cannot be read as a file of an AFM"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_one_sentence_and_nothing_is_written(tmp_path: Path, name: str) -> None:
    content, sentence = BAD[name]
    path, out = tmp_path / name, tmp_path / "out.csv"
    path.write_bytes(content)
    with pytest.raises(PalpdError, match=sentence) as refusal:
        import_files([path], ImportOptions(), out)
    assert "\n" not in str(refusal.value)
    assert name in str(refusal.value)
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({}, r"--force-column is missing: .* holds 'Time \(s\)' \(s\), 'F \(mN\)' \(mN\)"),
        ({"force_column": "F (mN)"}, "--depth-column or --height-column is missing"),
        ({"force_column": "F (mN)", "height_column": "z"}, r"there is no z in curve\.csv"),
        (
            {"force_column": "F (mN)", "height_column": "Z (mm)"},
            "needs time and no column of curve.csv is named for it; give --time-column",
        ),
        ({"force_column": "F (mN)", "height_column": "F (mN)", "time_columns": ("t",)}, r"curve\.csv has no column t; it holds"),
        ({"force_column": "F (mN)", "depth_column": "Z (mm)", "height_column": "Z (mm)"}, "were both given"),
        ({"force_column": "F (mN)", "height_column": "Z (mm)", "time_columns": ("Z (mm)",)}, "one column of curve.csv is named for two"),
        ({"columns": {"fw_N": "x"}}, r"--column fw_N is no column of a recording \(did you mean"),
        (
            {"force_column": "F (mN)", "height_column": "Z (mm)", "time_columns": ("Time (s)",), "twist": "v"},
            "--twist belongs to --pose; with columns give --column vz_m_per_s=NAME",
        ),
        (
            {"force_column": "F (mN)", "height_column": "Z (mm)", "time_columns": ("Time (s)",), "wrench_in": "tool"},
            "--wrench-in belongs to --wrench",
        ),
        ({"wrench": "F (mN)", "pose": "Z (mm)"}, "F .mN. is a column of numbers, expected a wrench"),
    ],
)
def test_options_that_do_not_fit_are_one_sentence(tmp_path: Path, options: dict[str, object], sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence):
        read_files([millimetres(tmp_path)], ImportOptions(**options))  # type: ignore[arg-type]
