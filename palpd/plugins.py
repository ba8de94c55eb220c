"""Plug-ins: palpd's own, and objects that other packages register as entry points. One that fails is a sentence with its name.

Groups: `palpd.readers`, `palpd.effects`, `palpd.sensors`, `palpd.robots` (docs/sensors.md, docs/import.md).
"""

from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, NamedTuple

from palpd.errors import BadInput


class Plugin(NamedTuple):
    """A registered object: its name, where it stands ("module:attribute", or a module), and the package that registers it."""

    group: str
    name: str
    place: str
    package: str = "palpd"

    def load(self) -> Any:
        """Import the object. Raises BadInput, one sentence, whatever the plug-in does."""
        module, _, attribute = self.place.partition(":")
        try:
            return getattr(import_module(module), attribute) if attribute else import_module(module)
        except (Exception, SystemExit) as error:  # somebody else's code may fail in any way
            raise BadInput(self.failure(f"{type(error).__name__}: {error}")) from error

    def failure(self, why: str) -> str:
        """Say that it cannot be used.

        Args:
            why: What is wrong with it.
        """
        why = " ".join(why.split())
        return f"plug-in {self.name!r} of {self.group} cannot be used ({self.place}: {why}); repair or uninstall package {self.package}"


def plugins(group: str, ours: Mapping[str, str]) -> dict[str, Plugin]:
    """All plug-ins of a group by their names.

    Args:
        group: Group of entry points.
        ours: The places of palpd's own.

    Returns:
        The plug-ins; nobody replaces one of ours.
    """
    others = (Plugin(group, point.name, point.value, point.dist.name if point.dist else "unknown") for point in entry_points(group=group))
    # versions of palpd before this one registered their own, and an installation may still say so
    foreign = {plugin.name: plugin for plugin in others if plugin.package != "palpd"}
    return foreign | {name: Plugin(group, name, place) for name, place in ours.items()}


def loaded(registered: Iterable[Plugin], check: Callable[[Plugin, Any], Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Load plug-ins, and leave out those that cannot be used.

    Args:
        check: Takes each object in and returns what is kept of it. Raises BadInput where it is not what the group expects.

    Returns:
        What was kept by name, and a sentence on each plug-in that was left out.
    """
    kept: dict[str, Any] = {}
    failures: list[str] = []
    for plugin in registered:
        try:
            kept[plugin.name] = check(plugin, plugin.load())
        except BadInput as error:
            failures.append(str(error))
    return kept, tuple(failures)
