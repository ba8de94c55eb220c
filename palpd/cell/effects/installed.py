"""Effects that packages register as entry points `palpd.effects`: an Effect, or several of them."""

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from palpd.cell.effects.effect import Effect
from palpd.errors import BadInput
from palpd.plugins import Plugin, loaded, plugins

GROUP = "palpd.effects"
OURS = {site: f"palpd.cell.effects.{site}:EFFECTS" for site in ("motion", "tissue", "probe", "sensor")}
"""The library's modules, as pyproject.toml registers them."""


@cache
def installed_effects() -> tuple[dict[str, Effect], tuple[str, ...]]:
    """Find the effects of all packages.

    Returns:
        The effects by id, and a sentence on each plug-in that is left out: it fails, gives no effects, or an id that another has.
    """
    effects: dict[str, Effect] = {}

    def check(plugin: Plugin, given: Any) -> None:
        several = given.values() if isinstance(given, Mapping) else given if isinstance(given, Iterable) else ()
        listed = [given] if isinstance(given, Effect) else list(several)
        if not listed or not all(isinstance(each, Effect) for each in listed):
            raise BadInput(plugin.failure("it gives no palpd.cell.effects.Effect and no list of them"))
        if taken := [each.id for each in listed if each.id in effects]:
            raise BadInput(plugin.failure(f"there is an effect {taken[0]} already, expected an id of its own"))
        effects.update({each.id: each for each in listed})

    registered = plugins(GROUP, OURS)
    _, failures = loaded(sorted(registered.values(), key=lambda each: each.name not in OURS), check)  # ours first: their ids are taken
    return effects, failures
