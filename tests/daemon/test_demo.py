"""What `palpd demo --effect` plants: an id at its typical size, a cell file, or a user's own effect, which the emulator knows too."""

from pathlib import Path

import numpy as np
import pytest

from hw.emulators.controller import MODELS
from hw.emulators.rig import Rig
from palpd.cell.cell_file import CellFile, load_cell, nominal, save_cell
from palpd.cell.effects import EFFECTS, load_effects
from palpd.cell.effects.learned import save_learned
from palpd.daemon.demo import _with_effect
from palpd.errors import BadInput, ConfigError
from tests.cell.test_learned_effects import learned
from tests.paths import EXAMPLE


def _effects_of(effect: str, cell: CellFile) -> dict[str, dict[str, float]]:
    return _with_effect(cell, effect).effects


def test_effects_come_from_an_id_a_cell_file_or_a_users_file(tmp_path: Path) -> None:
    assert _effects_of("none", nominal()) == {}
    assert set(_effects_of("sensor.creep", nominal())["sensor.creep"]) == {"ratio", "tau_s"}
    save_cell(tmp_path / "cell.yaml", nominal().with_effects({"robot.lag": {"bandwidth_ratio": 0.7}}))
    assert _effects_of(str(tmp_path / "cell.yaml"), nominal()) == {"robot.lag": {"bandwidth_ratio": 0.7}}
    assert _effects_of(str(EXAMPLE), nominal())["tissue.pulse"]["share"] == pytest.approx(0.05)
    with pytest.raises(BadInput, match="no effect of the library"):
        _effects_of("sensor.magic", nominal())


def test_a_file_of_learned_effects_is_planted_whole_and_the_daemon_does_not_know(tmp_path: Path) -> None:
    save_learned(tmp_path / "law.yaml", [learned()])
    planted = _with_effect(nominal(), str(tmp_path / "law.yaml"))
    assert planted.learned == (learned(),)
    assert planted.effects == {}


def test_an_emulated_cell_can_have_an_effect_of_ones_own(tmp_path: Path) -> None:
    library = load_effects(EXAMPLE)
    file = tmp_path / "cell.yaml"
    save_cell(file, nominal().with_effects(_effects_of(str(EXAMPLE), nominal())))
    with pytest.raises(ConfigError, match=r"tissue\.pulse"):
        load_cell(file)
    rig = Rig(MODELS["ur5"], load_cell(file, library), "127.1.9.9", tmp_path / "hex", library=library)
    try:
        rig.cell.begin()
        still = np.tile([0.0, 0.0, -0.004], (2000, 1))
        force_N = rig.cell.step(still).contact_N[1000:]
        assert np.ptp(force_N) / force_N.mean() == pytest.approx(0.1, rel=0.05), "it beats by 5 % both ways"
    finally:
        rig.close()
    assert "tissue.pulse" not in EFFECTS
