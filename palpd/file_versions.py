"""The versions of config.yaml, cell.yaml and plan.yaml, and of recordings: what this palpd reads, and which keys had other names.

A file without `version` has version 1. A version grows when a key is renamed or changes its meaning; a key more is no new version.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

from palpd.documents import Document, Location
from palpd.errors import ConfigError

Kind = Literal["config", "cell", "plan"]

NEWEST_FILE = 1
"""Newest version of config.yaml, cell.yaml and plan.yaml."""
NEWEST_RECORDING = 1
"""Newest version of an MCAP recording: names and meaning of its header, its footer and its ticks."""
RENAMED: Mapping[Kind, Mapping[str, str]] = MappingProxyType({"config": {}, "cell": {}, "plan": {}})
"""New names of renamed keys, by their old path without the numbers of lists ("sites.x_m"). No key has been renamed so far."""


def newer(version: int, newest: int, what: str) -> str | None:
    """Say that something is newer than this palpd.

    Args:
        newest: The newest version that this palpd reads.
        what: What it is, such as "the file".

    Returns:
        The sentence, or None where this palpd reads it.
    """
    if version <= newest:
        return None
    return f"{what} has version {version}, and this palpd reads versions up to {newest}; install a newer palpd"


def renamed_keys(kind: Kind, content: object, at: Location = ()) -> list[tuple[Location, str]]:
    """Find the keys of a file that have another name today.

    Args:
        at: Where that stands in the file.

    Returns:
        The place of each such key, and its name today.
    """
    if not RENAMED[kind]:
        return []
    renamed: list[tuple[Location, str]] = []
    if isinstance(content, Mapping):
        for key, value in content.items():
            path = ".".join(str(part) for part in (*at, key) if not isinstance(part, int))
            if path in RENAMED[kind]:
                renamed.append(((*at, key), RENAMED[kind][path]))
            renamed += renamed_keys(kind, value, (*at, key))
    elif isinstance(content, list):
        for number, value in enumerate(content):
            renamed += renamed_keys(kind, value, (*at, number))
    return renamed


def refuse_renamed(kind: Kind, document: Document) -> None:
    """Refuse a file with a key that has another name today, and name the command that rewrites it.

    Args:
        document: What it holds, and the lines of its keys.

    Raises:
        ConfigError: There is such a key.
    """
    for location, name in renamed_keys(kind, document.content)[:1]:
        raise ConfigError(
            f"{document.place(location)}: {'.'.join(map(str, location))} is called {name} today; "
            f"palpd migrate {document.name} rewrites the file"
        )
