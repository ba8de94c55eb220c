"""The dictionary of laws: which factors and drivers are tried on which channel, and what it costs to name them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import log

import numpy as np

from palpd.cell.effects.drivers import Driver, FactorName, Quantity
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import CHANNELS
from palpd.gap.laws.bases import FINE_KNOTS, Basis, harmonics, hats, powers
from palpd.gap.laws.scene import LATERAL, LawCandidate, Scene
from palpd.tick import Floats

FACTOR_PRICE = dict(ASSUMED.laws.factor_nats)
"""Nats that a factor costs: the rarer kinds of law cost more."""

CHANNEL_PRICE = {"fz_N": 0.0, LATERAL: ASSUMED.laws.lateral_nats, "z_m": ASSUMED.laws.height_nats}

RELAXED: tuple[Quantity, ...] = (
    "force", "absolute_speed", "squared_speed", "speed", "direction", "contact", "air", "depth", "power",
)  # fmt: skip
TIME_CONSTANTS = np.geomspace(*ASSUMED.laws.time_constants, 6)
"""Time constants of relaxed states, as shares of the longest recording."""


REFINED = (0.5, 0.63, 0.8, 1.0, 1.25, 1.6, 2.0)
"""Factors at which the constant of the likeliest memory is tried again."""

IN_CONTACT: tuple[FactorName, ...] = ("force", "surface", "force_direction")
WRENCH_FACTORS = tuple(FACTOR_PRICE)
LATERAL_FACTORS: tuple[FactorName, ...] = ("one", "force", "direction", "force_direction", "speed")
SINGLE_FACTORS: tuple[FactorName, ...] = ("one", "force", "direction")
HEIGHT_FACTORS: tuple[FactorName, ...] = ("one", "direction")

PERIODIC_FACTORS: dict[str, tuple[FactorName, ...]] = {
    "fz_N": ("one", "force", "surface", "direction"),
    "z_m": ("one",),
    LATERAL: ("one", "force"),
}

MOST_FREQUENCIES = 1500
PEAKS, EXTENTS = 2, 10
"""Largest number of frequencies of a periodic law that are tried, number of highest peaks for each factor that become candidates, and
classes of similar extent into which bins go."""


@dataclass(frozen=True)
class Group:
    """Candidates with the same channel, driver and basis, and several factors; `price` is in nats, without that of the factor."""

    channel: str
    factors: tuple[FactorName, ...]
    basis: Basis
    price: float

    def candidate(self, factor: FactorName) -> LawCandidate:
        """The candidate with one of the factors."""
        return LawCandidate(self.channel, factor, self.basis, self.price + FACTOR_PRICE[factor])


def plain_drivers(scene: Scene) -> list[tuple[Driver, float]]:
    """Drivers without a constant of memory, and their prices in nats."""
    rest, step_s = scene.rest_speed_m_per_s, 0.002 * scene.duration_s
    other, rare = ASSUMED.laws.driver_nats, ASSUMED.laws.rare_driver_nats
    return [
        (Driver(quantity="height"), 0.0),
        (Driver(quantity="depth"), 0.0),
        (Driver(quantity="force"), 0.0),
        (Driver(quantity="gap", log_scale=scene.shallow_m), other),
        (Driver(quantity="speed"), 0.0),
        (Driver(quantity="speed", log_scale=rest), other),
        (Driver(quantity="time"), other),
        (Driver(quantity="acceleration"), rare),
        (Driver(quantity="force_rate"), rare),
        (Driver(quantity="time_in_contact", log_scale=step_s), rare),
        (Driver(quantity="time_in_motion", log_scale=step_s), rare),
        (Driver(quantity="deepest"), rare),
        (Driver(quantity="presses"), rare),
    ]


def groups(scene: Scene) -> Iterator[Group]:
    """All groups without periodic drivers, channel by channel."""
    lateral = [channel for channel in ("fx_N", "fy_N", "tx_Nm", "ty_Nm", "tz_Nm") if scene.judged(_number(channel))]
    plain = plain_drivers(scene)
    if scene.judged(_number("fz_N")):
        yield from _of_drivers(scene, "fz_N", WRENCH_FACTORS, plain, 0.0)
        fine = [
            (d, p + ASSUMED.laws.fine_nats)
            for d, p in plain
            if d.quantity in ("height", "gap", "speed", "time") and not (d.quantity == "speed" and d.log_scale)
        ]
        yield from _of_drivers(scene, "fz_N", ("one", "force", "air"), fine, 0.0, FINE_KNOTS)
        yield from _relaxed(scene, "fz_N", WRENCH_FACTORS, 0.0)
        yield from _loops(scene, "fz_N", ("height", "force"), ("one", "force"), 0.0)
    usual = [one for one in plain if one[0].quantity in ("height", "depth", "force", "time", "speed", "time_in_motion", "time_in_contact")]
    if {"fx_N", "fy_N"} <= set(lateral):
        yield from _of_drivers(scene, LATERAL, LATERAL_FACTORS, usual, CHANNEL_PRICE[LATERAL])
        yield from _relaxed(scene, LATERAL, ("one", "force"), CHANNEL_PRICE[LATERAL], every=2)
    few = [one for one in usual if one[0].quantity in ("height", "force", "time", "speed") and one[0].log_scale is None]
    for channel in lateral:
        yield from _of_drivers(scene, channel, SINGLE_FACTORS, few, ASSUMED.laws.single_axis_nats)
    if scene.judged(_number("z_m")):
        price = CHANNEL_PRICE["z_m"]
        still = [one for one in plain if one[0].quantity in ("height", "speed", "time", "acceleration", "time_in_motion")]
        yield from _of_drivers(scene, "z_m", HEIGHT_FACTORS, still, price)
        yield from _of_drivers(scene, "z_m", ("one",), [(Driver(quantity="command"), ASSUMED.laws.driver_nats)], price, FINE_KNOTS)
        yield from _loops(scene, "z_m", ("height", "command"), ("one",), price)
        yield from _speed_limits(scene, price)


def _number(channel: str) -> int:
    return CHANNELS.index(channel)


def _of_drivers(
    scene: Scene, channel: str, factors: tuple[FactorName, ...], drivers: list[tuple[Driver, float]], price: float, knots: int = 8
) -> Iterator[Group]:
    """Hats over each driver; where a factor is zero in the air or in contact, knots lie where it is not."""
    air = scene.driver(channel, Driver(quantity="air")) > 0.5
    for driver, own in drivers:
        x = scene.driver(channel, driver)
        for where, mine in (
            (~air, [f for f in factors if f in IN_CONTACT]),
            (air, [f for f in factors if f == "air"]),
            (np.ones_like(air), [f for f in factors if f != "air" and f not in IN_CONTACT]),
        ):
            if mine and (basis := hats(driver, x[where], knots)):
                yield Group(channel, tuple(mine), basis, price + own)


def _relaxed(scene: Scene, channel: str, factors: tuple[FactorName, ...], price: float, every: int = 1) -> Iterator[Group]:
    for quantity in RELAXED[::every]:
        for share in TIME_CONSTANTS:
            driver = Driver(quantity=quantity, memory="relaxed", constant=float(share * scene.duration_s))
            if basis := powers(driver, scene.driver(channel, driver)):
                yield Group(channel, factors, basis, price + ASSUMED.laws.relaxed_nats)


def _loops(scene: Scene, channel: str, quantities: tuple[Quantity, ...], factors: tuple[FactorName, ...], price: float) -> Iterator[Group]:
    for quantity in quantities:
        range_ = float(np.ptp(scene.driver(channel, Driver(quantity=quantity))))
        for share in ASSUMED.laws.dead_bands if range_ > 0.0 else ():
            for memory in ("play", "stop"):
                driver = Driver(quantity=quantity, memory=memory, constant=share * range_)
                if basis := hats(driver, scene.driver(channel, driver)):
                    yield Group(channel, factors, basis, price + ASSUMED.laws.loop_nats)


def _speed_limits(scene: Scene, price: float) -> Iterator[Group]:
    """A drive that follows its command only up to some speed."""
    fastest = float(np.quantile(np.abs(scene.driver("z_m", Driver(quantity="speed"))), 0.998))
    for share in (0.35, 0.5, 0.65, 0.8, 0.92) if fastest > 0.0 else ():
        driver = Driver(quantity="command", memory="slew", constant=share * fastest)
        if basis := powers(driver, scene.driver("z_m", driver)):
            yield Group("z_m", ("one",), basis, price + ASSUMED.laws.loop_nats)


def refined(scene: Scene, candidate: LawCandidate) -> list[LawCandidate]:
    """A candidate with other periods, or with other constants of its memory; empty where its driver has neither, or it is a formula."""
    driver, basis = candidate.driver, candidate.basis
    if not isinstance(basis, Basis):
        return []
    if driver.period is not None:
        x = scene.driver(candidate.channel, driver.model_copy(update={"period": None}))
        shifts = np.linspace(-0.2, 0.2, 9) / (2.0 * float(np.ptp(x)))  # of the frequency, within one peak
        periods = [float(1.0 / (1.0 / driver.period + shift)) for shift in shifts]
        return [replace(candidate, basis=harmonics(driver.model_copy(update={"period": period}), x)) for period in periods]
    if driver.constant is None:
        return []
    out = []
    for factor in REFINED:
        other = driver.model_copy(update={"constant": driver.constant * factor})
        x = scene.driver(candidate.channel, other)
        new = powers(other, x) if not len(basis.knots) else hats(other, x, len(basis.knots))
        if new is not None:
            out.append(replace(candidate, basis=new))
    return out


def periodic(scene: Scene, remainder: Floats) -> Iterator[LawCandidate]:
    """The likeliest periodic laws, by a scan over frequencies.

    Args:
        remainder: What the nuisances leave of the residual (7, b), whitened.
    """
    noise_m = scene.problem.cell.robot.position_noise_rms_m
    for channel, factors in PERIODIC_FACTORS.items():
        rows = [_number("fx_N"), _number("fy_N")] if channel == LATERAL else [_number(channel)]
        if not all(scene.judged(row) for row in rows):
            continue
        quantities: tuple[Quantity, ...] = ("command", "time") if channel == "z_m" else ("height", "time")
        for quantity in quantities:
            x = scene.driver(channel, Driver(quantity=quantity))
            span = float(np.ptp(x))
            if quantity == "time":
                finest = min(
                    ASSUMED.laws.fastest_Hz, ASSUMED.laws.fastest_rate_share * min(one.samples.rate_Hz for one in scene.problem.recordings)
                )
            else:
                finest = 1.0 / max(
                    min(ASSUMED.laws.shortest_pitch_m, span / ASSUMED.laws.strokes_per_pitch), ASSUMED.laws.pitch_noises * noise_m, 1e-12
                )
            count = min(int(2.0 * span * finest), MOST_FREQUENCIES)
            if count < 4:
                continue
            frequencies: Floats = np.asarray((2.0 + np.arange(count)) / (2.0 * span), dtype=np.float64)
            weights = [scene.factor(channel, factor) / scene.problem.noise.sigma[row] for row in rows for factor in factors]
            signal = np.array([w * remainder[row] for w, row in zip(weights, np.repeat(rows, len(factors)), strict=True)])
            power = _power(x, _extent(scene, quantity), signal, np.array(weights) ** 2, frequencies)
            power = power.reshape(len(rows), len(factors), -1).sum(axis=0)
            for factor, mine in zip(factors, power, strict=True):
                for k in _peaks(mine):
                    price = CHANNEL_PRICE[channel] + FACTOR_PRICE[factor] + ASSUMED.laws.periodic_nats + log(count)
                    for shift in (-0.35, 0.0, 0.35):
                        period = float(1.0 / (frequencies[k] + shift * (frequencies[1] - frequencies[0])))
                        yield LawCandidate(channel, factor, harmonics(Driver(quantity=quantity, period=period), x), price)


def _extent(scene: Scene, quantity: Quantity) -> Floats:
    """By how much a quantity changes within each bin (b,)."""
    length_s = scene.problem.per_bin(lambda one: one.bins.count / one.samples.rate_Hz)
    if quantity == "time":
        return length_s
    return np.asarray(np.abs(scene.problem.per_bin(lambda one: one.bins.mean(one.phases.velocity_m_per_s))) * length_s)


def _power(x: Floats, extent: Floats, signal: Floats, energy: Floats, frequencies: Floats) -> Floats:
    """Power (k, f) of k signals (k, b) at even frequencies of x, over that of a wave: the sums of signal × e^(-2πifx), by FFT.

    Bins that are long against the period average over it. So bins of similar extent go together, and each class has its sinc.
    """
    step = frequencies[1] - frequencies[0]
    size = 1 << int(np.ceil(np.log2(8.0 * frequencies[-1] / step)))
    place = np.rint((x - x.min()) * step * size).astype(np.intp) % size
    kind = np.digitize(extent, np.quantile(extent, np.linspace(0.0, 1.0, EXTENTS + 1)[1:-1]))
    first = round(frequencies[0] / step)
    waves, energies = np.zeros((len(signal), len(frequencies)), complex), np.zeros((len(signal), len(frequencies)))
    for number in np.unique(kind):
        mine = kind == number
        sinc = np.sinc(frequencies * float(np.mean(extent[mine])))
        for k, values in enumerate(signal):
            folded = np.bincount(place[mine], values[mine], size)
            waves[k] += np.fft.fft(folded)[first : first + len(frequencies)] * sinc
        energies += energy[:, mine].sum(axis=1)[:, None] * sinc**2
    return np.asarray(np.abs(waves) ** 2 / np.maximum(energies, 1e-9 * energies.max(axis=1, keepdims=True) + 1e-300))


def _peaks(power: Floats) -> list[int]:
    """Numbers of the PEAKS highest local maxima."""
    inner = np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])) + 1
    order = inner[np.argsort(-power[inner])]
    return [int(k) for k in order[:PEAKS]]
