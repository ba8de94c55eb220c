"""Files and recordings live long: what version 1 could say loads for ever, what is newer is refused, what is older is rewritten."""

from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from mcap.records import Metadata

from palpd import file_versions
from palpd.analysis.results import analysed_sites, sites
from palpd.cell.cell_file import load_cell, save_cell
from palpd.cell.effects import EFFECTS
from palpd.config import Config, load_config, load_plan, parse_config
from palpd.documents import read_yaml
from palpd.errors import BadInput, ConfigError, RecordingError
from palpd.migration import MODELS, migration_of, write
from palpd.recording import cdr, topics
from palpd.recording.mcap_file import HEADER, Contents, RecordingWriter
from palpd.recording.reader import Recording, export
from palpd.recording.recovery import recover
from palpd.recording.samples import COLUMNS, read
from tests.paths import ROOT

VERSION_1 = ROOT / "tests" / "version_1"
RECORDING = VERSION_1 / "recording.mcap"
"""A run of the daemon on emulated wires, at 12.5 Hz and with 25 sensor frames a second: sites A and B at 3 and 4 mm."""


def written(tmp_path: Path, text: str, name: str = "file.yaml") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


# --- recordings


def test_a_recording_of_version_1_loads_and_gives_the_figures_that_it_gave_then() -> None:
    """Static and dynamic moduli as `palpd run` printed them when the file was written."""
    recording = Recording.load(RECORDING)
    assert recording.header["format_version"] == 1
    assert (len(recording.rows), recording.footer["verdict"]) == (506, "done")
    a, b = sites(recording.rows, recording.header)
    assert a["static_youngs_modulus_Pa"] == pytest.approx(57_543, rel=1e-3)
    assert b["static_youngs_modulus_Pa"] == pytest.approx(145_896, rel=1e-3)
    assert a["dynamic_original_Pa"] == pytest.approx(58_058, rel=1e-3)
    assert b["dynamic_original_Pa"] == pytest.approx(146_413, rel=1e-3)
    assert [round(site["peak_force_N"], 2) for site in (a, b)] == [1.94, 4.69]
    assert [site["name"] for site in analysed_sites(recording)] == ["A", "B"]


def test_the_configuration_in_a_recording_of_version_1_is_still_read() -> None:
    config = parse_config(Recording.load(RECORDING).header["config"], "its configuration")
    assert (config.robot.rate_Hz, config.sensor.rate_Hz) == (12.5, 25.0)


def rewritten(tmp_path: Path, version: object) -> Path:
    """The recording with another version in its header."""
    whole = Recording.load(RECORDING)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("palpd.recording.mcap_file.NEWEST_RECORDING", version)
        writer = RecordingWriter(tmp_path / "run.mcap", whole.header)
        writer.write(whole.rows[:20])
        return writer.close(whole.footer)


def test_a_newer_recording_is_refused_with_both_versions_and_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"run.mcap has version 2, and this palpd reads versions up to 1; install a newer palpd"):
        Recording.load(rewritten(tmp_path, 2))
    (tmp_path / "run.mcap").rename(tmp_path / "run.part")
    with pytest.raises(RecordingError, match="install a newer palpd"):
        recover(tmp_path / "run.part")


@pytest.mark.parametrize("version", ["1", 0, None, 1.5])
def test_a_recording_whose_version_is_no_number_is_refused_as_damaged(tmp_path: Path, version: object) -> None:
    with pytest.raises(RecordingError, match="corrupt"):
        Recording.load(rewritten(tmp_path, version))


def test_a_recording_without_a_version_has_version_1() -> None:
    contents = Contents()
    contents._keep(Metadata(name=HEADER, metadata={"json": '{"kind": "palpation"}'}))
    contents.refuse_foreign(RECORDING)
    assert contents.header == {"kind": "palpation"}


def without_running_zero(path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording as the first palpd wrote them: its ticks had no field zero_N."""
    whole = Recording.load(RECORDING)
    schema = "\n".join(line for line in cdr.TICK.splitlines() if not line.endswith(" zero_n"))
    monkeypatch.setitem(topics.SCHEMAS, "palpd_msgs/msg/Tick", schema)
    monkeypatch.setattr(cdr, "_ONCE", tuple(name for name in cdr._ONCE if name != "zero_N"))
    cdr.tick_layout.cache_clear()
    writer = RecordingWriter(path, whole.header)
    writer.write(whole.rows)
    writer.close(whole.footer)
    monkeypatch.undo()
    cdr.tick_layout.cache_clear()
    return path


def test_a_recording_from_before_the_running_zero_loads_and_recovers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = without_running_zero(tmp_path / "old.mcap", monkeypatch)
    whole, old = Recording.load(RECORDING), Recording.load(path)
    assert path.stat().st_size < RECORDING.stat().st_size
    for name in whole.rows.dtype.names or ():
        assert name == "zero_N" or np.array_equal(old.rows[name], whole.rows[name], equal_nan=True), name
    assert not old.rows["zero_N"].any()
    assert sites(old.rows, old.header) == sites(whole.rows, whole.header)
    path.rename(tmp_path / "cut.part")
    assert recover(tmp_path / "cut.part").ticks == len(whole.rows)


def test_ticks_that_lack_or_have_another_field_are_refused() -> None:
    for old, new in (("float64 force_n\n", ""), ("float64 force_n\n", "float32 force_n\n"), ("uint8 phase\n", "uint8 phase\nuint8 more\n")):
        assert old in cdr.TICK
        assert cdr.absent_fields(cdr.TICK.replace(old, new)) is None
    assert cdr.absent_fields(cdr.TICK) == ()


@pytest.mark.parametrize("site", ["A", None], ids=["one site", "all sites"])
def test_an_export_to_parquet_holds_the_columns_of_the_csv_and_the_header(tmp_path: Path, site: str | None) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    recording = Recording.load(RECORDING)
    samples = export(recording, tmp_path / "a.parquet", site)
    export(recording, tmp_path / "a.csv", site)
    table = parquet.read_table(tmp_path / "a.parquet")
    assert ",".join(table.column_names) == (tmp_path / "a.csv").read_text().splitlines()[0]
    assert table.column_names[: len(COLUMNS)] == list(COLUMNS)
    assert b'"robot_model": "ur5"' in table.schema.metadata[b"palpd.header"]
    assert b'"verdict": "done"' in table.schema.metadata[b"palpd.footer"]
    for again in (read(tmp_path / "a.parquet"), read(tmp_path / "a.csv")):
        assert (again.t_s == samples.t_s).all()
        assert (again.wrench == samples.wrench).all()
        assert again.sites == ((site,) if site else ("A", "B"))
    export(recording, tmp_path / "a.parquet", site)
    (tmp_path / "a.parquet").write_bytes(b"PAR1 of another program")
    with pytest.raises(BadInput, match="exists and is not overwritten"):
        export(recording, tmp_path / "a.parquet", site)


def test_an_export_to_parquet_without_pyarrow_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(BadInput, match=r"install palpd\[parquet\] or write a CSV"):
        export(Recording.load(RECORDING), tmp_path / "a.parquet")
    assert not list(tmp_path.iterdir())


# --- config.yaml, cell.yaml and plan.yaml


def migrated(kind: file_versions.Kind, tmp_path: Path) -> Path:
    """The file of version 1 as `palpd migrate` leaves it."""
    path = written(tmp_path, (VERSION_1 / f"{kind}.yaml").read_text(), f"{kind}.yaml")
    path.write_text(migration_of(path).after)
    return path


def test_a_configuration_of_version_1_with_all_its_keys_loads(tmp_path: Path) -> None:
    config = load_config(migrated("config", tmp_path))
    assert (config.robot.host, config.robot.rate_Hz, config.robot.watchdog_Hz) == ("192.168.1.10", 250.0, 25.0)
    assert (config.sensor.rate_Hz, config.sensor.filter_cutoff_Hz, config.sensor.fz_slopes) == (500.0, 50.0, "both")
    assert (config.safety.contact_limit_N, config.safety.absolute_limit_N, config.safety.sensor_stale_s) == (10.0, 20.0, 0.045)
    assert (config.model.zero, config.machine.stiffness_N_per_m, config.cell.probe.tip_radius_m) == ("learned", 30_000.0, 0.004)


def test_a_plan_of_version_1_with_all_its_keys_loads(tmp_path: Path) -> None:
    plan = load_plan(migrated("plan", tmp_path))
    assert (plan.depths_m, plan.repeats, plan.mode) == ((0.003, 0.005), 2, "static")
    assert plan.free is not None
    assert plan.free.strokes == 5


def test_a_cell_of_version_1_with_all_effects_and_parameters_loads(tmp_path: Path) -> None:
    cell = load_cell(migrated("cell", tmp_path))
    assert cell.effects["sensor.crosstalk"]["fx_per_fz"] == 0.02
    assert (cell.learned[0].id, cell.sites[0].name, cell.estimated is not None) == ("learned.warm_drive", "A", True)


@pytest.mark.parametrize("kind", ["config", "cell", "plan"])
def test_the_files_of_version_1_hold_every_key_of_version_1(kind: file_versions.Kind) -> None:
    """A key that is added later need not stand there; this finds one that was forgotten when the files were written."""
    content = read_yaml(VERSION_1 / f"{kind}.yaml").keys_and_values()
    later = {"config": {"page", "alarms", "check"}, "cell": {"uncertainty"}, "plan": set[str]()}[kind]
    assert set(MODELS[kind].model_fields) - set(content) == {"version"} | later
    if kind == "cell":
        assert set(content["effects"]) <= set(EFFECTS)


@pytest.mark.parametrize("kind", ["config", "cell", "plan"])
def test_a_newer_file_is_refused_for_its_version_and_not_for_its_new_keys(tmp_path: Path, kind: file_versions.Kind) -> None:
    path = written(tmp_path, "new_block: {a: 1}\nversion: 2\nsites: 5\n")
    load = {"config": load_config, "cell": load_cell, "plan": load_plan}[kind]
    with pytest.raises(ConfigError, match=r"line 2: version: the file has version 2, and .* up to 1; install a newer palpd"):
        load(path)


def test_a_newer_cell_in_a_configuration_is_refused_too() -> None:
    with pytest.raises(ConfigError, match=r"cell\.version: the file has version 2"):
        parse_config({"cell": {"version": 2}}, "it")


@pytest.mark.parametrize("version", ['"1"', "0", "true", "1.0", "null"])
def test_a_version_that_is_no_whole_number_is_refused(tmp_path: Path, version: str) -> None:
    with pytest.raises(ConfigError, match="version"):
        load_config(written(tmp_path, f"version: {version}"))


def test_a_cell_that_is_saved_says_its_version(tmp_path: Path) -> None:
    save_cell(tmp_path / "c.yaml", load_cell(VERSION_1 / "cell.yaml"))
    assert (tmp_path / "c.yaml").read_text().splitlines()[1] == "version: 1"


def test_a_variable_of_another_program_is_no_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPD_VERSION", "3.2")
    assert load_config(None).version == Config().version == 1


# --- palpd migrate

OLD = """# my cell
robot:
  watchdog_Hz: "20"   # as the robot's handbook says
  tcp: ["0", 0, '0.1', 0, 0, 0]
sensor: {rate_Hz: 0x64, counts_per_N: ~}   # YAML 1.1
safety:
    contact_limit_N: 1_2

    min_z_m: -0.1
"""


def test_texts_that_the_first_palpd_took_for_numbers_become_numbers_and_all_else_stays(tmp_path: Path) -> None:
    """That palpd read YAML 1.1 and turned texts into numbers; the one of today refuses them."""
    path = written(tmp_path, OLD)
    with pytest.raises(ConfigError, match="expected a number"):
        load_config(path)
    migration = migration_of(path)
    expected = OLD.replace('"20"', "20").replace('"0"', "0").replace("'0.1'", "0.1").replace("0x64", "100.0").replace("1_2", "12.0")
    assert migration.after == expected
    assert migration.changes[0] == f'{path}, line 3: robot.watchdog_Hz was "20" and is 20'
    assert len(migration.changes) == 5
    write(migration, tmp_path / "file.yaml.old")
    assert load_config(path).sensor.rate_Hz == 100.0
    assert (tmp_path / "file.yaml.old").read_text() == OLD
    assert migration_of(path).changes == ()


def test_a_count_that_was_written_with_a_point_becomes_a_whole_number(tmp_path: Path) -> None:
    path = written(tmp_path, "sites: [{name: A}]\ndepths_m: [0.004]\nrepeats: 3.0   # a depth\n")
    assert migration_of(path).after.endswith("repeats: 3   # a depth\n")


def test_what_an_alias_stands_for_changes_once(tmp_path: Path) -> None:
    path = written(tmp_path, 'safety: {robot_stale_s: &stale "0.04", sensor_stale_s: *stale}')
    assert migration_of(path).after == "safety: {robot_stale_s: &stale 0.04, sensor_stale_s: *stale}"


def test_a_truth_value_or_a_word_is_no_number_and_stays_refused(tmp_path: Path) -> None:
    for value in ("yes", "fast", "[1]"):
        with pytest.raises(ConfigError, match="watchdog_Hz"):
            migration_of(written(tmp_path, f"robot: {{watchdog_Hz: {value}}}"))


def test_a_file_that_needs_no_change_is_left_alone(tmp_path: Path) -> None:
    for name in ("config.yaml", "plan.yaml"):
        migration = migration_of(ROOT / name)
        assert (migration.changes, migration.before) == ((), migration.after)
        assert migration.unchanged.endswith("of version 1, the newest; there is nothing to change.")


def test_a_file_that_would_still_be_refused_is_refused_and_stays(tmp_path: Path) -> None:
    path = written(tmp_path, 'robot: {watchdog_Hz: "20", hots: a}')
    with pytest.raises(ConfigError, match=r"there is no key 'robot\.hots'"):
        migration_of(path)
    with pytest.raises(ConfigError, match="install a newer palpd"):
        migration_of(written(tmp_path, "version: 2\nsafety: {}"))


def test_a_file_of_which_two_kinds_are_possible_asks_for_the_kind(tmp_path: Path) -> None:
    path = written(tmp_path, 'sensor: {rate_Hz: "500"}')
    with pytest.raises(ConfigError, match="could be a config or a cell file by its keys; say which with --kind"):
        migration_of(path)
    assert migration_of(path, "cell").after == "sensor: {rate_Hz: 500}"


def test_an_old_file_that_was_kept_before_is_not_overwritten(tmp_path: Path) -> None:
    path, old = written(tmp_path, OLD), written(tmp_path, "mine", "file.yaml.old")
    with pytest.raises(BadInput, match="exists and is not overwritten"):
        write(migration_of(path), old)
    assert (path.read_text(), old.read_text()) == (OLD, "mine")


def test_a_renamed_key_is_refused_with_its_new_name_and_migrate_renames_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No key of ours was renamed so far; this stands for the first that will be."""
    renamed = {"config": {"robot.ip": "host"}, "cell": {"effects.sensor.scale": "sensor.gain"}, "plan": {"sites.east_m": "x_m"}}
    monkeypatch.setattr(file_versions, "RENAMED", MappingProxyType(renamed))
    config = written(tmp_path, "robot:\n  ip: 10.0.0.2   # the robot\n", "config.yaml")
    with pytest.raises(ConfigError, match=r"line 2: robot.ip is called host today; palpd migrate .*config.yaml rewrites the file"):
        load_config(config)
    assert migration_of(config).after == "robot:\n  host: 10.0.0.2   # the robot\n"
    plan = written(tmp_path, "sites: [{name: A}, {name: B, east_m: '0.03'}]\ndepths_m: [0.004]", "plan.yaml")
    with pytest.raises(ConfigError, match=r"sites\.1\.east_m is called x_m today"):
        load_plan(plan)
    assert "x_m: 0.03" in migration_of(plan).after
    cell = written(tmp_path, "effects: {sensor.scale: {factor: 1.1}}\nprobe: {mass_kg: 0.1}", "cell.yaml")
    with pytest.raises(ConfigError, match=r"is called sensor\.gain today"):
        load_cell(cell)
    assert "sensor.gain: {factor" in migration_of(cell).after
