"""What can be wrong with a cell: causes of the contract's list, each as a change of the MuJoCo model or of the sensor.

The list is that of docs/reference/contract.md §6.
`law` says whether the change follows the contract's formula (`same`) or another real form of the same cause (`other`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpd.blind.mujoco.sensor import low_pass
from palpd.blind.mujoco.servos import play
from palpd.blind.mujoco.setup import (
    Array,
    Cable,
    CellSetup,
    Dashpot,
    ForceTerm,
    LateralTerm,
    PlantRun,
    PressPath,
    RingingMount,
    StatedCell,
)
from palpd.blind.stated_cell import log_uniform
from palpd.blind.truth import EVENT, LawStatement

Values = dict[str, float]
Draw = Callable[[np.random.Generator, StatedCell, PressPath], Values]
Apply = Callable[[CellSetup, Values], CellSetup]


@dataclass(frozen=True)
class CellEffect:
    """One cause: how its parameters are drawn, how it changes a cell, and which parameter makes it larger.

    `size` names the parameters that are scaled to reach a signal-to-noise ratio; `direction` -1 where smaller is worse. `limits` bound
    the first of them (absolute). `nature` is `law`, or `event` for something that happens at some instants only. `by` says what makes it.
    `states` says what an unlisted one is.
    """

    id: str
    listed: bool
    nature: str
    law: str
    by: str
    description: str
    draw: Draw
    apply: Apply
    size: tuple[str, ...]
    limits: tuple[float, float]
    direction: int = 1
    states: Callable[[Values, StatedCell], LawStatement] = lambda _, __: EVENT

    def scaled(self, values: Values, factor: float) -> Values:
        """The same effect that many times larger, inside its limits.

        Args:
            values: parameters.
            factor: more than 1 makes it larger.

        Returns:
            New parameters.
        """
        ratio = factor**self.direction
        size = abs(values[self.size[0]])
        ratio = float(np.clip(size * ratio, *self.limits)) / size
        return values | {name: values[name] * ratio for name in self.size}


def change_plant(setup: CellSetup, **changes: object) -> CellSetup:
    """The cell with other mechanics.

    Args:
        changes: fields of the plant by name.
    """
    return replace(setup, plant=replace(setup.plant, **changes))  # type: ignore[arg-type]


def change_sensor(setup: CellSetup, **changes: object) -> CellSetup:
    """The cell with another sensor.

    Args:
        changes: fields of the sensor by name.
    """
    return replace(setup, sensor=replace(setup.sensor, **changes))  # type: ignore[arg-type]


def add_stage(setup: CellSetup, stage: Callable[[Array, PlantRun], Array]) -> CellSetup:
    """The cell with one more step in the transducer.

    Args:
        stage: see `setup.Stage`.
    """
    return change_sensor(setup, stages=(*setup.sensor.stages, stage))


def add_zero(setup: CellSetup, zero: Callable[[Array, PlantRun], Array]) -> CellSetup:
    """The cell with one more wandering of the sensor's zero.

    Args:
        zero: see `setup.ZeroStage`.
    """
    return change_sensor(setup, zero_stages=(*setup.sensor.zero_stages, zero))


def add_force(setup: CellSetup, make: Callable[[PressPath, Array], ForceTerm]) -> CellSetup:
    """The cell with one more term in the tissue's force.

    Args:
        make: makes the term from path and times.
    """
    return change_plant(setup, force_terms=(*setup.plant.force_terms, make))


def fz_stage(law: Callable[[Array, float], Array]) -> Callable[[Array, PlantRun], Array]:
    """A transducer stage that replaces fz by a law of fz (n,) and the step in s."""

    def stage(wrench: Array, run: PlantRun) -> Array:
        out = wrench.copy()
        out[:, 2] = law(wrench[:, 2], float(run.t_s[1] - run.t_s[0]))
        return out

    return stage


def sign(rng: np.random.Generator) -> float:
    """Minus or plus one."""
    return 1.0 if rng.random() < 0.5 else -1.0


def peak_force_N(cell: StatedCell, path: PressPath) -> float:
    """Nominal force of the deepest press.

    Args:
        cell: gives the Hertz factor.
        path: gives the depth.
    """
    return cell.hertz_N_per_m15 * path.deepest_m**1.5


def _drift(setup: CellSetup, v: Values) -> CellSetup:
    return add_zero(setup, lambda t, _: v["rate_N_per_s"] * t * (1 + 0.2 * (t / t[-1] - 0.5)))


def _warmup(setup: CellSetup, v: Values) -> CellSetup:
    return add_zero(setup, lambda t, _: v["amplitude_N"] * (1 - 0.7 * np.exp(-t / v["tau_s"]) - 0.3 * np.exp(-t / (3 * v["tau_s"]))))


def _crosstalk(setup: CellSetup, v: Values) -> CellSetup:
    add = np.array([v["fx_per_fz"], v["fy_per_fz"], v["tx_per_fz_m"], v["ty_per_fz_m"]])
    return change_sensor(setup, crosstalk=tuple((np.array(setup.sensor.crosstalk) + add).tolist()))


def _draw_crosstalk(rng: np.random.Generator, *_: object) -> Values:
    a, b, c, d = rng.standard_normal(4)
    return {"fx_per_fz": 0.03 * a, "fy_per_fz": 0.03 * b, "tx_per_fz_m": 0.0015 * c, "ty_per_fz_m": 0.0015 * d}


def _hysteresis(setup: CellSetup, v: Values) -> CellSetup:
    widths = v["width_N"] * np.array([0.5, 1.0, 2.0])

    def law(fz: Array, _: float) -> Array:
        loop = sum((fz - play(fz, width)) / width for width in widths) / len(widths)
        return np.asarray(fz + v["amplitude_N"] * loop)

    return add_stage(setup, fz_stage(law))


def _creep(setup: CellSetup, v: Values) -> CellSetup:
    def law(fz: Array, step_s: float) -> Array:
        slow, slower = (low_pass(fz, 1 / (2 * np.pi * tau), step_s) for tau in (v["tau_s"], 4 * v["tau_s"]))
        return fz + v["ratio"] * (0.7 * slow + 0.3 * slower)

    return add_stage(setup, fz_stage(law))


def _saturation(setup: CellSetup, v: Values) -> CellSetup:
    knee = 0.03 * v["limit_N"]
    return add_stage(setup, fz_stage(lambda fz, _: fz - knee * np.logaddexp(0.0, (fz - v["limit_N"]) / knee)))


def _asymmetry(setup: CellSetup, v: Values) -> CellSetup:
    return add_stage(setup, fz_stage(lambda fz, _: fz + v["ratio"] * np.maximum(0.0, fz - v["at_N"])))


def _dropout(setup: CellSetup, v: Values) -> CellSetup:
    def keep(t: Array) -> NDArray[np.intp]:
        rng = np.random.default_rng(int(v["seed"]))
        starts, rows = np.sort(rng.uniform(0, t[-1], max(3, round(v["rate_Hz"] * t[-1])))), np.arange(len(t))
        for a, b in zip(np.searchsorted(t, starts), np.searchsorted(t, starts + v["length_s"]), strict=True):
            rows[a:b] = rows[max(0, a - 1)]
        return rows

    return change_sensor(setup, dropout=keep)


def _tilt(setup: CellSetup, v: Values) -> CellSetup:
    return change_plant(setup, tilt_rad=v["angle_rad"], tilt_azimuth_rad=v["azimuth_rad"])


def _cable(**names: str) -> Apply:
    """An effect of the cable: which of its fields takes which parameter."""

    def apply(setup: CellSetup, v: Values) -> CellSetup:
        cable = setup.plant.cable or Cable()
        return change_plant(setup, cable=replace(cable, **{field: v[name] for field, name in names.items()}))

    return apply


def _backlash(setup: CellSetup, v: Values) -> CellSetup:
    if setup.plant.rig == "slide":
        return change_plant(setup, backlash_m=v["width_m"], guide_friction_N=v["guide_friction_N"])

    def make(path: PressPath, _: Array) -> Callable[[float, int], float]:
        at, half = float(path.z_cmd_m[0]), v["width_m"] / 2

        def shift(tip_z_m: float, _: int) -> float:
            nonlocal at
            at = min(max(at, tip_z_m - half), tip_z_m + half)
            return tip_z_m - at

        return shift

    return change_plant(setup, shift_terms=(*setup.plant.shift_terms, make))


def _vibration(setup: CellSetup, v: Values) -> CellSetup:
    return change_plant(setup, vibration=(v["amplitude_m"], v["frequency_Hz"], v["phase_rad"]))


def _dashpot(setup: CellSetup, v: Values) -> CellSetup:
    return change_plant(setup, dashpot=Dashpot(v["stiffness_N_per_m"], v["tau_s"]))


def _draw_dashpot(rng: np.random.Generator, cell: StatedCell, path: PressPath) -> Values:
    return {"stiffness_N_per_m": 0.15 * peak_force_N(cell, path) / path.deepest_m, "tau_s": log_uniform(rng, 0.2, 3.0)}


def _preconditioning(setup: CellSetup, v: Values) -> CellSetup:
    def make(_: PressPath, __: Array) -> ForceTerm:
        deepest = 0.0

        def term(force_N: float, depth_m: float, _: int) -> float:
            nonlocal deepest
            if depth_m >= deepest:
                deepest = depth_m
                return force_N
            return force_N * (1 - v["softening"] * (1 - depth_m / deepest)) if depth_m > 0 else force_N

        return term

    return add_force(setup, make)


def _adhesion(setup: CellSetup, v: Values) -> CellSetup:
    def make(_: PressPath, __: Array) -> ForceTerm:
        deepest, last = 0.0, 0.0

        def term(force_N: float, depth_m: float, _: int) -> float:
            nonlocal deepest, last
            leaving, last = depth_m < last, depth_m
            if depth_m > deepest:
                deepest = depth_m
            if deepest == 0.0 or not leaving:
                return force_N
            if depth_m < -v["range_m"]:
                deepest = 0.0
                return force_N
            stretch = max(0.0, 1 - depth_m / deepest) if depth_m > 0 else (1 + depth_m / v["range_m"]) ** 2
            return force_N - v["force_N"] * stretch

        return term

    return add_force(setup, make)


def _thickness(setup: CellSetup, v: Values) -> CellSetup:
    radius = setup.plant.tip_radius_m

    def make(_: PressPath, __: Array) -> ForceTerm:
        def term(force_N: float, depth_m: float, _: int) -> float:
            if depth_m <= 0:
                return force_N
            x = (radius * depth_m) ** 0.5 / v["thickness_m"]
            return force_N * (1 + x * (1.133 + x * (1.283 + x * (0.769 + 0.0975 * x))))

        return term

    return add_force(setup, make)


def _inclusion(setup: CellSetup, v: Values) -> CellSetup:
    def make(_: PressPath, __: Array) -> ForceTerm:
        return lambda force_N, depth_m, _: (
            force_N * (1 + v["contrast"] * -np.expm1(-((depth_m / v["depth_m"]) ** 2))) if depth_m > 0 else force_N
        )

    return add_force(setup, make)


def _plasticity(setup: CellSetup, v: Values) -> CellSetup:
    def make(path: PressPath, _: Array) -> Callable[[float, int], float]:
        sunk, deepest, number = 0.0, 0.0, 0

        def shift(tip_z_m: float, _: int) -> float:
            nonlocal sunk, deepest, number
            depth = setup.plant.surface_z_m - tip_z_m
            if depth > 0:
                deepest = max(deepest, depth)
            elif deepest > 0 and depth < -1e-3:
                sunk += v["set_m"] * v["ratio"] ** number * deepest / path.deepest_m
                number, deepest = number + 1, 0.0
            return -sunk

        return shift

    return change_plant(setup, shift_terms=(*setup.plant.shift_terms, make))


def _lateral(setup: CellSetup, v: Values) -> CellSetup:
    x, y = v["ratio"] * np.cos(v["azimuth_rad"]), v["ratio"] * np.sin(v["azimuth_rad"])

    def make(_: PressPath, __: Array) -> LateralTerm:
        return lambda force_N, _: (x * force_N, y * force_N)

    return change_plant(setup, lateral=make)


def _sensor_field(name: str, parameter: str) -> Apply:
    """An effect that is added to one field of the true sensor."""
    return lambda setup, v: change_sensor(setup, **{name: getattr(setup.sensor, name) + v[parameter]})


def _cutoff(setup: CellSetup, v: Values) -> CellSetup:
    return change_sensor(setup, cutoff_Hz=v["cutoff_Hz"])


def _plant_field(name: str, parameter: str) -> Apply:
    """An effect that is added to one field of the plant."""
    return lambda setup, v: change_plant(setup, **{name: getattr(setup.plant, name) + v[parameter]})


LISTED: tuple[CellEffect, ...] = (
    CellEffect(
        "sensor.bias", True, "law", "same", "sensor model", "constant on fz",
        lambda r, _c, _p: {"offset_N": 0.2 * sign(r)}, _sensor_field("bias_N", "offset_N"), ("offset_N",), (1e-4, 5.0),
    ),
    CellEffect(
        "sensor.drift", True, "law", "other", "sensor model", "a slope in time that changes by a fifth over the recording",
        lambda r, _c, _p: {"rate_N_per_s": 0.005 * sign(r)}, _drift, ("rate_N_per_s",), (1e-6, 0.3),
    ),
    CellEffect(
        "sensor.warmup", True, "law", "other", "sensor model", "two exponentials, tau and 3 tau",
        lambda r, _c, _p: {"amplitude_N": 0.2 * sign(r), "tau_s": log_uniform(r, 3, 15)}, _warmup, ("amplitude_N",), (1e-4, 5.0),
    ),
    CellEffect(
        "sensor.gain", True, "law", "same", "sensor model", "fz times (1 + error)",
        lambda r, _c, _p: {"error": 0.03 * sign(r)}, _sensor_field("gain", "error"), ("error",), (1e-4, 0.6),
    ),
    CellEffect(
        "sensor.crosstalk", True, "law", "same", "sensor model", "fz leaks into fx, fy, tx, ty",
        _draw_crosstalk, _crosstalk, ("fx_per_fz", "fy_per_fz", "tx_per_fz_m", "ty_per_fz_m"), (1e-5, 1.0),
    ),
    CellEffect(
        "sensor.filter", True, "law", "same", "sensor model", "one pole at another frequency",
        lambda _r, c, _p: {"cutoff_Hz": 0.2 * (c.filter_cutoff_Hz or 150.0)}, _cutoff, ("cutoff_Hz",), (0.4, 140.0), -1,
    ),
    CellEffect(
        "sensor.latency", True, "law", "same", "sensor model", "wrench late by a constant",
        lambda _r, _c, _p: {"delay_s": 0.01}, _sensor_field("latency_s", "delay_s"), ("delay_s",), (2e-4, 0.3),
    ),
    CellEffect(
        "sensor.hysteresis", True, "law", "other", "sensor model", "three stop operators (Prandtl-Ishlinskii) of width/2, width, 2 width",
        lambda r, c, p: {"width_N": r.uniform(0.05, 0.25) * peak_force_N(c, p), "amplitude_N": 0.1},
        _hysteresis, ("amplitude_N",), (1e-4, 3.0),
    ),
    CellEffect(
        "sensor.creep", True, "law", "other", "sensor model", "two low-passes of the load, tau and 4 tau",
        lambda r, _c, _p: {"ratio": 0.05, "tau_s": log_uniform(r, 0.5, 5)}, _creep, ("ratio",), (1e-4, 1.0),
    ),
    CellEffect(
        "sensor.saturation", True, "law", "other", "sensor model", "clipping with a round knee of 3 % of the limit",
        lambda _r, c, p: {"limit_N": 0.8 * peak_force_N(c, p)}, _saturation, ("limit_N",), (0.05, 20.0), -1,
    ),
    CellEffect(
        "sensor.asymmetry", True, "law", "same", "sensor model", "another slope above at_N",
        lambda r, c, p: {"ratio": 0.1 * sign(r), "at_N": r.uniform(0.1, 0.5) * peak_force_N(c, p), "side": 1.0},
        _asymmetry, ("ratio",), (1e-3, 0.9),
    ),
    CellEffect(
        "sensor.dropout", True, "law", "same", "sensor model", "samples held now and then",
        lambda r, _c, _p: {"rate_Hz": log_uniform(r, 0.3, 1.5), "length_s": 0.1, "seed": float(r.integers(1 << 30))},
        _dropout, ("length_s",), (0.004, 2.0),
    ),
    CellEffect(
        "clock.skew", True, "law", "same", "sensor model", "the sensor's clock runs fast",
        lambda _r, _c, _p: {"ratio": 3e-4}, _sensor_field("clock_skew", "ratio"), ("ratio",), (1e-5, 1.4e-3),
    ),
    CellEffect(
        "probe.mass", True, "law", "same", "MuJoCo: body mass", "moving mass differs",
        lambda _r, c, _p: {"delta_kg": 0.3 * c.mass_kg}, _plant_field("mass_kg", "delta_kg"), ("delta_kg",), (1e-4, 5.0),
    ),
    CellEffect(
        "probe.tilt", True, "law", "same", "MuJoCo: sensor and probe turned about the tip", "sensor axis tilted against z",
        lambda r, _c, _p: {"angle_rad": 0.05, "azimuth_rad": r.uniform(-np.pi, np.pi)}, _tilt, ("angle_rad",), (1e-3, 0.7),
    ),
    CellEffect(
        "cable.spring", True, "law", "same", "MuJoCo: joint stiffness of a cable body", "spring from the first height",
        lambda _r, _c, _p: {"stiffness_N_per_m": 10.0}, _cable(stiffness_N_per_m="stiffness_N_per_m"), ("stiffness_N_per_m",), (0.1, 400.0),
    ),
    CellEffect(
        "cable.friction", True, "law", "other", "MuJoCo: joint frictionloss of a cable body", "Coulomb friction, regularised by the solver",
        lambda _r, _c, _p: {"force_N": 0.1}, _cable(friction_N="force_N"), ("force_N",), (1e-3, 4.0),
    ),
    CellEffect(
        "cable.viscous", True, "law", "same", "MuJoCo: joint damping of a cable body", "force linear in speed",
        lambda _r, _c, _p: {"coefficient_N_s_per_m": 5.0}, _cable(viscous_N_s_per_m="coefficient_N_s_per_m"),
        ("coefficient_N_s_per_m",), (0.05, 400.0),
    ),
    CellEffect(
        "structure.resonance", True, "law", "same", "MuJoCo: part of the probe on a sprung joint", "part of the probe rings",
        lambda r, _c, _p: {"frequency_Hz": log_uniform(r, 5, 25), "damping_ratio": log_uniform(r, 0.01, 0.08), "participation": 0.3},
        lambda s, v: change_plant(s, ring=RingingMount(v["frequency_Hz"], v["damping_ratio"], v["participation"])),
        ("participation",), (5e-3, 0.9),
    ),
    CellEffect(
        "robot.lag", True, "law", "other", "controller gains", "this controller's own bandwidth is lower",
        lambda _r, _c, _p: {"slowing": 0.1}, lambda s, v: change_plant(s, servo_ratio=s.plant.servo_ratio / (1 + v["slowing"])),
        ("slowing",), (2e-3, 3.0),
    ),
    CellEffect(
        "robot.compliance", True, "law", "other", "MuJoCo: sprung joint above the sensor", "tip gives way, and rings when it is let go",
        lambda _r, _c, _p: {"stiffness_N_per_m": 1e4}, lambda s, v: change_plant(s, tip_stiffness_N_per_m=v["stiffness_N_per_m"]),
        ("stiffness_N_per_m",), (400.0, 2.4e4), -1,
    ),
    CellEffect(
        "robot.backlash", True, "law", "other", "slide: a MuJoCo joint with a gap in a guide with friction; arm: tip height",
        "slide: play that impacts at its ends; arm: the play operator",
        lambda _r, c, p: {"width_m": 1e-4, "guide_friction_N": 1.3 * peak_force_N(c, p) + 2.0}, _backlash, ("width_m",), (1e-6, 1.5e-3),
    ),
    CellEffect(
        "robot.vibration", True, "law", "same", "actuator target", "sinusoidal motion, reported",
        lambda r, _c, _p: {"amplitude_m": 1e-5, "frequency_Hz": log_uniform(r, 2, 12), "phase_rad": r.uniform(-np.pi, np.pi)},
        _vibration, ("amplitude_m",), (2e-7, 5e-4),
    ),
    CellEffect(
        "tissue.surface", True, "law", "same", "tissue force", "surface elsewhere",
        lambda r, _c, _p: {"offset_m": 3e-4 * sign(r)}, _plant_field("surface_z_m", "offset_m"), ("offset_m",), (1e-5, 2.5e-3),
    ),
    CellEffect(
        "tissue.modulus", True, "law", "same", "tissue force", "stiffer or softer: ratio - 1 is excess",
        lambda r, _c, _p: {"excess": 0.1 * sign(r)},
        lambda s, v: change_plant(s, hertz_N_per_m15=s.plant.hertz_N_per_m15 * (1 + v["excess"])), ("excess",), (1e-3, 0.8),
    ),
    CellEffect(
        "tissue.viscoelastic", True, "law", "other", "MuJoCo: a damped body on a spring", "a linear Maxwell arm in parallel",
        _draw_dashpot, _dashpot, ("stiffness_N_per_m",), (1.0, 4000.0),
    ),
    CellEffect(
        "tissue.preconditioning", True, "law", "other", "tissue force", "softening linear in depth over deepest depth",
        lambda _r, _c, _p: {"softening": 0.1}, _preconditioning, ("softening",), (1e-3, 0.9),
    ),
    CellEffect(
        "tissue.adhesion", True, "law", "other", "tissue force", "pull that grows while leaving and tears quadratically",
        lambda r, _c, _p: {"force_N": 0.1, "range_m": r.uniform(3e-4, 2e-3)}, _adhesion, ("force_N",), (1e-3, 3.0),
    ),
    CellEffect(
        "tissue.thickness", True, "law", "same", "tissue force", "Dimitriadis 2002, bonded, nu = 0.5",
        lambda _r, _c, _p: {"thickness_m": 0.02}, _thickness, ("thickness_m",), (2e-3, 1.0), -1,
    ),
    CellEffect(
        "tissue.inclusion", True, "law", "other", "tissue force", "f (1 + contrast (1 - exp(-x²)))",
        lambda r, _c, p: {"contrast": 0.3, "depth_m": r.uniform(0.5, 1.2) * p.deepest_m}, _inclusion, ("contrast",), (2e-3, 5.0),
    ),
    CellEffect(
        "tissue.plasticity", True, "law", "other", "tissue force", "each press sinks the surface in proportion to its depth",
        lambda r, _c, _p: {"set_m": 1e-4, "ratio": r.uniform(0.5, 0.95)}, _plasticity, ("set_m",), (3e-6, 1.5e-3),
    ),
    CellEffect(
        "contact.lateral", True, "law", "same", "xfrc_applied at the tip", "lateral force in proportion to the contact force",
        lambda r, _c, _p: {"ratio": 0.05, "azimuth_rad": r.uniform(-np.pi, np.pi)}, _lateral, ("ratio",), (5e-4, 1.5),
    ),
)  # fmt: skip
"""All causes of the contract but `sensor.noise` and `sensor.quantization`."""


def contract_parameters(effect: CellEffect, values: Values) -> Values:
    """The parameters under the contract's names, where this one's differ.

    Args:
        values: its own parameters.

    Returns:
        Parameters for the sealed truth.
    """
    public = {name: value for name, value in values.items() if name not in {"seed", "guide_friction_N"}}
    if effect.id == "robot.lag":
        return {"bandwidth_ratio": 1 / (1 + values["slowing"])}
    if effect.id == "tissue.modulus":
        return {"ratio": 1 + values["excess"]}
    return public
