"""How readers are found, what a diagnosis says of foreign files, and a first cell file."""

import sys
from pathlib import Path

import numpy as np
import pytest

from palpd.cell.cell_file import cell_from, load_cell, nominal
from palpd.cell.simulation import simulate
from palpd.cli.gap import diagnose
from palpd.config import Plan, PlanSite
from palpd.errors import BadInput, RecordingError
from palpd.gap.commands import read_recording
from palpd.gap.first_cell import first_cell, written_out
from palpd.interchange.foreign import import_command, is_foreign
from palpd.interchange.import_files import ImportOptions, read_files, source_of
from palpd.interchange.registry import OURS, reader_of, readers
from palpd.recording import samples as samples_file
from palpd.recording.mcap_file import RecordingWriter
from palpd.recording.reader import Recording, export
from palpd.recording.samples import Samples, read_csv, write_csv
from tests.interchange.bags import STRAIGHT_DOWN, Truth, bag, truth
from tests.simulated import ran


def test_a_table_is_the_last_kind_of_file_that_is_tried() -> None:
    assert list(readers()[0]) == [*sorted(set(OURS) - {"table"}), "table"]


@pytest.mark.parametrize(
    ("content", "command"),
    [
        ("Time (s),F (mN),Z (mm)", "--force-column 'F (mN)' --height-column 'Z (mm)' --time-column 'Time (s)' --csv foreign.recording.csv"),
        ("t_s,load_uN,indentation_nm", "--force-column load_uN --depth-column indentation_nm --time-column t_s"),
        ("a,b,c", "--force-column FORCE --height-column HEIGHT --time-column TIME"),
    ],
)
def test_a_diagnosis_of_a_foreign_table_names_the_command_that_reads_it(tmp_path: Path, content: str, command: str) -> None:
    path, cell = tmp_path / "foreign.csv", tmp_path / "cell.yaml"
    path.write_text("\n".join([content, *(f"{k * 0.01},{k},{k}" for k in range(50))]))
    cell.write_text("{}\n")
    with pytest.raises(RecordingError, match=r"column .* is missing in row 0") as refusal:
        diagnose([path], cell)
    assert command in str(refusal.value)
    assert f"palpd import {path}" in str(refusal.value)


def test_a_diagnosis_of_a_bag_names_the_command_that_reads_it(tmp_path: Path) -> None:
    folder = bag(tmp_path, "mcap", truth(0.5))
    for path in (folder, next(folder.glob("*.mcap")), bag(tmp_path, "ros1", truth(0.5))):
        assert is_foreign(path)
        with pytest.raises(RecordingError, match=f"is no recording yet; this command makes one of it: palpd import {path} --csv"):
            diagnose([path], tmp_path / "cell.yaml")


def test_a_recording_of_the_daemon_is_read_by_its_site_and_is_not_foreign(tmp_path: Path) -> None:
    plan = Plan(sites=(PlanSite(name="A"), PlanSite(name="B", x_m=0.02)), depths_m=(0.004,), hold_s=0.5, repeats=1)
    run = ran(nominal(), plan, safety={"contact_limit_N": 16.0, "absolute_limit_N": 40.0})
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, run.header)
    writer.write(run.rows)
    writer.close({"verdict": "done", "reason": ""})
    assert not is_foreign(path)
    assert import_command(path) is None
    one = read_recording(path, "B")
    export(Recording.load(path), tmp_path / "b.csv", "B")
    assert np.array_equal(one.wrench, read_csv(tmp_path / "b.csv").wrench)
    with pytest.raises(RecordingError, match=r"run\.mcap holds 2 sites \(A, B\), expected one; choose one with --site"):
        read_recording(path)
    for name, words in (("C", "C"), ("", "without a name")):
        with pytest.raises(RecordingError, match=f"has no site {words}; it has A, B"):
            read_recording(path, name)
    with pytest.raises(RecordingError, match=r"run\.mcap is a recording of palpd, or a damaged bag; palpd diagnose"):
        read_files([path], ImportOptions())


def test_what_nothing_reads_has_no_command(tmp_path: Path) -> None:
    path = tmp_path / "picture.png"
    path.write_bytes(b"\x89PNG\0\0")
    assert import_command(path) is None
    assert not is_foreign(path)
    with pytest.raises(RecordingError, match="no text and no file of a known kind; known are"):
        reader_of(path)


def simulated(effects: dict[str, dict[str, float]], seconds: float = 12.0) -> Samples:
    """Two presses of 2 mm with a hold; a robot that reports its command too."""
    t_s = np.arange(int(seconds * 500)) * 0.002
    z_m = 0.003 - 0.005 * np.interp(t_s % 6.0, [0.0, 1.0, 2.0, 4.0, 5.0, 6.0], [0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    cell = cell_from({"tissue": {"surface_z_m": 0.0, "youngs_modulus_Pa": 60000}, "effects": effects}, "the test")
    out = simulate(cell, t_s, z_cmd_m=z_m, noise_seed=3)
    wrench = np.column_stack([out[name] for name in samples_file.WRENCH_COLUMNS])
    return Samples(t_s, z_m, out["z_m"], out["vz_m_per_s"], wrench)


def test_a_first_cell_file_is_near_the_cell_and_says_what_is_guessed(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    first = first_cell([simulated({})], 0.005)
    path.write_text(written_out(first, "a.csv"))
    cell = load_cell(path)
    assert cell.tissue is not None
    assert abs(cell.tissue.surface_z_m) < 1e-4
    assert cell.tissue.youngs_modulus_Pa == pytest.approx(60000, rel=0.05)
    assert cell.sensor.rate_Hz == pytest.approx(500.0)
    assert cell.sensor.noise_rms_N == pytest.approx(0.05, rel=0.1)
    assert cell.sensor.resolution_fz_N == pytest.approx(0.131, rel=0.01)
    assert cell.robot.servo_natural_frequency_Hz == pytest.approx(8.0, rel=0.06)
    assert cell.robot.position_noise_rms_m == pytest.approx(5e-6, rel=0.2)
    assert abs(cell.probe.mass_kg - 0.2) < 3.0 * cell.tolerances.mass_kg
    assert not cell.tolerances.modulus_known
    lines = [line for line in path.read_text().splitlines() if line.startswith("  ")]
    assert all("  # " in line for line in lines)
    assert "GUESS: no filter" in path.read_text()


def test_exact_heights_have_some_noise_in_a_first_cell_file() -> None:
    """A stage reports multiples of its step; the scatter of the last bits, 1e-18 m, ended a diagnosis in an error of linear algebra."""
    samples = simulated({})
    assert samples.z_cmd_m is not None
    exact = Samples(samples.t_s, None, samples.z_cmd_m, samples.vz_m_per_s, samples.wrench)
    robot = first_cell([exact], 0.005).content["robot"]
    assert robot is not None
    assert robot["position_noise_rms_m"] == pytest.approx(1e-9 * np.ptp(exact.z_m))


def test_a_cell_without_contact_has_no_tissue(tmp_path: Path) -> None:
    t_s = np.arange(2000) * 0.002
    z_m = 0.01 * np.sin(2.0 * t_s)
    wrench = np.random.default_rng(1).normal(0.0, 0.05, (2000, 6))
    path = tmp_path / "cell.yaml"
    path.write_text(written_out(first_cell([Samples(t_s, None, z_m, np.gradient(z_m, t_s), wrench)]), "a.csv"))
    assert load_cell(path).tissue is None
    assert "tissue: null  # no contact was seen" in path.read_text()


def test_from_a_bag_to_a_cell_file(tmp_path: Path) -> None:
    made_of = simulated({})
    stamps_ns = 1_700_000_000_000_000_000 + np.rint(made_of.t_s * 1e9).astype(np.int64)
    still = np.tile(STRAIGHT_DOWN, (len(made_of) // 4, 1))
    pose = np.column_stack([np.zeros((len(still), 2)), made_of.z_m[::4], still])
    twist = np.column_stack([np.zeros((len(still), 2)), made_of.vz_m_per_s[::4], np.zeros((len(still), 3))])
    path = bag(tmp_path, "sqlite3", Truth(stamps_ns, made_of.wrench, stamps_ns[::4], pose, twist))
    samples = read_files([path], ImportOptions()).samples
    assert load_cell_text(written_out(first_cell([samples], 0.005), path.name), tmp_path).tissue is not None


def load_cell_text(text: str, folder: Path) -> object:
    (folder / "first.yaml").write_text(text)
    return load_cell(folder / "first.yaml")


def test_many_rows_are_written_to_the_last_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyarrow")
    one = simulated({}, 1.0)
    odd = Samples(one.t_s, None, one.z_m * np.pi, one.vz_m_per_s * 1e-9, one.wrench / 3.0)
    write_csv(tmp_path / "slow.csv", odd)
    monkeypatch.setattr(samples_file, "MANY_ROWS", 10)
    write_csv(tmp_path / "fast.csv", odd)
    slow, fast = read_csv(tmp_path / "slow.csv"), read_csv(tmp_path / "fast.csv")
    assert (tmp_path / "slow.csv").read_bytes() != (tmp_path / "fast.csv").read_bytes()
    for name in ("t_s", "z_m", "vz_m_per_s", "wrench"):
        assert np.array_equal(getattr(slow, name), getattr(odd, name))
        assert np.array_equal(getattr(fast, name), getattr(odd, name))


def test_a_site_belongs_to_recordings_of_the_daemon(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", simulated({}, 1.0))
    with pytest.raises(RecordingError, match=r"a\.csv is no recording of the daemon, so --site A chooses nothing in it"):
        read_recording(tmp_path / "a.csv", "A")


@pytest.mark.parametrize(
    ("name", "content", "module"),
    [("a.bag", b"#ROSBAG V2.0\n", "rosbags.rosbag1"), ("a.tdms", b"TDSm", "nptdms"), ("a.jpk-force", b"PK", "afmformats")],
)
def test_a_reader_without_its_package_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, content: bytes, module: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=r"is not installed: install palpd\[readers\]"):
        read_files([tmp_path / name], ImportOptions())


def test_no_first_cell_is_made_of_a_force_with_the_wrong_sign() -> None:
    t_s = np.arange(0.0, 12.0, 0.01)
    z_m = 0.005 - 0.009 * np.interp(t_s % 6.0, [0.0, 1.0, 2.0, 4.5, 5.2], [0.0, 0.0, 1.0, 1.0, 0.0])
    turned = simulate(nominal(), t_s, z_cmd_m=z_m, noise_seed=1)
    turned["fz_N"] *= -1.0
    with pytest.raises(RecordingError, match=r"multiply the forces by -1 \(palpd import --compression-negative\)"):
        first_cell([samples_file.samples_from_columns(turned, "turned.csv")])


@pytest.mark.parametrize(
    ("factor", "height_factor", "question"),
    [(1e3, 1.0, "the modulus of the tissue is"), (1.0, 1e3, "the stroke of z_m is"), (-1.0, -1.0, "both signs look wrong")],
    ids=["mN", "mm", "two signs"],
)
def test_a_first_cell_of_another_unit_or_axis_is_questioned_and_can_be_accepted(factor: float, height_factor: float, question: str) -> None:
    made_of = simulated({})
    odd = Samples(
        made_of.t_s, None, height_factor * made_of.z_m, height_factor * made_of.vz_m_per_s, made_of.wrench * [1, 1, factor, 1, 1, 1]
    )
    with pytest.raises(BadInput, match=f"{question}.*--accept-implausible"):
        first_cell([odd], 0.005)
    accepted = first_cell([odd], 0.005, accept_implausible=True)
    assert any(question in sentence for sentence in accepted.sentences)


@pytest.mark.parametrize("fz_N", [0.0, 0.5])
def test_no_first_cell_is_made_of_a_force_that_never_changes(fz_N: float) -> None:
    made_of = simulated({})
    made_of.wrench[:, 2] = fz_N
    with pytest.raises(RecordingError, match="throughout, expected noise at least"):
        first_cell([made_of], 0.005, accept_implausible=True)


def test_a_damaged_file_of_an_instrument_is_one_sentence_and_no_log(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("afmformats")
    (tmp_path / "a.ibw").write_bytes(b"\x05\x00" + bytes(300))
    with pytest.raises(RecordingError, match="it is truncated, damaged or something else"):
        source_of(tmp_path / "a.ibw")
    assert "Traceback" not in capfd.readouterr().err
