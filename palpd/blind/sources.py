"""Where the cases of a check come from: one way to draw a case of any source."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

from palpd.blind.drawn_cases import STRATA, draw_case
from palpd.blind.injected_cells import draw_injected, hosts_in
from palpd.blind.plans import effects_of
from palpd.blind.truth import SOURCES, CannotDraw, CaseSpec, SealedCase, Source
from palpd.errors import BadInput


@dataclass(frozen=True)
class Hosts:
    """Where the injected cases find their recordings; without a folder MuJoCo simulates them."""

    folder: Path | None = None
    causes: Path | None = None


def sources_named(name: str, hosts: Hosts) -> tuple[Source, ...]:
    """The sources of a check.

    Args:
        name: One source, several with commas between them, or `all`.
        hosts: Where the injected cases find their recordings.

    Raises:
        BadInput: There is no such source, or it needs MuJoCo, which is not installed.
    """
    named = set(name.split(","))
    if not named <= {*SOURCES, "all"}:
        raise BadInput(f"--source is {name!r}; expected one of {', '.join((*SOURCES, 'all'))}, or several as in drawn,mujoco")
    chosen = tuple(source for source in SOURCES if named & {source, "all"})
    if hosts.folder is not None and "injected" not in chosen:
        raise BadInput(f"--recordings belongs to --source injected, and --source is {name!r}; leave one of them out")
    if hosts.causes is not None and hosts.folder is None:
        raise BadInput("--causes says what acts in --recordings, which is missing; give both")
    needing = [source for source in chosen if source == "mujoco" or (source == "injected" and hosts.folder is None)]
    if needing and find_spec("mujoco") is None:
        raise BadInput(
            f"--source {needing[0]} needs MuJoCo, which is not installed; install it (pip install mujoco) or give --source drawn"
        )
    return chosen


def draw(spec: CaseSpec, seed: int, hosts: Hosts) -> SealedCase:
    """Draw a case; where nothing can show its effects at any SNR, other effects of its kind take their place.

    Args:
        spec: What the case shall be.
        seed: Seed of the check.
        hosts: Where the injected cases find their recordings.

    Raises:
        CannotDraw: No effect of its kind can be shown.
    """
    for effects in _alternatives(spec):
        with contextlib.suppress(CannotDraw):
            return _draw_from_source(replace(spec, effects=effects), seed, hosts)
    advice = "give longer recordings, or recordings with less noise" if spec.source == "injected" else "give another --seed"
    raise CannotDraw(f"case {spec.index}: no recording of {spec.source} shows any effect; {advice}")


def _draw_from_source(spec: CaseSpec, seed: int, hosts: Hosts) -> SealedCase:
    if spec.source == "mujoco":
        from palpd.blind.mujoco_cells import draw_mujoco

        return draw_mujoco(spec, seed)
    if spec.source == "drawn":
        return _at_or_below(spec, seed)
    return draw_injected(spec, seed, hosts_in(hosts.folder, hosts.causes))


def _at_or_below(spec: CaseSpec, seed: int) -> SealedCase:
    """The case at the wanted SNR, or at the next lower one that a cell shows."""
    strata = list(STRATA)
    for stratum in strata[strata.index(spec.stratum) : 0 : -1]:
        with contextlib.suppress(CannotDraw):
            return draw_case(seed, replace(spec, stratum=stratum))
    return draw_case(seed, replace(spec, stratum=strata[0]))


def _alternatives(spec: CaseSpec) -> Sequence[tuple[str, ...]]:
    """The effects of a case, and others of its kind in turn where no recording can show these."""
    if not spec.effects:
        return [()]
    names = effects_of(spec.source)[spec.kind]
    places = [names.index(effect) for effect in spec.effects]
    return [tuple(names[(place + turn) % len(names)] for place in places) for turn in range(len(names))]
