"""The effects of this library, and those that packages register as entry points `palpd.effects`: an Effect, or several of them."""

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from palpd.cell.effects import motion, probe, sensor, tissue
from palpd.cell.effects.effect import Effect
from palpd.errors import BadInput
from palpd.plugins import Plugin, loaded, plugins

GROUP = "palpd.effects"
EFFECTS: dict[str, Effect] = {effect.id: effect for effect in (*motion.EFFECTS, *tissue.EFFECTS, *probe.EFFECTS, *sensor.EFFECTS)}
"""The effects of this library by id."""


@cache
def installed_effects() -> tuple[dict[str, Effect], tuple[str, ...]]:
    """Find the effects of all packages.

    Returns:
        This library and the effects of other packages, and a sentence on each plug-in that is left out: it fails, gives no effects, or an
        id that another has.
    """
    effects = dict(EFFECTS)

    def check(plugin: Plugin, given: Any) -> None:
        several = given.values() if isinstance(given, Mapping) else given if isinstance(given, Iterable) else ()
        listed = [given] if isinstance(given, Effect) else list(several)
        if not listed or not all(isinstance(each, Effect) for each in listed):
            raise BadInput(plugin.failure("it gives no palpd.cell.effects.Effect and no list of them"))
        if taken := [each.id for each in listed if each.id in effects]:
            raise BadInput(plugin.failure(f"there is an effect {taken[0]} already, expected an id of its own"))
        effects.update({each.id: each for each in listed})

    return effects, loaded(plugins(GROUP, {}).values(), check)[1]
