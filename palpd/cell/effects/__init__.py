"""The library of effects: what a real cell may do that the nominal one does not.

One module per part of the cell, in the order in which the physics passes them; within a site, effects act in the order of EFFECTS.
"""

import runpy
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from palpd.cell.effects.effect import SITES, DiscrepancyDriver, Effect, Parameter, Scale, Site, Values, of
from palpd.cell.effects.installed import EFFECTS, installed_effects
from palpd.cell.effects.learned import load_learned, save_learned
from palpd.errors import ConfigError
from palpd.files import opened

MOST_BYTES = 1_000_000
"""Largest file of effects; one effect takes some 2 kB of Python."""


def load_effects(path: str | Path | None = None) -> dict[str, Effect]:
    """The library, the effects of installed packages, and those that a user's file lists; one there with an id of these replaces it.

    A Python file lists them as EFFECTS, a YAML file holds learned effects; None: no user's file.

    Raises:
        ConfigError: The file fails, or it lists no effects.
    """
    known = dict(installed_effects()[0])
    if path is None:
        return known
    with opened(Path(path), most_bytes=MOST_BYTES, error=ConfigError):
        pass  # a pipe would be waited for, and a device read for ever
    if Path(path).suffix in (".yaml", ".yml"):
        return known | {learned.id: learned.effect() for learned in load_learned(path)}
    try:
        names: dict[str, Any] = runpy.run_path(str(path))
    except (Exception, SystemExit) as error:  # a user's file may fail in any way
        raise ConfigError(f"{path} could not be read as effects ({type(error).__name__}: {error}); expected a Python file") from error
    given = names.get("EFFECTS")
    listed = list(given.values() if isinstance(given, Mapping) else given) if isinstance(given, Iterable) else []
    if not listed or not all(isinstance(effect, Effect) for effect in listed):
        raise ConfigError(f"{path} defines no EFFECTS; expected a list of palpd.cell.effects.Effect of that name")
    return known | {effect.id: effect for effect in listed}


def user_effects(library: Mapping[str, Effect]) -> list[Effect]:
    """The effects of a library that a user or an installed package has added or replaced."""
    return [effect for name, effect in library.items() if EFFECTS.get(name) is not effect]


__all__ = [
    "EFFECTS",
    "SITES",
    "DiscrepancyDriver",
    "Effect",
    "Parameter",
    "Scale",
    "Site",
    "Values",
    "installed_effects",
    "load_effects",
    "of",
    "save_learned",
    "user_effects",
]
