"""The commands of the pages under docs, word by word and in their order, in a fresh folder beside docs; and what pages quote of code.

The pages that say how to do one thing go on from the files of docs/start.md. The README's commands are in test_readme.py.
"""

import json
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

from benchmarks.fuzz_inputs import sound_files
from palpd.cli import application
from palpd.cli.application import carry_out
from palpd.cli.command_groups import ORDER
from palpd.cli.output_options import examples_of
from palpd.errors import RecordingError
from palpd.interchange import registry
from palpd.interchange.import_files import ImportOptions, read_files
from palpd.testing.emulated_cell import EmulatedCell, emulated_cell, retry_if_machine_stalled
from palpd.testing.fixtures import skip_without_ur_rtde
from tests.pages import FENCE, commands_of, quoted_in, words
from tests.paths import ROOT

DOCS = ROOT / "docs"
START, ON_WIRES = DOCS / "start.md", DOCS / "tutorials" / "emulated-cell.md"
SIMULATOR = DOCS / "my-simulator.md"
"""Its Python comes before its commands: tests/gap/test_my_simulator_page.py runs both."""
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if commands_of(page) and page not in (START, ON_WIRES, SIMULATOR)]
LEAVES = {
    "tutorials/csv.md": {"recording.csv", "cell.yaml", "report.html", "out.json", "enriched.yaml"},
    "tutorials/modulus.md": {"modulus.json", "report.html", "enriched.yaml"},
    "tutorials/rosbag.md": {"bag.csv", "bag.yaml", "bag.html"},
    "how-to/fleet.md": {"fleet.json"},
    "how-to/service.md": {"look"},
    "import.md": {"mine.csv", "mine.yaml"},
}
"""Files that the commands of a page write."""
LEFT_OUT = {
    "palpd emulate --sensor-link hex": "the emulated cell of the test stands for it, on an address of its own",
    "palpd doctor --config cell/config.yaml": "judges this computer, which need not be fit",
    "palpd run --config cell/config.yaml --plan cell/plan.yaml": "a minute; make demo presses the same four sites",
    "palpd map --config cell/config.yaml --width-m 0.04 --height-m 0.02 --out map.png": "2 minutes; test_inclusion.py maps without wires",
}
"""Commands of the emulated cell that are not run, each with the reason."""
BY_HAND = {
    "palpd setup CELL": "asks an operator; tests/hil/test_setup.py answers",
    "palpd run --plan plan.yaml": "as in the tutorial",
    "palpd retract": "needs a stop in the tissue",
}


NEEDS_MORE = {
    **dict.fromkeys(
        ("run", "check", "inject", "calibrate", "stiffness", "free-motion", "level-test", "retract", "doctor", "resolve"), "needs a cell"
    ),
    **dict.fromkeys(
        ("status", "arm", "start", "pause", "resume", "abort", "clear", "recover-robot", "jobs", "job", "plans", "controls"),
        "needs a daemon",
    ),
    "setup": "asks an operator; tests/hil/test_setup.py answers",
    **dict.fromkeys(("emulate", "serve", "web"), "serves until Ctrl-C"),
    "alarms": "needs addresses; tests/streams sends to some",
    "arena": "needs the rigs of the repository; tests/arena asks every tool",
    **dict.fromkeys(("demo", "blind"), "minutes; the README's commands try them"),
    "palpd stream --config cell/config.yaml --foxglove 8765 --metrics 9464": "serves until Ctrl-C",
    "palpd map --config cell/config.yaml --width-m 0.04 --height-m 0.02 --out map.png": "needs a cell",
    "tolerances": "needs recordings of a healthy cell; how-to/tolerances.md makes some",
    "palpd diagnose --healthy monday.csv tuesday.csv wednesday.csv --now today.csv": "needs days; tests/gap/test_healthy.py makes some",
    "palpd study --days 0 --out study": "minutes; tests/study makes the page",
}
"""Commands and examples that are only parsed, each with the reason."""


def run_in_process(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A line as a shell would run it, without a process for palpd and the examples."""
    program, *arguments = shlex.split(line, comments=True)
    if program == "palpd":
        carry_out(arguments)
    elif program == "python":
        monkeypatch.setattr(sys, "argv", arguments)
        runpy.run_path(arguments[0], run_name="__main__")
    else:
        subprocess.run(["bash", "-euc", line], check=True)


def run_page(page: Path, folder: Path) -> None:
    """Run a page's commands in a folder; what it quotes must be printed."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as printed:
        if not (folder / "docs").exists():
            (folder / "docs").symlink_to(DOCS)
        patch.chdir(folder)
        patch.setenv("COLUMNS", "200")
        patch.setenv("PALPD_EFFECTS_DIR", str(folder / "effects"))
        for line in commands_of(page):
            run_in_process(line, patch)
    for line in quoted_in(page):
        assert words(line) in words(printed.getvalue()), printed.getvalue()


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the first page was followed, word by word."""
    folder = tmp_path_factory.mktemp("started")
    run_page(START, folder)
    return folder


def test_the_first_page_runs_word_by_word(started: Path) -> None:
    assert {"press.csv", "recording.csv", "cell.yaml", "enriched.yaml", "report.html", "predicted.csv"} <= {
        path.name for path in started.iterdir()
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_commands_of_a_page_run_word_by_word(page: Path, started: Path, tmp_path: Path) -> None:
    if page.parent.name != "tutorials":
        for name in ("press.csv", "recording.csv", "cell.yaml", "enriched.yaml"):
            shutil.copy(started / name, tmp_path)
    run_page(page, tmp_path)
    assert LEAVES.get(str(page.relative_to(DOCS)), set()) <= {path.name for path in tmp_path.iterdir()}


def test_start_my_csv_and_the_modulus_are_followed_one_after_the_other_in_one_folder(started: Path) -> None:
    for name in ("csv.md", "modulus.md"):
        run_page(DOCS / "tutorials" / name, started)
    modulus = json.loads((started / "modulus.json").read_text())
    assert modulus["ci95_Pa"][0] < 40_000.0 < modulus["ci95_Pa"][1]
    assert modulus["ci95_Pa"][1] - modulus["ci95_Pa"][0] < 2_000.0


def test_the_examples_of_the_commands_run_where_no_cell_and_no_hour_is_needed(
    started: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PALPD_EFFECTS_DIR", str(tmp_path / "effects"))
    sound = sound_files(tmp_path / "sound")
    for name, file in {
        "free.mcap": sound["free"],
        "presses.csv": sound["presses"],
        "cut-off.part": sound["part"],
        "run.mcap": ROOT / "tests" / "version_1" / "recording.mcap",
        **{name: started / name for name in ("press.csv", "recording.csv", "cell.yaml", "enriched.yaml", "report.html", "predicted.csv")},
    }.items():
        shutil.copy(file, name)
    (tmp_path / "runs").mkdir()
    shutil.copy("run.mcap", "runs")
    examples = {application.name_of(each): examples_of(each) for each in application.app.registered_commands}
    tried = [
        line
        for name in sorted(ORDER, key=lambda name: name != "init")
        for line in examples[name]
        if name not in NEEDS_MORE and line not in NEEDS_MORE
    ]
    assert len(tried) > 30
    for line in tried:
        run_in_process(line, monkeypatch)
    assert set(NEEDS_MORE) <= {*ORDER, *(line for lines in examples.values() for line in lines)}


@pytest.mark.hil
def test_the_tutorial_on_the_emulated_cell_runs_word_by_word(tmp_path_factory: pytest.TempPathFactory) -> None:
    lines = commands_of(ON_WIRES)
    assert set(LEFT_OUT) <= set(lines)
    kept = [line for line in lines if line not in LEFT_OUT]
    assert len(kept) >= 7

    def attempt(cell: EmulatedCell) -> None:
        here = tmp_path_factory.mktemp("attempt")
        (here / "hex").symlink_to(cell.wires.sensor)
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        variables = {"PYTHONPATH": str(ROOT), "PATH": path, "PALPD_ROBOT__HOST": cell.wires.host, "COLUMNS": "200"}
        done = subprocess.run(
            ["bash", "-euxc", "\n".join(kept)], cwd=here, env=os.environ | variables, capture_output=True, text=True, check=False,
            stdin=subprocess.DEVNULL, timeout=220,
        )  # fmt: skip
        assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        for line in quoted_in(ON_WIRES, LEFT_OUT):
            assert words(line) in words(done.stdout)
        assert (here / "cell" / "inertial.onnx").exists()

    skip_without_ur_rtde()
    with emulated_cell(tmp_path_factory.mktemp("cell")) as wired:
        retry_if_machine_stalled(lambda: wired.anew(tmp_path_factory.mktemp("run")), attempt)


def test_the_commands_for_a_real_cell_are_those_of_the_tutorial() -> None:
    commands = re.findall(r"`(palpd [^`]*)`", (DOCS / "how-to" / "real-cell.md").read_text())
    assert set(BY_HAND) <= set(commands)
    tried = {(line.split()[1], option) for line in commands_of(ON_WIRES) if line.startswith("palpd") for option in line.split()}
    for command in commands:
        if command not in BY_HAND:
            _, name, *rest = command.split()
            assert {(name, option) for option in rest if option.startswith("--")} <= tried
            assert (name, "palpd") in tried


@pytest.mark.parametrize(
    "page",
    [
        *(each for each in sorted((DOCS / "how-to").glob("add-*.md")) if each.stem != "add-a-rig"),
        DOCS / "how-to" / "test-a-plugin.md",
        DOCS / "streams.md",
    ],
    ids=lambda page: page.stem,
)
def test_code_that_a_page_shows_is_the_example(page: Path) -> None:
    shown = [text for kind, text in FENCE.findall(page.read_text()) if kind == "python"]
    assert shown
    assert not set(shown) - {file.read_text() for file in (DOCS / "examples").glob("*.py")}


def test_the_readers_example_reads_lines_of_json_and_refuses_others_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    example = runpy.run_path(str(DOCS / "examples" / "my_reader.py"))["READER"]
    ours, failures = registry.readers()
    monkeypatch.setattr(registry, "readers", lambda: ({"lines": example} | ours, failures))
    file = tmp_path / "log.jsonl"
    file.write_text("\n".join(f'{{"t_s": {k / 100}, "force_N": {k % 50 / 10}, "height_m": {-k % 50 / 1e4}}}' for k in range(200)))
    options = ImportOptions(force_column="force_N", height_column="height_m", time_columns=("t_s",))
    assert len(read_files([file], options).samples) == 200
    file.write_text("no json\n")
    with pytest.raises(RecordingError, match=r"log.jsonl is not one JSON object a line"):
        read_files([file], options)
