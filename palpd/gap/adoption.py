"""Learned laws join a user's library: checked, with the listed effects that imitate them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import EFFECTS, Effect, adopted
from palpd.cell.effects.adopted import load_adopted, remove
from palpd.cell.effects.learned import LearnedEffect
from palpd.cell.plausible import ask, doubts
from palpd.cell.simulation import simulate
from palpd.files import check_folder
from palpd.gap.assumptions import ASSUMED
from palpd.gap.similar_effects import similar_effects, standard_heights

__all__ = ["AdoptedEffect", "adopt", "described", "load_adopted", "remove"]


@dataclass(frozen=True)
class AdoptedEffect:
    """A law in a user's library, its file, and whether its confounds were measured here, on the standard motion of a cell."""

    law: LearnedEffect
    path: Path
    measured_here: bool

    @property
    def sentence(self) -> str:
        """The listed effects that imitate the law, in words."""
        motion = "the standard motion of the cell" if self.measured_here else "the motion that it was learned from"
        listed = ", ".join(f"{name} ({cosine:.2f})" for name, cosine in (self.law.confounds or {}).items())
        return f"On {motion} it is imitated by {f'{listed}; 1 is indistinguishable' if listed else 'no listed effect'}."

    def to_json(self) -> dict[str, Any]:
        """The answer of `palpd effects --adopt --json`."""
        return {"adopted": self.law.id, "file": str(self.path), "confounds": self.law.confounds or {}}


def adopt(file: Path, folder: Path, name: str | None, cell: CellFile, accept_implausible: bool = False) -> AdoptedEffect:
    """Adopt the law of a file.

    Args:
        file: File of a single learned effect, such as out.learned.yaml.
        folder: The user's folder of adopted effects.
        name: Its name there; None: the name in the file.
        cell: The cell on whose standard motion its size is judged, and confounds are measured where the diagnosis has not written them.
        accept_implausible: Whether a law of implausible size is adopted.

    Raises:
        ConfigError: The file holds no law, or more than one.
        BadInput: The name is no valid name or taken, the file cannot be written, or the size is implausible and `accept_implausible` is
            false.
    """
    check_folder(folder)
    law = adopted.to_adopt(file, folder, name)
    ask(_size_doubts(law, cell), accept_implausible, "check the units of its values")
    unknown = law.confounds is None
    if unknown:
        similar = similar_effects([effect := law.effect()], cell, EFFECTS | {law.id: effect})
        law = law.model_copy(
            update={"confounds": {one.other: round(one.cosine, 3) for one in similar if one.cosine > ASSUMED.advice.mostly_alike}}
        )
    return AdoptedEffect(law, adopted.adopt(law, folder), unknown)


def _size_doubts(law: LearnedEffect, cell: CellFile) -> list[str]:
    """What is implausible about the size of a law on the standard motion of a cell."""
    t_s, z_cmd_m = standard_heights(cell)
    without = simulate(cell, t_s, z_cmd_m=z_cmd_m)
    beside = simulate(cell.model_copy(update={"learned": (*cell.learned, law)}), t_s, z_cmd_m=z_cmd_m)
    change = {name: float(np.abs(beside[name] - without[name]).max()) for name in ("fx_N", "fy_N", "fz_N", "z_m")}
    return [
        doubt
        for name, size in change.items()
        for doubt in doubts("law height" if name == "z_m" else "law force", size, f"the change of {name} by {law.id}")
    ]


def described(effect: Effect, laws: Mapping[str, LearnedEffect], folder: Path) -> dict[str, Any]:
    """An effect of a library as data: its name, what it does, its formula and parameters, and its file if it is adopted.

    Args:
        laws: The adopted effects of the user, by id.
        folder: Where their files stand.
    """
    file = str(folder / f"{effect.id}.yaml") if effect.id in laws else None
    names = [one.name for one in effect.named_parameters]
    return {"id": effect.id, "what": effect.what, "formula": effect.formula, "parameters": names, "adopted": file}
