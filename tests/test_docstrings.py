"""The docstring rule: a docstring says what name and type leave open, and nothing that they or its sentence say already.

ruff asks for the docstring of every public module, class and function, and for a sentence as its first line.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.test_units import DIMENSIONLESS, SUFFIX

ROOT = Path(__file__).parents[1]
ARRAYS = re.compile(r"\b(Floats|Ints|Bools|NDArray|ndarray)\b")
SHAPE = re.compile(r"\(|\bshape|\bfields of\b")
MEANING_OF_NONE = re.compile(
    r"\bNone\b|`|\b(without|unless|if|where|else|default|when|otherwise|instead|place of|nothing)\b", re.IGNORECASE
)
"""How a text says when a value is None; a name in backquotes sends the reader to a place that says it."""
Function = ast.FunctionDef | ast.AsyncFunctionDef
Documented = Function | ast.ClassDef
UNIT = re.compile(r"\b(?:in )?(?:m/s²?|m|s|N|Hz|Pa|kPa|mm|rad)\b")
"""A unit in an entry; where the name carries a unit, it says nothing more."""
MEASURE = re.compile(r"\(|\d|None|null|`|\"|%|\b(?:each|not|without)\b|\bin (?:m|s|N|Hz|Pa|kPa|mm|rad)\b")
"""What makes an entry say more than its words: a shape, a number, a unit, the meaning of None, a name, an example."""
FILLERS = frozenset(
    {
        "a", "all", "an", "and", "are", "as", "by", "for", "from", "in", "is",
        "it", "its", "of", "or", "that", "the", "their", "this", "to", "with", "content",
        "figure", "file", "function", "given", "instance", "list", "made", "mapping", "name", "new", "number", "object",
        "path", "result", "row", "sentence", "sequence", "such", "text", "thing", "value", "what", "which",
        "word", "say", "show", "hold", "read", "write", "written", "cause", "chance", "source", "these", "where", "how",
    }
)  # fmt: skip
"""Words that fit every entry (without a plural s)."""
OTHER_WORDS = {
    "analysi": ["moduli"],
    "c": ["constant"],
    "config": ["configuration"],
    "detectability": ["cell", "motion"],
    "drawing": ["drawn"],
    "fit": ["hypothesi"],
    "library": ["effect", "id"],
    "page": ["route", "share"],
    "path": ["folder"],
    "planted": ["law", "parameter"],
    "problem": ["recording"],
    "rng": ["draw"],
    "survey": ["press", "presse"],
    "step": ["sampling"],
    "stated": ["nominal"],
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


SECTIONS = re.compile(r"^(?:Args|Returns|Yields|Raises|Attributes):$", re.MULTILINE)


def section(text: str, name: str) -> str | None:
    """The indented body of a section of a Google-style docstring; None where there is none."""
    match = re.search(rf"^{name}:\n((?:[ \t]+.*\n?|\n)*)", text, re.MULTILINE)
    return match.group(1) if match else None


class Entry(NamedTuple):
    """What a docstring says of one argument, one attribute, or what is returned (under the function's own name).

    Attributes:
        annotation: "" where the code has none.
        text: "" where the docstring has no such entry.
        above: Name and sentences of the function or class.
    """

    name: str
    annotation: str
    text: str
    above: str


def entries(node: Documented) -> Iterator[Entry]:
    """All arguments or fields and what is returned, each with what the docstring says of it."""
    text = ast.get_docstring(node) or ""
    above = f"{node.name} {re.split(SECTIONS, text, maxsplit=1)[0]}"
    if isinstance(node, ast.ClassDef):
        types = {
            each.target.id: ast.unparse(each.annotation)
            for each in node.body
            if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
        }
    else:
        types = {each.arg: ast.unparse(each.annotation) if each.annotation else "" for each in arguments(node)}
        returned = section(text, "Returns") or section(text, "Yields") or ""
        yield Entry(node.name, ast.unparse(node.returns) if node.returns else "", returned, above)
    texts = {}
    for title in ("Args", "Attributes"):
        for entry in re.split(r"\n(?= {4}\S)", section(text, title) or ""):
            if match := re.match(r"\s+\*{0,2}(\w+)(?: \(.*?\))?:(.*)", entry, re.DOTALL):
                texts[match[1]] = match[2]
    for name in types | texts:
        yield Entry(name, types.get(name, ""), texts.get(name, ""), above)


def may_be_none(annotation: str) -> bool:
    """Whether a union with None stands in a type; a callable that returns None, or an Iterator[None], is no such union."""
    unions = (node for node in ast.walk(ast.parse(annotation.strip("'\""))) if isinstance(node, ast.BinOp))
    return any(isinstance(side, ast.Constant) and side.value is None for union in unions for side in (union.left, union.right))


def is_array(annotation: str) -> bool:
    """Whether a type holds arrays, whose shape it does not say."""
    return bool(ARRAYS.search(annotation)) and "Callable" not in annotation


def left_open(name: str, annotation: str, text: str, above: str = "") -> str:
    """What name, type, entry and the sentences above it leave open; "" where nothing is."""
    if is_array(annotation) and not SHAPE.search(text):
        return "the shape"
    if may_be_none(annotation) and not MEANING_OF_NONE.search(text) and "None" not in above:
        return "what None means"
    if annotation.removesuffix(" | None") == "float" and not (text or SUFFIX.search(name) or name in DIMENSIONLESS):
        return "the unit"
    return ""


def compared_with(function: Function, name: str) -> set[str]:
    """The strings with which a function compares an argument for equality."""
    compared = [
        node.comparators[0]
        for node in ast.walk(function)
        if isinstance(node, ast.Compare) and getattr(node.left, "id", "") == name and isinstance(node.ops[0], ast.Eq | ast.In)
    ]
    constants = (each for one in compared for each in ast.walk(one) if isinstance(each, ast.Constant))
    return {each.value for each in constants if isinstance(each.value, str)}


def objections(function: Function) -> list[str]:
    """What the docstring of a public function lacks."""
    text = ast.get_docstring(function) or ""
    if not text:
        return ["has no docstring"]
    out = []
    first, *rest = text.split("\n")
    if not first.rstrip().endswith((".", "?", ":")) or (rest and rest[0].strip()):
        out.append("its first line is not one sentence, followed by a blank line")
    if "command" in decorators(function) or "property" in decorators(function):
        return out
    alone = len(arguments(function)) < 2
    for number, entry in enumerate(entries(function)):
        returned = number == 0  # an argument may have the name of the function
        if entry.name.startswith("_") or (
            returned and entry.annotation == "float"
        ):  # the sentence says what is returned, often with its unit
            continue
        documented = entry.text or (entry.above if alone or returned else "")
        if missing := left_open(entry.name, entry.annotation, documented):
            out.append(f"leaves open {missing} of {'what it returns' if returned else f'`{entry.name}`'}")
        values = compared_with(function, entry.name) if entry.annotation.removesuffix(" | None") == "str" else set()
        if len(values) > 1 and not any(value in documented for value in values):
            out.append(f"leaves open that `{entry.name}` is one of {sorted(values)}")
    if (
        (not alone or any(is_array(entry.annotation) for entry in entries(function) if entry.name != function.name))
        and raises(function)
        and section(text, "Raises") is None
    ):
        out.append("has no Raises section")
    return out


def words_of(text: str) -> set[str]:
    """The words of a name or a text, in small letters and without a plural s or a possessive."""
    apart = re.sub(r"([a-z])([A-Z])", r"\1 \2", re.sub(r"['’]s\b", "", text)).replace("_", " ")
    return {word[:-1] if word.endswith("s") and not word.endswith("ss") else word for word in re.findall("[a-z]+", apart.lower())}


def says_nothing(entry: Entry) -> bool:
    """Whether an entry only repeats the name, the type or the sentences above it."""
    text = UNIT.sub("", entry.text) if SUFFIX.search(entry.name) else entry.text
    says_keys = re.search(r"Mapping|dict", entry.annotation) and re.search(r"\bby\b", text)
    if not text.strip() or MEASURE.search(text) or says_keys or is_array(entry.annotation) or may_be_none(entry.annotation):
        return False
    known = words_of(f"{entry.name} {entry.annotation} {entry.above}")
    return words_of(text) <= known | FILLERS | {other for word in known for other in OTHER_WORDS.get(word, [])}


def empty_entries(tree: ast.Module) -> Iterator[str]:
    """One line for each entry that says nothing."""
    for node in ast.walk(tree):
        if isinstance(node, Documented):
            for entry in entries(node):
                if says_nothing(entry):
                    yield f"{node.name} says nothing by `{entry.name}: {' '.join(entry.text.split())}`; leave it out"


def open_attributes(tree: ast.Module) -> Iterator[str]:
    """One line for each entry of a class that does not say the shape or the meaning of None."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            for entry in entries(node):
                if entry.text and (missing := left_open(*entry)):
                    yield f"{node.name} leaves open {missing} of `{entry.name}`"


def findings() -> list[str]:
    """One line an objection: file, line, function, what is wrong."""
    out = []
    for path in (path for folder in ("palpd", "hw") for path in sorted((ROOT / folder).rglob("*.py"))):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        place = path.relative_to(ROOT)
        out += [f"{place}:{each.lineno}: {each.name} {fault}" for each in public_functions(tree) for fault in objections(each)]
        out += [f"{place}: {fault}" for fault in (*open_attributes(tree), *empty_entries(tree))]
    return out


def test_docstrings_say_what_names_and_types_do_not() -> None:
    assert not findings(), "\n".join(findings())


GOOD = '''
def f(a: float, b: Floats, c: int | None, d: str, e_m: float) -> Floats:
    """Say something.

    Args:
        a: Ratio of two forces.
        b: Forces in N (n,).
        c: Number of threads; None: one for each core.
        d: `mean` or `median`.

    Returns:
        Means in N (n,).

    Raises:
        ValueError: If not.
    """
    if d == "mean" or d == "median":
        raise ValueError("x")
'''


@pytest.mark.parametrize(
    ("part", "replaced", "objection"),
    [
        ("        a: Ratio of two forces.\n", "", "leaves open the unit of `a`"),
        ("        b: Forces in N (n,).\n", "", "leaves open the shape of `b`"),
        ("Forces in N (n,)", "Forces in N", "leaves open the shape of `b`"),
        ("; None: one for each core", "", "leaves open what None means of `c`"),
        ("        d: `mean` or `median`.\n", "        d: How to do it.\n", "leaves open that `d` is one of ['mean', 'median']"),
        ("    Returns:\n        Means in N (n,).\n", "", "leaves open the shape of what it returns"),
        ("    Raises:\n        ValueError: If not.\n", "", "has no Raises section"),
        ("Say something.", "Say something", "its first line is not one sentence, followed by a blank line"),
    ],
)
def test_the_check_sees_what_is_missing(part: str, replaced: str, objection: str) -> None:
    def judged(source: str) -> list[str]:
        return [each for function in public_functions(ast.parse(source)) for each in objections(function)]

    assert judged(GOOD) == []
    assert judged(GOOD.replace(part, replaced, 1)) == [objection]


def test_an_argument_with_the_name_of_its_function_is_no_result() -> None:
    source = 'def heights(heights: str, n: int) -> Floats:\n    """Read heights.\n\n    Returns:\n        Heights (n,).\n    """\n'
    assert [objections(function) for function in public_functions(ast.parse(source))] == [[]]


@pytest.mark.parametrize(
    ("name", "annotation", "text", "above", "open_"),
    [
        ("cell", "Cell", "", "", ""),
        ("t", "Floats", "Times (n,).", "", ""),
        ("t", "Floats", "Times.", "", "the shape"),
        ("smooth", "Callable[[Floats], Floats]", "", "", ""),
        ("site", "str | None", "A site, or None for all.", "", ""),
        ("site", "str | None", "A site.", "None for what there is not.", ""),
        ("site", "'str | None'", "A site.", "", "what None means"),
        ("say", "Callable[[str], None]", "", "", ""),
        ("force_N", "float", "", "", ""),
        ("damping_ratio", "float", "", "", ""),
        ("force", "float", "", "", "the unit"),
    ],
)
def test_what_name_and_type_leave_open_is_seen(name: str, annotation: str, text: str, above: str, open_: str) -> None:
    assert left_open(name, annotation, text, above) == open_


def test_an_attribute_without_the_meaning_of_none_is_seen() -> None:
    sentence = 'class Run:\n    """A run.\n\n    Attributes:\n        site: Its site.\n    """\n\n    site: str | None\n'
    assert list(open_attributes(ast.parse(sentence))) == ["Run leaves open what None means of `site`"]
    assert not list(open_attributes(ast.parse(sentence.replace("site.", "site; None: all."))))


@pytest.mark.parametrize(
    ("name", "annotation", "text", "above", "empty"),
    [
        ("cell", "CellFile", "The cell.", "", True),
        ("problem", "Problem", "The recordings.", "", True),
        ("read_force", "Wrench", "The wrench.", "", True),
        ("youngs_modulus_Pa", "float", "Young's modulus in Pa.", "", True),
        ("path", "Path", "File to write.", "write_card Write the card.", True),
        ("index", "int", "Number of the host.", "Simulate a host.", True),
        ("index", "int", "Number of the host.", "Simulate a cell.", False),
        ("cell", "CellFile", "Its modulus counts as not known.", "", False),
        ("cell", "CellFile | None", "The cell.", "", False),
        ("force_N", "float", "Largest force of the run.", "", False),
        ("noise", "Whitening", "Noise of 1 s.", "", False),
        ("forces", "dict[str, float]", "Forces by name.", "", False),
        ("free", "Motion", "Motion without the probe.", "Judge motion with and without the probe.", False),
    ],
)
def test_an_entry_that_repeats_name_type_and_sentence_is_seen(name: str, annotation: str, text: str, above: str, empty: bool) -> None:
    assert says_nothing(Entry(name, annotation, text, above)) == empty


def test_entries_are_found_in_the_docstrings_of_functions_and_classes() -> None:
    def source(text: str) -> str:
        return (
            f'def found(cell: Cell) -> Site:\n    """Say.\n\n    Args:\n        cell: {text}\n\n    Returns:\n        {text}\n    """\n'
            f'class Site:\n    """A place.\n\n    Attributes:\n        cell: {text}\n    """\n\n    cell: Cell\n'
        )

    assert len(list(empty_entries(ast.parse(source("The found cell."))))) == 1
    assert len(list(empty_entries(ast.parse(source("The cell."))))) == 2
    assert len(list(empty_entries(ast.parse(source("The site."))))) == 2
    assert not list(empty_entries(ast.parse(source("Where the probe presses."))))
