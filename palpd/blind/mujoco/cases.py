"""One case: a cell that is drawn, simulated with MuJoCo, and sealed with its truth."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from palpd.blind.mujoco.effects import LISTED, CellEffect, Values, contract_parameters
from palpd.blind.mujoco.motions import calibration_path, draw_path
from palpd.blind.mujoco.nominal import force_residual, phase_of
from palpd.blind.mujoco.plant import simulate
from palpd.blind.mujoco.sensor import read, record
from palpd.blind.mujoco.servos import identify_servo, second_order
from palpd.blind.mujoco.setup import (
    TORQUE_ARM_M,
    Array,
    CellSetup,
    PlantRun,
    PlantSetup,
    PressPath,
    Reading,
    Rig,
    SensorSetup,
    ServoDesign,
    StatedCell,
    StatedTolerances,
)
from palpd.blind.mujoco.snr import Yardstick, sizes, snr, yardstick
from palpd.blind.mujoco.unlisted import UNLISTED
from palpd.blind.stated_cell import CHANNELS, log_uniform
from palpd.recording.samples import Samples

SNR_RANGE = (4.0, 60.0)
"""Signal-to-noise ratios are log-uniform over this range."""
SNR_ACCURACY = 0.04
"""The size of an effect is sought until its ratio is this near to the drawn one."""
EFFECTS: dict[str, CellEffect] = {effect.id: effect for effect in (*LISTED, *UNLISTED)}
"""All causes by id."""
ARM_SHARE = 0.4
"""Share of cells with the six-axis arm; the others are slides."""
MAX_TRIALS = 12
"""Number of sizes that are tried at most; three are usual."""
DEVIATION_LIMIT = 2.0
"""Deviations are drawn again beyond this number of standard deviations: all cells are within specification."""
ENGINE_SHARE = 0.3
"""Share of the slides that press on the engine's own contact, where no effect needs a tissue law of ours."""
OWN_CONTACT = ("tissue.", "contact.", "mount.thermal", "drive.", "phantom.")
"""Effects that begin so need the tissue law of this code."""


@dataclass(frozen=True)
class PlantedEffect:
    """An effect of a case with its parameters, the ratio that was sought and the one that it has alone."""

    effect: CellEffect
    values: Values
    sought_snr: float
    reached_snr: float = float("nan")


@dataclass
class MujocoCase:
    """A drawn cell with its effects; the runs are simulated when they are asked for, and kept."""

    seed: int
    index: int
    stated: StatedCell
    healthy: CellSetup
    deviations: dict[str, Any]
    path: PressPath
    other_path: PressPath
    planted: tuple[PlantedEffect, ...] = ()
    _readings: dict[tuple[Any, ...], Reading] = field(default_factory=dict, repr=False)
    _healthy_run: PlantRun | None = field(default=None, repr=False)
    _yardstick: Yardstick | None = field(default=None, repr=False)

    def reading(self, planted: Sequence[PlantedEffect] | None = None, *, other: bool = False) -> Reading:
        """The noise-free reading with some effects.

        Args:
            planted: the effects that act; None: all of the case.
            other: on the second motion.
        """
        acting = self.planted if planted is None else planted
        key = (other, *((each.effect.id, *each.values.items()) for each in acting))
        if key not in self._readings:
            setup = self.healthy
            for each in acting:
                setup = each.effect.apply(setup, each.values)
            path = self.other_path if other else self.path
            self._readings[key] = read(self.run(setup.plant, other=other), setup.sensor, self.stated, path)
        return self._readings[key]

    def run(self, plant: PlantSetup, *, other: bool = False) -> PlantRun:
        """Simulate a plant on one of the motions; the run of the healthy plant is kept.

        Args:
            plant: the mechanics.
            other: on the second motion.
        """
        if other or plant is not self.healthy.plant:
            return simulate(plant, self.other_path if other else self.path)
        if self._healthy_run is None:
            self._healthy_run = simulate(plant, self.path)
        return self._healthy_run

    def yardstick(self) -> Yardstick:
        """What a healthy cell may do on the first motion."""
        if self._yardstick is None:
            self._yardstick = healthy_variation(self)
        return self._yardstick

    def recording(self, *, other: bool = False, stated: StatedCell | None = None) -> Samples:
        """The recording with noise and rounding.

        Args:
            other: on the second motion.
            stated: gives noise and resolution; None: the cell's own.

        Returns:
            The rows of the CSV.
        """
        rng = np.random.default_rng([self.seed, self.index, 7 + other])
        path = self.other_path if other else self.path
        return record(self.reading(other=other), stated or self.stated, path, rng, self.deviations["noise_ratio"])


def draw_case(seed: int, index: int, effects: Sequence[str] = (), steps_over_noise: tuple[float, float, float] | None = None) -> MujocoCase:
    """Draw one case; the same arguments give the same case to the last bit.

    Args:
        seed: seed of the whole set.
        index: number of the case in the set.
        effects: ids of the effects to plant.
        steps_over_noise: coarse steps, as in a `CaseSpec`.

    Returns:
        The case, its effects scaled to their signal-to-noise ratios. A motion that hardly shows an effect at any size gives a lower one.
    """
    rng = np.random.default_rng([seed, index])
    rig: Rig = "arm" if rng.random() < ARM_SHARE else "slide"
    case = _draw_cell(rng, seed, index, rig)
    if steps_over_noise:
        case.stated = _with_coarse_steps(case.stated, steps_over_noise)
    own_contact = any(name.startswith(OWN_CONTACT) for name in effects)
    if rig == "slide" and rng.random() < ENGINE_SHARE and not own_contact:
        case.healthy = replace(case.healthy, plant=replace(case.healthy.plant, engine_contact=True))
    case.planted = tuple(_scaled(case, EFFECTS[name], case.yardstick(), rng) for name in effects)
    return case


def _with_coarse_steps(stated: StatedCell, over_noise: tuple[float, float, float]) -> StatedCell:
    lateral, vertical, torque = over_noise
    return replace(
        stated,
        resolution_fxy_N=lateral * stated.noise_rms_N,
        resolution_fz_N=vertical * stated.noise_rms_N,
        resolution_Nm=torque * stated.noise_rms_Nm,
    )


def _draw_servo(rng: np.random.Generator) -> ServoDesign:
    frequency, damping = rng.uniform(6.0, 12.0), rng.uniform(0.75, 1.1)
    design = ServoDesign("second order", frequency, damping, rng.uniform(32, 42), 0.002)
    name = str(rng.choice(["second order", "held at 125 Hz", "held at 500 Hz", "third order", "limited jerk"]))
    if name == "held at 125 Hz":
        return replace(design, name=name, hold_Hz=125.0, inner_frequency_Hz=rng.uniform(14, 17), drive_filter_s=0.016)
    if name == "held at 500 Hz":
        return replace(design, name=name, hold_Hz=500.0)
    if name == "third order":
        return replace(design, name=name, extra_pole_Hz=rng.uniform(6.0, 12.0) * frequency)
    if name == "limited jerk":
        return replace(design, name=name, jerk_window_s=rng.uniform(0.008, 0.016))
    return design


def _draw_stated(rng: np.random.Generator) -> StatedCell:
    coarse = rng.random() < 0.5
    # A step far above the noise would make the rounding error anything but white.
    mass, radius, noise = rng.uniform(0.1, 0.4), rng.uniform(0.003, 0.008), log_uniform(rng, 0.045 if coarse else 0.02, 0.08)
    rate = float(rng.choice([125, 250, 500, 500, 1000]))
    tolerances = StatedTolerances(0.4 * noise, 0.2 * noise, 0.015 * mass, 0.006 * radius)
    return StatedCell(
        mass, radius, rng.uniform(0.05, 0.12), rate, float(rng.choice([15.0, 50.0, 150.0])) if rng.random() < 0.85 else None,
        noise, 0.02 * noise, 0.024 if coarse else 0.002, 0.131 if coarse else 0.005, 0.001 if coarse else 1e-4,
        8.0, 1.0, rng.uniform(4e-6, 8e-6), rng.uniform(1e-4, 3e-4), rng.uniform(-0.02, 0.05), log_uniform(rng, 2e4, 2e5),
        0.5 if rng.random() < 0.7 else float(np.round(rng.uniform(0.4, 0.5), 2)), 0.004 * radius, 0.01, tolerances,
        float(rng.choice([125, 500])),
    )  # fmt: skip


def _draw_cell(rng: np.random.Generator, seed: int, index: int, rig: Rig) -> MujocoCase:
    stated = _draw_stated(rng)
    servo = _draw_servo(rng)
    if rig == "arm":
        stated = replace(stated, rate_Hz=min(500.0, stated.rate_Hz))
    step = 0.001 if stated.rate_Hz > 500 else 0.002
    moving = rng.uniform(60, 120) * (37 / servo.inner_frequency_Hz) ** 2  # all loops are about as stiff
    ideal = PlantSetup(
        rig, step, servo, moving, stated.mass_kg, stated.tip_length_m, stated.hertz_N_per_m15, stated.surface_z_m, stated.tip_radius_m
    )
    frequency, damping = _calibrated(rng, ideal, stated)
    stated = replace(stated, servo_natural_frequency_Hz=frequency, servo_damping_ratio=damping)
    healthy, deviations = _deviating(rng, ideal, stated)
    long_s = 90.0 if rig == "slide" and stated.rate_Hz <= 500 else 45.0
    force = log_uniform(rng, 1.5, 5.0)
    path = draw_path(rng, stated, log_uniform(rng, 20.0, long_s), force)
    healthy = replace(healthy, plant=replace(healthy.plant, deepest_m=path.deepest_m))
    other = draw_path(rng, stated, 25.0, force * rng.uniform(0.6, 1.1))
    return MujocoCase(seed, index, stated, healthy, deviations, path, other)


def _calibrated(rng: np.random.Generator, plant: PlantSetup, stated: StatedCell) -> tuple[float, float]:
    """Natural frequency and damping ratio as a user identifies them from a noisy free motion of the healthy cell."""
    path = calibration_path(rng, stated.surface_z_m, 0.02)
    samples = record(read(simulate(plant, path), SensorSetup(None), stated, path), stated, path, rng)
    assert samples.z_cmd_m is not None
    return identify_servo(samples.t_s, samples.z_cmd_m, samples.z_m)


def _deviating(rng: np.random.Generator, plant: PlantSetup, stated: StatedCell) -> tuple[CellSetup, dict[str, Any]]:
    """The cell as it is: every tolerance has its own deviation."""
    draws = rng.standard_normal(13)
    while (far := np.abs(draws) > DEVIATION_LIMIT).any():
        draws[far] = rng.standard_normal(int(far.sum()))
    limit = stated.tolerances
    cross = limit.crosstalk * draws[:4] * np.array([1, 1, TORQUE_ARM_M, TORQUE_ARM_M])
    values = {
        name: float(getattr(limit, name) * draw)
        for name, draw in zip(
            ["bias_N", "drift_N_per_min", "gain", "latency_s", "filter_cutoff", "mass_kg", "youngs_modulus", "surface_z_m",
             "servo_natural_frequency"], draws[4:], strict=True,
        )
    }  # fmt: skip
    true = replace(
        plant,
        mass_kg=plant.mass_kg + values["mass_kg"],
        hertz_N_per_m15=plant.hertz_N_per_m15 * (1 + values["youngs_modulus"]),
        surface_z_m=plant.surface_z_m + values["surface_z_m"],
        servo_ratio=1 + values["servo_natural_frequency"],
    )
    cutoff = stated.filter_cutoff_Hz and stated.filter_cutoff_Hz * (1 + values["filter_cutoff"])
    sensor = SensorSetup(
        cutoff,
        values["gain"],
        (cross[0], cross[1], cross[2], cross[3]),
        values["latency_s"],
        values["bias_N"],
        values["drift_N_per_min"] / 60,
    )
    noise_ratio = float(rng.uniform(0.85, 1.15))
    return CellSetup(true, sensor), values | {"crosstalk": cross.tolist(), "noise_ratio": noise_ratio}


def healthy_variation(case: MujocoCase) -> Yardstick:
    """Directions of one standard deviation of every tolerance and of every press, by finite differences of the simulator itself.

    Args:
        case: the cell.

    Returns:
        The yardstick for its effects.
    """
    healthy, stated, limit = case.healthy, case.stated, case.stated.tolerances
    base = case.reading([])

    def change(setup: CellSetup) -> Array:
        reading = read(case.run(setup.plant), setup.sensor, stated, case.path)
        return force_residual(reading.samples, stated, case.path) - force_residual(base.samples, stated, case.path)

    def sensor(**moved: Any) -> CellSetup:
        return replace(healthy, sensor=replace(healthy.sensor, **moved))

    def plant(**moved: Any) -> CellSetup:
        return replace(healthy, plant=replace(healthy.plant, **moved))

    true = healthy.sensor
    directions = [
        change(sensor(bias_N=true.bias_N + limit.bias_N)),
        change(sensor(drift_N_per_s=true.drift_N_per_s + limit.drift_N_per_min / 60)),
        change(sensor(gain=true.gain + limit.gain)),
        change(sensor(latency_s=true.latency_s + limit.latency_s)),
        *([] if true.cutoff_Hz is None else [change(sensor(cutoff_Hz=true.cutoff_Hz * (1 + limit.filter_cutoff)))]),
    ]
    for axis in range(4):
        leak = list(true.crosstalk)
        leak[axis] += limit.crosstalk * (1.0 if axis < 2 else TORQUE_ARM_M)
        directions.append(change(sensor(crosstalk=tuple(leak))))
    of = healthy.plant
    stiffer = change(plant(hertz_N_per_m15=of.hertz_N_per_m15 * (1 + limit.youngs_modulus)))
    higher = change(plant(surface_z_m=of.surface_z_m + limit.surface_z_m))
    directions += [stiffer, higher, change(plant(mass_kg=of.mass_kg + limit.mass_kg))]
    directions.append(change(plant(servo_ratio=of.servo_ratio * (1 + limit.servo_natural_frequency))))
    press = case.path.press_of(base.samples.t_s)
    for number in range(len(case.path.surface_m)):
        rows = (press == number)[:, None]
        directions.append(np.where(rows, stiffer * stated.scatter_stiffness / limit.youngs_modulus, 0.0))
        directions.append(np.where(rows, higher * stated.scatter_surface_z_m / limit.surface_z_m, 0.0))
    return yardstick(base.samples, stated, directions)


def change_by(case: MujocoCase, planted: Sequence[PlantedEffect], without: Sequence[PlantedEffect] = ()) -> Array:
    """The noise-free change of height and wrench between two sets of effects, less what the change of motion explains.

    Args:
        case: the cell.
        planted: effects that act.
        without: effects that act in the comparison.

    Returns:
        (n, 7) in the order of `CHANNELS`.
    """
    one, two = (force_residual(case.reading(some).samples, case.stated, case.path) for some in (planted, without))
    return np.asarray(one - two)


def _scaled(case: MujocoCase, effect: CellEffect, scale: Yardstick, rng: np.random.Generator) -> PlantedEffect:
    """The effect with the size that gives a drawn signal-to-noise ratio, by secants in the logarithms."""
    sought = log_uniform(rng, *SNR_RANGE)
    values = effect.draw(rng, case.stated, case.path)
    best, tried = (np.inf, values, 0.0), []
    log_size, low, high = 0.0, -np.inf, np.inf
    for _ in range(MAX_TRIALS):
        trial = effect.scaled(values, float(np.exp(log_size)))
        reached = effect.direction * float(np.log(trial[effect.size[0]] / values[effect.size[0]]))
        ratio = snr(change_by(case, [PlantedEffect(effect, trial, sought)]), scale)[0]
        miss = float(np.clip(np.log(max(ratio, 1e-6) / sought), -4.0, 4.0))
        best = min(best, (abs(miss), trial, ratio), key=lambda entry: entry[0])
        if abs(miss) < SNR_ACCURACY or abs(reached - log_size) > 1e-6:
            break
        tried.append((log_size, miss))
        low, high = (log_size, high) if miss < 0 else (low, log_size)
        log_size = _next_size(tried, low, high)
    return PlantedEffect(effect, best[1], sought, best[2])


def _next_size(tried: list[tuple[float, float]], low: float, high: float) -> float:
    """The next logarithm of a size to try: a secant, inside of what is bracketed."""
    (at, miss) = tried[-1]
    slope = 1.0
    if len(tried) > 1 and abs(at - tried[-2][0]) > 1e-4:
        slope = float(np.clip((miss - tried[-2][1]) / (at - tried[-2][0]), 0.3, 8.0))
    following = at + float(np.clip(-miss / slope, -2.0, 2.0))
    if np.isfinite(low) and np.isfinite(high):
        edge = 0.1 * (high - low)
        if not low + edge < following < high - edge:
            # A secant that wants the edge of a bracket hardly moves it.
            following = 0.5 * (low + high) if len(tried) > 3 else float(np.clip(following, low + edge, high - edge))
    return following


def sealed_truth(case: MujocoCase) -> dict[str, Any]:
    """What is true about a case, as JSON.

    Returns:
        Rig, deviations, every effect with its parameters, signal-to-noise ratios and sizes, and how exact the healthy cell is.
    """
    plant = case.healthy.plant
    truth: dict[str, Any] = {
        "schema": "palpd.mujoco_truth/1", "seed": case.seed, "index": case.index, "rig": plant.rig,
        "controller": vars(plant.servo), "physics_step_s": plant.step_s, "report_rate_Hz": case.stated.report_rate_Hz,
        "contact": "MuJoCo's soft contact" if plant.engine_contact else "Hertz, by xfrc_applied at the tip",
        "deviations": case.deviations,
        "press_scatter": {"surface_z_m": case.path.surface_m.tolist(), "stiffness": case.path.stiffness.tolist()},
    }  # fmt: skip
    scale = case.yardstick()
    truth["healthy_mismatch"] = healthy_mismatch(case, scale)
    truth["effects"] = []
    for each in case.planted:
        rest = [some for some in case.planted if some is not each]
        change = change_by(case, case.planted, rest)
        reached, projected = snr(change, scale)
        phases = phase_of(case.reading(rest).samples, case.stated)
        table = sizes(change, phases, scale)
        effect = each.effect
        truth["effects"].append({
            "id": effect.id, "listed": effect.listed, "nature": effect.nature, "law": effect.law, "made_by": effect.by,
            "description": effect.description, "parameters": contract_parameters(effect, each.values),
            "snr": reached, "snr_projected": projected, "snr_sought": each.sought_snr,
            "where": {key: table[0][key] for key in ("channel", "phase")}, "size": table[0]["size"], "change": table,
        })  # fmt: skip
    return truth


def healthy_mismatch(case: MujocoCase, scale: Yardstick) -> dict[str, Any]:
    """How far the cell without effects is from the nominal physics of docs/reference/contract.md (§3), its in-tolerance deviations fitted.

    Args:
        scale: its healthy directions.

    Returns:
        For every channel the rms in standard deviations of one sample, and the signal-to-noise ratios of the whole and of the forces.
    """
    samples = case.reading([]).samples
    assert samples.z_cmd_m is not None
    stated = case.stated
    rest = force_residual(samples, stated, case.path)
    rest[:, 0] -= second_order(samples.z_cmd_m, 1 / stated.rate_Hz, stated.servo_natural_frequency_Hz, stated.servo_damping_ratio)
    d = np.column_stack([scale.whitened(direction) for direction in scale.directions])
    fitted = np.linalg.solve(np.eye(d.shape[1]) + d.T @ d, d.T @ scale.whitened(rest))
    left = rest - np.tensordot(fitted, scale.directions, axes=1)
    forces = np.concatenate([np.zeros_like(left[:, :1]), left[:, 1:]], axis=1)
    return {
        "rms_sigma": dict(zip(CHANNELS, (np.sqrt((left**2).mean(axis=0)) / stated.sigma).tolist(), strict=True)),
        "largest_sigma": dict(zip(CHANNELS, (np.abs(left).max(axis=0) / stated.sigma).tolist(), strict=True)),
        "snr": float(np.linalg.norm(scale.whitened(left))),
        "snr_of_forces": float(np.linalg.norm(scale.whitened(forces))),
    }
