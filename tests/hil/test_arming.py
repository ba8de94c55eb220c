"""Arming that fails: each way ends with its own true sentence, and nothing moves. The table stands in docs/faults.md."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.arming import ARMING_FAULTS, failed_arming, fresh, objection, required
from palpd.testing.emulated_cell import EmulatedCell, emulated_cell, retry_if_machine_stalled
from palpd.testing.fixtures import skip_without_ur_rtde

pytestmark = pytest.mark.hil

SAID_WITHIN_S = 10.0
"""Generous, because the machine runs other things: the library alone would wait longer where a fault lasts. A benchmark measures it."""


def test_every_fault_has_a_row() -> None:
    assert set(required()) == set(ARMING_FAULTS)


@pytest.fixture(scope="module")
def calibrated(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[EmulatedCell, str]]:
    skip_without_ur_rtde()
    with emulated_cell(tmp_path_factory.mktemp(request.param), request.param) as base:
        yield base, base.anew(base.folder).calibrate().read_text()


@pytest.mark.parametrize(("calibrated", "fault"), [(kind.model, fault) for fault, kind in ARMING_FAULTS.items()], indirect=["calibrated"])
def test_arming_that_fails_says_why_and_nothing_moves(calibrated: tuple[EmulatedCell, str], fault: str, tmp_path: Path) -> None:
    base, calibration = calibrated
    folders = iter(tmp_path / str(number) for number in range(9))

    def ready() -> EmulatedCell:
        folder = next(folders)
        folder.mkdir()
        return fresh(base, folder, calibration)

    def attempt(cell: EmulatedCell) -> None:
        outcome = failed_arming(cell, fault)
        assert not objection(outcome, required()[fault])
        assert outcome.said_s < SAID_WITHIN_S

    retry_if_machine_stalled(ready, attempt)
