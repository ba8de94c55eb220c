"""Blind checks that stand beside another on its page: with a part of the method taken away, or of other sources."""

from collections.abc import Sequence
from pathlib import Path

from palpd.blind.check import ABLATIONS, Ablation, CheckResult
from palpd.blind.figures import load
from palpd.blind.truth import Source
from palpd.errors import BadInput


def ablation_named(name: str | None) -> Ablation | None:
    """The ablation of that name, or None for the whole method. Raises BadInput where there is no such ablation."""
    chosen = next((each for each in ABLATIONS if each == name), None)
    if name is not None and chosen is None:
        raise BadInput(f"--ablation is {name!r}; expected one of {', '.join(ABLATIONS)}")
    return chosen


def load_ablations(paths: Sequence[Path], seed: int) -> list[CheckResult]:
    """Read checks to set beside a check of the whole method.

    Args:
        paths: JSON files of blind checks with --ablation.
        seed: The one that drew the cells of the whole method's check.

    Raises:
        BadInput: Where a check drew other cells, or nothing was taken away in it.
    """
    checks = [load(path) for path in paths]
    for path, check in zip(paths, checks, strict=True):
        if not {"seed", "ablation"} <= check.keys():
            raise BadInput(f"{path} is no result of a blind check; give the JSON of one with --ablation")
        if check["seed"] != seed:
            raise BadInput(f"--compare names a check of seed {check['seed']}, expected {seed}: only the same cells can be compared")
        if check["ablation"] is None:
            raise BadInput("--compare names a check from which nothing was taken away; give the JSON of one with --ablation")
    return checks


def load_other_sources(paths: Sequence[Path], seed: int, sources: Sequence[Source]) -> list[CheckResult]:
    """Read checks of other sources, with other numbers of cells, that shall share the page of a check.

    Args:
        paths: JSON files of blind checks of the whole method.
        seed: Seed of the check whose page it is.

    Raises:
        BadInput: Where a check has another seed, lacks a part of the method, or has a source that is on the page already.
    """
    checks, taken = [load(path) for path in paths], set(sources)
    for path, check in zip(paths, checks, strict=True):
        if check["seed"] != seed or check["ablation"] is not None:
            raise BadInput(f"--others names {path} with seed {check['seed']}, expected a check of the whole method with seed {seed}")
        if both := taken & set(check["sources"]):
            raise BadInput(f"--others names {path} with the source {', '.join(sorted(both))}, which is on the page already; leave one out")
        taken |= set(check["sources"])
    return checks
