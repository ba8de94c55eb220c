"""Learned laws join a user's library: checked, with the listed effects that imitate them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import EFFECTS, Effect, adopted
from palpd.cell.effects.adopted import load_adopted, remove
from palpd.cell.effects.learned import LearnedEffect
from palpd.files import check_folder
from palpd.gap.similar_effects import MOSTLY_ALIKE, similar_effects

__all__ = ["AdoptedEffect", "adopt", "described", "load_adopted", "remove"]


@dataclass(frozen=True)
class AdoptedEffect:
    """A law in a user's library, its file, and whether its confounds were measured here, on the standard motion of a cell."""

    law: LearnedEffect
    path: Path
    measured_here: bool

    @property
    def sentence(self) -> str:
        """What imitates it, in words."""
        motion = "the standard motion of the cell" if self.measured_here else "the motion that it was learned from"
        listed = ", ".join(f"{name} ({cosine:.2f})" for name, cosine in (self.law.confounds or {}).items())
        return f"On {motion} it is imitated by {f'{listed}; 1 is indistinguishable' if listed else 'no listed effect'}."

    def to_json(self) -> dict[str, Any]:
        """For --json."""
        return {"adopted": self.law.id, "file": str(self.path), "confounds": self.law.confounds or {}}


def adopt(file: Path, folder: Path, name: str | None, cell: CellFile) -> AdoptedEffect:
    """Adopt the law of a file.

    Args:
        file: File of one learned effect, such as out.learned.yaml.
        folder: The user's folder of adopted effects.
        name: Its name there; the one in the file where not given.
        cell: The cell on whose standard motion confounds are measured, where the diagnosis has not written them.

    Returns:
        What was adopted.

    Raises:
        ConfigError: The file holds no law, or more than one.
        BadInput: The name is none or taken, or the file cannot be written.
    """
    check_folder(folder)
    law = adopted.to_adopt(file, folder, name)
    unknown = law.confounds is None
    if unknown:
        similar = similar_effects([effect := law.effect()], cell, EFFECTS | {law.id: effect})
        law = law.model_copy(update={"confounds": {one.other: round(one.cosine, 3) for one in similar if one.cosine > MOSTLY_ALIKE}})
    return AdoptedEffect(law, adopted.adopt(law, folder), unknown)


def described(effect: Effect, laws: Mapping[str, LearnedEffect], folder: Path) -> dict[str, Any]:
    """An effect of a library as data: its name, what it does, its formula and parameters, and where it is adopted.

    Args:
        effect: The effect.
        laws: The adopted effects of the user.
        folder: Their folder.

    Returns:
        The data.
    """
    file = str(folder / f"{effect.id}.yaml") if effect.id in laws else None
    names = [one.name for one in effect.named_parameters]
    return {"id": effect.id, "what": effect.what, "formula": effect.formula, "parameters": names, "adopted": file}
