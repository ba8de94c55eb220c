"""A user's library: learned effects that were adopted from diagnoses, one file each.

They stand in the folder of PALPD_EFFECTS_DIR, else in palpd/effects of the user's data directory ($XDG_DATA_HOME, or ~/.local/share).
Nothing reads this folder by itself: whoever weighs effects is given it.
"""

import os
import re
from pathlib import Path

from palpd.cell.effects.learned import LearnedEffect, load_learned, save_learned
from palpd.errors import BadInput, ConfigError
from palpd.files import check_folder

FOLDER_VARIABLE = "PALPD_EFFECTS_DIR"
NAME = re.compile(r"learned\.[a-z0-9_]{1,80}")
"""Names of adopted effects: also file names, on file systems that do not distinguish capitals as well."""


def user_folder() -> Path:
    """Where the effects of this user stand; the folder may not exist.

    Raises:
        ConfigError: The user has no home, and no variable names a folder.
    """
    if own := os.environ.get(FOLDER_VARIABLE):
        return Path(own)
    data = Path(os.environ.get("XDG_DATA_HOME", ""))
    try:
        return (data if data.is_absolute() else Path.home() / ".local" / "share") / "palpd" / "effects"
    except RuntimeError:
        raise ConfigError(f"this user has no home folder for adopted effects; give a folder as {FOLDER_VARIABLE}") from None


def load_adopted(folder: Path) -> dict[str, LearnedEffect]:
    """The adopted effects of a folder in the order of their names; none where the folder does not exist.

    Raises:
        ConfigError: A file is no adopted effect, or the folder cannot be read.
    """
    if not folder.exists():
        return {}
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix == ".yaml")
    except OSError as error:
        raise ConfigError(f"{folder} cannot be read as the folder of adopted effects ({error.strerror}); give another one") from error
    out = {}
    for path in files:
        one = only_law(path)
        if one.id != path.stem:
            raise ConfigError(f"{path} holds {one.id}, expected {path.stem} as its name says; rename one of them")
        out[one.id] = one
    return out


def only_law(path: Path) -> LearnedEffect:
    """The law of a file that holds one.

    Raises:
        ConfigError: It holds none, or several.
    """
    first, *others = load_learned(path)
    if others:
        raise ConfigError(f"{path} holds {1 + len(others)} learned effects, expected one; give each a file of its own")
    return first


def to_adopt(file: Path, folder: Path, name: str | None = None) -> LearnedEffect:
    """The law of a file under the name that it would have in a user's library, checked.

    Args:
        file: File of a learned effect.
        folder: Folder of adopted effects.
        name: Its name; the one in the file where not given.

    Raises:
        ConfigError: The file holds no law, or more than one.
        BadInput: The name is none, or it is taken.
    """
    law = only_law(file)
    name = name if name is not None else law.id
    if not NAME.fullmatch(name):
        raise BadInput(f"an adopted effect cannot be called {name!r}, expected learned. and small letters, digits or _; give --name")
    if _file_of(name, folder).exists():
        raise BadInput(f"{name} is adopted already ({_file_of(name, folder)}); give another --name, or remove it first")
    return law.model_copy(update={"id": name})


def adopt(law: LearnedEffect, folder: Path) -> Path:
    """Write a law into a user's library; the file appears whole or not at all.

    Args:
        law: The law, under its new name.
        folder: Folder of adopted effects; it is made where it does not exist.

    Raises:
        BadInput: The name is taken, or nothing can be written there.
    """
    check_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = _file_of(law.id, folder)
    if path.exists():  # adopted meanwhile
        raise BadInput(f"{path} exists and is not replaced; give another --name, or remove it first")
    save_learned(path, [law])
    return path


def remove(name: str, folder: Path) -> Path:
    """Take an adopted effect out of a user's library.

    Returns:
        The file that is gone.

    Raises:
        BadInput: It is not adopted, or the file cannot be removed.
    """
    path = _file_of(name, folder)
    if not NAME.fullmatch(name) or not path.exists():
        there = sorted(one.stem for one in folder.glob("*.yaml"))
        raise BadInput(f"{name!r} is not adopted, expected one of {', '.join(there) or 'none'} in {folder}")
    try:
        path.unlink()
    except OSError as error:
        raise BadInput(f"{path} cannot be removed ({error.strerror}); remove it by hand") from error
    return path


def _file_of(name: str, folder: Path) -> Path:
    return folder / f"{name}.yaml"
