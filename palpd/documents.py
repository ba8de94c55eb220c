"""What YAML and JSON files hold: parsed strictly, with the line of each key, and what a model says against it, in a sentence."""

import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

from palpd.errors import BadInput, ConfigError, PalpdError
from palpd.files import MOST_JSON_BYTES, read_text

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError
    from pydantic_core import ErrorDetails


Location = tuple[str | int, ...]


MOST_LEVELS = 32
"""Deepest nesting of YAML and JSON; our own files have 6 levels."""


MOST_NODES = 200_000
"""Most values that a YAML file may stand for with its aliases written out; 256 kB of plain YAML hold fewer."""


MOST_DIGITS = 40
"""Longest whole number; a 64-bit one has 19 digits, and Python refuses more than 4300."""


class Document(NamedTuple):
    """What a YAML file holds, and where: `places` gives a key's place, such as "plan.yaml, line 3", by its path of keys."""

    name: str
    content: Any
    places: Mapping[Location, str] = MappingProxyType({})

    def place(self, location: Location) -> str:
        """Where that key stands, or the nearest block around it that has a place."""
        for length in range(len(location), 0, -1):
            if location[:length] in self.places:
                return self.places[location[:length]]
        return self.name

    def refuse_empty(self) -> None:
        """Refuse a file that holds nothing: it was cut off, or is another one. Raises ConfigError."""
        if self.content is None:
            raise ConfigError(f"{self.name} is empty, expected keys and values; write at least one, such as version: 1")

    def keys_and_values(self) -> dict[str, Any]:
        """The content of a file that must be a mapping; an empty file is an empty one. Raises ConfigError."""
        if self.content is None:
            return {}
        if not isinstance(self.content, dict):
            raise ConfigError(f"{self.name} holds a {type(self.content).__name__}, expected keys and values")
        return self.content


def read_yaml(path: Path, *, error: type[PalpdError] = ConfigError) -> Document:
    """Read a YAML file; a key that stands twice in one block is refused with both line numbers.

    Args:
        error: Class of the refusal.

    Returns:
        Its content, None where the file is empty, with the line of each key.

    Raises:
        PalpdError: Of the class `error`, as `read_text` does, and where the text is not what `parse_yaml` accepts.
    """
    return parse_yaml(read_text(path, error=error), str(path), error=error)


def parse_yaml(text: str, name: str, *, error: type[PalpdError] = ConfigError) -> Document:
    """Parse YAML in which every key stands once and numbers are decimal (1e-3 is a number; 1:30 and 0x1F are text).

    Args:
        text: One YAML document.
        name: What an error calls it.
        error: Class of the refusal.

    Returns:
        Its content with the line of each key.

    Raises:
        PalpdError: Of the class `error`, one sentence with the line.
    """
    try:
        loader = _StrictLoader(text)
        node = loader.get_single_node()
        content = None if node is None else loader.construct_document(node)
    except yaml.MarkedYAMLError as failure:
        mark = failure.problem_mark or failure.context_mark
        line = f", line {mark.line + 1}" if mark else ""
        ours = isinstance(failure, _Refusal)
        what = failure.problem if ours else f"this is not YAML ({failure.problem or failure.context}); correct it"
        raise error(f"{name}{line}: {what}") from failure
    except (yaml.YAMLError, ValueError) as failure:
        raise error(f"{name} is not YAML ({str(failure).splitlines()[0]}); correct it") from failure
    places = {} if node is None else {location: f"{name}, line {line}" for location, line in _lines(node, ())}
    return Document(name, content, places)


def read_json(path: Path, *, most_bytes: int = MOST_JSON_BYTES, error: type[PalpdError] = BadInput) -> Any:
    """Read a JSON file; a key that stands twice in one object is refused.

    Args:
        most_bytes: Largest size in bytes.
        error: Class of the refusal.

    Raises:
        PalpdError: Of the class `error`, as `read_text` does, and where the text is not what `parse_json` accepts.
    """
    return parse_json(read_text(path, most_bytes=most_bytes, error=error), str(path), error=error)


def parse_json(text: str, name: str, *, error: type[PalpdError] = BadInput) -> Any:
    """Parse JSON in which every key stands once.

    Args:
        text: One JSON value.
        name: What an error calls it.
        error: Class of the refusal.

    Raises:
        PalpdError: Of the class `error`, one sentence.
    """
    try:
        content = json.loads(text, object_pairs_hook=_pairs, parse_int=_whole)
        if "\\u" in text:  # else nothing but a plain letter can stand in it
            _refuse_letters(content)
    except json.JSONDecodeError as failure:
        raise error(f"{name}, line {failure.lineno}: this is not JSON ({failure.msg}); correct it") from failure
    except ValueError as failure:
        raise error(f"{name}: {failure}") from failure
    except RecursionError as failure:
        raise error(_too_deep(name)) from failure
    if _deeper_than(content, MOST_LEVELS):
        raise error(_too_deep(name))
    return content


def finite_json(values: Any) -> Any:
    """The same data with null for what JSON has no number for: browsers refuse NaN."""
    if isinstance(values, Mapping):
        return {name: finite_json(value) for name, value in values.items()}
    if isinstance(values, list | tuple):
        return [finite_json(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values


NAME_PATTERN = r"^[A-Za-z0-9_.-]+$"
"""Names that are parts of file names and of columns."""


def refusal(error: "ValidationError", model: "type[BaseModel]", document: Document, hints: Mapping[str, str] | None = None) -> str:
    """Turn the first complaint of pydantic into one sentence: file, line, what was found, what was expected.

    Args:
        error: What validation raised.
        model: Model that the document was validated against.
        document: Names the file and the lines of its keys.
        hints: Questions to ask about a number out of range, by the end of the key that it belongs to; None for none.
    """
    first = error.errors(include_url=False)[0]
    return f"{document.place(first['loc'])}: {_complaint(first, model, hints)}"


def faults(error: "ValidationError", model: "type[BaseModel]", hints: Mapping[str, str] | None = None) -> dict[str, str]:
    """Turn every complaint of pydantic into a sentence without its place.

    Args:
        error: As for `refusal`.
        model: As for `refusal`.
        hints: As for `refusal`.

    Returns:
        The sentences by the path of their key, such as `sites.2.x_m`; the path of what belongs to no key is empty.
    """
    wrong = {".".join(map(str, each["loc"])): _complaint(each, model, hints) for each in error.errors(include_url=False)}
    # a list without what is wrong in it may be too short, which is no fault of its own
    return {path: sentence for path, sentence in wrong.items() if not any(each.startswith(f"{path}.") for each in wrong)}


def _complaint(complaint: "ErrorDetails", model: "type[BaseModel]", hints: Mapping[str, str] | None) -> str:
    location, message = complaint["loc"], complaint["msg"]
    key = ".".join(map(str, location)) or "the file"
    if complaint["type"] == "extra_forbidden":
        known = _fields_at(model, location[:-1])
        return f"there is no key {key!r}{nearest(str(location[-1]), known)}; expected {', '.join(known)}"
    if complaint["type"] == "missing":
        return f"{key} is not given; it has no default"
    if complaint["type"] == "value_error":
        return f"{f'{key}: ' if location else ''}{message.removeprefix('Value error, ')}"
    if complaint["type"] == "string_pattern_mismatch" and complaint["ctx"]["pattern"] == NAME_PATTERN:
        return f"{key} is {_shown(complaint['input'])}; expected letters (a to z), digits, '.', '_' and '-', without a space"
    bounds = ("less_than", "less_than_equal", "greater_than", "greater_than_equal")
    ranged = complaint["type"] in bounds or isinstance(complaint["input"], str)
    hint = next((f" ({hint})" for end, hint in (hints or {}).items() if ranged and key.endswith(end)), "")
    expected = message.replace("Input should be", "expected").replace("a valid ", "a ")
    return f"{key} is {_shown(complaint['input'])}{hint}; {expected[0].lower()}{expected[1:]}"


def nearest(word: str, known: list[str]) -> str:
    """Ask whether a known word was meant: " (did you mean 'x'?)", or nothing where none is like it.

    Args:
        known: What could have been written.

    Returns:
        The question, or an empty text.
    """
    import difflib  # here and not above: only a refusal needs it, and an abort must not wait for it

    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f" (did you mean {close[0]!r}?)" if close else ""


class _Refusal(yaml.MarkedYAMLError):
    """A refusal of ours; its problem is a sentence already."""


class _StrictLoader(yaml.SafeLoader):
    """YAML as our files use it: no duplicate keys, bounded nesting and aliases, numbers in decimal only."""

    yaml_implicit_resolvers = {  # noqa: RUF012 - PyYAML declares it so
        first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith((":int", ":float"))]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._level = 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose the next node, and refuse nesting that is too deep and aliases that stand for too much.

        Args:
            parent: Node around it.
            index: Its key or number there.

        Returns:
            The node.

        Raises:
            yaml.MarkedYAMLError: Where it is refused.
        """
        mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        if self._level >= MOST_LEVELS:
            raise _Refusal(problem=f"blocks are nested deeper than {MOST_LEVELS} levels; write it flatter", problem_mark=mark)
        alias = self.check_event(yaml.AliasEvent)
        self._level += 1
        node = super().compose_node(parent, index)
        self._level -= 1
        if node is None or id(node) in self._sizes:
            return node
        if alias:
            raise _Refusal(problem="an alias stands inside what it names; write the value out", problem_mark=mark)
        children = [child for pair in node.value for child in pair] if isinstance(node, yaml.MappingNode) else node.value
        inner = children if isinstance(node, yaml.CollectionNode) else []
        self._sizes[id(node)] = 1 + sum(self._sizes[id(child)] for child in inner)
        if self._sizes[id(node)] > MOST_NODES:
            raise _Refusal(problem=f"the aliases stand for more than {MOST_NODES} values; write fewer", problem_mark=mark)
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping, and refuse a key that stands in it twice.

        Args:
            deep: Whether what it holds is constructed at once.

        Raises:
            yaml.MarkedYAMLError: Where a key stands twice or is no name.
        """
        lines: dict[Any, int] = {}
        for key_node, _ in node.value:
            merge = key_node.tag == "tag:yaml.org,2002:merge"
            key = "<<" if merge else self.construct_object(key_node, deep=True)
            if not isinstance(key, str | int | float | bool | None):
                raise _Refusal(problem=f"a {type(key).__name__} is no key; expected a name", problem_mark=key_node.start_mark)
            line = key_node.start_mark.line + 1
            if key in lines:
                raise _Refusal(
                    problem=f"the key {str(key)!r} stands here and in line {lines[key]}, expected once; remove one of them",
                    problem_mark=key_node.start_mark,
                )
            lines[key] = line
        return super().construct_mapping(node, deep)


_StrictLoader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(r"^[-+]?[0-9]+$"), list("-+0123456789"))


_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^(?:[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"),
    list("-+0123456789."),
)


def _constructed(read: Callable[[str], object]) -> Callable[[_StrictLoader, yaml.ScalarNode], object]:
    """Construct a scalar by that function, whose ValueError is a refusal at its place."""

    def construct(_: _StrictLoader, node: yaml.ScalarNode) -> object:
        try:
            return read(node.value)
        except ValueError as failure:
            raise _Refusal(problem=str(failure), problem_mark=node.start_mark) from failure

    return construct


def _lines(node: yaml.Node, at: Location) -> Iterator[tuple[Location, int]]:
    """The line of every key and list entry of a node, by its path of keys."""
    if isinstance(node, yaml.MappingNode):
        inner = [(key.value, key, value) for key, value in node.value if isinstance(key, yaml.ScalarNode)]
    elif isinstance(node, yaml.SequenceNode):
        inner = [(number, value, value) for number, value in enumerate(node.value)]
    else:
        return
    for key, where, value in inner:
        yield (*at, key), where.start_mark.line + 1
        yield from _lines(value, (*at, key))


def _pairs(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice!r} stands twice in one object, expected once; remove one of them")
    return content


def _plain(text: str) -> str:
    try:
        os.fsencode(text)  # as Python gives it to the system: a byte of a file name that is not UTF-8 stands for itself
    except UnicodeEncodeError as failure:
        raise ValueError(f"a text holds {text[failure.start]!r}, which no file name can hold; remove it") from failure
    if "\0" in text:
        raise ValueError("a text holds '\\x00', which no file name can hold; remove it")
    return text


def _whole(text: str) -> int:
    if len(text) > MOST_DIGITS:
        raise ValueError(f"a whole number has {len(text)} digits, expected at most {MOST_DIGITS}; correct it")
    return int(text)


_StrictLoader.add_constructor("tag:yaml.org,2002:int", _constructed(_whole))
_StrictLoader.add_constructor("tag:yaml.org,2002:str", _constructed(_plain))


def _too_deep(name: str) -> str:
    return f"{name}: blocks are nested deeper than {MOST_LEVELS} levels; write it flatter"


def _deeper_than(content: object, levels: int) -> bool:
    inner = content.values() if isinstance(content, dict) else content if isinstance(content, list) else ()
    return any(levels <= 1 or _deeper_than(each, levels - 1) for each in inner)


def _refuse_letters(content: object) -> None:
    """Refuse JSON that holds a letter which is none. Raises ValueError."""
    if isinstance(content, str):
        _plain(content)
    for each in (*content, *content.values()) if isinstance(content, dict) else content if isinstance(content, list) else ():
        _refuse_letters(each)


def _shown(value: object) -> str:
    """A value as the file has it, cut short."""
    if isinstance(value, bool):
        return "true" if value else "false"
    import reprlib

    return "null" if value is None else reprlib.repr(value)


def _fields_at(model: Any, location: Location) -> list[str]:
    """The keys that a block may hold, by its place in the file."""
    for part in location:
        inner = getattr(model, "model_fields", {}).get(part)
        if inner is not None:
            model = model_in(inner.annotation) or model
    return list(getattr(model, "model_fields", {}))


def model_in(annotation: Any) -> Any:
    """Find the model that an annotation such as `tuple[Site, ...]` or `Wall | None` speaks of.

    Args:
        annotation: Type of a field.

    Returns:
        The first model in it, or None.
    """
    if hasattr(annotation, "model_fields"):
        return annotation
    return next((model for part in getattr(annotation, "__args__", ()) if (model := model_in(part))), None)
