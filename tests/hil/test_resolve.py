"""`palpd resolve` on wires: the first recording, its diagnosis, and what is left on disk."""

import json
from collections.abc import Callable

import pytest
import yaml

from tests.hil.wired import ABOVE_M, PRESS, Wired

pytestmark = pytest.mark.hil


def test_a_running_cell_is_recorded_and_diagnosed(cell: Callable[..., Wired]) -> None:
    # a machine that runs other tests may stand still for longer than a cell may; how fast the guard is, is tested elsewhere
    patient = {"robot_stale_s": 0.2, "sensor_stale_s": 0.2, "max_stall_s": 0.2}
    wired = cell(1000.0, safety={"contact_limit_N": 16.0} | patient, robot={"watchdog_Hz": 5})
    config = yaml.safe_load(wired.config.read_text())
    config["cell"] = {"tissue": {"surface_z_m": wired.truth()["tip_z_m"] - ABOVE_M}}
    (wired.folder / "cell.yaml").write_text(yaml.safe_dump(config))
    (wired.folder / "plan.yaml").write_text(yaml.safe_dump(PRESS | {"depths_m": [0.003]}))
    out = wired.folder / "found.json"
    done = wired.palpd(
        "resolve", "--config", wired.folder / "cell.yaml", "--plan", wired.folder / "plan.yaml", "--take-reference", "--rounds", "1",
        "--yes", "--out", wired.folder / "kept", "--json", out,
        patience_s=200.0,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    assert found["verdict"] == "done"
    assert found["diagnosis"]["verdict"] in {"effects", "unknown", "ambiguous"}, "a wall is no elastic half-space"
    assert [one["recording"] for one in found["rounds"]] == ["round-1.csv"]
    assert {"round-1.csv", "round-1.mcap", "plan-1.yaml", "diagnosis-1.json", "gap.html", "enriched.yaml"} <= {
        path.name for path in (wired.folder / "kept").iterdir()
    }
