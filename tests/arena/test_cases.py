"""The rigs that are shipped: complete, licensed, silent about their truth, and read by every tool."""

import json
from pathlib import Path

import pytest
import yaml

import palpd
from palpd.arena.cases import ArenaRig, every, rigs
from palpd.arena.columns import load
from palpd.errors import BadInput
from tests.paths import ROOT

CASES = ROOT / "benchmarks" / "arena"
FOLDERS = sorted(each.parent for each in CASES.glob("*/rig.yaml"))


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_rig_is_complete_and_its_cell_file_is_one(folder: Path) -> None:
    rig = ArenaRig.load(folder)
    palpd.Cell.load(folder / "cell.yaml")
    stated = yaml.safe_load((folder / "rig.yaml").read_text(encoding="utf-8"))
    assert len(stated["source"]["commit"]) == 40
    assert stated["authors"]
    assert f"| [{folder.name}]({folder.name}/README.md) | {stated['licence']} " in (CASES / "LICENCES.md").read_text(encoding="utf-8")
    assert {"README.md", "picture.png", "convert.py"} <= {each.name for each in folder.iterdir()}
    assert len(rig.questions[0].healthy) >= 3
    if not stated["shipped"]:
        assert f"benchmarks/arena/{folder.name}/recordings/" in (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()
        return
    assert (folder / "LICENSE").stat().st_size > 500
    for question in rig.questions:
        assert question.recording.is_file()
    recording = load(rig.questions[0].recording)
    assert {"t_s", "z_m", "vz_m_per_s", "fz_N"} <= recording.keys()


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_names_say_nothing_of_the_truth(folder: Path) -> None:
    rig = ArenaRig.load(folder)
    assert all(question.name[0] == "j" and question.name[1:].isdigit() for question in rig.questions)
    if 0 < len(rig.healthy) < len(rig.questions):
        order = [rig.truths[question.name].healthy for question in rig.questions]
        assert sorted(order) not in (order, order[::-1])


def test_the_data_stay_small_and_outside_the_wheel() -> None:
    assert sum(each.stat().st_size for each in CASES.rglob("*") if each.is_file()) < 20e6
    assert "benchmarks" not in (ROOT / "pyproject.toml").read_text().partition("[tool.hatch.build")[2].partition("[tool.ruff")[0]


def test_some_questions_are_taken_in_turn_from_each_rig() -> None:
    shipped = rigs(CASES)
    some = every(shipped, len(shipped) + 1)
    assert [question.rig for question, _ in some].count(shipped[0].name) == 2
    assert len({question.rig for question, _ in some}) == len(shipped)


def rig_with(folder: Path, **changed: object) -> Path:
    stated = yaml.safe_load((FOLDERS[0] / "rig.yaml").read_text()) | {"healthy": ["h1.csv"], "judged": ["j1.csv"], "other": {}} | changed
    (folder / "recordings").mkdir(parents=True)
    for name in ("h1.csv", "j1.csv"):
        (folder / "recordings" / name).write_text("t_s,z_m,fz_N\n")
    (folder / "rig.yaml").write_text(yaml.safe_dump(stated))
    (folder / "truth.json").write_text(json.dumps({"j1.csv": {"causes": [], "known": "annotated"}}))
    return folder


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"judged": ["j1.csv", "j2.csv"]}, r"j2\.csv is missing; rig\.yaml names it"),
        ({"judged": ["h1.csv"], "healthy": []}, r"h1\.csv, j1\.csv stands in only one"),
        ({"healthy": ["h1.csv", "j1.csv"]}, "a healthy recording that a tool is given is judged too"),
    ],
)
def test_a_rig_that_contradicts_itself_is_refused(tmp_path: Path, changed: dict[str, object], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        ArenaRig.load(rig_with(tmp_path / "rig", **changed))


def test_a_truth_of_no_known_kind_is_refused(tmp_path: Path) -> None:
    folder = rig_with(tmp_path / "rig")
    (folder / "truth.json").write_text('{"j1.csv": {"causes": [], "known": "heard"}}')
    with pytest.raises(BadInput, match="known is 'heard', expected one of planted, annotated, measured, inferred"):
        ArenaRig.load(folder)
    with pytest.raises(BadInput, match="holds no rig with recordings"):
        rigs(tmp_path / "nowhere")
