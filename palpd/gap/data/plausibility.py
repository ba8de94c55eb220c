"""What is odd about recordings before any simulation: units, signs, dead axes, holes in time, missing motion.

A recording is refused where every later number would be wrong: a wrong unit or sign, a dead fz in the tissue, two sites in one file, a
hole in time that hides motion. Everything else becomes a note, and what can still be judged is judged.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from palpd.cell.cell_file import CellFile, TissueBlock
from palpd.cell.lattice import lattice_step
from palpd.cell.plausible import doubts, doubts_of_cell
from palpd.errors import RecordingError
from palpd.gap.data.noise import CHANNELS, FZ, declared_rms
from palpd.gap.data.prepare import PreparedRecording, moves
from palpd.recording.oddities import (
    CLEAR_NOISES,
    HEIGHT_CORRELATION,
    correlation,
    dead,
    measured_rms,
    refuse_dead,
    refuse_repeated,
    refuse_turned,
    slope_ratio,
    swing_N,
    turned_twice,
)
from palpd.recording.samples import Samples, refuse_mixed_sites, runs_of_true
from palpd.tick import Floats

LONGEST_STROKE_M = 5.0
"""No palpation moves this far: such heights are in mm."""

DEEPEST_TIP_RADII, DEEPEST_M = 20.0, 0.2
"""A press that is deeper than both has its height in another unit; a press that is deeper than the first gets a note."""

SATURATED_ROWS, SATURATED_STEPS, SATURATED_STROKE_SHARE = 4, 3.0, 0.02
"""Rows in succession at the very largest or smallest value from which a channel looks saturated, if the height changes meanwhile by
this share of the stroke, and enough to change the force by this many of its steps."""

SAME_SHARE = 1e-3
"""Change of a reading, as a share of its range, that counts as none: at a limit the last digit still goes to and fro."""

UNITS = {1e3: "z_m looks like mm", 1e-3: "vz_m_per_s looks like mm/s, or t_s like ms", -1.0: "their signs disagree"}

LONGEST_HOLE_S = 5.0
"""Hole in time above which a recording is refused: drift, relaxation and warm-up go on in it, and nobody knows how the probe moved."""

HOLE_STEPS = 50.0
"""Number of usual time steps above which a step is a hole: uneven recordings have steps of several times the usual one."""

SHORT_HOLE_STEPS, SHORT_HOLE_S = 10.0, 0.2
"""A hole in time that is longer than both gets a note. A shorter hole hides no motion of a robot."""

WRONG_UNIT_RATIO = 200.0
"""Measured over expected force above which the unit is wrong: no effect changes a force as much, and units differ by 1000."""

ODD_FORCE_RATIO = 10.0
"""Measured over expected force above which a note asks for the unit and the modulus."""

SHAPE_CORRELATION = 0.7
"""Least correlation of measured with expected force for a judgement of the unit: a healthy press has above 0.95."""

FAR_TOUCH_TIP_RADII = 1.0
"""Distance of the touch from the stated surface, in tip radii, above which it gets a note: Hertz does not hold at such a depth."""

LOADED_SHARE = 0.25
"""Share of the rising rows between the stated surface and the touch that must be loaded: inertia in the air loads below 0.06 of them, and
tissue that relaxes leaves the probe before it is back at the surface."""

SLOPE_S = 0.05
"""Time between two speeds that give an acceleration: the noise of speeds gives little over it, and a robot's motion is seen."""

FROZEN_S = 1.0
"""Shortest stretch of constant fz that gets a note: dropouts of a live sensor are shorter."""

HIDDEN_SHARE = 0.3
"""Change of the expected force, over its largest, that a live sensor may leave unseen: the play of a drive hides a reversal, and may be a
fifth of the depth."""

ODD_NOISE_RATIO = 4.0
"""Measured over stated noise, or its inverse, above which it gets a note: the effect sensor.noise is at most about this large."""


def check_recordings(recordings: Sequence[Samples], cell: CellFile, *, sized: bool = True) -> list[str]:
    """Check recordings against their cell file.

    Args:
        sized: Whether the cell's own tissue says how large a force is to be expected; not where a user's simulator does.

    Returns:
        One sentence for everything that makes a verdict doubtful without preventing one: units, signs, dead axes, missing contact.

    Raises:
        RecordingError: There is no recording, or one has another unit, a wrong sign, a dead height or fz, a hole in time, or several
            sites, or stands there twice.
    """
    if not recordings:
        raise RecordingError("no recording was given; at least one is needed")
    for samples, label in zip(recordings, _labels(recordings), strict=True):
        refuse_mixed_sites(samples.sites, f"{label}the recording holds")
    refuse_mixed_sites((name for samples in recordings for name in samples.sites), "the recordings together hold")
    refuse_repeated(recordings)
    notes = [f"{doubt}; correct the cell file." for doubt in doubts_of_cell(cell)]
    if not sized:
        cell = cell.with_tolerances(youngs_modulus=1.0)
    for samples, label in zip(recordings, _labels(recordings), strict=True):
        _refuse_hole(samples, label)
        for check in (_motion_notes, _depth_notes, _force_notes):
            notes += [label + note for note in check(samples, cell, label)]
        refuse_dead(samples, label)
    return notes


def recording_notes(recordings: Sequence[Samples], cell: CellFile) -> list[str]:
    """Notes that do not make the verdict doubtful, on recordings that `check_recordings` has let pass."""
    notes = [
        label + note
        for samples, label in zip(recordings, _labels(recordings), strict=True)
        for note in (*_hole_notes(samples), *_air_notes(samples, cell))
    ]
    if cell.sites:
        notes.append(
            f"the cell file has sites ({', '.join(site.name for site in cell.sites)}), and the recording names none of them, so its tissue "
            "block counts; palpd export --site writes the name into the recording."
        )
    return notes


def _labels(recordings: Sequence[Samples]) -> list[str]:
    return [f"recording {number + 1}: " if len(recordings) > 1 else "" for number in range(len(recordings))]


def _refuse_hole(samples: Samples, label: str) -> None:
    step_s = np.diff(samples.t_s)
    usual_s, longest = float(np.median(step_s)), int(np.argmax(step_s))
    hole_s, begin_s = float(step_s[longest]), float(samples.t_s[longest])
    if hole_s > max(LONGEST_HOLE_S, HOLE_STEPS * usual_s):
        raise RecordingError(
            f"{label}t_s jumps from {begin_s:.6g} s to {begin_s + hole_s:.6g} s after row {longest + 1}, usual are {usual_s:.3g} s; "
            "split the file there and diagnose both parts as two recordings of the cell, or correct t_s."
        )


def _hole_notes(samples: Samples) -> Iterator[str]:
    step_s = np.diff(samples.t_s)
    holes = int(np.sum(step_s > max(SHORT_HOLE_S, SHORT_HOLE_STEPS * float(np.median(step_s)))))
    if holes:
        yield (
            f"samples are missing at {holes} place{'s' if holes > 1 else ''}, the longest time {step_s.max():.3g} s from "
            f"{samples.t_s[int(np.argmax(step_s))]:.6g} s on; nothing is judged there, and a sensor or recorder that pauses should be "
            "mended."
        )


def _air_notes(samples: Samples, cell: CellFile) -> Iterator[str]:
    if cell.tissue is not None and bool((samples.z_m < cell.tissue.surface_z_m).all()):
        yield "there is no free motion: inertia, cable and bias can hardly be distinguished from the tissue."


def _motion_notes(samples: Samples, cell: CellFile, label: str) -> Iterator[str]:
    """Stroke, dead heights, and heights against speeds."""
    stroke_m = float(np.ptp(samples.z_m))
    if not samples.joint:
        yield from (f"{doubt}; check the unit of z_m." for doubt in doubts("stroke", stroke_m, "the stroke of z_m"))
    path_m = float(np.sum(np.abs(samples.vz_m_per_s[1:]) * np.diff(samples.t_s)))
    if stroke_m > LONGEST_STROKE_M and not samples.joint:
        raise RecordingError(
            f"{label}z_m spans {stroke_m:.3g} m, expected a stroke of millimetres to decimetres; it looks like mm, divide by 1000."
        )
    if not moves(samples, cell) and path_m < 3.0 * stroke_m + 1e-9:
        yield f"nothing moves (z_m spans {stroke_m:.2g} m): only bias, drift, warm-up and noise can be judged."
    if stroke_m == 0.0 and samples.vz_m_per_s.any():
        raise RecordingError(f"{label}z_m is {samples.z_m[0]:g} m throughout and vz_m_per_s moves: z_m is dead; record it.")
    if not samples.vz_m_per_s.any() and moves(samples, cell):
        raise RecordingError(f"{label}vz_m_per_s is 0 throughout and z_m spans {stroke_m:.3g} m: vz_m_per_s is dead; record it.")
    slope = slope_ratio(samples)
    if slope is not None and not 0.5 < slope < 2.0:
        near = min((1e3, 1e-3, 1e6, 1e-6, -1.0), key=lambda k: abs(np.log(abs(slope) / abs(k))) + (slope * k < 0) * 9)
        unit = UNITS.get(near, "their units disagree")
        sentence = f"z_m changes {slope:.3g} times as fast as vz_m_per_s says, expected 1; {unit}."
        if 0.5 < abs(slope) / abs(near) < 2.0:
            raise RecordingError(f"{label}{sentence} Correct the unit or sign and diagnose again.")
        yield sentence


def _depth_notes(samples: Samples, cell: CellFile, label: str) -> Iterator[str]:
    """Depth of the presses against tip and surface."""
    if cell.tissue is None:
        return
    depth_m = cell.tissue.surface_z_m - float(samples.z_m.min())
    radii = depth_m / cell.probe.tip_radius_m
    if radii > DEEPEST_TIP_RADII and depth_m > DEEPEST_M:
        raise RecordingError(
            f"{label}the probe is {depth_m:.3g} m below the surface with a tip of {cell.probe.tip_radius_m:.3g} m radius; "
            "z_m looks like mm read as m, divide by 1000 or correct tissue.surface_z_m."
        )
    if radii > DEEPEST_TIP_RADII:
        yield f"the deepest press is {radii:.0f} tip radii below the stated surface; check the unit of z_m and tissue.surface_z_m."
    if depth_m <= 0:
        yield "the probe never comes below the stated surface: nothing of the tissue can be judged."


def _force_notes(samples: Samples, cell: CellFile, label: str) -> Iterator[str]:
    """Liveness, sign and unit of fz against the force of the stated tissue, and the height of the touch."""
    fz_N, z_m = samples.wrench[:, 2], samples.z_m
    noise_N = max(float(declared_rms(cell)[FZ]), cell.sensor.resolution_fz_N)
    depth_m = np.maximum(cell.tissue.surface_z_m - z_m, 0.0) if cell.tissue is not None else np.zeros(len(samples))
    expected_N = _hertz_N(cell.tissue, cell.probe.tip_radius_m, depth_m) if cell.tissue is not None else depth_m
    peak_N = float(expected_N.max())
    if dead(fz_N):
        yield _dead_note(samples, cell, depth_m, peak_N, noise_N, label)
    elif cell.tissue is not None and swing_N(fz_N) >= CLEAR_NOISES * max(noise_N, measured_rms(fz_N)):
        refuse_turned(samples, label)
        yield from (f"{doubt}; check the signs of force and height." for doubt in turned_twice(samples))
        if depth_m.any():
            yield from _shape_notes(fz_N, expected_N, peak_N, cell, label)
            yield from _frozen_notes(samples, expected_N, noise_N)
        yield from _touch_notes(samples, cell, noise_N)
    elif cell.tolerances.modulus_known and peak_N > 2.0 * CLEAR_NOISES * noise_N and swing_N(fz_N) < 0.1 * peak_N:
        yield (
            f"fz_N changes by {swing_N(fz_N):.2g} N only where the cell file expects {peak_N:.3g} N: the sensor does not feel the "
            "press, or the probe does not touch; check its wiring, its mount and tissue.surface_z_m."
        )


def _dead_note(samples: Samples, cell: CellFile, depth_m: Floats, peak_N: float, noise_N: float, label: str) -> str:
    """A constant fz: refused where contact or inertia must have changed it, else noted."""
    fz_N = samples.wrench[0, 2]
    if peak_N > CLEAR_NOISES * noise_N or (peak_N > 0 and not cell.tolerances.modulus_known):
        raise RecordingError(
            f"{label}fz_N is {fz_N:g} throughout while the probe goes {depth_m.max() * 1e3:.3g} mm into the tissue, expected up to "
            f"{peak_N:.3g} N; the sensor is dead or the column is wrong: record fz_N and diagnose again."
        )
    inertia_N = cell.probe.mass_kg * _acceleration_swing_m_per_s2(samples)
    if moves(samples, cell) and inertia_N > cell.sensor.resolution_fz_N:  # no rounding hides a swing of more than its step
        raise RecordingError(
            f"{label}fz_N is {fz_N:g} throughout while the inertia of {cell.probe.mass_kg:g} kg changes by {inertia_N:.2g} N, more than "
            f"the sensor's step of {cell.sensor.resolution_fz_N:g} N; the sensor is dead or the column is wrong: record fz_N again."
        )
    return f"fz_N is {fz_N:g} throughout, so nothing vertical is judged; check that the sensor is alive, and press the tissue."


def _acceleration_swing_m_per_s2(samples: Samples) -> float:
    """Largest less smallest acceleration, from speeds SLOPE_S apart; 0 if the recording is shorter than three times that."""
    rows = max(1, round(SLOPE_S * samples.rate_Hz))
    if len(samples) < 3 * rows:
        return 0.0
    return float(np.ptp((samples.vz_m_per_s[rows:] - samples.vz_m_per_s[:-rows]) / (samples.t_s[rows:] - samples.t_s[:-rows])))


def _shape_notes(fz_N: Floats, expected_N: Floats, peak_N: float, cell: CellFile, label: str) -> list[str]:
    """Unit of fz by its size against the force of the stated tissue, where it has its shape."""
    ratio = float(np.std(fz_N) / np.std(expected_N))
    if correlation(fz_N, expected_N) < SHAPE_CORRELATION or 1.0 / ODD_FORCE_RATIO < ratio < ODD_FORCE_RATIO:
        return []
    tissue = cell.tissue
    assert tissue is not None
    size = f"fz_N is {ratio:.3g} times the force that the cell file expects ({peak_N:.3g} N at the deepest point)"
    if not cell.tolerances.modulus_known:
        odd = doubts("modulus", ratio * tissue.youngs_modulus_Pa, "the modulus that this gives")
        return [f"{size}; {doubt}; check the units of fz_N, z_m and probe.tip_radius_m." for doubt in odd]
    if 1.0 / WRONG_UNIT_RATIO < ratio < WRONG_UNIT_RATIO:
        return [f"{size}; check the unit of fz_N and tissue.youngs_modulus_Pa."]
    unit = "fz_N looks like mN, divide by 1000" if ratio > 1.0 else "fz_N looks like kN, multiply by 1000"
    raise RecordingError(f"{label}{size}, expected about 1; {unit}, or correct tissue.youngs_modulus_Pa ({tissue.youngs_modulus_Pa:g} Pa).")


def _frozen_notes(samples: Samples, expected_N: Floats, noise_N: float) -> Iterator[str]:
    """The first long stretch over which fz does not change at all while the expected force does."""
    fz_N = samples.wrench[:, 2]
    begins, ends = runs_of_true(np.diff(fz_N) == 0.0)
    long = samples.t_s[ends] - samples.t_s[begins] > FROZEN_S
    clipped = np.isin(fz_N[begins], (fz_N.max(), fz_N.min()))  # a saturated channel has its own note
    for begin, end in zip(begins[long & ~clipped], ends[long & ~clipped], strict=True):
        if np.ptp(expected_N[begin : end + 1]) > max(CLEAR_NOISES * noise_N, HIDDEN_SHARE * float(expected_N.max())):
            yield (
                f"fz_N stays at {fz_N[begin]:.4g} N from {samples.t_s[begin]:.4g} s to {samples.t_s[end]:.4g} s while the probe moves in "
                "the tissue: the sensor or its cable failed; leave that stretch out."
            )
            return


def _touch_notes(samples: Samples, cell: CellFile, noise_N: float) -> Iterator[str]:
    """A touch far from the stated surface: the height at which fz leaves its level in the air.

    Above the stated surface it counts only if rising rows are loaded there, too: drag and friction push a rising probe down.
    """
    tissue = cell.tissue
    assert tissue is not None
    fz_N, z_m = samples.wrench[:, 2], samples.z_m
    high = z_m >= np.quantile(z_m, 0.9)  # of heights that rest at their highest, all are equal
    level_N = float(np.median(fz_N[high]))
    threshold_N = max(CLEAR_NOISES * max(noise_N, measured_rms(fz_N)), 0.02 * float(fz_N.max() - level_N))
    loaded = fz_N - level_N > threshold_N
    if correlation(fz_N, -z_m) < HEIGHT_CORRELATION or not loaded.any() or bool(loaded[high].any()):
        return
    # By Hertz the depth grows with the force to the power of 2/3, which leads from the threshold back to the touch.
    share = float((threshold_N / (fz_N.max() - level_N)) ** (2.0 / 3.0))
    touch_m = min((float(np.quantile(z_m[loaded], 0.98)) - share * float(z_m.min())) / (1.0 - share), float(z_m.max()))
    far_m = FAR_TOUCH_TIP_RADII * cell.probe.tip_radius_m
    between = (z_m > tissue.surface_z_m + far_m) & (z_m < touch_m) & (samples.vz_m_per_s >= 0.0)
    if between.any() and float(loaded[between].mean()) < LOADED_SHARE:
        return
    if abs(touch_m - tissue.surface_z_m) > far_m:
        yield (
            f"fz_N begins to rise at z = {touch_m:.4g} m and the cell file has the surface at {tissue.surface_z_m:.4g} m; "
            "correct tissue.surface_z_m or the zero of z_m."
        )


def _hertz_N(tissue: TissueBlock, tip_radius_m: float, depth_m: Floats) -> Floats:
    return np.asarray(4.0 / 3.0 * tissue.youngs_modulus_Pa / (1.0 - tissue.poisson_ratio**2) * np.sqrt(tip_radius_m) * depth_m**1.5)


def channel_notes(recordings: Sequence[PreparedRecording], cell: CellFile) -> Iterator[str]:
    """One sentence for every channel that is not compared, looks saturated, or hides something."""
    if all(recording.samples.z_cmd_m is None for recording in recordings):
        yield "z_cmd_m is absent: how the robot follows its command is not judged."
    dead = [channel for channel in range(1, 7) if not any(recording.judged[channel] for recording in recordings)]
    if dead:
        names = ", ".join(f"{CHANNELS[channel]} (always {recordings[0].samples.wrench[0, channel - 1]:g})" for channel in dead)
        yield f"{names}: never changes, so it is dead or not measured, and is not judged."
    compared = [recording for recording in recordings if recording.judged[FZ]]
    yield from (note for recording in compared if recording.noise_measured for note in _noise_notes(recording, cell))
    yield from (note for recording in compared for note in _saturation_notes(recording.samples, cell))
    if not cell.tolerances.modulus_known:
        yield (
            "The modulus is not known, so it was fitted. A wrong gain, or anything else in proportion to the contact force, cannot be "
            "distinguished from it. Surface height, thickness, inclusion and compliance of the machine differ from it only in the shape "
            "of the force curve."
        )


def _saturation_notes(samples: Samples, cell: CellFile) -> Iterator[str]:
    """Plateaus of fz at its largest value while the probe moves, or at its smallest while it moves in the tissue: in the air fz rests."""
    fz_N, z_m = samples.wrench[:, 2], samples.z_m
    touching = z_m < (np.inf if cell.tissue is None else cell.tissue.surface_z_m)
    deeper, other_zero = "press less deep, or use a sensor with a larger range", "tare it in the air, or use a sensor with a larger range"
    swing_N, stroke_m = float(np.ptp(fz_N)), float(np.ptp(z_m))
    step_N = max(cell.sensor.resolution_fz_N, lattice_step(fz_N), measured_rms(fz_N))
    least_m = max(SATURATED_STROKE_SHARE, SATURATED_STEPS * step_N / swing_N) * stroke_m
    least_m = max(least_m, CLEAR_NOISES * cell.robot.position_noise_rms_m)
    for which, limit_N, where, remedy in (
        ("largest", float(fz_N.max()), True, deeper),
        ("smallest", float(fz_N.min()), touching, other_zero),
    ):
        begins, ends = runs_of_true((np.abs(fz_N - limit_N) <= SAME_SHARE * swing_N) & where)
        flat = [(a, b) for a, b in zip(begins, ends, strict=True) if b - a >= SATURATED_ROWS and np.ptp(z_m[a:b]) > least_m]
        if flat and abs(limit_N) > CLEAR_NOISES * cell.sensor.noise_rms_N:
            rows = sum(b - a for a, b in flat)
            yield (
                f"fz_N stays at its {which} value {limit_N:.4g} N for {rows} rows while the probe moves, expected to follow it: it looks "
                f"saturated; {remedy}."
            )


def _noise_notes(recording: PreparedRecording, cell: CellFile) -> Iterator[str]:
    """Noise of fz at rest far from the stated."""
    stated_N, measured_N = float(declared_rms(cell)[FZ]), measured_rms(recording.samples.wrench[:, 2], recording.rest)
    sentence = f"the noise of fz_N at rest is {measured_N:.2g} N and the cell file states {stated_N:.2g} N with rounding; correct "
    if measured_N > ODD_NOISE_RATIO * stated_N:
        yield f"{sentence}sensor.noise_rms_N, or look for vibration and bad shielding."
    elif 0.0 < measured_N < stated_N / ODD_NOISE_RATIO:
        yield f"{sentence}sensor.noise_rms_N, or record without the filter that smoothed it."
