"""What `palpd demo --effect` plants: an id at its typical size, a cell file, or a user's own effect, which the emulator knows too."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.law_demos import LawDemo, table
from benchmarks.marked_text import parted, write_marked
from hw.emulators.controller_state import MODELS
from hw.emulators.rig import Rig
from palpd.cell.cell_file import load_cell, nominal, save_cell
from palpd.cell.effects import EFFECTS, load_effects
from palpd.cell.effects.learned import load_learned
from palpd.daemon.demo import _effects_of, _laws_of, gap
from palpd.daemon.display import NoDisplay
from palpd.errors import BadInput, ConfigError
from tests.paths import EXAMPLE, LAWS, ROOT


def test_effects_come_from_an_id_a_cell_file_or_a_users_file(tmp_path: Path) -> None:
    assert _effects_of("none", nominal()) == {}
    assert set(_effects_of("sensor.creep", nominal())["sensor.creep"]) == {"ratio", "tau_s"}
    save_cell(tmp_path / "cell.yaml", nominal().with_effects({"robot.lag": {"bandwidth_ratio": 0.7}}))
    assert _effects_of(str(tmp_path / "cell.yaml"), nominal()) == {"robot.lag": {"bandwidth_ratio": 0.7}}
    assert _effects_of(str(EXAMPLE), nominal())["tissue.pulse"]["share"] == pytest.approx(0.05)
    with pytest.raises(BadInput, match="no effect of the library"):
        _effects_of("sensor.magic", nominal())


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


def test_the_example_laws_are_five_that_differ_in_kind() -> None:
    laws = [_laws_of(str(file))[0] for file in sorted(LAWS.glob("*.yaml"))]
    kinds = {(term.factor, term.driver.quantity, term.driver.period, *term.channels) for (term,) in (law.terms for law in laws)}
    assert len(kinds) == len(laws) == 5
    assert all(_effects_of(str(file), nominal()) == {} for file in LAWS.glob("*.yaml"))


def test_a_law_outside_the_list_is_found_and_closes_the_gap_on_another_motion(tmp_path: Path) -> None:
    demonstration = gap(str(LAWS / "cogging.yaml"), tmp_path, NoDisplay(), wires=False)
    answer = demonstration.result["diagnosis"]
    (term,) = load_learned(tmp_path / "diagnosis.learned.yaml")[0].terms
    assert (answer["verdict"], term.factor, term.driver.quantity) == ("unknown", "one", "height")
    assert term.driver.period == pytest.approx(0.0025, rel=0.01)
    x = np.linspace(0.0, 0.0025, 50)
    assert np.std(term.curve(x) - 0.12 * np.sin(2.0 * np.pi * x / 0.0025 + 0.7)) < 0.01
    assert answer["another_motion"]["closed"] > 0.95
    page = (tmp_path / "gap.html").read_text(encoding="utf-8")
    assert "The law on another motion" in page
    assert "repeating every 2.5 mm, in m <code>x</code>" in page


def test_the_table_of_laws_stands_between_its_marks(tmp_path: Path) -> None:
    row = LawDemo("cogging", "a gear", "unknown", "an added force", "0.1 * x", 0.97, 12.0)
    page, copy = (ROOT / "docs" / "outside-the-list.md").read_text(encoding="utf-8"), tmp_path / "page.md"
    copy.write_text(page, encoding="utf-8")
    write_marked(copy, "laws", table([row]))
    before, text, after = parted(copy.read_text(encoding="utf-8"), "laws")
    assert text.splitlines()[2:] == ["| [a gear](examples/laws/cogging.yaml) | an added force | `0.1 * x` | 97% | 12 |"]
    assert (before, after) == parted(page, "laws")[::2]
