"""Events and random walks in time: changes that come at certain times, and do not follow from what the probe does."""

from dataclasses import dataclass
from math import log
from typing import TypedDict

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import CHANNELS, FX, FZ
from palpd.gap.data.phases import Ints
from palpd.gap.gaussian.evidence import batch_nats, posterior_of
from palpd.gap.gaussian.nuisance_space import NuisanceSpace
from palpd.gap.laws.scene import Scene
from palpd.gap.model.problem import Problem
from palpd.tick import Floats

EVERY = 4
"""Every fourth bin is tried as the time of an event; the nearest bin is found afterwards."""


KIND_PRICE = log(ASSUMED.events.kinds)
"""Price in nats of the kind and the channel of an event, in addition to the log of the number of its times."""


class Event(TypedDict):
    """A change at an instant. `t_s` counts from the first sample of its recording, `size` has the unit of the channel."""

    recording: int
    t_s: float
    channel: str
    size: float
    kind: str


@dataclass(frozen=True)
class Events:
    """The events of a residual, their evidence together in nats, and their change of the whitened prediction."""

    listed: list[Event]
    nats: float
    change: Floats  # (7, b), without bursts, which change the noise only


@dataclass(frozen=True)
class _Atom:
    """An event that may have happened: its evidence less its price, and its whitened column in a channel."""

    nats: float
    kind: str
    channel: int
    bin: int
    column: Floats  # (b,)


def find_events(scene: Scene, space: NuisanceSpace) -> Events:
    """Pursue events greedily in the residual of `space`: each event that is found joins its nuisances."""
    problem, beside = scene.problem, space
    force = scene.factor("fz_N", "force")
    atoms: list[_Atom] = []
    while len(atoms) < ASSUMED.events.most:
        each = [atom for channel in range(FX, 7) if scene.judged(channel) for atom in _atoms(problem, beside, channel, force)]
        best = max(each, key=lambda atom: atom.nats, default=None)
        if best is None or best.nats < ASSUMED.events.least_nats:
            break
        atoms.append(best)
        if best.kind == "burst":  # noise has no column: its bins no longer count
            beside = beside.restricted_to((np.arange(7)[:, None] != best.channel) | (best.column == 0.0))
        else:
            beside = beside.with_columns({best.channel: best.column[:, None] * _unit(best)})
    sizes, change = _sizes(space, [atom for atom in atoms if atom.kind != "burst"])
    return Events([_described(problem, space, atom, sizes.get(id(atom))) for atom in atoms], sum(atom.nats for atom in atoms), change)


def _unit(atom: _Atom) -> float:
    """Factor on the column of an event that was found: ten times `events.size_sd`, so that its size is free."""
    return 10.0 * ASSUMED.events.size_sd / max(float(np.linalg.norm(atom.column)), 1e-300)


def _sizes(space: NuisanceSpace, atoms: list[_Atom]) -> tuple[dict[int, float], Floats]:
    """Coefficients of events that are fitted together, by the identity of each, and their change (7, b)."""
    change = np.zeros_like(space.residual)
    if not atoms:
        return {}, change
    columns: dict[int, Floats] = {}
    for k, atom in enumerate(atoms):
        columns.setdefault(atom.channel, np.zeros((len(atom.column), len(atoms))))[:, k] = atom.column
    mean, _ = posterior_of(space.products(columns), np.diag([_unit(atom) for atom in atoms]))
    for channel, values in columns.items():
        change[channel] = values @ mean
    return {id(atom): float(value) for atom, value in zip(atoms, mean, strict=True)}, change


def _atoms(problem: Problem, space: NuisanceSpace, channel: int, force: Floats) -> list[_Atom]:
    """The likeliest step, fall of the contact force, pulse, change of drift and burst in one channel."""
    r = space.remainder[channel]
    white = 1.0 / problem.noise.sigma[channel]
    white = np.where(np.isfinite(problem.noise.sigma[channel]), white, 0.0)
    ends, first = [], 0
    for one in problem.recordings:
        first += len(one.bins)
        ends.append(first)
    last = np.asarray(ends)[np.searchsorted(ends, np.arange(first), side="right")]
    times = np.arange(1, first - 1, EVERY)
    trials = [("step", white, times, last[times])]
    if channel == FZ:
        press_end = _end_of_contact(force)
        falls = times[press_end[times] > times]
        trials.append(("fall of the contact force", white * force, falls, press_end[falls]))
    trials += [("pulse", white, times, np.minimum(times + length, last[times])) for length in ASSUMED.events.pulse_bins]
    out = []
    for kind, shape, begin, end in trials:
        if not len(begin):
            continue
        norm, slope = space.windows(channel, shape, begin, end)
        gain = _gain(norm, slope)
        k = int(np.argmax(gain))
        a, b, nats = _sharpened(space, channel, shape, int(begin[k]), int(end[k]), moves_end=kind == "pulse")
        column = np.zeros(first)
        column[a:b] = shape[a:b]
        out.append(_Atom(nats - log(len(times)) - KIND_PRICE, kind, channel, a, column))
    return [*out, _bend(problem, space, channel, white, last), *_bursts(r, channel)]


def _bend(problem: Problem, space: NuisanceSpace, channel: int, white: Floats, last: Ints) -> _Atom:
    """The likeliest time from which on a channel drifts at another rate, until its recording ends.

    Args:
        white: One in units of the noise (b,).
        last: Number of the first bin after the recording of each bin (b,).
    """
    bins, t_s = np.arange(len(white)), np.concatenate([one.t_s for one in problem.recordings])
    begin = np.unique(np.linspace(0, len(white) - 2, ASSUMED.events.drift_changes).astype(np.intp))
    after = (bins[:, None] >= begin) & (bins[:, None] < last[begin])
    ramps = white[:, None] * np.where(after, t_s[:, None] - t_s[begin], 0.0)
    products = space.products({channel: ramps})
    gain = _gain(np.diag(products.gram), products.slope)
    k = int(np.argmax(gain))
    return _Atom(float(gain[k]) - log(len(begin)) - KIND_PRICE, "change of drift", channel, int(begin[k]), ramps[:, k])


def _gain(norm: Floats, slope: Floats) -> Floats:
    """Log Bayes factors of columns whose size has the prior N(0, EVENT_SIGMAS²), from squared lengths and products with the residual."""
    size = ASSUMED.events.size_sd**2
    return np.where(norm > 1e-9, -0.5 * log(1.0 + size) + 0.5 * slope**2 / np.maximum(norm, 1e-9) * size / (1.0 + size), -np.inf)


def _sharpened(space: NuisanceSpace, channel: int, shape: Floats, begin: int, end: int, *, moves_end: bool) -> tuple[int, int, float]:
    """Begin, end and evidence of an event, moved to where they fit best."""
    near = max(EVERY, (end - begin) // 2) if moves_end else EVERY
    begins = np.unique(np.clip(np.linspace(begin - near, begin + near, 25).astype(np.intp), 0, len(shape) - 2))
    ends = np.unique(np.clip(np.linspace(end - near, end + near, 25).astype(np.intp), 1, len(shape))) if moves_end else np.array([end])
    a, b = (grid.ravel() for grid in np.meshgrid(begins, ends, indexing="ij"))
    a, b = a[b > a], b[b > a]
    gain = _gain(*space.windows(channel, shape, a, b))
    k = int(np.argmax(gain))
    return int(a[k]), int(b[k]), float(gain[k])


def _bursts(r: Floats, channel: int) -> list[_Atom]:
    """The likeliest stretch of wider noise, judged by differences of neighbours, which no slow change makes."""
    d2 = 0.5 * np.diff(r, append=r[-1]) ** 2
    sums = np.concatenate([[0.0], np.cumsum(d2)])
    out = []
    for length in ASSUMED.events.pulse_bins[1:]:
        begin = np.arange(0, len(r) - length, EVERY)
        if not len(begin):
            continue
        energy = sums[begin + length] - sums[begin]
        count = 0.5 * length  # neighbouring differences share a reading
        each = [-0.5 * count * log(1.0 + sd**2) + 0.25 * energy * sd**2 / (1.0 + sd**2) for sd in ASSUMED.events.burst_sd]
        gain = np.logaddexp(*each) - log(2.0)
        k = int(np.argmax(gain))
        column = np.zeros(len(r))
        column[begin[k] : begin[k] + length] = 1.0
        out.append(_Atom(float(gain[k]) - log(len(begin)) - KIND_PRICE, "burst", channel, int(begin[k]), column))
    return out


def _end_of_contact(force: Floats) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """For every bin (b,) in contact the number of the first bin after it in the air; for a bin in the air its own number."""
    n = len(force)
    air = np.where(force > 0.0, n, np.arange(n))
    return np.asarray(np.minimum.accumulate(air[::-1])[::-1])


def _described(problem: Problem, space: NuisanceSpace, atom: _Atom, coefficient: float | None) -> Event:
    """The event in words and units; a burst has no coefficient, and its size is the spread of its noise."""
    ends = np.cumsum([len(one.bins) for one in problem.recordings])
    number = int(np.searchsorted(ends, atom.bin, side="right"))
    one, mine = problem.recordings[number], atom.column != 0.0
    sigma = problem.noise.sigma[atom.channel][mine]
    if coefficient is None:
        size = float(np.std(space.remainder[atom.channel][mine]) * np.median(sigma))
    else:
        size = coefficient * float(np.abs(atom.column[mine] * sigma).max())
    t_s = float(one.t_s[atom.bin - int(ends[number]) + len(one.bins)])
    return Event(recording=number, t_s=t_s, channel=CHANNELS[atom.channel], size=size, kind=atom.kind)


def wander_nats(scene: Scene, space: NuisanceSpace) -> float:
    """Evidence of a random walk in time of the zero or of the scale of fz (an Ornstein-Uhlenbeck process).

    Returns:
        The larger of both, in nats; -inf where fz is not compared.
    """
    if not scene.judged(FZ):
        return -np.inf
    problem = scene.problem
    hats, start = [], 0
    for one in problem.recordings:
        t = one.t_s / max(float(one.t_s[-1]), 1e-12) * (ASSUMED.events.wander_knots - 1)
        mine = np.zeros((problem.data.shape[1], ASSUMED.events.wander_knots))
        mine[start : start + len(t)] = np.maximum(1.0 - np.abs(t[:, None] - np.arange(ASSUMED.events.wander_knots)), 0.0)
        start += len(t)
        hats.append(mine)
    white = np.where(np.isfinite(problem.noise.sigma[FZ]), 1.0 / problem.noise.sigma[FZ], 0.0)[:, None]
    knots = np.arange(ASSUMED.events.wander_knots)
    distance = np.abs(np.subtract.outer(knots, knots))
    roots = tuple(np.linalg.cholesky(np.exp(-distance / length)) for length in ASSUMED.events.wander_lengths)
    best = -np.inf
    for factor in (white, white * scene.factor("fz_N", "force")[:, None]):
        products = [space.products({FZ: factor * mine}) for mine in hats]
        # Every recording wanders by itself.
        nats = batch_nats(np.array([one.gram for one in products]), np.array([one.slope for one in products]), roots)
        best = max(best, float(nats[np.isfinite(nats)].sum()))  # a recording without contact says nothing of a scale
    return best
