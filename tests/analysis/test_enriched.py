"""The modulus by a cell file, and its doubt where the cell file does not describe the recording."""

from pathlib import Path

import numpy as np
import pytest

from palpd.analysis.enriched import analysed
from palpd.cell.cell_file import CellFile, cell_from
from palpd.cell.simulation import simulate
from palpd.errors import RecordingError
from palpd.recording.samples import samples_from_columns, write_csv

CELL = cell_from(
    {
        "probe": {"mass_kg": 0.1, "tip_radius_m": 0.004},
        "sensor": {"filter_cutoff_Hz": None, "noise_rms_N": 0.01, "resolution_fz_N": 0.002},
        "tissue": {"surface_z_m": 0.1, "youngs_modulus_Pa": 40000.0},
    },
    "the test",
)
RELAXES = {"tissue.viscoelastic": {"ratio": 0.35, "tau_s": 1.0}}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two presses with holds on a tissue that relaxes."""
    t_s = np.arange(0.0, 12.0, 0.01)
    way_m = np.interp(t_s % 6.0, [0.0, 1.0, 2.0, 4.5, 5.2], [0.0, 0.0, 1.0, 1.0, 0.0]) * 0.006
    columns = simulate(CELL.with_effects(RELAXES), t_s, z_cmd_m=0.102 - way_m, noise_seed=1)
    path = tmp_path / "recording.csv"
    write_csv(path, samples_from_columns(columns, "the test"))
    return path


@pytest.mark.parametrize(
    ("cell", "doubtful"),
    [(CELL, True), (CELL.with_effects(RELAXES), False), (CELL.with_effects({"sensor.noise": {"ratio": 1.1}}), False)],
)
def test_a_cell_file_that_does_not_describe_a_recording_is_doubted(recording: Path, cell: CellFile, doubtful: bool) -> None:
    result = analysed(recording, cell)
    assert bool(result["warnings"]) == doubtful
    if doubtful:
        assert "times what noise and scatter of this cell make: something is not in the cell file" in result["warnings"][0]
    elif "tissue.viscoelastic" in cell.effects:
        assert result["ci95_Pa"][0] < 40000.0 < result["ci95_Pa"][1]


def test_the_name_of_a_site_is_refused_for_a_table(recording: Path) -> None:
    with pytest.raises(RecordingError, match="--site A chooses nothing in it"):
        analysed(recording, CELL, "A")
