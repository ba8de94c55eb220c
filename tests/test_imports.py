"""What import-linter does not see: benchmarks stand in no package, so a test reads their imports."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def imported_modules(path: Path) -> set[str]:
    """Full names of all modules that a file imports, at any level."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    modules = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    return modules | {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").rglob("*.py")), ids=lambda path: path.stem)
def test_benchmarks_import_no_tests(path: Path) -> None:
    assert not {module for module in imported_modules(path) if module.partition(".")[0] == "tests"}


@pytest.mark.parametrize("path", sorted([*(ROOT / "palpd").rglob("*.py"), *(ROOT / "hw").rglob("*.py")]), ids=lambda path: path.stem)
def test_the_package_imports_neither_tests_nor_benchmarks(path: Path) -> None:
    assert not {module for module in imported_modules(path) if module.partition(".")[0] in {"tests", "benchmarks"}}
