"""Many recordings: one task each whoever runs them, failures as rows, and which cell has what since when."""

from pathlib import Path

import numpy as np
import pytest

from palpd.cell.cell_file import nominal, save_cell
from palpd.errors import BadInput
from palpd.gap.fleet import FleetRow, by_cell, cell_of, diagnose_folder, recordings_in
from palpd.recording.samples import Samples, write_csv
from tests.gap.test_diagnosis import recording

EFFECT = {"tissue.viscoelastic": {"ratio": 0.2, "tau_s": 0.8}}


def row(name: str, cell: str, creep: float | None = None, failed: bool = False) -> FleetRow:
    effects = {} if creep is None else {"sensor.creep": {"ratio": (creep, creep - 0.01, creep + 0.01), "tau_s": (1.0, 0.9, 1.1)}}
    verdict = None if failed else "none" if creep is None else "effects"
    return FleetRow(name, cell, verdict, effects, None if failed else 0.9, None, "no header" if failed else "")


def still(folder: Path, name: str) -> None:
    """A short recording in which nothing moves."""
    t_s = np.arange(60) * 0.01
    noise = np.random.default_rng(0).normal(size=(60, 6)) * [0.05, 0.05, 0.05, 1e-3, 1e-3, 1e-3]
    write_csv(folder / f"{name}.csv", Samples(t_s, np.full(60, 0.01), np.full(60, 0.01), np.zeros(60), noise))


def test_a_recording_of_a_folder_that_fails_is_reported_and_stops_nothing(tmp_path: Path) -> None:
    write_csv(tmp_path / "good.csv", recording(nominal(), EFFECT))
    save_cell(tmp_path / "good.yaml", nominal())
    (tmp_path / "bad.csv").write_text("t_s,z_m\n0,0\n")
    save_cell(tmp_path / "bad.yaml", nominal())
    still(tmp_path, "alone")
    rows = {row.name: row for row in diagnose_folder(tmp_path)}
    assert rows["good"].verdict == "effects"
    assert set(rows["good"].effects) == set(EFFECT)
    assert (tmp_path / "good.json").exists()
    assert rows["bad"].verdict is None
    assert "missing" in rows["bad"].sentence
    assert "alone.yaml" in rows["alone"].sentence


def test_a_recording_belongs_to_the_folder_it_stands_in_or_to_its_name_without_the_date() -> None:
    here = Path("fleet")
    assert cell_of(here / "left" / "a.csv", here) == "left"
    assert cell_of(here / "left-20261101-120000.csv", here) == "left"
    assert cell_of(here / "cell-B_7.csv", here) == "cell-B"
    assert cell_of(here / "00012.csv", here) == "00012", "a bare number is a cell of its own"


def test_the_recordings_of_a_folder_of_folders_share_a_cell_file(tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        save_cell(tmp_path / name / "cell.yaml", nominal())
        still(tmp_path / name, "1")
    assert len(recordings_in(tmp_path)) == 2
    rows = list(diagnose_folder(tmp_path, jobs=2))
    assert {(row.cell, row.verdict) for row in rows} == {("left", "none"), ("right", "none")}
    with pytest.raises(BadInput, match="holds no recording"):
        recordings_in(Path(__file__).parent.parent / "service")


def test_since_when_a_cell_has_an_effect_and_whether_it_grows() -> None:
    history = [None, 0.10, None, 0.10, 0.15, 0.20, 0.25]
    rows = [row(f"A-{k}", "A", creep) for k, creep in enumerate(history)] + [row("B-1", "B"), row("B-2", "B", failed=True)]
    rows += [row(f"C-{k}", "C", 0.1 + 0.001 * (-1) ** k) for k in range(4)]
    cells = {cell.cell: cell for cell in by_cell(rows[::-1])}
    assert cells["A"].effects == ("sensor.creep",)
    assert cells["A"].since == "A-3", "the first of the unbroken run to the last"
    assert cells["A"].trend.endswith("0.25, growing")
    assert cells["C"].trend.endswith("steady")
    assert (cells["B"].verdict, cells["B"].recordings, cells["B"].failed) == ("none", 2, 1)
    assert by_cell([row("D-1", "D", failed=True)])[0].verdict is None


def test_a_cluster_does_the_same_as_processes(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="Dask is not installed: palpd[cluster]")
    (tmp_path / "bad.csv").write_text("t_s,z_m\n0,0\n")
    save_cell(tmp_path / "cell.yaml", nominal())
    still(tmp_path, "good")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        there = sorted(diagnose_folder(tmp_path, scheduler=cluster.scheduler_address), key=lambda row: row.name)
    assert there == sorted(diagnose_folder(tmp_path), key=lambda row: row.name)
    assert [row.verdict for row in there] == [None, "none"]


def test_without_a_cluster_the_sentence_says_what_to_do(tmp_path: Path) -> None:
    still(tmp_path, "good")
    with pytest.raises(BadInput, match=r"dask scheduler|palpd\[cluster\]"):
        list(diagnose_folder(tmp_path, scheduler="tcp://127.0.0.1:9"))
