"""What recordings say of themselves without a cell: white noise, dead forces, turned axes, one recording given twice."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpd.cell.plausible import doubts
from palpd.errors import RecordingError
from palpd.recording.samples import Samples
from palpd.tick import Floats

CLEAR_NOISES = 10.0
"""Number of standard deviations of noise that a change must have to be judged."""

HEIGHT_CORRELATION = 0.4
"""Least correlation of force with height that shows contact: strokes in the air, without force, keep it below 0.8 in healthy recordings."""

SLOPE_CORRELATION = 0.9
"""Least correlation of the heights with the integral of the speeds for a judgement of their units."""

SWING_OF_NOISE = 5.2
"""Swing of white noise without its rarest values, in standard deviations."""

FALLING_SHARE = 0.3
"""Share of the swing of the force by which it may be lower where the tip is lowest: adhesion and friction stay below."""

TURNED_RATIO = 5.0
"""Swing of the force in the upper third of the heights over that in the lower third, above which the tissue seems to be above the probe.
A healthy press has below 0.1, friction and cables about 1, and the largest of the shared real recordings 2.2."""


def measured_rms(values: Floats, where: NDArray[np.bool_] | None = None) -> float:
    """Rms of the white part of a signal, from its second differences without the largest 2 % (corners, steps).

    Args:
        values: The signal (n,).
        where: Samples that count (n,); all where not given.

    Returns:
        The rms in the unit of the signal; 0 of too few samples.
    """
    differences = np.diff(values, 2)
    if where is not None:
        differences = differences[where[2:] & where[1:-1] & where[:-2]]
    if len(differences) < 6:
        return 0.0
    squares = np.sort(differences**2)
    kept = squares[: max(4, int(0.98 * len(squares)))]
    # A normal variable without its largest 2 %: |x| < 2.326 holds 0.856 of the variance in 0.98 of the probability.
    return float(np.sqrt(kept.mean() / 6.0 / 0.8735))


def dead(values: Floats) -> bool:
    """Whether a channel (n,) never changes.

    Args:
        values: The channel (n,).

    Returns:
        True where all values are equal.
    """
    return bool(np.all(values == values[0]))


def refuse_dead(samples: Samples, label: str = "") -> None:
    """Refuse a wrench none of whose axes ever changes although the probe moves: rounding hides some axes of a quiet sensor, never all six.

    Args:
        label: What an error begins with.

    Raises:
        RecordingError: All axes are constant in motion.
    """
    stroke_m = float(np.ptp(samples.z_m))
    if stroke_m > CLEAR_NOISES * measured_rms(samples.z_m) and all(dead(axis) for axis in samples.wrench.T):
        raise RecordingError(
            f"{label}fz_N is {samples.wrench[0, 2]:g} throughout, and no other axis of the force changes, while the probe moves by "
            f"{stroke_m * 1e3:.3g} mm; the sensor is dead or the column is wrong: record the force again"
        )


def refuse_repeated(recordings: Sequence[Samples]) -> None:
    """Refuse the same recording twice: it would count as two that agree. Raises RecordingError."""
    for number, samples in enumerate(recordings):
        for before, other in enumerate(recordings[:number]):
            if np.array_equal(samples.t_s, other.t_s) and np.array_equal(samples.wrench, other.wrench):
                raise RecordingError(
                    f"recordings {before + 1} and {number + 1} hold the same samples, expected different ones; "
                    "the same twice is no further evidence: leave one of them out"
                )


def refuse_turned(samples: Samples, label: str = "") -> None:
    """Refuse a force that rises with the height; the side to which fz leaves its usual level says which of the two is turned.

    Args:
        label: What an error begins with.

    Raises:
        RecordingError: Forces or heights have the wrong sign.
    """
    fz_N = samples.wrench[:, 2]
    if swing_N(fz_N) < CLEAR_NOISES * measured_rms(fz_N) or correlation(fz_N, samples.z_m) <= HEIGHT_CORRELATION:
        return
    level_N = np.median(fz_N)
    if fz_N.max() - level_N > level_N - fz_N.min():
        raise RecordingError(
            f"{label}fz_N rises with z_m, expected to rise while the probe goes down; z_m looks positive downwards: "
            "multiply z_m, z_cmd_m and vz_m_per_s by -1."
        )
    raise RecordingError(
        f"{label}fz_N falls to {fz_N.min():.3g} N while the probe presses, expected to rise; pressing gives positive fz_N: "
        "multiply the forces by -1 (palpd import --compression-negative)."
    )


def fall_where_lowest_N(height_m: Floats, force_N: Floats) -> float:
    """How much lower the force is where the tip is lowest than where it is highest; 0 up to `FALLING_SHARE` of its swing.

    Args:
        height_m: Heights (n,) of the tip.
        force_N: Forces (n,).
    """
    high, low = height_m >= np.quantile(height_m, 0.8), height_m <= np.quantile(height_m, 0.05)
    fall_N = float(np.median(force_N[high]) - np.median(force_N[low]))
    return fall_N if fall_N > FALLING_SHARE * float(np.ptp(force_N)) else 0.0


def turned_twice(samples: Samples) -> list[str]:
    """A sentence where both force and height seem to be turned: the force falls, and nearly all of it where the probe is highest.

    Two wrong signs leave a force that falls with the height, as it should. Yet a press ends at its lowest point, so there the force
    changes most.

    Returns:
        No sentence or one, without a full stop.
    """
    fz_N, z_m = samples.wrench[:, 2], samples.z_m
    third_m = float(np.ptp(z_m)) / 3.0
    low, high = fz_N[z_m < z_m.min() + third_m], fz_N[z_m > z_m.max() - third_m]
    if not len(low) or not len(high) or correlation(fz_N, z_m) >= -HEIGHT_CORRELATION:
        return []
    noise_N = measured_rms(fz_N)
    below_N, above_N = (max(swing_N(part) - SWING_OF_NOISE * noise_N, 0.0) for part in (low, high))
    if above_N <= max(TURNED_RATIO * below_N, (CLEAR_NOISES - SWING_OF_NOISE) * noise_N):
        return []
    return [
        f"fz_N changes by {above_N:.3g} N where z_m is highest and by {below_N:.3g} N where it is lowest, expected the other way round "
        "(both signs look wrong)"
    ]


def questions_of(samples: Samples) -> list[str]:
    """A sentence for everything implausible about a recording by itself: stroke, speed, rate, force, and two signs that cancel."""
    return [
        *doubts("stroke", float(np.ptp(samples.z_m)), "the stroke of z_m"),
        *doubts("speed", float(np.quantile(np.abs(samples.vz_m_per_s), 0.99)), "the speed vz_m_per_s"),
        *doubts("rate", samples.rate_Hz, "the rate of t_s"),
        *doubts("force", float(np.abs(samples.wrench[:, :3]).max()), "the largest force"),
        *turned_twice(samples),
        *_slope_doubts(samples),
    ]


def _slope_doubts(samples: Samples) -> list[str]:
    ratio = slope_ratio(samples)
    if ratio is None or 0.5 < ratio < 2.0:
        return []
    return [f"z_m changes {ratio:.3g} times as fast as vz_m_per_s says, expected 1"]


def slope_ratio(samples: Samples) -> float | None:
    """How fast z_m changes over how fast vz_m_per_s says it does.

    Returns:
        The ratio, negative where their signs disagree; None where neither says anything.
    """
    path_m = np.concatenate([[0.0], np.cumsum(0.5 * (samples.vz_m_per_s[1:] + samples.vz_m_per_s[:-1]) * np.diff(samples.t_s))])
    agreement = correlation(samples.z_m, path_m)
    if abs(agreement) < SLOPE_CORRELATION:
        return None
    return float(np.sign(agreement) * np.std(samples.z_m) / np.std(path_m))


def swing_N(fz_N: Floats) -> float:
    """How far a force goes, without its rarest values.

    Args:
        fz_N: The force (n,).
    """
    return float(np.quantile(fz_N, 0.995) - np.quantile(fz_N, 0.005))


def correlation(one: Floats, other: Floats) -> float:
    """Correlation of two columns.

    Args:
        one: A column (n,).
        other: Another one (n,).

    Returns:
        The correlation; 0 where one is constant.
    """
    a, b = one - one.mean(), other - other.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0.0 else 0.0
