"""One emulated cell for all tests of this folder: each begins at rest above a wall of its own."""

from collections.abc import Callable, Iterator

import pytest

from tests.hil.wired import Wired, wired


@pytest.fixture(scope="package")
def cb3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Wired]:
    """A UR5 at 125 Hz and a HEX-70 at 1 kHz."""
    with wired(tmp_path_factory.mktemp("cell"), "ur5") as cell:
        yield cell


@pytest.fixture
def cell(cb3: Wired, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Wired]:
    """Makes the cell ready for this test; arguments as of `Wired.anew`."""

    def ready(stiffness_N_per_m: float = 1000.0, **blocks: dict[str, object]) -> Wired:
        return cb3.anew(tmp_path_factory.mktemp("run"), stiffness_N_per_m, **blocks)

    return ready
