"""The second channel of a run: its tared wrench with one effect of a sensor planted into it, which a diagnosis alone reads.

The recorder makes it, behind the loop and in a process of its own. The loop, its guard, search, tare and running zero never see it. The
laws are written apart from those of the cell, so a diagnosis does not meet its own formulas. Each works frame by frame on what has come:

| effect | parameters | law |
|---|---|---|
| sensor.gain | error | fz · (1 + error) |
| sensor.bias | offset_N | fz + offset, from the end of the tare |
| sensor.drift | rate_N_per_s | fz + rate · time since the end of the tare |
| sensor.latency | delay_s | the frame that came nearest to this time ago |
| sensor.filter | cutoff_Hz | one pole on each axis |
| sensor.hysteresis | amplitude_N, width_N | fz + amplitude · mean of three friction elements, slipping after half, once, twice the width |
"""

import hashlib
import json
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpd.tick import Floats, Phase

Parameters = Mapping[str, float]

DRIVE_TAU_S = 0.02
"""Time constant that smooths the drive of the hysteresis: noise of single frames would wear the loop down."""
FZ = 2


@dataclass(frozen=True, slots=True)
class SealedAnswer:
    """What is planted: the id of an effect, with its parameters as in docs/reference/effects.md; an empty id for nothing.

    `salt` is random, so that nobody can guess the text behind the seal.
    """

    effect: str = ""
    parameters: Parameters = field(default_factory=dict)
    salt: str = ""

    @property
    def text(self) -> str:
        """What is sealed."""
        return json.dumps({"effect": self.effect, "parameters": dict(self.parameters), "salt": self.salt}, sort_keys=True)

    @property
    def seal(self) -> str:
        """SHA-256 of the text."""
        return hashlib.sha256(self.text.encode()).hexdigest()


class Frame(NamedTuple):
    """A tared wrench (6,) in base axes, its time, and the time since the end of the tare, NaN before it."""

    wrench: Floats
    at_s: float
    since_s: float

    def plus(self, force_N: float) -> Floats:
        """The wrench (6,) with that much more vertical force."""
        changed = self.wrench.copy()
        changed[FZ] += force_N
        return changed


class SecondChannel:
    """Makes the second channel of one run. `rows` must come in their order."""

    def __init__(self, planted: SealedAnswer) -> None:
        self._law, self._begin_s = LAWS[planted.effect](planted.parameters), math.nan

    def wrench(self, rows: NDArray[np.void], filled: NDArray[np.bool_]) -> Floats:
        """The wrench with the effect.

        Args:
            rows: Ticks (m,).
            filled: Which of their frame slots (m, slots) count.

        Returns:
            Wrenches (n, 6) of these frames in base axes, N and Nm; before the end of the tare as they were measured.
        """
        t_s, wrench = rows["frame_t_s"][filled], rows["tared"][filled].astype(np.float64)
        tared = np.repeat(~np.isin(rows["phase"], (Phase.IDLE, Phase.TARE)), rows["frames"])
        for number, (at_s, begun) in enumerate(zip(t_s.tolist(), tared.tolist(), strict=True)):
            if begun and math.isnan(self._begin_s):
                self._begin_s = at_s
            changed = self._law(Frame(wrench[number].copy(), at_s, at_s - self._begin_s))
            if not math.isnan(self._begin_s):
                wrench[number] = changed
        return wrench


Law = Callable[[Frame], Floats]
"""The wrench (6,) of a frame with the effect; a law remembers the frames before."""


def _latency(p: Parameters) -> Law:
    kept = deque[Frame]()

    def law(frame: Frame) -> Floats:
        kept.append(frame)
        asked_s = frame.at_s - p["delay_s"]
        while len(kept) > 1 and abs(kept[1].at_s - asked_s) <= abs(kept[0].at_s - asked_s):
            kept.popleft()
        return kept[0].wrench

    return law


class _OnePole:
    """A low-pass at rest on the first value; exact for a value that is held between two times."""

    def __init__(self, tau_s: float) -> None:
        self._tau_s, self._at_s = tau_s, 0.0
        self._value: Floats | None = None

    def __call__(self, value: Floats, at_s: float) -> Floats:
        if self._value is None:
            self._value = value
        else:
            self._value = self._value - math.expm1(-max(at_s - self._at_s, 0.0) / self._tau_s) * (value - self._value)
        self._at_s = at_s
        return self._value


def _filter(p: Parameters) -> Law:
    low_pass = _OnePole(1.0 / (2.0 * math.pi * p["cutoff_Hz"]))
    return lambda frame: low_pass(frame.wrench, frame.at_s)


def _hysteresis(p: Parameters) -> Law:
    low_pass, limits_N = _OnePole(DRIVE_TAU_S), p["width_N"] * np.array([0.5, 1.0, 2.0])
    slips, last_N = np.zeros(3), math.nan

    def law(frame: Frame) -> Floats:
        nonlocal slips, last_N
        drive_N = float(low_pass(frame.wrench, frame.at_s)[FZ])
        slips = np.clip(slips + (0.0 if math.isnan(last_N) else drive_N - last_N), -limits_N, limits_N)
        last_N = drive_N
        return frame.plus(p["amplitude_N"] * float(np.mean(slips / limits_N)))

    return law


LAWS: Mapping[str, Callable[[Parameters], Law]] = {
    "": lambda _: lambda frame: frame.wrench,
    "sensor.gain": lambda p: lambda frame: frame.plus(p["error"] * float(frame.wrench[FZ])),
    "sensor.bias": lambda p: lambda frame: frame.plus(p["offset_N"]),
    "sensor.drift": lambda p: lambda frame: frame.plus(p["rate_N_per_s"] * frame.since_s),
    "sensor.latency": _latency,
    "sensor.filter": _filter,
    "sensor.hysteresis": _hysteresis,
}
"""Makes the law of each effect."""
