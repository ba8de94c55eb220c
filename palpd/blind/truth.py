"""The sealed truth of a case, the same for every source of cases, and what a case is made of."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal, NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

from palpd.recording.samples import Samples

CaseKind = Literal["healthy", "library", "foreign", "two", "removed", "novel"]
CASE_KINDS: tuple[CaseKind, ...] = ("healthy", "library", "foreign", "two", "removed", "novel")
"""`library` and `foreign`: one listed effect, with the law of docs/reference/contract.md §6 or with another one. `removed`: a listed effect
that the diagnosis is not given. `novel`: an effect outside the list."""

Source = Literal["drawn", "mujoco", "injected"]
SOURCES: tuple[Source, ...] = ("drawn", "mujoco", "injected")


class CannotDraw(Exception):
    """This cell and motion cannot show the wanted effect at the wanted size; draw again."""


class NearestLaw(TypedDict):
    """The listed law nearest to an effect's noise-free change: its parameters, and the SNR of the residual that it leaves."""

    id: str
    parameters: dict[str, float]
    snr_left: float


class LawName(TypedDict):
    """One right name of a law: its channel (`lateral`: a force to the side), what its curve is multiplied with, and its driver.

    The driver is a quantity with its memory (`relaxed`, `play`, `stop`, `slew`), the constant of that, and its period; None: without.
    """

    channel: str
    factor: str
    quantity: str
    memory: str | None
    constant: float | None
    period: float | None


class LawStatement(TypedDict):
    """What an effect outside the list is, so that a learned law can be judged.

    `law`: it is factor × curve(driver) under each of its names, which say the same on one tissue. `near`: no such form exists, and the
    names are those of its parts. `event`: it happens at some times or wanders, and every law is wrong.
    """

    kind: Literal["law", "near", "event"]
    names: list[LawName]


EVENT = LawStatement(kind="event", names=[])
"""What no law describes."""
DEEP = ("depth", "force", "gap")
"""Quantities that are functions of each other while one tissue is pressed."""
HIGH = ("height", "gap")
"""Quantities that differ by the height of the surface."""


def names(
    channel: str,
    factors: Sequence[str],
    quantities: Sequence[str],
    *,
    memory: str | None = None,
    constant: float | None = None,
    period: float | None = None,
) -> list[LawName]:
    """Right names of a law: every factor with every quantity.

    Args:
        quantities: Quantities of the driver.
        memory: Memory of the driver; None: without.
        constant: Constant of the memory, in SI units; None: any.
        period: Period of the curve, in the unit of the driver; None: without.
    """
    each = product(factors, quantities)
    return [LawName(channel=channel, factor=f, quantity=q, memory=memory, constant=constant, period=period) for f, q in each]


def pressing_names() -> list[LawName]:
    """Names of a force that only depends on how deep the probe presses."""
    return names("fz_N", ("one", "force", "surface"), DEEP) + names("fz_N", ("force", "surface"), ("height",))


def is_law(*each: list[LawName]) -> LawStatement:
    """The statement of an effect that is a law, under each of these names."""
    return {"kind": "law", "names": [name for some in each for name in some]}


def is_near(*each: list[LawName]) -> LawStatement:
    """The statement of an effect that is near laws of these names."""
    return {"kind": "near", "names": [name for some in each for name in some]}


class SealedEffect(TypedDict):
    """One planted effect. `snr` is None for effects that change scatter and not the mean.

    `nearest` is the effect's own listed law, fitted to the change that another law makes. `statement` says what an effect outside the
    list is.
    """

    id: str
    law: str
    parameters: dict[str, float]
    snr: float | None
    variance: bool
    snr_per_row_sigma: float | None
    snr_beside_the_other: NotRequired[float]
    nearest: NotRequired[NearestLaw]
    statement: NotRequired[LawStatement]


class SecondMotion(TypedDict):
    """Rms by channel on another motion: what tolerances leave there, what the effects change, the noise of one row."""

    floor: dict[str, float]
    change: dict[str, float]
    sigma: dict[str, float]


class Truth(TypedDict):
    """The sealed truth of a case, written as JSON.

    `host_causes` are listed effects that the recording had before anything was planted. `sizes` is by channel and phase. `mimic` is the
    nearest listed law of an effect that the diagnosis is not given. `about` holds what is particular to a source.
    """

    source: Source
    kind: CaseKind
    effects: list[SealedEffect]
    host_causes: list[str]
    without: list[str]
    size: float
    sizes: dict[str, dict[str, float]]
    rate_Hz: float
    robot_rate_Hz: float
    rows: int
    duration_s: float
    mimic: NearestLaw | None
    second: SecondMotion | None
    about: dict[str, Any]


@dataclass(frozen=True)
class CaseSpec:
    """What a case shall be. `extra` cases count in the line of their own class alone.

    `steps_over_noise` are coarse steps of the lateral forces, of fz and of the torques, over the stated noise; None: those of the source.
    """

    source: Source
    index: int
    kind: CaseKind
    effects: tuple[str, ...]
    stratum: str
    extra: bool = False
    steps_over_noise: tuple[float, float, float] | None = None

    @property
    def name(self) -> str:
        """The name that the files of the case begin with."""
        return f"{self.source}-{self.index:06d}"


@dataclass(frozen=True)
class TrueChange:
    """What the planted effects change row by row: (m, 7), the height and the wrench, on the noise-free motion of the recording."""

    motion: Samples
    change: NDArray[np.float64]


@dataclass(frozen=True)
class SealedCase:
    """One case: what the diagnosis may see (`cell`, `samples`, `without`) and what is sealed (`second`, `truth`, `true_change`).

    `cell` holds the keys of cell.yaml. `second` is the true cell on another motion, without noise and rounding; None where the
    recording comes from a cell that can not be moved again. `true_change` is None where no law outside the list is planted.
    """

    cell: dict[str, Any]
    samples: Samples
    without: tuple[str, ...]
    second: Samples | None
    truth: Truth
    true_change: TrueChange | None = None
