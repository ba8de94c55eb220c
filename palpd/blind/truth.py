"""The sealed truth of a case, the same for every source of cases, and what a case is made of."""

from dataclasses import dataclass
from typing import Any, Literal, NotRequired, TypedDict

from palpd.recording.samples import Samples

CaseKind = Literal["healthy", "library", "foreign", "two", "removed", "novel"]
CASE_KINDS: tuple[CaseKind, ...] = ("healthy", "library", "foreign", "two", "removed", "novel")
"""`library` and `foreign`: one listed effect, with the law of the contract or with another one. `removed`: a listed effect that the
diagnosis is not given. `novel`: an effect outside the list."""

Source = Literal["drawn", "mujoco", "injected"]
SOURCES: tuple[Source, ...] = ("drawn", "mujoco", "injected")


class CannotDraw(Exception):
    """This cell and motion cannot show the wanted effect at the wanted size; draw again."""


class NearestLaw(TypedDict):
    """The listed law nearest to an effect's noise-free change: its parameters, and the SNR of the residual that it leaves."""

    id: str
    parameters: dict[str, float]
    snr_left: float


class SealedEffect(TypedDict):
    """One planted effect. `snr` is None for effects that change scatter and not the mean.

    `nearest` is the effect's own listed law, fitted to the change that another law makes.
    """

    id: str
    law: str
    parameters: dict[str, float]
    snr: float | None
    variance: bool
    snr_per_row_sigma: float | None
    snr_beside_the_other: NotRequired[float]
    nearest: NotRequired[NearestLaw]


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
    """What a case shall be. `extra` cases count in the line of their own class alone."""

    source: Source
    index: int
    kind: CaseKind
    effects: tuple[str, ...]
    stratum: str
    extra: bool = False

    @property
    def name(self) -> str:
        """The name that the files of the case begin with."""
        return f"{self.source}-{self.index:06d}"


@dataclass(frozen=True)
class SealedCase:
    """One case: what the diagnosis may see (`cell`, `samples`, `without`) and what is sealed (`second`, `truth`).

    `cell` holds the keys of cell.yaml. `second` is the true cell on another motion, without noise and rounding; None where the
    recording comes from a cell that can not be moved again.
    """

    cell: dict[str, Any]
    samples: Samples
    without: tuple[str, ...]
    second: Samples | None
    truth: Truth
