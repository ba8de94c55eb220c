"""Retired names do not come back: identifiers and file names are read, and each finding says what to write instead."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("palpd", "hw", "tests", "benchmarks")

CLASSES = {
    "Sight": "Observation",
    "Look": "Observation",
    "Turn": "TickRecord in the loop, Steps in the sequence",
    "Body": "ArmGeometry",
    "Bent": "ModelDiscrepancy",
    "Left": "ResidualStructure",
    "Deed": "Fault",
    "Ground": "Detectability",
    "World": "SimulatedRun",
    "Order": "CaseSpec",
    "Measure": "CellScales",
    "Motion": "TipMotion, MotionFeatures, TestMotion or DrawnMotion",
}
NAMES = {
    "told": "what it is: `summary`, `command`",
    "said": "what it is: `message`, `printed`",
    "found": "what it is: `report`, `diagnosis`, `match`",
    "wanted": "what it is: `plan`, `targets`",
    "made": "what it is: `presses`, `detectability`",
    "climb": "gauss_newton",
    "judge": "laplace_evidence",
    "what_is_left": "test_residual",
    "bends": "discrepancy_drivers",
    "INEXACT": "discrepancy_drivers",
    "weigh": "with_row_weight",
    "soften": "with_model_error_floor",
    "afresh": "starts_at_tare",
    "measured_motion": "estimate_tip_motion",
    "trust": "acceleration_weight",
    "shaken": "inertial_noise",
    "suffered": "inject",
    "fairly": "retry_if_machine_stalled",
    "likes": "similar_effects",
    "twins": "indistinguishable effects",
    "twin": "indistinguishable effect",
}
FILES = {
    "palpd/daemon/control.py": "control_socket.py",
    "palpd/daemon/motion.py": "motion_process.py",
    "palpd/daemon/state.py": "stored_state.py",
    "palpd/cell/kinematics.py": "tip_motion.py",
    "palpd/recording/record.py": "reader.py",
    "palpd/cell/reported.py": "report_times.py",
    "palpd/recording/rows.py": "tick_rows.py",
}
PARTS = {"deed", "twin", "twins", "bent", "likes", "inexact"}
"""Words that may not be a part of a name either."""


def defined_names(tree: ast.AST) -> Iterator[tuple[int, str, bool]]:
    """(line, name, whether it is a class) of everything that a module defines: classes, functions, arguments, variables, attributes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            yield node.lineno, node.name, True
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.lineno, node.name, False
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg, False
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id, False
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr, False
        elif isinstance(node, ast.alias) and node.asname:
            yield getattr(node, "lineno", 0), node.asname, False


def instead(name: str, is_class: bool) -> str | None:
    """What to write instead of a retired name; None where it is not retired."""
    bare = name.strip("_")
    if bare in NAMES:
        return NAMES[bare]
    if bare in CLASSES and (is_class or bare != bare.lower()):
        return CLASSES[bare]
    words = {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", bare)}
    retired = sorted(words & PARTS)
    return f"a name without '{retired[0]}'" if retired else None


def findings() -> list[str]:
    """One line a retired name: file, line, name, replacement."""
    out = []
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            where = path.relative_to(ROOT)
            if where.as_posix() in FILES:
                out.append(f"{where}: the file is called {FILES[where.as_posix()]}")
            for line, name, is_class in defined_names(ast.parse(path.read_text(encoding="utf-8"))):
                if path != Path(__file__) and (better := instead(name, is_class)):
                    out.append(f"{where}:{line}: `{name}`; write {better}")
    return out


def test_no_retired_name_is_defined() -> None:
    assert not findings(), "\n".join(["retired names:", *findings()])


def test_no_two_public_classes_share_a_name() -> None:
    places: dict[str, list[str]] = {}
    for folder in ("palpd", "hw", "benchmarks"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    places.setdefault(node.name, []).append(f"{path.relative_to(ROOT)}:{node.lineno}")
    shared = {name: where for name, where in places.items() if len(where) > 1}
    assert not shared, "\n".join(f"{name}: {', '.join(where)}" for name, where in shared.items())


def test_the_check_sees_a_retired_name_in_every_position() -> None:
    source = "class World: ...\ndef climb(told): ...\nfound = 1\nself.said = 2\nimport a as made\nfor wanted in (): ...\nTWINS = {}\n"
    retired = [name for _, name, is_class in defined_names(ast.parse(source)) if instead(name, is_class)]
    assert sorted(retired) == sorted(["World", "climb", "told", "found", "said", "made", "wanted", "TWINS"])
