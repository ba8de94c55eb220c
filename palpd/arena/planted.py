"""Plants effects into recordings of real rigs, at a strength that is drawn from a range."""

from dataclasses import dataclass

import numpy as np

from palpd.arena.laws import LAWS, PlantedLaw
from palpd.arena.signals import FloatArray, PlantingRefusedError, Recording, noise_N, rounding_step, smooth, snr_against

__all__ = ["LAWS", "Planted", "PlantedLaw", "PlantingRefusedError", "noise_N", "plant"]

SMALLEST = 1e-6
"""Smallest share of the largest size that is searched."""
CLOSE = 0.01
"""Relative distance from the drawn SNR at which the search ends."""
ATTEMPTS = 40
"""Number of sizes that are tried: with every other one the search halves its interval."""
LEAST_KEPT = 0.9
"""Least share of rows that a shift in time may leave."""


@dataclass(frozen=True)
class Planted:
    """A recording with a planted effect.

    Attributes:
        columns: All columns (m,), on the recorded rounding steps; m < n where a shift in time has cut rows.
        law: Key in LAWS.
    """

    columns: dict[str, FloatArray]
    law: str
    parameters: dict[str, float]
    snr: float


def plant(
    recording: Recording,
    law: str,
    rng: np.random.Generator,
    snr_range: tuple[float, float],
    *,
    sigma_N: float | None = None,
) -> Planted:
    """Plant a law of LAWS at an SNR that is drawn from a range, even in its logarithm.

    A rounded force is spread evenly over its step, changed and rounded again, so a row without change stays as it was. A rounded height is
    changed and rounded, so that a robot at rest stays at rest. The SNR of a law that docs/reference/contract.md has no name for
    counts only what no spring, friction and viscous drag together can follow.

    Args:
        recording: Columns (n,).
        sigma_N: Noise of a sample of fz; None: `noise_N`.

    Raises:
        PlantingRefusedError: If a column is missing, the SNR is out of reach, or a shift in time would cut over 10 % of all rows.
    """
    chosen, (low, high) = LAWS[law], snr_range
    if missing := [name for name in chosen.needs if name not in recording]:
        raise PlantingRefusedError(f"{law} needs {', '.join(missing)}, which the recording does not have; add it or take another law")
    largest, sigma_N = chosen.draw(recording, rng), noise_N(recording) if sigma_N is None else sigma_N
    bare = {**recording, "fz_N": smooth(recording["fz_N"])}
    neighbours = [LAWS[f"cable.{name}"] for name in ("spring", "friction", "viscous")] if chosen.effect == "unknown" else []
    free = [neighbour.change(recording, {neighbour.size: 1.0}) for neighbour in neighbours]
    snr_of = snr_against(bare, sigma_N=sigma_N, free=free)
    below, above, goal, power = float(np.log(SMALLEST)), 0.0, np.inf, 0.0
    for attempt in range(ATTEMPTS):
        parameters = {**largest, chosen.size: chosen.resize(largest[chosen.size], float(np.exp(power)))}
        reached = snr_of({**bare, **chosen.apply(bare, parameters)})
        if not attempt:
            goal = float(np.exp(rng.uniform(np.log(low), np.log(np.clip(reached, low, high)))))
        if (reached < low and not attempt) or (low <= reached <= high and abs(reached / goal - 1) < CLOSE):
            break
        below, above = (below, power) if reached > goal else (power, above)
        guess = power + np.log(goal / max(reached, SMALLEST))  # most changes grow in proportion to their size
        power = guess if attempt % 2 == 0 and below < guess < above else (below + above) / 2
    if not low <= reached <= high:
        raise PlantingRefusedError(f"{law} has an SNR of {reached:.3g}, but {low:.3g} to {high:.3g} is expected; take another law or range")
    steps = {name: rounding_step(recording[name]) for name in chosen.apply(recording, parameters)}
    spread = recording["fz_N"] + steps.get("fz_N", 0.0) * rng.uniform(-0.5, 0.5, len(recording["fz_N"]))
    columns = {**recording, **chosen.apply({**recording, "fz_N": spread}, parameters)}
    for name, step in steps.items():
        if step:
            columns[name] = recording[name] + step * np.rint((columns[name] - recording[name]) / step)
    known = np.all([np.isfinite(column) for column in columns.values()], axis=0)
    if np.mean(known) < LEAST_KEPT:
        raise PlantingRefusedError(
            f"{law} cuts {1 - np.mean(known):.0%} of all rows, but at most 10 % is expected; take a longer recording"
        )
    return Planted({name: column[known] for name, column in columns.items()}, law, parameters, reached)
