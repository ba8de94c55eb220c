"""Simulators of `benchmarks.own_models` with parameters, for `mujoco.sysid`: what a careful user gives it to fit.

Each parameter stands for an element of MJCF, or is one of sysid's `SignalTransform`. The rollout of sysid steps a model that forces drive.
These simulators are driven by the measured motion, so they are given as its `custom_rollout`.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import sysid
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

import palpd
from benchmarks.own_models import OwnRig, fine_grid, linear_response, low_pass, play, sensor_filter

Array = NDArray[np.float64]
RAISED = 0.02
"""Share of the reach by which the tip is raised for the slope of the contact force."""
KEPT = 300
"""Most outputs of the simulator that are kept, for memory."""
SIGNALS = {"sensor bias", "sensor gain", "sensor delay"}
"""Candidates of sysid's `SignalTransform`; the others are the simulator's."""
SENSORS = ("fz_N", "fx_N", "fy_N", "tx_Nm", "ty_Nm", "z_m")


class SysidCandidate(NamedTuple):
    """Parameters that act like an effect, zero at nominal.

    Attributes:
        effects: Ids of effects (docs/reference/contract.md §6) that count as named by it.
        low: Lower bound of each parameter.
        high: Upper bound.
        start: Start value where nominal is a corner.
        sigma: Standard deviation of the healthy rig; 0: a healthy rig has exactly the nominal value.
        size: Number of parameters.
        shape: Start and bounds of a further parameter that sysid fits only where the candidate stands alone.
    """

    effects: tuple[str, ...]
    low: float
    high: float
    start: float = 0.0
    sigma: float = 0.0
    size: int = 1
    shape: tuple[float, float, float] | None = None


def candidates(rig: OwnRig) -> dict[str, SysidCandidate]:
    """What a careful user gives to sysid for a rig."""
    tolerances, leak = rig.cell["tolerances"], rig.cell["tolerances"]["crosstalk"]
    noise = rig.cell["sensor"]["noise_rms_N"]
    of_rig = {
        "sensor bias": SysidCandidate(("sensor.bias",), -20 * noise, 20 * noise, sigma=tolerances["bias_N"]),
        "sensor gain": SysidCandidate(("sensor.gain",), -0.6, 1.0, sigma=tolerances["gain"]),
        "sensor delay": SysidCandidate(("sensor.latency",), -0.06, 0.06, sigma=tolerances["latency_s"]),
        "sensor cutoff": SysidCandidate(("sensor.saturation",), -0.6, 0.7, start=0.03),
        "body mass": SysidCandidate(("probe.mass",), -0.8, 1.0, sigma=tolerances["mass_kg"] / rig.mass_kg),
        "sensor site pose": SysidCandidate(("sensor.crosstalk",), -0.3, 0.3, sigma=leak, size=4),
        "probe orientation": SysidCandidate(("probe.tilt",), -0.4, 0.4, size=2),
        "joint stiffness": SysidCandidate(("cable.spring",), -20, 20),
        "joint damping": SysidCandidate(("cable.viscous",), -20, 20),
        "joint frictionloss": SysidCandidate(("cable.friction",), -20, 20),
        "sprung mass near 8 Hz": SysidCandidate(("structure.resonance",), -1, 1, start=0.02, shape=(8, 6, 10)),
        "sprung mass near 12 Hz": SysidCandidate(("structure.resonance",), -1, 1, start=0.02, shape=(12, 10, 14)),
    }
    if rig.cell["sensor"]["filter_cutoff_Hz"]:
        of_rig["filter of the simulator"] = SysidCandidate(("sensor.filter",), -3, 1, sigma=tolerances["filter_cutoff"])
    if rig.predicts_height:
        of_rig["actuator gains"] = SysidCandidate(("robot.lag",), -0.6, 1, sigma=tolerances["servo_natural_frequency"])
    if rig.contact:
        height = float(np.hypot(tolerances["surface_z_m"], rig.cell["repeatability"]["surface_z_m"])) / rig.reach_m
        of_rig |= {
            "tissue stiffness": SysidCandidate(("tissue.modulus",), -0.7, 1.5, sigma=tolerances["youngs_modulus"]),
            "tissue position": SysidCandidate(("tissue.surface",), -0.25, 0.25, sigma=height),
            "Maxwell arm": SysidCandidate(("tissue.viscoelastic",), -0.5, 2, start=0.01, shape=(0.0, -1.6, 1.4)),
            "stiffness polynomial": SysidCandidate(("tissue.thickness", "tissue.inclusion"), -0.8, 3),
            "adhesion actuator": SysidCandidate(("tissue.adhesion",), -50, 50),
            "mount joint stiffness": SysidCandidate(("robot.compliance",), -0.03, 0.4),
            "backlash joint": SysidCandidate(("robot.backlash",), 0, 0.3, start=0.002),
            "geom orientation": SysidCandidate(("contact.lateral",), -0.4, 0.4, size=2),
        }
    return of_rig


class Rollout:
    """A rig's simulator with parameters, in the form of sysid's `custom_rollout`; equal calls are computed once."""

    def __init__(self, rig: OwnRig, motion: Mapping[str, Array]) -> None:
        self.rig, self.motion, self.t_s = rig, motion, fine_grid(motion["t_s"], rig.fine_steps)
        self.dt = float(self.t_s[1] - self.t_s[0])
        times, inside = motion["t_s"], np.minimum(self.t_s, motion["t_s"][-1])
        self.z = CubicHermiteSpline(times, motion["z_m"], motion["vz_m_per_s"])(inside)
        self.v = CubicHermiteSpline(times, motion["vz_m_per_s"], motion["az_m_per_s2"])(inside)
        self.a = np.interp(inside, times, motion["az_m_per_s2"])
        self.background = rig.background(self.t_s, self.z, self.v)
        self.kept: dict[tuple[Any, ...], Any] = {}
        self.peak_N = float(np.abs(self.readings({})[:, 0]).max())

    def once(self, key: tuple[Any, ...], compute: Callable[[], Any]) -> Any:
        """A value, computed once for a key."""
        value = self.kept.pop(key) if key in self.kept else compute()
        self.kept[key] = value
        if len(self.kept) > KEPT:
            del self.kept[next(iter(self.kept))]
        return value

    def contact(self, ratio: float, offset: float, width: float, raised: float = 0.0) -> tuple[dict[str, Array], Array]:
        """Contact force and height above the surface; arguments are shares of modulus and reach."""
        rig, surface = self.rig, self.rig.surface_z_m + (offset - raised) * self.rig.reach_m
        assert rig.contact is not None
        tip = play(self.z, width * rig.reach_m) if width > 0 else self.z
        speed = np.gradient(tip, self.dt) if width > 0 else self.v
        return rig.contact(self.t_s, tip - surface, speed, 1 + ratio), tip - surface

    def tissue(self, value: Callable[[str], float], tau_s: float) -> dict[str, Array]:
        """Contact force with what acts inside the tissue."""
        rig = self.rig
        key = tuple(value(name) for name in ("tissue stiffness", "tissue position", "backlash joint"))
        forces, height = self.once(("contact", *key), lambda: self.contact(*key))
        if give := value("mount joint stiffness"):
            # The mount and the tissue in series, with the tissue's slope at each time.
            raised = self.once(("raised", *key), lambda: self.contact(*key, RAISED)[0])
            slope = (forces["fz_N"] - raised["fz_N"]) / RAISED
            share = 1 / np.maximum(0.2, 1 + give * slope / rig.force_N)
            forces = {name: values * share for name, values in forces.items()}
            height = height + give * forces["fz_N"] * rig.reach_m / rig.force_N
        f, factor = forces["fz_N"], 1 + value("stiffness polynomial") * np.maximum(0, -height) / rig.reach_m
        if value("Maxwell arm"):
            slow = self.once(("slow", *key, tau_s), lambda: low_pass(f, tau_s, self.dt))
            factor = factor + value("Maxwell arm") * np.divide(f - slow, f, out=np.zeros_like(f), where=f > 1e-9)
        forces = {name: values * np.maximum(0, factor) for name, values in forces.items()}
        pull = value("adhesion actuator") * rig.cell["sensor"]["noise_rms_N"] * (height < 0.3 * min(rig.reach_m, 0.006))
        return forces | {"fz_N": forces["fz_N"] - pull}

    def readings(self, values: Mapping[str, Array]) -> Array:
        """Readings without noise, (n, 6), for the values of candidates; a missing one is nominal."""

        def value(name: str, index: int = 0) -> float:
            return float(values[name][index]) if name in values else 0.0

        rig, noise, zero = self.rig, self.rig.cell["sensor"]["noise_rms_N"], np.zeros(len(self.t_s))
        push = self.tissue(value, float(np.exp(value("Maxwell arm shape")))) if rig.contact else {"fz_N": zero}
        inertia = self.a
        for name in ("sprung mass near 8 Hz", "sprung mass near 12 Hz"):
            if value(name):
                w = 2 * np.pi * value(f"{name} shape")
                ringing = self.once((name, w), partial(linear_response, [0.1 * w, w * w], [1, 0.1 * w, w * w], self.a, self.dt))[0]
                inertia = inertia + value(name) * (ringing - self.a)
        along = self.background.get("fz_N", zero) - rig.mass_kg * (1 + value("body mass")) * inertia
        along = along - noise * value("joint stiffness") * (self.z - self.z[0]) / 0.01
        along = along - noise * value("joint damping") * self.v / rig.speeds_m_per_s[1]
        along = along - noise * value("joint frictionloss") * np.tanh(self.v / 5e-4)
        tilts = [value("probe orientation", index) for index in (0, 1)]
        sides = [
            push.get(name, zero) + (value("geom orientation", index) + tilts[index]) * push["fz_N"]
            for index, name in enumerate(("fx_N", "fy_N"))
        ]
        across = [sides[index] + tilts[index] * along + self.background.get(name, zero) for index, name in enumerate(("fx_N", "fy_N"))]
        arm, cutoff = rig.cell["probe"]["tip_length_m"], rig.cell["sensor"]["filter_cutoff_Hz"]
        if cutoff:
            cutoff *= float(np.exp(value("filter of the simulator")))
        sums = [along + push["fz_N"], *across, sides[1] * arm, -sides[0] * arm]
        columns = [sensor_filter(rig, column, self.dt, cutoff)[:: rig.fine_steps] for column in sums]
        for index, unit in enumerate((1.0, 1.0, 0.05, 0.05)):
            columns[index + 1] = columns[index + 1] + unit * value("sensor site pose", index) * columns[0]
        if "sensor cutoff" in values:
            limit = self.peak_N * (1 - value("sensor cutoff"))
            columns[0] = np.clip(columns[0], -limit, limit)
        return np.column_stack([*columns, self.height(value("actuator gains")) if rig.predicts_height else self.motion["z_m"]])

    def height(self, gains: float) -> Array:
        """Height that the servo reaches for the command."""
        command = np.interp(self.t_s, self.motion["t_s"], self.motion["z_cmd_m"])
        return self.once(("height", gains), lambda: self.rig.servo(command, self.dt, 1 + gains)[0][:: self.rig.fine_steps])

    def __call__(
        self, *, models: Any, control_signal: Any, initial_states: Any, param_dicts: Any, rollout_signal_mapping: Any, **_: Any
    ) -> list[Any]:
        """Trajectories for sysid, one for each set of parameters."""
        trajectories, t_s = [], self.motion["t_s"]
        state = sysid.TimeSeries(t_s, np.column_stack([t_s, np.zeros((len(t_s), len(initial_states[0]) - 1))]))
        for model, control, initial, parameters in zip(models, control_signal, initial_states, param_dicts, strict=True):
            values = {name: parameter.value for name, parameter in parameters.items() if name not in SIGNALS}
            key = tuple((name, *value.tolist()) for name, value in values.items())
            output = self.once(key, partial(self.readings, values))
            trajectories.append(
                sysid.SystemTrajectory(model, control, sysid.TimeSeries(t_s, output, rollout_signal_mapping), initial, state)
            )
        return trajectories


def residual_function(rig: OwnRig, columns: Mapping[str, Array], signals: Any) -> Any:
    """What sysid minimises: readings minus recording over the noise, with the parameters of its signal transform."""
    sensor, motion = rig.cell["sensor"], {name: np.asarray(values) for name, values in palpd.tip_motion(columns, rig.cell).items()}
    users = "".join(f'<user name="{name}" dim="1"/>' for name in SENSORS)
    spec = mujoco.MjSpec.from_string(f"""<mujoco><worldbody><body><joint name="z" type="slide"/><geom size=".01"/></body></worldbody>
<actuator><motor joint="z"/></actuator><sensor>{users}</sensor></mujoco>""")
    model, t_s = spec.compile(), motion["t_s"]
    measured = sysid.TimeSeries.from_names(t_s, np.column_stack([columns[name] for name in SENSORS]), model)
    control, initial = sysid.TimeSeries(t_s, np.zeros((len(t_s), 1))), sysid.create_initial_state(model, np.zeros(1))
    transform = sysid.SignalTransform(normalize=False)
    transform.gain("fz_N", signals["sensor gain"], target="predicted")
    transform.bias("fz_N", signals["sensor bias"], target="predicted")
    transform.delay("[ft]*", signals["sensor delay"])
    noise = {"f": sensor["noise_rms_N"], "t": sensor["noise_rms_Nm"], "z": rig.cell["robot"]["position_noise_rms_m"]}
    transform.set_sensor_weights({name: 1 / noise[name[0]] for name in SENSORS})
    transform.enable_sensors([name for name in SENSORS if name != "z_m" or rig.predicts_height])
    return sysid.build_residual_fn(
        models_sequences=[sysid.ModelSequences("rig", spec, "recording", initial, control, measured)],
        modify_residual=transform.apply,
        custom_rollout=Rollout(rig, motion),
        n_threads=1,
        resample_true=False,
    )
