"""The few dynamic systems that the physics of the cell is made of.

Every function takes a block of successive samples and a `memory` that it carries from block to block, so that a whole recording
(one block) and a controller's cycle (blocks of one) are the same computation. Linear systems are exact for an input that is
straight between samples, at even and at uneven steps.
"""

from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Memory = dict[str, Any]
Column = Floats | float
State = tuple[float, float]
"""Position and speed, in m and m/s."""

SHORT = 64
"""Samples up to which a relaxation uses a stored matrix: one product costs less than setting up a filter."""

FORGOTTEN, MOST_TAPS = 1e-17, 10
"""Share of an input that a relaxation has lost to rounding, and inputs up to which their weighted sum costs a third of the recursion."""

FEW = 8
"""Steps of a recurrence that are done one by one: halving them costs more."""

EVEN = 1e-3
"""Relative spread below which time steps count as even; jitter of a thousandth moves no filter."""


def steps(t_s: Floats) -> Column:
    """The time step before each sample.

    Args:
        t_s: Times (n,) in s, increasing.

    Returns:
        One number in s where the steps are even, else (n,) with the median step before the first sample.
    """
    if len(t_s) < 2:
        return 1e-3
    dt_s = np.diff(t_s)
    mean_s = float(t_s[-1] - t_s[0]) / len(dt_s)
    if float(dt_s.max() - dt_s.min()) <= EVEN * mean_s:
        return mean_s
    dt_s = np.maximum(dt_s, 1e-6 * mean_s)
    return np.concatenate(([np.median(dt_s)], dt_s))


def integral(x: Floats, t_s: Floats) -> Floats:
    """Integral over time, straight between samples and 0 at the first.

    Args:
        x: Values (n,).
        t_s: Times (n,) in s.

    Returns:
        The integral (n,).
    """
    return np.concatenate(([0.0], np.cumsum(0.5 * (x[1:] + x[:-1]) * np.diff(t_s))))


def recurrence(a: NDArray[Any], b: NDArray[Any], y: Any) -> NDArray[Any]:
    """y_k = a_k y_(k-1) + b_k with varying coefficients.

    Two steps are one step with other coefficients, so every second output follows from half as many steps, and the others from these.

    Args:
        a: Factors (n,).
        b: Inputs (n,).
        y: The output before the first.

    Returns:
        The outputs (n,).
    """
    out = np.empty(len(b), np.result_type(a, b))
    if len(b) <= FEW:
        for k in range(len(b)):
            out[k] = y = a[k] * y + b[k]
        return out
    first, second = slice(0, len(b) - 1, 2), slice(1, None, 2)
    out[second] = recurrence(a[second] * a[first], a[second] * b[first] + b[second], y)
    out[0] = a[0] * y + b[0]
    out[2::2] = a[2::2] * out[1:-1:2] + b[2::2]
    return out


def _weights(x: Any) -> tuple[Any, Any, Any]:
    """What the last output, the last input and the new input weigh in a relaxation over pole × step = x."""
    shrink = np.expm1(x)
    new = 1.0 - shrink / x
    return shrink + 1.0, -shrink - new, new


@lru_cache(maxsize=512)
def _short_block(x: complex, n: int) -> NDArray[Any]:
    """(n, n + 2): outputs of a relaxation from (last output, last input, the n inputs)."""
    keep, old, new = _weights(x if x.imag else x.real)
    rows = np.zeros((n, n + 2), dtype=type(keep) if isinstance(keep, complex) else np.result_type(keep))
    row = np.zeros(n + 2, rows.dtype)
    row[0] = 1.0
    for k in range(n):
        row = row * keep
        row[k + 1] += old
        row[k + 2] += new
        rows[k] = row
    rows.setflags(write=False)
    return rows


def lowpass(u: NDArray[Any], dt_s: Column, pole_per_s: complex, memory: Memory, start: float | None = None) -> NDArray[Any]:
    """Relaxation towards the input, dy/dt = pole (y - u).

    Args:
        u: Input, (n,) or (n, k).
        dt_s: Step before each sample in s, one number or (n,).
        pole_per_s: Pole left of zero, real or complex, in 1/s.
        memory: State that is carried from one stretch of samples to the next.
        start: Output before the first sample; None means settled on the first input.

    Returns:
        The output, shaped as the input.
    """
    settled = "y" not in memory and start is None
    if "y" not in memory:
        memory["y"] = memory["u"] = u[0] + 0.0 if start is None else u[0] * 0.0 + start
    n = len(u)
    if isinstance(dt_s, float):
        x = complex(pole_per_s) * dt_s
        if n <= SHORT:
            y = _short_block(x, n) @ np.concatenate((np.stack((memory["y"], memory["u"])), u))
        elif settled and u.ndim == 1 and not x.imag and np.log(FORGOTTEN) / x.real < MOST_TAPS - 2:
            keep, old, new = _weights(x.real)
            taps = np.concatenate(([new], (keep * new + old) * keep ** np.arange(MOST_TAPS - 1)))
            y = np.convolve(np.concatenate((np.full(MOST_TAPS - 1, u[0]), u)), taps, "valid")
        else:
            keep, old, new = _weights(x if x.imag else x.real)
            from scipy.linalg.lapack import dtbtrs, ztbtrs  # here, since the control loop reads cell files and needs none of it

            added = new * u
            added[1:] += old * u[:-1]
            added[0] += keep * memory["y"] + old * memory["u"]
            bands = np.array(np.broadcast_to([[1.0], [-keep]], (2, n)), order="F")
            y = (ztbtrs if x.imag else dtbtrs)(bands, added, uplo="L", diag="U")[0].reshape(u.shape)
    else:
        keep, old, new = _weights((pole_per_s if complex(pole_per_s).imag else complex(pole_per_s).real) * dt_s)
        before = np.concatenate(([memory["u"]], u[:-1]))
        y = recurrence(keep, old * before + new * u, memory["y"])
    memory["y"], memory["u"] = y[-1], u[-1].copy()  # the caller may use its array again
    result: NDArray[Any] = y
    return result


def filtered(column: Floats, dt_s: Column, cutoff_Hz: float) -> Floats:
    """A column behind a filter of one pole.

    Args:
        column: Values (n,) of an axis.
        dt_s: Step before each sample, one number or (n,).
        cutoff_Hz: Its cutoff; infinite: none.

    Returns:
        The filtered values (n,).
    """
    return lowpass(column, dt_s, -2.0 * np.pi * cutoff_Hz, {}) if np.isfinite(cutoff_Hz) else column


def unfiltered(column: Floats, t_s: Floats, cutoff_Hz: float) -> Floats:
    """A smooth column before it passed a filter of one pole.

    Args:
        column: Values (n,) of an axis behind the filter.
        t_s: Times (n,).

    Returns:
        The values (n,) before it.
    """
    return column + np.gradient(column, t_s) / (2.0 * np.pi * cutoff_Hz) if np.isfinite(cutoff_Hz) else column


def poles(natural_frequency_Hz: float, damping_ratio: float) -> tuple[complex, complex]:
    """The two poles of a second-order system; a double pole is split by 1e-4, which moves the frequency by 1e-8.

    Args:
        natural_frequency_Hz: Undamped natural frequency.
        damping_ratio: Damping ratio, 1 at critical damping.

    Returns:
        Both poles in 1/s.
    """
    omega = 2.0 * np.pi * natural_frequency_Hz
    root = complex(damping_ratio**2 - 1.0) ** 0.5
    if abs(root) < 1e-4:
        root = complex(1e-4)
    return omega * (-damping_ratio + root), omega * (-damping_ratio - root)


def _pair(
    u: Floats, dt_s: Column, fast: complex, slow: complex, memory: Memory, start: State | None = None
) -> tuple[NDArray[Any], NDArray[Any]]:
    """The relaxations over both poles; of a conjugate pair only one needs computing."""
    if start is not None:  # as long as the input rests, each decays from (height - speed / the other pole)
        first_s = dt_s if isinstance(dt_s, float) else dt_s[0]
        for name, pole, other in (("one", fast, slow), ("two", slow, fast)):
            kept = np.exp(complex(max(pole.real * first_s, -460.0), pole.imag * first_s))  # less is no number any more
            before = (start[0] - start[1] / other - u[0]) / kept
            memory[name] = {"y": u[0] + (before if pole.imag else before.real), "u": u[0]}
    one = lowpass(u, dt_s, fast, memory.setdefault("one", {}))
    if fast.imag:
        return one, one.conj()
    return one, lowpass(u, dt_s, slow, memory.setdefault("two", {}))


def servo(
    u: Floats, dt_s: Column, natural_frequency_Hz: float, damping_ratio: float, memory: Memory, start: State | None = None
) -> tuple[Floats, Floats, Floats]:
    """Second-order following of a target.

    Args:
        u: Target positions, (n,) or (n, k).
        dt_s: Step before each sample in s, one number or (n,).
        natural_frequency_Hz: Undamped natural frequency.
        damping_ratio: Damping ratio, 1 at critical damping.
        memory: State that is carried from one stretch of samples to the next.
        start: Position and speed at the first sample; None: at rest at the first target, or as the memory says.

    Returns:
        Position, speed and acceleration, each shaped as the target.
    """
    p, q = poles(natural_frequency_Hz, damping_ratio)
    one, two = _pair(u, dt_s, p, q, memory, start)
    weight = p * q / (q - p)
    position = (q * one - p * two) / (q - p)
    speed = weight * (one - two)
    acceleration = weight * (p * (one - u) - q * (two - u))
    return np.real(position), np.real(speed), np.real(acceleration)


def servo_heights(u: Floats, dt_s: Column, natural_frequency_Hz: float, damping_ratio: float, start: State | None = None) -> Floats:
    """The positions of `servo`, without speed and acceleration.

    Args:
        u: Target positions, (n,) or (n, k).
        dt_s: Step before each sample in s, one number or (n,).
        natural_frequency_Hz: Undamped natural frequency.
        damping_ratio: Damping ratio, 1 at critical damping.
        start: Position and speed at the first sample; None: at rest at the first target.

    Returns:
        Positions, shaped as the target.
    """
    p, q = poles(natural_frequency_Hz, damping_ratio)
    one, two = _pair(u, dt_s, p, q, {}, start)
    return np.real((q * one - p * two) / (q - p))


def mounted(a: Floats, dt_s: Column, frequency_Hz: float, damping_ratio: float, memory: Memory) -> Floats:
    """Acceleration of a mass on a spring and damper whose base moves: (2ζωs + ω²)/(s² + 2ζωs + ω²).

    Args:
        a: Accelerations (n,) of the base.
        dt_s: Step before each sample in s, one number or (n,).
        frequency_Hz: Undamped natural frequency.
        memory: State that is carried from one stretch of samples to the next.

    Returns:
        Accelerations (n,) of the mass.
    """
    p, q = poles(frequency_Hz, damping_ratio)
    one, two = _pair(a, dt_s, p, q, memory)
    return np.real((p * one - q * two) / (p - q))


def excess_N(x_N: Floats, knee_N: float) -> Floats:
    """What a force exceeds zero by, max(0, x), with the corner rounded over `knee_N`: knee · ln(1 + exp(x / knee)), a softplus.

    Args:
        x_N: Forces (n,) in N.
        knee_N: Width of the rounding in N; 0: a corner.

    Returns:
        The excess (n,) in N.
    """
    return knee_N * np.logaddexp(0.0, x_N / knee_N) if knee_N > 0.0 else np.maximum(x_N, 0.0)


def limited_N(x_N: Floats, limit_N: float, knee_N: float) -> Floats:
    """Forces between -limit and limit.

    Args:
        x_N: Forces (n,) in N.
        limit_N: 0 or more, in N.
        knee_N: Width in N over which they approach it, as `excess_N`; 0: they are cut off.

    Returns:
        The limited forces (n,) in N.
    """
    if knee_N <= 0.0:
        return np.clip(x_N, -limit_N, limit_N)
    return x_N - excess_N(x_N - limit_N, knee_N) + excess_N(-x_N - limit_N, knee_N)


def play(u: Floats, width: float, memory: Memory) -> Floats:
    """Follower with a dead band around the input, centred where it starts.

    Args:
        u: Input (n,).
        width: Full width of the dead band, in the unit of the input.
        memory: State that is carried from one stretch of samples to the next.

    Returns:
        The follower (n,).
    """
    follower = _clipped(u - width / 2.0, u + width / 2.0, memory.get("follower", u[0]))
    memory["follower"] = follower[-1]
    return follower


def _clipped(low: Floats, high: Floats, y: float) -> Floats:
    """y_k = y_(k-1) clipped to (low_k, high_k), with y before the first; a clip of a clip is a clip, so as `recurrence`."""
    out = np.empty_like(low)
    if len(low) <= FEW:
        for k in range(len(low)):
            out[k] = y = min(max(y, low[k]), high[k])
        return out
    first, second = slice(0, len(low) - 1, 2), slice(1, None, 2)

    def both(bound: Floats) -> Floats:
        return np.minimum(np.maximum(bound[first], low[second]), high[second])

    out[second] = _clipped(both(low), both(high), y)
    out[0] = min(max(y, low[0]), high[0])
    out[2::2] = np.minimum(np.maximum(out[1:-1:2], low[2::2]), high[2::2])
    return out


def slack_dahl(u: Floats, length: float, slack: float, memory: Memory) -> Floats:
    """Friction of Dahl (1968) behind a play, as a share of its full force: a slack link carries no force.

    At a reversal the friction's own spring pushes the link back, so the force falls to zero first. Then the play is crossed without
    force, and then the friction builds up to the other side. The play is centred where it starts.

    Args:
        u: Input (n,) before the play.
        length: Length over which the friction builds up, in the unit of the input.
        slack: Full width of the play, in the unit of the input.
        memory: State that is carried from one stretch of samples to the next.

    Returns:
        The share (n,), positive where the input rises.
    """
    last, share, crossed = memory.get("slack", (float(u[0]), 0.0, 0.5 * slack))
    change = np.diff(u, prepend=last)
    direction = np.sign(change)
    turns = np.flatnonzero(direction != 0.0)
    edges = [*turns[np.flatnonzero(np.diff(direction[turns], prepend=0.0))].tolist(), len(u)]  # where strokes begin, and the end
    out = np.empty(len(u))
    out[: edges[0]] = share
    for a, b in pairwise(edges):
        way = float(direction[a])
        travel = way * np.cumsum(change[a:b])
        before = way * share
        across = crossed if way > 0.0 else slack - crossed
        unloading = length * float(np.log1p(max(-before, 0.0)))
        remaining = slack - across if before <= 0.0 else 0.0
        built = np.maximum(travel - unloading - remaining, 0.0)
        falling = 1.0 - (1.0 - min(before, 0.0)) * np.exp(-np.minimum(travel, unloading) / length)
        rising = 1.0 - (1.0 - max(before, 0.0)) * np.exp(-built / length)
        out[a:b] = way * (np.minimum(falling, 0.0) + rising)
        within = unloading <= float(travel[-1]) <= unloading + remaining and before <= 0.0
        share = 0.0 if within else float(out[b - 1])  # rounding must not make a force in the play
        across += min(max(float(travel[-1]) - unloading, 0.0), remaining)
        crossed = across if way > 0.0 else slack - across
    memory["slack"] = (float(u[-1]), share, crossed)
    return out


def delayed(u: Floats, t_s: Floats, when_s: Floats, memory: Memory) -> Floats:
    """A signal at other times, straight between samples, its ends held.

    Args:
        u: Signal, (n,) or (n, k).
        t_s: Its times (n,) in s.
        when_s: Times (m,) to give it at, in s.
        memory: Samples that later stretches may still need.

    Returns:
        The signal at those times, (m,) or (m, k).
    """
    if "t_s" in memory:
        t_s, u = np.concatenate((memory["t_s"], t_s)), np.concatenate((memory["u"], u))
    columns = [np.interp(when_s, t_s, column) for column in u.reshape(len(u), -1).T]
    keep = max(int(np.searchsorted(t_s, when_s[-1])) - 2, 0)
    memory["t_s"], memory["u"] = t_s[keep:], u[keep:]
    return np.stack(columns, axis=-1).reshape(len(when_s), *u.shape[1:])


def shifted(u: Floats, rows: float) -> Floats:
    """`delayed` by a constant time on an even grid, at a third of the cost.

    Args:
        u: Signal (n,).
        rows: How many rows later it is to be given; negative is earlier.

    Returns:
        The signal (n,), straight between samples, its ends held.
    """
    whole = int(np.floor(min(max(rows, -len(u)), len(u))))
    share = min(max(rows - whole, 0.0), 1.0)
    between = u[1:] + share * (u[:-1] - u[1:])  # of k and k + 1: the signal at k + 1 - share
    if whole >= 0:
        return np.concatenate([np.full(min(whole + 1, len(u)), u[0]), between[: max(len(u) - whole - 1, 0)]])
    return np.concatenate([between[-whole - 1 :], np.full(min(-whole, len(u)), u[-1])])
