"""A first cell file from recordings, for a rig that has none: some values are measured, the others are guesses and marked as such."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from palpd.analysis.curves import Curve, analyse_curve
from palpd.cell.cell_file import cell_from
from palpd.cell.dynamics import servo_heights, steps
from palpd.cell.plausible import ask, doubts
from palpd.cell.report_times import find_reports
from palpd.documents import parse_yaml
from palpd.errors import BadInput, RecordingError
from palpd.gap.data.recorded_noise import with_recorded_noise
from palpd.gap.data.rounding import coarse_step_N
from palpd.recording.oddities import CLEAR_NOISES, dead, measured_rms, questions_of, refuse_repeated, refuse_turned, swing_N
from palpd.recording.samples import Samples
from palpd.tick import Floats

GUESSED_TIP_RADIUS_M = 0.005
"""Tip radius where none is given: the emulated cell's."""
BIN_S = 0.05
"""Length of the stretches over whose means inertia is sought: the noise of speeds makes little acceleration over it, a robot's motion
does."""
FEWEST_BINS = 10
"""Least number of means in free motion from which a mass is estimated."""
LARGEST_MASS_KG = 1.0
"""Largest uncertainty of the mass that is written: a probe is lighter."""
SERVO_HZ = np.geomspace(0.5, 60.0, 97)
"""Natural frequencies of the servo from which the best is sought, 5 % apart."""
DAMPING_RATIOS = (0.2, 5.0)
"""Least and largest damping ratio that is sought: a robot's servo neither rings for long nor creeps."""
SERVO_TOLERANCE = 0.05
"""Tolerance of the servo's natural frequency, as a ratio, where it was taken from the recording."""
EXACT = 1e-9
"""Least noise, as a share of the span of the readings: heights of a stage may have none, and columns over it would be beyond a float."""


class CommentedValue(NamedTuple):
    """A value of a cell file and where it comes from. A value None is written as null."""

    value: float | None
    comment: str


@dataclass(frozen=True)
class FirstCell:
    """Blocks of a cell file with a comment for each value, and sentences for the user. A block None is written as null."""

    blocks: dict[str, dict[str, CommentedValue] | None]
    sentences: tuple[str, ...]

    @property
    def content(self) -> dict[str, dict[str, float | None] | None]:
        """The blocks without their comments."""
        return {name: None if block is None else {k: each.value for k, each in block.items()} for name, block in self.blocks.items()}


def first_cell(
    recordings: Sequence[Samples], tip_radius_m: float | None = None, accept_implausible: bool = False, *, contact: bool = True
) -> FirstCell:
    """Estimate a cell file from recordings.

    Args:
        recordings: All of the same cell.
        tip_radius_m: Radius of the spherical tip; None where it is not known.
        accept_implausible: Whether implausible values count.
        contact: Whether the probe touches something in them.

    Raises:
        RecordingError: There is no recording, its fz never changes, or its forces or heights have the wrong sign.
        BadInput: The radius is impossible, or a value is implausible and `accept_implausible` is false.
    """
    if not recordings:
        raise RecordingError("no recording was given; at least one is needed")
    if tip_radius_m is not None and not 0.0 < tip_radius_m < 1.0:
        raise BadInput(f"the tip radius is {tip_radius_m:g} m, expected above zero and below 1 m; give it in metres (5 mm is 0.005)")
    refuse_repeated(recordings)
    for samples in recordings:
        _refuse_constant(samples)
        refuse_turned(samples)
    radius_m = tip_radius_m or GUESSED_TIP_RADIUS_M
    touches = [touch for samples in recordings if contact and (touch := _touch(samples, radius_m)) is not None]
    surface_m = float(np.median([touch.height_m for touch in touches])) if touches else -9.0
    robot = _robot(recordings)
    sensor = _sensor(recordings, surface_m, robot)
    mass_kg, sigma_kg = _mass(recordings, surface_m, bool(touches))
    from_recordings = f"over {len(recordings)} recording{'s' if len(recordings) > 1 else ''}"
    probe = {
        "mass_kg": CommentedValue(mass_kg, "inertia in free motion; weigh what hangs on the sensor, if you can"),
        "tip_radius_m": CommentedValue(radius_m, "as given" if tip_radius_m else "GUESS: give --tip-radius-m; the modulus depends on it"),
    }
    tolerances = {
        "mass_kg": CommentedValue(max(sigma_kg, 0.015 * mass_kg), "how well the recordings show the mass"),
        "youngs_modulus": CommentedValue(1.0, "1.0 says that the stiffness is not known, so it is fitted and is no gap"),
    }
    tissue: dict[str, CommentedValue] | None = None
    if touches:
        spread_m = float(np.std([touch.height_m for touch in touches]))
        tissue = {
            "surface_z_m": CommentedValue(surface_m, f"touch: Hertz fitted to the loading, {from_recordings}"),
            "youngs_modulus_Pa": CommentedValue(
                float(np.median([each.modulus_Pa for each in touches])), "from the same fit; see tolerances"
            ),
            "poisson_ratio": CommentedValue(0.5, "GUESS: incompressible, like soft tissue and rubber"),
        }
        least_m = max(spread_m, float(np.median([touch.sigma_m for touch in touches])), 0.006 * radius_m)
        tolerances["surface_z_m"] = CommentedValue(least_m, "how well the recordings show the touch, at least 0.6 % of the tip radius")
    if robot["servo_natural_frequency_Hz"].value is not None and any(samples.z_cmd_m is not None for samples in recordings):
        tolerances["servo_natural_frequency"] = CommentedValue(SERVO_TOLERANCE, "GUESS: relative")
    blocks = {"probe": probe, "sensor": sensor, "robot": robot, "tissue": tissue, "tolerances": tolerances}
    questions = [question for samples in recordings for question in questions_of(samples)]
    if tissue is not None:
        questions += doubts("modulus", tissue["youngs_modulus_Pa"].value or 0.0, "the modulus of the tissue")
    questions += doubts("mass", mass_kg, "the moving mass")
    accepted = ask(questions, accept_implausible, "check the units and signs of force, height and time, and the tip radius")
    return FirstCell(blocks, (*accepted, *_sentences(blocks, tip_radius_m is None)))


def _refuse_constant(samples: Samples) -> None:
    """Refuse a constant fz, which shows neither noise nor steps nor a touch. Raises RecordingError."""
    if dead(samples.wrench[:, 2]):
        raise RecordingError(
            f"fz_N is {samples.wrench[0, 2]:g} throughout, expected noise at least: it shows nothing of the cell; check that the sensor is "
            "alive and the column the right one, and record again"
        )


def written_out(first: FirstCell, names: str) -> str:
    """Write a first cell file with its comments.

    Args:
        names: Names of the recordings.

    Returns:
        YAML that the reader of cell files accepts.

    Raises:
        ConfigError: A value is outside what a cell file may hold.
    """
    lines = [
        f"# First cell file, from {' '.join(names.split())}. Each comment says how its value was found; correct what you know better.",
        "# What is not written here has the default of docs/cell.md.",
    ]
    for block, values in first.blocks.items():
        if values is None:
            lines.append(f"{block}: null  # no contact was seen")
            continue
        lines.append(f"{block}:")
        lines += [f"  {key}: {_number(value)}  # {comment}" for key, (value, comment) in values.items()]
    text = "\n".join(lines) + "\n"
    cell_from(parse_yaml(text, "the cell file").content, "the cell file")  # it must be read again
    return text


class _Touch(NamedTuple):
    height_m: float
    sigma_m: float
    modulus_Pa: float


def _touch(samples: Samples, tip_radius_m: float) -> _Touch | None:
    """Where contact begins and how stiff it is; None where nothing is touched."""
    fz_N = samples.wrench[:, 2]
    if swing_N(fz_N) < CLEAR_NOISES * measured_rms(fz_N):
        return None
    try:
        fit = analyse_curve(Curve("", samples.z_m, fz_N, samples.t_s, 1.0, ("fz_N", "z_m")), tip_radius_m=tip_radius_m)
    except RecordingError:
        return None
    height_m = fit["contact_point_m"]
    if not fit["youngs_modulus_Pa"] >= 1.0 or not samples.z_m.min() < height_m < 10.0:
        return None
    return _Touch(height_m, fit["contact_sigma_m"], min(fit["youngs_modulus_Pa"], 1e13))


def _robot(recordings: Sequence[Samples]) -> dict[str, CommentedValue]:
    position, velocity, fits = [], [], []
    for samples in recordings:
        at_s = find_reports(samples.t_s, samples.z_m).t_s
        least_m = EXACT * float(np.ptp(samples.z_m))
        position.append(max(measured_rms(np.interp(at_s, samples.t_s, samples.z_m)), least_m))
        velocity.append(measured_rms(np.interp(at_s, samples.t_s, samples.vz_m_per_s)))
        if samples.z_cmd_m is not None and np.ptp(samples.z_cmd_m) > 0.0:
            fits.append(_servo(samples, samples.z_cmd_m))
    followed = "the one that fits how z_m follows z_cmd_m best" if fits else "GUESS: without z_cmd_m the servo is not judged"
    natural_Hz, damping_ratio = np.median(fits, axis=0).tolist() if fits else (8.0, 1.0)
    return {
        "servo_natural_frequency_Hz": CommentedValue(natural_Hz, followed),
        "servo_damping_ratio": CommentedValue(damping_ratio, "from the same fit" if fits else "GUESS: no overshoot"),
        "position_noise_rms_m": CommentedValue(float(np.median(position)), "scatter of z_m from report to report"),
        "velocity_noise_rms_m_per_s": CommentedValue(float(np.median(velocity)), "scatter of vz_m_per_s from report to report"),
    }


def _servo(samples: Samples, z_cmd_m: Floats) -> tuple[float, float]:
    """Natural frequency in Hz and damping ratio of the servo that explains the heights best; it starts as it was measured."""
    dt_s, moving = steps(samples.t_s), (float(samples.z_m[0]), float(samples.vz_m_per_s[0]))

    def missed_m(logarithms: Floats) -> Floats:
        natural_Hz, damping_ratio = np.exp(logarithms).tolist()
        return servo_heights(z_cmd_m, dt_s, natural_Hz, damping_ratio, moving) - samples.z_m

    start = min(((np.log(natural_Hz), 0.0) for natural_Hz in SERVO_HZ), key=lambda at: float(np.mean(missed_m(np.array(at)) ** 2)))
    low, high = np.log([[SERVO_HZ[0] / 2.0, DAMPING_RATIOS[0]], [2.0 * SERVO_HZ[-1], DAMPING_RATIOS[1]]])
    natural_Hz, damping_ratio = np.exp(least_squares(missed_m, start, bounds=(low, high), diff_step=np.full(2, 1e-3)).x).tolist()
    return natural_Hz, damping_ratio


def _sensor(recordings: Sequence[Samples], surface_m: float, robot: dict[str, CommentedValue]) -> dict[str, CommentedValue]:
    rate_Hz = float(np.median([samples.rate_Hz for samples in recordings]))
    noise_m = max(robot["position_noise_rms_m"].value or 0.0, 0.0)
    provisional = cell_from(
        {
            "sensor": {"rate_Hz": rate_Hz, "filter_cutoff_Hz": None},
            "robot": {"position_noise_rms_m": noise_m},
            "tissue": {"surface_z_m": surface_m},
        },
        "the recordings",
    )
    cell = with_recorded_noise(recordings, provisional)[0]
    sensor = cell.sensor
    coarse_N = max(coarse_step_N(samples, cell) for samples in recordings)  # readings that were rounded twice stand on no one lattice
    torques = any(not dead(samples.wrench[:, axis]) for samples in recordings for axis in (3, 4, 5))
    fz_span_N = max(float(np.ptp(samples.wrench[:, 2])) for samples in recordings)
    lattice = "lattice of the readings; 0 is none"
    return {
        "rate_Hz": CommentedValue(rate_Hz, "median of the time steps"),
        "filter_cutoff_Hz": CommentedValue(None, "GUESS: no filter; give the sensor's own in Hz"),
        "noise_rms_N": CommentedValue(max(sensor.noise_rms_N, EXACT * fz_span_N, 1e-15), "scatter of the forces at rest"),
        "noise_rms_Nm": CommentedValue(
            sensor.noise_rms_Nm if torques else 0.0, "scatter of the torques at rest" if torques else "no torque was recorded"
        ),
        "resolution_fxy_N": CommentedValue(sensor.resolution_fxy_N, lattice),
        "resolution_fz_N": CommentedValue(coarse_N or sensor.resolution_fz_N, lattice),
        "resolution_Nm": CommentedValue(sensor.resolution_Nm, lattice),
    }


def _mass(recordings: Sequence[Samples], surface_m: float, touched: bool) -> tuple[float, float]:
    """Mass behind fz = -m·a in free motion and its standard deviation, from means over 50 ms; 0 where no motion shows it."""
    forces, accelerations, noise = [], [], []
    for samples in recordings:
        each = max(1, round(BIN_S * samples.rate_Hz))
        number = (len(samples) - 1) // each
        at = np.arange(number + 1) * each
        dt_s = np.diff(samples.t_s[at])
        free = np.minimum.reduceat(samples.z_m, at[:-1])[: len(dt_s)] > surface_m if touched else np.ones(len(dt_s), bool)
        mean_N = np.add.reduceat(samples.wrench[: at[-1], 2], at[:-1]) / each if number else np.zeros(0)
        if free.sum() < FEWEST_BINS:
            continue
        middle_s = samples.t_s[at[:-1]][free]
        drift = np.polynomial.Polynomial.fit(middle_s, mean_N[free], 1)(middle_s)
        forces.append(mean_N[free] - drift)
        accelerations.append((np.diff(samples.vz_m_per_s[at]) / dt_s)[free])
        noise.append(2.0 * measured_rms(samples.vz_m_per_s) ** 2 / float(np.median(dt_s)) ** 2)
    if not forces:
        return 0.0, LARGEST_MASS_KG
    force_N, a_m_per_s2 = np.concatenate(forces), np.concatenate(accelerations)
    seen = float(np.mean(a_m_per_s2**2)) - float(np.mean(noise))
    if seen <= 0.2 * float(np.mean(noise)) or seen == 0.0:
        return 0.0, LARGEST_MASS_KG
    mass_kg = -float(np.mean(force_N * a_m_per_s2)) / seen
    rest_N = float(np.std(force_N + mass_kg * a_m_per_s2))
    sigma_kg = min(rest_N / float(np.sqrt(seen * len(force_N))), LARGEST_MASS_KG)
    return (mass_kg if mass_kg > 2.0 * sigma_kg else 0.0), sigma_kg


def _number(value: float | None) -> str:
    if value is None:
        return "null"
    text = f"{value:.6g}"
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def _sentences(blocks: dict[str, dict[str, CommentedValue] | None], guessed_tip: bool) -> list[str]:
    sensor, tissue, probe = blocks["sensor"], blocks["tissue"], blocks["probe"]
    assert sensor is not None
    assert probe is not None
    out = [
        f"Sensor: {sensor['rate_Hz'].value:.4g} Hz, noise {sensor['noise_rms_N'].value:.3g} N, "
        f"steps of {sensor['resolution_fz_N'].value:.3g} N.",
        f"Probe: {probe['mass_kg'].value:.3g} kg, tip radius {probe['tip_radius_m'].value:.4g} m{' (a guess)' if guessed_tip else ''}.",
    ]
    if tissue is None:
        return [*out, "No contact was seen, so the cell has no tissue."]
    modulus_Pa = tissue["youngs_modulus_Pa"].value
    return [*out, f"Touch at {tissue['surface_z_m'].value:.6g} m, E {modulus_Pa:.3g} Pa, which counts as not known."]
