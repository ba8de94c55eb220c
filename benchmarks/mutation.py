"""Change the guard, the tare and the frame parser in one place at a time, and see whether the tests notice.

`python benchmarks/mutation.py [--only safety] [--share 0.1] [--seed N] [--json FILE]`.

Each mutant is compiled in a forked process that then runs the
tests of its module; it is killed if one fails, or if they need five times the time. Changed are comparisons, arithmetic, and/or, not,
numbers, truth values, bytes, min/max and any/all, conditions, returned values; statements are left out. Not changed: annotations, texts.
Ends with 1 where fewer than 95 % are killed; of a share, where chance does not explain so few.
"""

import argparse
import ast
import copy
import importlib.util
import json
import os
import random
import resource
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import numpy as np  # noqa: F401  # imported once, before the forks
import pytest
from scipy.stats import binom

import palpd.tick  # noqa: F401
from palpd.testing.processes import children_s, take_signals

ROOT = Path(__file__).parents[1]
TARGETS = {  # name: (module, file, what of it; everything if empty, the tests)
    "safety": ("palpd.control.safety", "palpd/control/safety.py", (), ["tests/control/test_safety.py"]),
    "tare": ("palpd.control.tare", "palpd/control/tare.py", (), ["tests/control/test_tare.py"]),
    "parser": ("hw.hex_frames", "hw/hex_frames.py", ("FrameParser", "_frame"), ["tests/wire/test_hex_parser.py"]),
}
PATIENCE = 5
"""Processor time that a mutant may take, in units of the unchanged module's, besides 5 s."""
ENOUGH = 0.95
SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.Pow: ast.Mult,
    ast.Continue: ast.Break, ast.Break: ast.Continue,
}  # fmt: skip
SAME = {  # the mutated part, and why no test can see it
    "[:, :-3]": "three of six either way",
    "slice(-3)": "three of six either way",
    "angle >= 1e-12": "a rotation of 1e-12 rad or none",
    "if angle > 1e-12 else 1.0": "without a rotation its axis does not matter",
    "self._attempt_frames = min(": "it changes only the number of frames tried at once, and so the speed",
    "whole = (rows[:, :4] != ": "the careful path runs then, with the same result",
    "- len(DATA) + -1": "two bytes without a header are read again",
    "steps = counter[1:]": "the careful path runs then, with the same result",
    "reshape(-2, 8)": "numpy reads any negative length as the unknown one",
    "(32769.0,) * 6": "no count of 16 bits is between the two",
    "response < self._lowest_limit": "the careful check behind it says the same",
}
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any"}
Place = list[str | int]


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """What may stand in the place of a node."""
    if type(node) in SWAPS:
        yield SWAPS[type(node)]()
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield ast.Constant(node.value + 1)
        if node.value:
            yield ast.Constant(-node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, bytes) and node.value:
        yield ast.Constant(bytes([node.value[0] ^ 1]) + node.value[1:])
    elif isinstance(node, ast.UnaryOp):
        yield node.operand
    elif isinstance(node, ast.Name) and node.id in NAMES:
        yield ast.Name(NAMES[node.id], node.ctx)
    elif isinstance(node, ast.If | ast.IfExp | ast.While):
        changed = copy.deepcopy(node)
        changed.test = ast.UnaryOp(ast.Not(), changed.test)
        yield changed
    elif isinstance(node, ast.Return) and node.value is not None and not _is_none(node.value):
        yield ast.Return(ast.Constant(None))
    elif isinstance(node, ast.Assign | ast.AugAssign) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        yield ast.Pass()


def _is_none(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def places(node: ast.AST, at: Place, parts: tuple[str, ...]) -> Iterator[tuple[Place, ast.AST]]:
    """Every node but annotations, decorators and texts, with the way to it from the root."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params", "bases"):
            continue
        for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if not isinstance(child, ast.AST):
                continue
            if isinstance(node, ast.Module) and parts and getattr(child, "name", None) not in parts:
                continue
            way: Place = [*at, name] if index is None else [*at, name, index]
            yield way, child
            yield from places(child, way, parts)


def mutants(file: str, parts: tuple[str, ...]) -> Iterator[tuple[str, ast.Module]]:
    """(what was changed, the changed module)."""
    source = (ROOT / file).read_text()
    tree = ast.parse(source)
    for way, node in places(tree, [], parts):
        for new in changes(node):
            changed = copy.deepcopy(tree)
            parent: ast.AST | list[ast.AST] = changed
            for step in way[:-1]:
                parent = parent[step] if isinstance(step, int) else getattr(parent, step)  # type: ignore[index]
            if isinstance(parent, list):
                parent[way[-1]] = new  # type: ignore[index]
            else:
                setattr(parent, str(way[-1]), new)
            ast.fix_missing_locations(changed)
            old_lines, new_lines = ast.unparse(tree).splitlines(), ast.unparse(changed).splitlines()
            line = next((i for i, pair in enumerate(zip(old_lines, new_lines, strict=False)) if pair[0] != pair[1]), None)
            if line is not None:
                yield f"{file}: `{old_lines[line].strip()}` → `{new_lines[line].strip()}`", changed


def killed(module: str, file: str, tree: ast.Module, tests: list[str], cpu_s: int = 600) -> bool:
    """Whether the tests notice, in a process of their own."""
    child = os.fork()
    if not child:
        code = 1
        try:
            resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s))
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
            _replace(module, file, tree)
            code = int(pytest.main(["-x", "-q", "--no-header", "-W", "default", *(str(ROOT / test) for test in tests)]))
        finally:
            os._exit(code)
    return os.waitpid(child, 0)[1] != 0


def _why(what: str) -> str:
    new = what.rpartition(" → ")[2]
    return next((f": equivalent, {why}" for part, why in SAME.items() if part in new), "")


def _replace(name: str, file: str, tree: ast.Module) -> types.ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / file)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    exec(compile(tree, str(ROOT / file), "exec"), module.__dict__)
    return module


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=tuple(TARGETS))
    parser.add_argument("--share", type=float, default=1.0, help="of the mutants, chosen by chance")
    parser.add_argument("--seed", type=int, default=None, help="of that chance; printed, so that the same mutants can be drawn again")
    parser.add_argument("--json", type=Path, help="survivors, as they are found")
    options = parser.parse_args()
    os.chdir(ROOT)
    hypothesis.settings.register_profile("mutation", database=None, derandomize=True, deadline=None)
    hypothesis.settings.load_profile("mutation")
    take_signals()
    seed = random.randrange(2**31) if options.seed is None else options.seed
    print(f"| module, share {options.share:g} drawn with --seed {seed} | mutants | killed | |\n|---|---|---|---|", flush=True)
    survivors, enough = [], True
    for name, (module, file, parts, tests) in TARGETS.items():
        if options.only in (None, name):
            before_s = children_s()
            assert not killed(module, file, ast.parse((ROOT / file).read_text()), tests), "the tests fail on the unchanged module"
            cpu_s = 5 + round(PATIENCE * (children_s() - before_s))
            chance = random.Random(f"{seed} {name}")  # one stream a module: --only draws the same mutants as all modules do
            chosen = [mutant for mutant in mutants(file, parts) if chance.random() < options.share]
            alive = []
            for what, tree in chosen:
                if not killed(module, file, tree, tests, cpu_s):
                    alive.append(what)
                    print(what, file=sys.stderr, flush=True)
            share = 1.0 - len(alive) / max(1, len(chosen))
            by_chance = options.share < 1.0 and binom.sf(len(alive) - 1, len(chosen), 1.0 - ENOUGH) > 0.01
            enough &= share >= ENOUGH or bool(by_chance)
            survivors += alive
            print(f"| {module} | {len(chosen)} | {len(chosen) - len(alive)} | {share:.1%} |", flush=True)
            if options.json:
                options.json.write_text(json.dumps(survivors, indent=1, ensure_ascii=False))
    print("\nSurvivors:\n" + "\n".join(f"- {what}{_why(what)}" for what in survivors))
    sys.exit(0 if enough else 1)


if __name__ == "__main__":
    main()
