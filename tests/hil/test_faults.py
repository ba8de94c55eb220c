"""The table of docs/faults.md: every fault has a row, what was measured keeps what is required, and some are done again here."""

from collections.abc import Callable

import pytest

from tests.hil.faults import DEEDS, objection, required, suffered
from tests.hil.wired import Wired, fairly

pytestmark = pytest.mark.hil

AGAIN = ("robot connection dropped", "recorder killed")
"""Two of those that are the hardest to survive; all of them are `python benchmarks/faults.py`."""


def test_every_fault_that_can_be_done_has_a_row() -> None:
    assert set(required()) == set(DEEDS)


@pytest.mark.parametrize("fault", [name for name, row in required().items() if row.deadline is not None and row.measured is not None])
def test_what_was_measured_is_within_its_deadline(fault: str) -> None:
    row = required()[fault]
    assert row.deadline is not None
    assert row.measured is not None
    assert row.measured <= row.deadline


@pytest.mark.parametrize("fault", AGAIN)
def test_the_fault_is_met_as_the_table_says(cell: Callable[..., Wired], fault: str) -> None:
    def attempt(wired: Wired) -> None:
        assert not objection(suffered(lambda: wired, fault, attempts=1), required()[fault])

    fairly(lambda: cell(safety={"contact_limit_N": 16.0}), attempt)
