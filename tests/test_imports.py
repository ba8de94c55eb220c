"""What import-linter does not see: the imports of benchmarks, which stand in no package, and the table of rooms in ARCHITECTURE.md."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

OF_BENCHMARKS = {
    "blind/test_calibration.py": {"calibrate"},
    "blind/test_own_simulators.py": {"own_models", "own_simulators"},
    "blind/test_own_sysid.py": {"own_models"},
    "blind/test_real_recordings.py": {"real_recordings"},
    "blind/test_scored_batches.py": {"blind_errors", "neighbours"},
    "browser/test_setup.py": {"setup"},
    "cli/test_fuzz_lines.py": {"fuzz_commands"},
    "cli/test_output_options.py": {"fuzz_commands"},
    "daemon/test_demo.py": {"law_demos", "marked_text"},
    "hil/test_after_a_run.py": {"after_a_run"},
    "hil/test_arming.py": {"arming"},
    "hil/test_faults.py": {"fault_injection"},
    "hil/test_setup.py": {"setup", "setup_faults"},
    "hil/test_signals.py": {"signals"},
    "study/test_methods.py": {"compensation_methods", "recurrent_method"},
    "gap/test_evidence_audit.py": {"evidence_audit"},
    "gap/test_fixed_point.py": {"fixed_point"},
    "test_foreign_cells.py": {"foreign", "foreign_cells"},
    "test_pages.py": {"fuzz_inputs"},
}
"""Tests of a benchmark, or of a short sample of what it measures; what tests and benchmarks share otherwise is in palpd.testing."""


def imported_modules(path: Path) -> set[str]:
    """Full names of all modules that a file imports, at any level."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    modules = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    return modules | {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").rglob("*.py")), ids=lambda path: path.stem)
def test_benchmarks_import_no_tests(path: Path) -> None:
    assert not {module for module in imported_modules(path) if module.partition(".")[0] == "tests"}


def test_only_the_tests_of_a_benchmark_import_it() -> None:
    imported = {}
    for path in (ROOT / "tests").rglob("*.py"):
        modules = {module.partition(".")[2] for module in imported_modules(path) if module.startswith("benchmarks.")}
        imported[path.relative_to(ROOT / "tests").as_posix()] = modules
    assert {name: modules for name, modules in imported.items() if modules} == OF_BENCHMARKS


def test_only_the_module_of_fixtures_imports_pytest() -> None:
    importers = {path.name for path in (ROOT / "palpd").rglob("*.py") if "pytest" in imported_modules(path)}
    assert importers == {"fixtures.py"}


@pytest.mark.parametrize("path", sorted([*(ROOT / "palpd").rglob("*.py"), *(ROOT / "hw").rglob("*.py")]), ids=lambda path: path.stem)
def test_the_package_imports_neither_tests_nor_benchmarks(path: Path) -> None:
    assert not {module for module in imported_modules(path) if module.partition(".")[0] in {"tests", "benchmarks"}}


def test_the_table_of_rooms_has_each_room_in_the_order_of_the_import_law() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    layers = [set(layer.split(" | ")) for layer in contracts[0]["layers"] if layer != "__main__"]
    table = re.findall(r"^\| `palpd/(\w+)(?:/|\.py)` \|", (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8"), re.MULTILINE)
    for layer in layers:
        rooms, table = set(table[: len(layer)]), table[len(layer) :]
        assert rooms == layer
    assert table == []


def test_the_table_of_the_diagnosis_has_each_module_behind_what_it_imports() -> None:
    text, gap = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8"), ROOT / "palpd" / "gap"
    (table,) = re.findall(r"^\| folder \| what is in it \|\n(.*?)\n\n", text, re.MULTILINE | re.DOTALL)
    listed: set[str] = set()
    for row in table.splitlines()[1:]:
        of_row = re.findall(r"`(\w+(?:\.py|/))`", row.split("|")[1])
        listed |= {name.removesuffix(".py").removesuffix("/") for name in of_row}
        for path in [path for name in of_row for path in ([gap / name] if name.endswith(".py") else sorted((gap / name).rglob("*.py")))]:
            imported = re.findall(r"^\s*from palpd\.gap\.(\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert set(imported) <= listed, f"{path.name} imports what stands below its row"
    assert listed == {path.stem for path in gap.iterdir() if path.suffix == ".py" or path.is_dir()} - {"__init__", "__pycache__"}
