"""Fixtures for pytest: an emulated cell with a UR5 and a HEX-70. A conftest.py imports those that its tests use.

Only this module of palpd imports pytest.
"""

from collections.abc import Callable, Iterator

import pytest

from hw.rtde import require_library
from palpd.errors import RobotError
from palpd.testing.emulated_cell import EmulatedCell, emulated_cell


def skip_without_ur_rtde() -> None:
    """Skip a test where ur-rtde is not installed, with the driver's own sentence."""
    try:
        require_library()
    except RobotError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="package")
def cb3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmulatedCell]:
    """A UR5 at 125 Hz and a HEX-70 at 1 kHz."""
    skip_without_ur_rtde()
    with emulated_cell(tmp_path_factory.mktemp("cell"), "ur5") as cell:
        yield cell


@pytest.fixture
def cell(cb3: EmulatedCell, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., EmulatedCell]:
    """Makes the cell ready for this test; arguments as of `EmulatedCell.anew`."""

    def ready(stiffness_N_per_m: float = 1000.0, **blocks: dict[str, object]) -> EmulatedCell:
        return cb3.anew(tmp_path_factory.mktemp("run"), stiffness_N_per_m, **blocks)

    return ready
