"""The docstring law: what a public function takes, returns and raises stands in its docstring, with units and shapes."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ARRAYS = re.compile(r"\b(Floats|Ints|Bools|NDArray|ndarray)\b")
Function = ast.FunctionDef | ast.AsyncFunctionDef


def public_functions(tree: ast.Module) -> Iterator[Function]:
    """Module-level functions, and methods of public classes, without leading underscore."""
    for node in tree.body:
        if isinstance(node, Function) and not node.name.startswith("_"):
            yield node
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from (child for child in node.body if isinstance(child, Function) and not child.name.startswith("_"))


def decorators(function: Function) -> set[str]:
    """Last part of the name of every decorator."""
    targets = [node.func if isinstance(node, ast.Call) else node for node in function.decorator_list]
    return {target.attr if isinstance(target, ast.Attribute) else getattr(target, "id", "") for target in targets}


def arguments(function: Function) -> list[ast.arg]:
    """All arguments but self and cls."""
    a = function.args
    listed = [*a.posonlyargs, *a.args, *([a.vararg] if a.vararg else []), *a.kwonlyargs, *([a.kwarg] if a.kwarg else [])]
    return [argument for argument in listed if argument.arg not in {"self", "cls"}]


def raises(function: Function) -> bool:
    """Whether the function itself raises a new error on purpose; an assertion or a bare `raise` is none."""
    return any(
        isinstance(node, ast.Raise)
        and isinstance(node.exc, ast.Call)
        and getattr(node.exc.func, "id", "") not in {"AssertionError", "NotImplementedError"}
        for node in ast.walk(function)
    )


def section(text: str, name: str) -> str | None:
    """The indented body of a section of a Google-style docstring; None where there is none."""
    match = re.search(rf"^{name}:\n((?:[ \t]+.*\n?|\n)*)", text, re.MULTILINE)
    return match.group(1) if match else None


def objections(function: Function) -> list[str]:
    """What the docstring lacks."""
    text = ast.get_docstring(function) or ""
    if not text:
        return ["has no docstring"]
    out = []
    first, *rest = text.split("\n")
    if not first.rstrip().endswith((".", "?", ":")) or (rest and rest[0].strip()):
        out.append("its first line is not one sentence, followed by a blank line")
    taken = arguments(function)
    array = any(argument.annotation is not None and ARRAYS.search(ast.unparse(argument.annotation)) for argument in taken)
    if (len(taken) < 2 and not array) or "command" in decorators(function) or "property" in decorators(function):
        return out
    args = section(text, "Args")
    if args is None:
        out.append("has no Args section")
    else:
        described = set(re.findall(r"^\s+\*{0,2}(\w+)(?: \(.*?\))?:", args, re.MULTILINE))
        out += [f"Args lacks `{argument.arg}`" for argument in taken if argument.arg not in described and not argument.arg.startswith("_")]
    returned = ast.unparse(function.returns) if function.returns else "None"
    if returned not in {"None", "NoReturn"} and section(text, "Returns") is None and section(text, "Yields") is None:
        out.append("has no Returns section")
    if raises(function) and section(text, "Raises") is None:
        out.append("has no Raises section")
    return out


def findings() -> list[str]:
    """One line an objection: file, line, function, what is missing."""
    return [
        f"{path.relative_to(ROOT)}:{function.lineno}: {function.name} {objection}"
        for folder in ("palpd", "hw")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for function in public_functions(ast.parse(path.read_text(encoding="utf-8")))
        for objection in objections(function)
    ]


def test_every_public_function_says_what_it_takes_returns_and_raises() -> None:
    assert not findings(), "\n".join(findings())


GOOD = '''
def f(a_m: float, b: Floats) -> float:
    """Say something.

    Args:
        a_m: Height in m.
        b: Forces in N (n,).

    Returns:
        A number.

    Raises:
        ValueError: If not.
    """
    raise ValueError("x")
'''


@pytest.mark.parametrize(
    ("part", "objection"),
    [
        ("    Args:\n        a_m: Height in m.\n        b: Forces in N (n,).\n", "has no Args section"),
        ("        b: Forces in N (n,).\n", "Args lacks `b`"),
        ("    Returns:\n        A number.\n", "has no Returns section"),
        ("    Raises:\n        ValueError: If not.\n", "has no Raises section"),
    ],
)
def test_the_check_sees_what_is_missing(part: str, objection: str) -> None:
    def judged(source: str) -> list[str]:
        return [each for function in public_functions(ast.parse(source)) for each in objections(function)]

    assert judged(GOOD) == []
    assert judged(GOOD.replace(part, "")) == [objection]
