"""Causes that are not in the list (docs/reference/contract.md §6): laws that a diagnosis may learn, and events."""

from collections.abc import Callable

import numpy as np

from palpd.blind.mujoco.effects import (
    CellEffect,
    Values,
    add_force,
    add_stage,
    add_zero,
    change_plant,
    peak_force_N,
    sign,
)
from palpd.blind.mujoco.sensor import low_pass
from palpd.blind.mujoco.setup import (
    Array,
    Cable,
    CellSetup,
    ForceTerm,
    GRAVITY_m_per_s2,
    LateralTerm,
    PlantRun,
    PressPath,
    ProbeTerm,
    StatedCell,
    Table,
)
from palpd.blind.stated_cell import log_uniform
from palpd.blind.truth import DEEP, HIGH, LawStatement, is_law, is_near, names, pressing_names


def _surface_motion(setup: CellSetup, motion: Callable[[PressPath, Array], Array]) -> CellSetup:
    return change_plant(setup, surface_motions=(*setup.plant.surface_motions, motion))


def _probe_term(setup: CellSetup, make: Callable[[PressPath, Array], ProbeTerm]) -> CellSetup:
    return change_plant(setup, probe_terms=(*setup.plant.probe_terms, make))


def _commanded_speed(path: PressPath, t_s: Array) -> Array:
    return np.interp(t_s, path.t_s, np.gradient(path.z_cmd_m, path.t_s))


def _thermal(setup: CellSetup, v: Values) -> CellSetup:
    def motion(path: PressPath, t_s: Array) -> Array:
        power = np.abs(_commanded_speed(path, t_s))
        heat = low_pass(power, 1 / (2 * np.pi * v["tau_s"]), float(t_s[1] - t_s[0]))
        return v["growth_m"] * heat / max(1e-9, float(heat.max()))

    return _surface_motion(setup, motion)


def _breathing(setup: CellSetup, v: Values) -> CellSetup:
    def motion(_: PressPath, t_s: Array) -> Array:
        phase = np.pi * v["frequency_Hz"] * t_s + v["phase_rad"]
        return v["amplitude_m"] * (np.sin(phase) ** 4 - 0.375)

    return _surface_motion(setup, motion)


def _height_ripple(setup: CellSetup, v: Values) -> CellSetup:
    wave = 2 * np.pi / v["pitch_m"]

    def make(_: PressPath, __: Array) -> Callable[[float, int], float]:
        return lambda tip_z_m, _: v["amplitude_m"] * float(np.sin(wave * tip_z_m + v["phase_rad"]))

    return change_plant(setup, shift_terms=(*setup.plant.shift_terms, make))


def _height_friction(setup: CellSetup, v: Values) -> CellSetup:
    def make(path: PressPath, _: Array) -> ProbeTerm:
        top, span = float(path.z_cmd_m.max()), float(np.ptp(path.z_cmd_m))
        return lambda tip_z_m, speed, _: -v["force_N"] * ((top - tip_z_m) / span) ** 2 * float(np.tanh(speed / 5e-4))

    return _probe_term(setup, make)


def _stick_slip(setup: CellSetup, v: Values) -> CellSetup:
    def make(_: PressPath, __: Array) -> ProbeTerm:
        stiffness, anchor = v["static_N"] / v["stretch_m"], float("nan")

        def term(tip_z_m: float, _: float, __: int) -> float:
            nonlocal anchor
            if anchor != anchor:
                anchor = tip_z_m
            force = -stiffness * (tip_z_m - anchor)
            if abs(force) > v["static_N"]:
                force *= v["kinetic_ratio"]
                anchor = tip_z_m + force / stiffness
            return force

        return term

    return _probe_term(setup, make)


def _tip_slip(setup: CellSetup, v: Values) -> CellSetup:
    x, y = np.cos(v["azimuth_rad"]), np.sin(v["azimuth_rad"])

    def make(_: PressPath, __: Array) -> LateralTerm:
        slipped = False

        def term(force_N: float, _: int) -> tuple[float, float]:
            nonlocal slipped
            slipped = force_N > 0 and (slipped or force_N > v["threshold_N"])
            lateral = v["ratio"] * force_N * (0.25 if slipped else 1.0)
            return x * lateral, y * lateral

        return term

    return change_plant(setup, lateral=make)


def _flex_gravity(setup: CellSetup, v: Values) -> CellSetup:
    weight = setup.plant.mass_kg * GRAVITY_m_per_s2
    lever = setup.plant.tip_length_m / 2

    def stage(wrench: Array, run: PlantRun) -> Array:
        first = run.z_m[np.searchsorted(run.t_s, 0.0)]
        angle = v["turn_rad_per_m"] * (run.z_m - first)
        out = wrench.copy()
        side = np.sin(angle)
        out[:, 0] += side * (wrench[:, 2] - weight)
        out[:, 2] += (np.cos(angle) - 1) * (wrench[:, 2] - weight)
        out[:, 4] += side * weight * lever
        return out

    return add_stage(setup, stage)


def _snag(setup: CellSetup, v: Values) -> CellSetup:
    return change_plant(setup, cable=Cable(snag_stiffness_N_per_m=v["stiffness_N_per_m"], snag_z_m=v["height_m"]))


def _poroelastic(setup: CellSetup, v: Values) -> CellSetup:
    radius = setup.plant.tip_radius_m

    def make(_: PressPath, t_s: Array) -> ForceTerm:
        pressure, last, step = 0.0, 0.0, float(t_s[1] - t_s[0])

        def term(force_N: float, depth_m: float, _: int) -> float:
            nonlocal pressure, last
            area = radius * max(depth_m, 1e-5)
            pressure += v["ratio"] * (force_N - last) - pressure * min(1.0, step * v["diffusivity_m2_per_s"] / area)
            last = force_N
            return max(0.0, force_N + pressure) if depth_m > 0 else 0.0

        return term

    return add_force(setup, make)


def _tone(setup: CellSetup, v: Values) -> CellSetup:
    def zero(t_s: Array, run: PlantRun) -> Array:
        speed = np.abs(np.interp(t_s, run.t_s, run.vz_m_per_s))
        return v["amplitude_N"] * speed / max(1e-9, float(np.percentile(speed, 95))) * np.sin(2 * np.pi * v["frequency_Hz"] * t_s)

    return add_zero(setup, zero)


def _temperature_step(setup: CellSetup, v: Values) -> CellSetup:
    return add_zero(
        setup, lambda t, _: v["offset_N"] * np.where(t > (at := v["when"] * t[-1]), -np.expm1(-np.maximum(0, t - at) / 0.4), 0.0)
    )


def _random_walk(setup: CellSetup, v: Values) -> CellSetup:
    def zero(t_s: Array, _: PlantRun) -> Array:
        steps = np.random.default_rng(int(v["seed"])).standard_normal(int(t_s[-1] * 10) + 2) * np.sqrt(0.1)
        walk = np.concatenate([[0.0], np.cumsum(steps)])
        return v["rate_N_per_sqrt_s"] * np.interp(t_s, np.arange(len(walk)) * 0.1, walk)

    return add_zero(setup, zero)


def _knocks(setup: CellSetup, v: Values) -> CellSetup:
    def make(_: PressPath, t_s: Array) -> Array:
        rng, out = np.random.default_rng(int(v["seed"])), np.zeros((len(t_s), 3))
        for when, length, direction in zip(rng.uniform(0.05, 0.95, 5), rng.uniform(0.03, 0.1, 5), rng.standard_normal((5, 3)), strict=True):
            inside = (t_s - when * t_s[-1]) / length
            shape = np.where((inside > 0) & (inside < 1), np.sin(np.pi * inside), 0.0)
            out += v["force_N"] * shape[:, None] * direction / np.linalg.norm(direction)
        return out

    return change_plant(setup, knocks=make)


def _draw_table(rng: np.random.Generator, _cell: StatedCell, _path: PressPath) -> Values:
    return {"table_mass_kg": 300.0, "frequency_Hz": log_uniform(rng, 2.0, 7.0), "damping_ratio": log_uniform(rng, 0.02, 0.08)}


# what they are, as factor × curve(driver)


def _states_stick_slip(_: Values, __: StatedCell) -> LawStatement:
    """A spring that slips keeps a part of its stretch, which no dead band does."""
    return is_near(
        *(names("fz_N", ("one",), ("height",), memory=memory) for memory in ("stop", "play")), names("fz_N", ("direction",), HIGH)
    )


def _states_tip_slip(_: Values, __: StatedCell) -> LawStatement:
    """Whether it has slipped in this press is no function of one quantity."""
    loops = (names("lateral", ("one", "force"), ("force",), memory=memory) for memory in ("stop", "play"))
    return is_near(names("lateral", ("one", "force"), DEEP), *loops)


def _states_flex_gravity(_: Values, __: StatedCell) -> LawStatement:
    """The flange turns with the height; weight and contact force leak by that angle, and in contact the height says the force."""
    each = [names(c, ("one", "force"), HIGH) + names(c, ("force",), ("depth", "force")) for c in ("fx_N", "lateral", "ty_Nm")]
    return is_law(*each)


def _states_snag(v: Values, cell: StatedCell) -> LawStatement:
    """A cable that is taut below the surface acts in contact alone."""
    return is_law(names("fz_N", ("one",), HIGH), pressing_names() if v["height_m"] <= cell.surface_z_m else [])


def _states_poroelastic(_: Values, __: StatedCell) -> LawStatement:
    """The time constant follows the depth, which no relaxed quantity does."""
    relaxed = names("fz_N", ("one", "force", "surface"), ("force", "depth", "contact"), memory="relaxed")
    return is_near(relaxed, names("fz_N", ("one", "force", "surface"), ("force_rate", "time_in_contact")), names("fz_N", ("speed",), DEEP))


def _states_wobble(_: Values, __: StatedCell) -> LawStatement:
    """A ringing table is an oscillator of its own."""
    return is_near(names("fz_N", ("one",), ("acceleration",)), names("fz_N", ("acceleration",), ("acceleration",)))


def _states_tone(v: Values, _: StatedCell) -> LawStatement:
    """The absolute speed is no factor of a law."""
    return is_near(names("fz_N", ("one", "speed", "direction"), ("time",), period=1.0 / v["frequency_Hz"]))


UNLISTED: tuple[CellEffect, ...] = (
    CellEffect(
        "mount.thermal_growth", False, "law", "other", "tip grows, as a moving surface", "the mount warms with the motion and grows",
        lambda r, _c, _p: {"growth_m": 2e-4, "tau_s": log_uniform(r, 5, 25)}, _thermal, ("growth_m",), (5e-6, 2e-3),
        states=lambda v, _: is_law(names("fz_N", ("surface",), ("absolute_speed",), memory="relaxed", constant=v["tau_s"])),
    ),
    CellEffect(
        "drive.height_ripple", False, "law", "other", "tip height differs from the reported one", "gear ripple, periodic in height",
        lambda r, _c, p: {"amplitude_m": 5e-5, "pitch_m": r.uniform(0.2, 0.7) * p.deepest_m, "phase_rad": r.uniform(-np.pi, np.pi)},
        _height_ripple, ("amplitude_m",), (2e-6, 8e-4),
        states=lambda v, _: is_law(names("fz_N", ("surface",), (*HIGH, "depth"), period=v["pitch_m"]), pressing_names()),
    ),
    CellEffect(
        "cable.height_friction", False, "law", "other", "xfrc_applied on the probe", "Coulomb friction that grows with depth squared",
        lambda _r, _c, _p: {"force_N": 0.2}, _height_friction, ("force_N",), (2e-3, 4.0),
        states=lambda _, __: is_law(names("fz_N", ("direction",), HIGH)),
    ),
    CellEffect(
        "guide.stick_slip", False, "law", "other", "xfrc_applied on the probe", "a line sticks, stretches and slips: a sawtooth in height",
        lambda r, _c, _p: {"static_N": 0.2, "stretch_m": log_uniform(r, 5e-4, 3e-3), "kinetic_ratio": r.uniform(0.2, 0.6)},
        _stick_slip, ("static_N",), (2e-3, 4.0), states=_states_stick_slip,
    ),
    CellEffect(
        "contact.tip_slip", False, "law", "other", "xfrc_applied at the tip", "the tip slips on an incline above a force",
        lambda r, c, p: {"ratio": 0.05, "threshold_N": r.uniform(0.2, 0.6) * peak_force_N(c, p), "azimuth_rad": r.uniform(-np.pi, np.pi)},
        _tip_slip, ("ratio",), (5e-4, 1.5), states=_states_tip_slip,
    ),
    CellEffect(
        "mount.loose_screw", False, "law", "other", "MuJoCo: joint with a gap under a weight",
        "the probe is held down by a force, and lifts to a stop when pushed",
        lambda r, c, p: {"gap_m": 1e-4, "hold_down_N": r.uniform(0.1, 0.4) * peak_force_N(c, p)},
        lambda s, v: change_plant(s, loose_gap_m=v["gap_m"], loose_weight_N=v["hold_down_N"]), ("gap_m",), (1e-7, 2e-3),
        states=lambda _, __: is_law(pressing_names()),
    ),
    CellEffect(
        "arm.flex_gravity", False, "law", "other", "sensor model", "the flange turns with height, so that gravity and contact leak into fx",
        lambda r, _c, _p: {"turn_rad_per_m": sign(r)}, _flex_gravity, ("turn_rad_per_m",), (0.01, 20.0), states=_states_flex_gravity,
    ),
    CellEffect(
        "cable.snag", False, "law", "other", "MuJoCo: tendon with a dead band", "a slack cable that is taut below some height",
        lambda r, c, p: {"stiffness_N_per_m": 30.0, "height_m": c.surface_z_m + r.uniform(-0.3, 1.0) * p.deepest_m},
        _snag, ("stiffness_N_per_m",), (0.5, 1500.0), states=_states_snag,
    ),
    CellEffect(
        "tissue.poroelastic", False, "law", "other", "tissue force", "pore pressure that drains faster where the contact is small",
        lambda r, c, p: {"ratio": 0.15, "diffusivity_m2_per_s": c.tip_radius_m * p.deepest_m / log_uniform(r, 0.3, 3.0)},
        _poroelastic, ("ratio",), (2e-3, 2.0), states=_states_poroelastic,
    ),
    CellEffect(
        "table.wobble", False, "law", "other", "MuJoCo: the robot stands on a sprung body", "accelerations of the robot ring the table",
        _draw_table, lambda s, v: change_plant(s, table=Table(v["frequency_Hz"], v["damping_ratio"], v["table_mass_kg"])),
        ("table_mass_kg",), (4.0, 2e5), -1, states=_states_wobble,
    ),
    CellEffect(
        "phantom.breathing", False, "law", "other", "tissue force", "the surface moves as a chest does",
        lambda r, _c, _p: {"amplitude_m": 1e-4, "frequency_Hz": r.uniform(0.15, 0.4), "phase_rad": r.uniform(-np.pi, np.pi)},
        _breathing, ("amplitude_m",), (5e-6, 1.5e-3),
        states=lambda v, _: is_law(names("fz_N", ("surface",), ("time",), period=1.0 / v["frequency_Hz"])),
    ),
    CellEffect(
        "sensor.speed_tone", False, "law", "other", "sensor model", "interference whose amplitude follows the speed",
        lambda r, _c, _p: {"amplitude_N": 0.1, "frequency_Hz": r.uniform(4, 20)}, _tone, ("amplitude_N",), (1e-3, 4.0), states=_states_tone,
    ),
    CellEffect(
        "sensor.temperature_step", False, "event", "other", "sensor model", "the zero moves once, within a second",
        lambda r, _c, _p: {"offset_N": 0.1 * sign(r), "when": r.uniform(0.25, 0.75)}, _temperature_step, ("offset_N",), (1e-3, 4.0),
    ),
    CellEffect(
        "rig.knocks", False, "event", "other", "MuJoCo: xfrc_applied on the probe", "five knocks of 30 to 100 ms in any direction",
        lambda r, _c, _p: {"force_N": 0.5, "seed": float(r.integers(1 << 30))}, _knocks, ("force_N",), (5e-3, 20.0),
    ),
    CellEffect(
        "sensor.random_walk", False, "event", "other", "sensor model", "the zero wanders",
        lambda r, _c, _p: {"rate_N_per_sqrt_s": 0.03, "seed": float(r.integers(1 << 30))},
        _random_walk, ("rate_N_per_sqrt_s",), (5e-4, 1.0),
    ),
)  # fmt: skip
"""Twelve laws and three events."""
