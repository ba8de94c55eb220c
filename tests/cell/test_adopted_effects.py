"""A user's library: where it stands, what joins it, and what is refused without a trace."""

from pathlib import Path

import pytest
import yaml

from palpd.cell.effects.adopted import adopt, load_adopted, remove, to_adopt, user_folder
from palpd.cell.effects.learned import save_learned
from palpd.errors import BadInput, ConfigError
from tests.cell.test_learned_effects import learned


@pytest.fixture
def file(tmp_path: Path) -> Path:
    save_learned(tmp_path / "out.learned.yaml", [learned()])
    return tmp_path / "out.learned.yaml"


def test_the_library_stands_in_the_data_directory_of_the_user(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PALPD_EFFECTS_DIR", str(tmp_path / "mine"))
    assert user_folder() == tmp_path / "mine"
    monkeypatch.delenv("PALPD_EFFECTS_DIR")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert user_folder() == tmp_path / "data" / "palpd" / "effects"
    monkeypatch.setenv("XDG_DATA_HOME", "relative")  # which the XDG rules have programs ignore
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_folder() == tmp_path / ".local" / "share" / "palpd" / "effects"


def test_a_law_joins_under_its_name_and_leaves_again(file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "data" / "effects"
    assert load_adopted(folder) == {}
    path = adopt(to_adopt(file, folder, "learned.stiff_foam"), folder)
    assert path == folder / "learned.stiff_foam.yaml"
    assert load_adopted(folder) == {"learned.stiff_foam": learned().model_copy(update={"id": "learned.stiff_foam"})}
    adopt(to_adopt(file, folder), folder)
    assert list(load_adopted(folder)) == ["learned.stiff_foam", "learned.test"]
    remove("learned.stiff_foam", folder)
    assert list(load_adopted(folder)) == ["learned.test"]


@pytest.mark.parametrize("name", ["stiff_foam", "learned.", "learned.Foam", "learned.a/b", "learned.../x", "sensor.gain", ""])
def test_a_name_that_is_none_is_refused(file: Path, tmp_path: Path, name: str) -> None:
    with pytest.raises(BadInput, match="give --name"):
        to_adopt(file, tmp_path / "effects", name)
    with pytest.raises(BadInput, match="is not adopted"):
        remove(name, tmp_path / "effects")
    assert file.exists()


def test_a_taken_name_a_broken_file_and_several_laws_are_refused_and_nothing_is_written(file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "effects"
    adopt(to_adopt(file, folder), folder)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(BadInput, match="adopted already"):
        to_adopt(file, folder)
    with pytest.raises(BadInput, match="exists"):  # adopted meanwhile by another process
        adopt(learned(), folder)
    save_learned(tmp_path / "two.yaml", [learned(), learned().model_copy(update={"id": "learned.other"})])
    with pytest.raises(ConfigError, match="2 learned effects"):
        to_adopt(tmp_path / "two.yaml", folder)
    (tmp_path / "broken.yaml").write_text("learned: [{id: learned.x, terms: []}]", encoding="utf-8")
    with pytest.raises(ConfigError, match="terms"):
        to_adopt(tmp_path / "broken.yaml", folder)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_file_whose_law_has_another_name_is_refused(file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "effects"
    path = adopt(to_adopt(file, folder), folder)
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["learned"][0]["id"] = "learned.other"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"expected learned\.test"):
        load_adopted(folder)
