"""The docstring rule: shapes, the meaning of None and what is raised stand in a docstring, and nothing that name and type say already."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ARRAYS = re.compile(r"\b(Floats|Ints|Bools|NDArray|ndarray)\b")
MAY_BE_NONE = re.compile(r"\bNone\b")
Function = ast.FunctionDef | ast.AsyncFunctionDef
Documented = Function | ast.ClassDef
MEASURE = re.compile(r"\(|\d|None|null|`|%|\bin (?:m|s|N|Hz|Pa|kPa|mm|rad)\b")
"""What makes an entry say more than its words: a shape, a number, a unit, the meaning of None, a name."""
FILLERS = frozenset(
    {
        "a", "all", "an", "and", "are", "as", "by", "each", "for", "from", "in", "is",
        "it", "its", "of", "one", "or", "that", "the", "their", "this", "to", "with", "content",
        "figure", "file", "function", "given", "instance", "list", "made", "mapping", "name", "new", "number", "object",
        "path", "result", "row", "same", "sentence", "sequence", "such", "text", "thing", "value", "what", "which",
        "word",
    }
)  # fmt: skip
"""Words that fit every entry (without a plural s)."""
OTHER_WORDS = {
    "c": ["constant"],
    "config": ["configuration"],
    "fit": ["hypothesi"],
    "path": ["folder"],
    "problem": ["recording"],
    "whitening": ["noise"],
}
"""What names and types of the code are called in prose."""


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
    described = set(re.findall(r"^\s+\*{0,2}(\w+)(?: \(.*?\))?:", section(text, "Args") or "", re.MULTILINE))
    out += [
        f"Args lacks `{argument.arg}`, an array or perhaps None"
        for argument in taken
        if argument.annotation is not None and needs_entry(ast.unparse(argument.annotation))
        if argument.arg not in described and not argument.arg.startswith("_")
    ]
    returned = ast.unparse(function.returns) if function.returns else "None"
    if returned != "None" and needs_entry(returned) and section(text, "Returns") is None and section(text, "Yields") is None:
        out.append("has no Returns section")
    if raises(function) and section(text, "Raises") is None:
        out.append("has no Raises section")
    return out


def needs_entry(annotation: str) -> bool:
    """Whether a type leaves a question open: the shape of an array, or what None means."""
    return bool(ARRAYS.search(annotation) or MAY_BE_NONE.search(annotation))


def words_of(text: str) -> set[str]:
    """The words of a name or a text, in small letters and without a plural s."""
    apart = re.sub(r"([a-z])([A-Z])", r"\1 \2", text).replace("_", " ")
    return {word[:-1] if word.endswith("s") and not word.endswith("ss") else word for word in re.findall("[a-z]+", apart.lower())}


def says_nothing(name: str, annotation: str, text: str) -> bool:
    """Whether an entry only repeats the name and the type of what it describes."""
    if MEASURE.search(text) or needs_entry(annotation):
        return False
    known = words_of(name) | words_of(annotation)
    return words_of(text) <= known | FILLERS | {other for word in known for other in OTHER_WORDS.get(word, [])}


def entries(node: Documented) -> Iterator[tuple[str, str, str]]:
    """Name, type and text of each entry under Args and Attributes, and of what is returned under the function's own name."""
    text = ast.get_docstring(node) or ""
    if isinstance(node, ast.ClassDef):
        types = {
            each.target.id: ast.unparse(each.annotation)
            for each in node.body
            if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
        }
    else:
        types = {each.arg: ast.unparse(each.annotation) if each.annotation else "" for each in arguments(node)}
        if (returned := section(text, "Returns") or section(text, "Yields")) is not None:
            yield node.name, ast.unparse(node.returns) if node.returns else "", returned
    for title in ("Args", "Attributes"):
        for entry in re.split(r"\n(?= {4}\S)", section(text, title) or ""):
            if match := re.match(r"\s+\*{0,2}(\w+)(?: \(.*?\))?:(.*)", entry, re.DOTALL):
                yield match[1], types.get(match[1], ""), match[2]


def empty_entries(tree: ast.Module) -> Iterator[str]:
    """One line an entry that says nothing."""
    for node in ast.walk(tree):
        if isinstance(node, Documented):
            for name, annotation, text in entries(node):
                if says_nothing(name, annotation, text):
                    yield f"{node.name} says nothing by `{name}: {' '.join(text.split())}`; leave it out"


def findings() -> list[str]:
    """One line an objection: file, line, function, what is wrong."""
    out = []
    for path in (path for folder in ("palpd", "hw") for path in sorted((ROOT / folder).rglob("*.py"))):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        out += [
            f"{path.relative_to(ROOT)}:{each.lineno}: {each.name} {fault}" for each in public_functions(tree) for fault in objections(each)
        ]
        out += [f"{path.relative_to(ROOT)}: {fault}" for fault in empty_entries(tree)]
    return out


def test_docstrings_say_what_names_and_types_do_not() -> None:
    assert not findings(), "\n".join(findings())


GOOD = '''
def f(a_m: float, b: Floats) -> Floats:
    """Say something.

    Args:
        a_m: Height in m.
        b: Forces in N (n,).

    Returns:
        Means in N (n,).

    Raises:
        ValueError: If not.
    """
    raise ValueError("x")
'''


@pytest.mark.parametrize(
    ("part", "objection"),
    [
        ("    Args:\n        a_m: Height in m.\n        b: Forces in N (n,).\n", "Args lacks `b`, an array or perhaps None"),
        ("        b: Forces in N (n,).\n", "Args lacks `b`, an array or perhaps None"),
        ("    Returns:\n        Means in N (n,).\n", "has no Returns section"),
        ("    Raises:\n        ValueError: If not.\n", "has no Raises section"),
    ],
)
def test_the_check_sees_what_is_missing(part: str, objection: str) -> None:
    def judged(source: str) -> list[str]:
        return [each for function in public_functions(ast.parse(source)) for each in objections(function)]

    assert judged(GOOD) == []
    assert judged(GOOD.replace(part, "")) == [objection]


@pytest.mark.parametrize(
    ("name", "annotation", "text", "empty"),
    [
        ("cell", "CellFile", "The cell.", True),
        ("problem", "Problem", "The recordings.", True),
        ("read_force", "Wrench", "The wrench.", True),
        ("cell", "CellFile", "Its modulus counts as not known.", False),
        ("cell", "CellFile | None", "The cell.", False),
        ("force_N", "float", "Largest force of the run.", False),
        ("noise", "Whitening", "Noise of 1 s.", False),
    ],
)
def test_an_entry_that_repeats_name_and_type_is_seen(name: str, annotation: str, text: str, empty: bool) -> None:
    assert says_nothing(name, annotation, text) == empty
    docstring = f'"""Say.\n\n    Args:\n        {name}: {text}\n        other_m: Way.\n    """'
    sentence = f"def f({name}: {annotation}, other_m: float) -> None:\n    {docstring}\n"
    assert len(list(empty_entries(ast.parse(sentence)))) == empty
