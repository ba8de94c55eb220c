"""Rewriting config.yaml, cell.yaml and plan.yaml of an older palpd: only what has to change is written anew, every other byte stays."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from pydantic import TypeAdapter, ValidationError

from palpd.cell.cell_file import HINTS, CellFile
from palpd.cell.effects.drivers import StrictBlock
from palpd.config import Config, Plan
from palpd.documents import Document, Location, model_in, parse_yaml, refusal
from palpd.errors import ConfigError
from palpd.file_versions import NEWEST_FILE, Kind, renamed_keys
from palpd.files import check_resumed, read_text, write_text

MODELS: dict[Kind, type[StrictBlock]] = {"config": Config, "cell": CellFile, "plan": Plan}


_ANCHOR = re.compile(r"&\S+\s+")


class Change(NamedTuple):
    """One place of a file that is written anew: characters `begin` to `end` become `text`."""

    begin: int
    end: int
    text: str
    sentence: str


class Migration(NamedTuple):
    """A file as it shall be, and what differs from the file as it is."""

    path: Path
    kind: Kind
    before: str
    after: str
    changes: tuple[str, ...]

    @property
    def unchanged(self) -> str:
        """What is said of a file that needs no change."""
        return f"{self.path} is a {self.kind} file of version {NEWEST_FILE}, the newest; there is nothing to change."


def migration_of(path: Path, kind: Kind | None = None) -> Migration:
    """Find what has to change in a file; nothing is written.

    Args:
        path: config.yaml, cell.yaml or plan.yaml.
        kind: Which of them it is; None: as its keys say.

    Returns:
        The file before and after, and a sentence for each change.

    Raises:
        ConfigError: The file cannot be read, or it would still be refused after the changes.
    """
    before = after = read_text(path, error=ConfigError)
    document = parse_yaml(before, str(path))
    kind = kind or _kind_of(document)
    sentences: list[str] = []
    for step in (_names, _numbers):
        nodes = _nodes(yaml.compose(after, yaml.SafeLoader), ())
        by_place = {change.begin: change for change in step(kind, document, nodes, after)}
        changes = [by_place[begin] for begin in sorted(by_place)]  # an alias has the place of what it names, which changes once
        for change in reversed(changes):  # from the end, so that the places before it stay
            after = after[: change.begin] + change.text + after[change.end :]
        sentences += [change.sentence for change in changes]
        document = parse_yaml(after, str(path))
    try:
        MODELS[kind].model_validate(document.keys_and_values())
    except ValidationError as error:
        raise ConfigError(refusal(error, MODELS[kind], document, HINTS)) from None
    return Migration(path, kind, before, after, tuple(sentences))


def write(migration: Migration, old: Path) -> None:
    """Write the file anew and keep it as it was.

    Args:
        migration: What changes.
        old: Where the file as it was is kept; a file of a user that exists there is not overwritten.

    Raises:
        BadInput: One of the two cannot be written; the file is as it was then.
    """
    check_resumed(migration.path)
    write_text(old, migration.before)
    write_text(migration.path, migration.after, own=True)


def with_values(text: str, values: Mapping[tuple[str, str], object]) -> str:
    """Set keys of blocks in a YAML file; every other byte stays, comments too.

    Args:
        values: What each key of a block shall be, as JSON can hold it; a key that is absent is added.
    """
    for (block, key), value in values.items():
        nodes, written = _nodes(yaml.compose(text, yaml.SafeLoader), ()), json.dumps(value, ensure_ascii=False)
        parent = nodes[block,][1] if (block,) in nodes else None
        if (block, key) in nodes:
            node = nodes[block, key][1]
            begin, end = node.start_mark.index, node.end_mark.index
        elif isinstance(parent, yaml.MappingNode) and parent.value and not parent.flow_style:
            first = parent.value[0][0].start_mark
            begin = end = first.index
            written = f"{key}: {written}\n{' ' * first.column}"
        elif isinstance(parent, yaml.MappingNode) and parent.value:
            begin = end = parent.start_mark.index + 1
            written = f"{key}: {written}, "
        else:
            begin = end = len(text)
            written = f"{'' if text.endswith(chr(10)) or not text else chr(10)}{block}:\n  {key}: {written}\n"
        text = text[:begin] + written + text[end:]
    return text


def _kind_of(document: Document) -> Kind:
    """The kind of file that knows most of the keys; of two that know the same, the one in the name. Raises ConfigError where neither is."""
    known = {kind: _known_keys(model, document.keys_and_values()) for kind, model in MODELS.items()}
    kinds = [kind for kind, number in known.items() if number == max(known.values())]
    named = [kind for kind in kinds if kind in Path(document.name).name]
    if len(kinds) > 1 and len(named) != 1:
        raise ConfigError(f"{document.name} could be a {' or a '.join(kinds)} file by its keys; say which with --kind")
    return kinds[0] if len(kinds) == 1 else named[0]


def _known_keys(model: Any, content: Mapping[str, Any]) -> int:
    """The number of keys that a model knows, those of its blocks included."""
    fields = getattr(model, "model_fields", {})
    inner = [(fields[key], value) for key, value in content.items() if key in fields]
    return len(inner) + sum(_known_keys(model_in(field.annotation), value) for field, value in inner if isinstance(value, Mapping))


Nodes = dict[Location, tuple[yaml.Node, yaml.Node]]


def _nodes(node: yaml.Node | None, at: Location) -> Nodes:
    """Key and value of every place in a file; an entry of a list is both."""
    nodes: Nodes = {}
    if isinstance(node, yaml.MappingNode):
        inner: list[tuple[Any, yaml.Node, yaml.Node]] = [(key.value, key, value) for key, value in node.value]
    elif isinstance(node, yaml.SequenceNode):
        inner = [(number, value, value) for number, value in enumerate(node.value)]
    else:
        return nodes
    for name, key, value in inner:
        nodes[(*at, name)] = key, value
        nodes |= _nodes(value, (*at, name))
    return nodes


def _names(kind: Kind, document: Document, nodes: Nodes, _text: str) -> list[Change]:
    """Keys that have another name today."""
    return [
        Change(key.start_mark.index, key.end_mark.index, name, f"{document.place(location)}: {_path(location)} is called {name} now")
        for location, name in renamed_keys(kind, document.content)
        for key, _ in [nodes[location]]
    ]


def _numbers(kind: Kind, document: Document, nodes: Nodes, text: str) -> list[Change]:
    """Texts that stand for numbers. The first palpd took "20" for 20 and 0x14 for 20, as YAML 1.1 does."""
    wrong = []
    try:
        MODELS[kind].model_validate(document.keys_and_values())
    except ValidationError as error:
        wrong = error.errors(include_url=False)
    changes = []
    for each in wrong:
        location = each["loc"]
        if each["type"] not in ("float_type", "int_type") or location not in nodes or not isinstance(each["input"], str | float):
            continue
        _, node = nodes[location]
        begin, end = node.start_mark.index, node.end_mark.index
        if anchor := _ANCHOR.match(text, begin, end):
            begin = anchor.end()
        number = _as_once_read(node, int if each["type"] == "int_type" else float)
        if number is not None:
            sentence = f"{document.place(location)}: {_path(location)} was {text[begin:end]} and is {number}"
            changes.append(Change(begin, end, number, sentence))
    return changes


def _as_once_read(node: yaml.Node, number_type: type[int] | type[float]) -> str | None:
    """The number that the first palpd took a value for, as decimal text; None where it is none."""
    if not isinstance(node, yaml.ScalarNode):
        return None
    value = yaml.SafeLoader("").construct_object(node)
    try:
        number: int | float = TypeAdapter(number_type).validate_python(value)
    except ValidationError:
        return None
    written = parse_yaml(node.value.strip(), "a number").content
    return node.value.strip() if type(written) in (int, number_type) else repr(number)


def _path(location: Location) -> str:
    return ".".join(map(str, location))
