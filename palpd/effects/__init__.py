"""The library of effects: what a real cell may do that the nominal one does not.

One module per part of the cell, in the order in which the physics passes them; within a site, effects act in the order of EFFECTS.
"""

import runpy
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from palpd.effects import motion, probe, sensor, tissue
from palpd.effects.effect import SITES, Bends, Effect, Parameter, Scale, Site, Values, of
from palpd.errors import ConfigError

EFFECTS: dict[str, Effect] = {effect.id: effect for effect in (*motion.EFFECTS, *tissue.EFFECTS, *probe.EFFECTS, *sensor.EFFECTS)}
"""The effects of this library by id."""


def load_effects(path: str | Path) -> dict[str, Effect]:
    """The library and the effects of a user's own Python file, which lists them as EFFECTS; one of the same id replaces ours."""
    try:
        names: dict[str, Any] = runpy.run_path(str(path))
    except Exception as error:  # a user's file may fail in any way
        raise ConfigError(f"{path} could not be read as effects ({type(error).__name__}: {error}); expected a Python file") from error
    own = names.get("EFFECTS")
    listed = list(own.values() if isinstance(own, Mapping) else own) if isinstance(own, Iterable) else []
    if not listed or not all(isinstance(effect, Effect) for effect in listed):
        raise ConfigError(f"{path} defines no EFFECTS; expected a list of palpd.effects.Effect of that name")
    return EFFECTS | {effect.id: effect for effect in listed}


def own_effects(library: Mapping[str, Effect]) -> list[Effect]:
    """Those of a library that are not ours."""
    return [effect for name, effect in library.items() if EFFECTS.get(name) is not effect]


__all__ = ["EFFECTS", "SITES", "Bends", "Effect", "Parameter", "Scale", "Site", "Values", "load_effects", "of", "own_effects"]
