"""Recordings in, answers out: one, a folder of them, and a simulation of what was found."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_diagnosis import recording

from palpd.cell_file import load_cell, nominal, save_cell
from palpd.errors import BadInput, RecordingError
from palpd.gap.commands import diagnose_files, simulate_file, tolerances_of
from palpd.samples import read_csv, write_csv

EFFECT = {"tissue.viscoelastic": {"ratio": 0.2, "tau_s": 0.8}}


def test_a_file_is_diagnosed_and_its_enriched_cell_simulates_it(tmp_path: Path) -> None:
    samples = recording(nominal(), EFFECT)
    write_csv(tmp_path / "a.csv", samples)
    save_cell(tmp_path / "cell.yaml", nominal())
    diagnose_files(
        [tmp_path / "a.csv"], tmp_path / "cell.yaml", json_out=tmp_path / "a.json", cell_out=tmp_path / "rich.yaml", propose=False
    )
    assert json.loads((tmp_path / "a.json").read_text())["effects"][0]["id"] == "tissue.viscoelastic"
    assert load_cell(tmp_path / "rich.yaml").estimated is not None
    simulate_file(tmp_path / "a.csv", tmp_path / "rich.yaml", tmp_path / "predicted.csv")
    assert np.std(read_csv(tmp_path / "predicted.csv").wrench[:, 2] - samples.wrench[:, 2]) < 0.08
    with pytest.raises(BadInput, match="exists"):
        simulate_file(tmp_path / "a.csv", tmp_path / "rich.yaml", tmp_path / "predicted.csv")


def test_a_simulation_needs_a_time_and_a_height(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("t_s,force\n0,0\n1,1\n")
    save_cell(tmp_path / "cell.yaml", nominal())
    with pytest.raises(RecordingError, match="z_cmd_m"):
        simulate_file(tmp_path / "m.csv", tmp_path / "cell.yaml", tmp_path / "out.csv")


def test_tolerances_follow_from_healthy_recordings(tmp_path: Path) -> None:
    save_cell(tmp_path / "cell.yaml", nominal())
    paths = []
    for seed in (1, 2):
        paths.append(tmp_path / f"{seed}.csv")
        write_csv(paths[-1], recording(nominal(), {}, seed=seed))
    found = tolerances_of(paths, tmp_path / "cell.yaml")
    assert 0.005 < found["tolerances"]["youngs_modulus"] < 0.05
    assert 0.005 < found["tolerances"]["bias_N"] < 0.05
