"""What tests that speak RTDE need; where it has no wheel they are skipped, and say so."""

import pytest

from hw.rtde import require_library
from palpd.errors import RobotError


def skip_without_ur_rtde() -> None:
    """Skip a test where ur-rtde is not installed, with the driver's own sentence."""
    try:
        require_library()
    except RobotError as error:
        pytest.skip(str(error))
