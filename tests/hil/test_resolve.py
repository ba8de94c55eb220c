"""`palpd resolve` on wires: the first recording, its diagnosis, and the files on disk."""

import json
from collections.abc import Callable

import pytest
import yaml

from palpd.testing.emulated_cell import ABOVE_M, PATIENT, PRESS, EmulatedCell

pytestmark = pytest.mark.hil


def test_a_running_cell_is_recorded_and_diagnosed(cell: Callable[..., EmulatedCell]) -> None:
    wired = cell(1000.0, **PATIENT)
    config = yaml.safe_load(wired.config.read_text())
    config["cell"] = {"tissue": {"surface_z_m": wired.truth()["tip_z_m"] - ABOVE_M}}
    (wired.folder / "cell.yaml").write_text(yaml.safe_dump(config))
    (wired.folder / "plan.yaml").write_text(yaml.safe_dump(PRESS | {"depths_m": [0.003]}))
    out = wired.folder / "resolved.json"
    done = wired.palpd(
        "resolve", "--config", wired.folder / "cell.yaml", "--plan", wired.folder / "plan.yaml", "--take-reference", "--rounds", "1",
        "--yes", "--out", wired.folder / "kept", "--json", out,
        patience_s=200.0,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads(out.read_text())
    assert report["verdict"] == "done"
    assert report["diagnosis"]["verdict"] in {"effects", "unknown", "ambiguous"}, "a wall is no elastic half-space"
    assert [one["recording"] for one in report["rounds"]] == ["round-1.csv"]
    assert {"round-1.csv", "round-1.mcap", "plan-1.yaml", "diagnosis-1.json", "gap.html", "enriched.yaml"} <= {
        path.name for path in (wired.folder / "kept").iterdir()
    }
