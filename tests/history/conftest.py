"""Recordings of three short palpations of one cell, a day apart: done, done with a press cut short, and stopped by the force limit."""

import shutil
from pathlib import Path

import pytest

from palpd.config import Config, Plan
from palpd.testing.simulated_recording import BEGAN_S, write_simulated

PLAN = Plan.model_validate(
    {
        "sites": [{"name": "A"}], "depths_m": [0.003, 0.005], "repeats": 1, "hold_s": 0.3, "press_speed_m_per_s": 0.02,
        "safe_height_m": 0.005, "search": {"speed_m_per_s": 0.02},
    }
)  # fmt: skip
DAY_S = 86400.0


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which they are made; nothing is written to it."""
    folder = tmp_path_factory.mktemp("simulated")
    for day, limit_N in enumerate((12.0, 3.5, 2.5)):
        config = Config.model_validate({"safety": {"contact_limit_N": limit_N}})
        write_simulated(folder / f"day-{day}.mcap", PLAN, config=config, began_s=BEGAN_S + day * DAY_S, seed=day)
    return folder


@pytest.fixture
def runs(simulated: Path, tmp_path: Path) -> Path:
    """A folder of runs with a copy of each."""
    return Path(shutil.copytree(simulated, tmp_path / "runs"))
