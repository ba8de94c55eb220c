"""A sensor whose slopes of Fz part where it carries nothing: contacts are read as they are with `both`, and too large with `pressed`."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from palpd.recording.reader import Recording
from palpd.testing.emulated_cell import PATIENT, PRESS, EmulatedCell, emulated_cell
from palpd.testing.fixtures import skip_without_ur_rtde

pytestmark = pytest.mark.hil

STATIC = PRESS | {"mode": "static", "depths_m": [0.004], "hold_s": 1.5}
OVER_READ_N = (1656 / 1528 - 1.0) * 0.2 * 9.81
"""What the other slope adds to a contact: the ratio of the registers, on the weight of the probe."""


@pytest.fixture(scope="module")
def parting_at_load(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmulatedCell]:
    """A sensor of that law."""
    skip_without_ur_rtde()
    with emulated_cell(tmp_path_factory.mktemp("cell"), "ur5", None, "--fz-parts-at", "load") as cell:
        yield cell


@pytest.mark.parametrize(("setting", "over_read_N"), [("both", 0.0), ("pressed", OVER_READ_N)])
def test_a_held_contact_is_read_with_the_slopes_that_are_set(
    parting_at_load: EmulatedCell, tmp_path: Path, setting: str, over_read_N: float
) -> None:
    wired = parting_at_load.anew(tmp_path, 1000.0, **PATIENT, sensor={"fz_slopes": setting})
    daemon = wired.run(STATIC)
    assert daemon.wait() == 0, daemon.stderr
    log = wired.log(0.0)
    rows = Recording.load(Path(daemon.report["recording"])).rows
    true_N = np.interp(rows["now_s"] - 0.01, [sample.t_s for sample in log], [sample.contact_N for sample in log])
    held = (rows["frames"] > 0) & (true_N > 2.0) & (np.abs(np.gradient(true_N)) < 1e-3)
    assert held.sum() > 50
    read_N = np.array([row["tared"][: row["frames"], 2].mean() for row in rows[held]])
    assert float(np.mean(read_N - true_N[held])) == pytest.approx(over_read_N, abs=0.04)
