"""Stage 1 of a diagnosis: a recording is cut into phases and bins; the motion of its tip and the noise of its channels are estimated."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array

from palpd.cell.cell_file import CellFile
from palpd.cell.dynamics import State, mounted, steps
from palpd.cell.effects import Effect
from palpd.cell.report_times import Reports, find_reports, straight_between
from palpd.cell.simulation import MeanReading, mean_reading
from palpd.cell.span import TipMotion
from palpd.cell.tip_motion import StartingMotion, estimate_tip_motion, slope_weights, starting_motion
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data import controller_cycle
from palpd.gap.data.bins import Bins, make_bins
from palpd.gap.data.noise import FZ, Z, declared_rms
from palpd.gap.data.phases import FREE_STILL, HOLDING, Ints, Phases, find_phases
from palpd.gap.data.rounding import Rounding, undithered
from palpd.gap.user_simulator import SimulatedNominal, UserSimulator, followed_command, simulated_nominal
from palpd.recording.oddities import dead, measured_rms
from palpd.recording.samples import Samples
from palpd.tick import Floats

FILTER_MEMORY = 4.6
"""Time constants after which a filter has forgotten all but one hundredth of its input."""


LAST_DIGITS = 1e-9
"""Least noise of a channel without any, as a share of its span: readings have no more digits."""


LEAST_BINS = 600
"""Number of bins that each recording may have, however many there are."""


@dataclass(frozen=True)
class PreparedRecording:
    """One recording of n samples in b bins, with the noise of every bin and the motion behind its noisy heights."""

    samples: Samples
    phases: Phases
    bins: Bins  # of samples
    sampled: TipMotion  # at every sample
    motion: TipMotion  # at the steps, several samples long where the motion is smooth; moved to even times where nearly even
    step_means: csr_array  # (b, steps) takes means over the bins of what is known at the times of `motion`
    otherwise: tuple[TipMotion, ...]  # `motion` with another path, with its acceleration averaged more, and behind damped mounts
    reports: Reports  # of the robot
    robot_t_s: Floats  # (k,) times from the first row: of the samples where the robot reports less often, else of the steps
    z_cmd_m: Floats | None  # (k,) at those times
    z_means: csr_array  # (b, k) takes means over the bins of heights at those times
    inertial_noise_N: csr_array  # (b, r) effect on fz of one standard deviation of the error of each reported speed
    noise_rms: Floats  # (7,) of one sample: as measured, but at least half of the stated noise, and all of it without dither
    rest: NDArray[np.bool_]  # (n,) samples at which the noise was measured
    noise_measured: bool  # whether enough samples at rest were there for it
    judged: tuple[bool, ...]  # which of the 7 channels are compared
    held_command_s: float | None  # for which each commanded height stays the same; None where it changes with each sample
    cycle_s: float | None  # of a controller that holds its targets, as the command or the force shows it; None where neither does
    start: StartingMotion | None  # None where it starts at rest, and where a user's simulator predicts the heights
    simulated: SimulatedNominal | None  # what the user's simulator predicts of the nominal cell; None without one

    @cached_property
    def t_s(self) -> Floats:
        """Mean time of every bin (b,), from the first sample."""
        return self.bins.mean(self.samples.t_s - self.samples.t_s[0])

    @property
    def measured(self) -> Floats:
        """Measured bins y (7, b) in the units of the channels; heights are 0 where these are not compared."""
        z_m = self.samples.z_m if self.judged[Z] else np.zeros(len(self.samples))
        return np.ascontiguousarray(self.bins.mean(np.column_stack([z_m, self.samples.wrench])).T)

    @cached_property
    def bin_phase(self) -> Ints:
        """Phase of every bin (b,)."""
        return self.bins.label(self.phases.phase)

    @cached_property
    def bin_cycle(self) -> Ints:
        """Cycle of every bin (b,)."""
        return self.bins.label(self.phases.cycle)

    @cached_property
    def bin_press(self) -> Ints:
        """Press of every bin (b,), -1 in the air."""
        return self.bins.label(self.phases.press)

    @property
    def removed_m_per_s2(self) -> Floats:
        """Rms of what averaging has removed from the acceleration in every bin (b,), as far as averaging it once more shows."""
        removed_m_per_s2 = self.otherwise[1].az_m_per_s2 - self.motion.az_m_per_s2
        return np.asarray(np.sqrt(self.step_means @ removed_m_per_s2**2))

    def reading(self, cell: CellFile, motion: TipMotion, library: Mapping[str, Effect]) -> MeanReading:
        """Predicted mean reading; with a user's simulator the cell's effects and deviations act on its output.

        Args:
            cell: With the effects and deviations of the state that is predicted.
            motion: Motion of the tip in this recording, at the samples or the steps.
            library: Effects by id.
        """
        return mean_reading(cell, motion, library, nominal=None if self.simulated is None else self.simulated.nominal(motion))

    def heights(self, palpd_m: Floats, t_s: Floats) -> Floats:
        """Predicted heights; with a user's simulator what its heights have beyond those of palpd's servo is added.

        Args:
            palpd_m: What palpd's servo makes of `command_m`, (m,).
            t_s: The times (m,) of these heights, from the first row.

        Returns:
            The heights (m,) in m.
        """
        return palpd_m if self.simulated is None else self.simulated.heights(palpd_m, t_s)

    def state_at(self, after_s: float) -> State | None:
        """Height and speed from which the servo starts a little after the first row; None: at rest at its first target."""
        return None if self.start is None else self.start.at(after_s)

    @property
    def command_m(self) -> Floats | None:
        """Commanded heights (n,); with a user's simulator those for which palpd's servo moves as the simulator's does."""
        return self.samples.z_cmd_m if self.simulated is None else self.simulated.command_m


def moves(samples: Samples, cell: CellFile) -> bool:
    """Whether the heights of a recording span more than their noise."""
    low_m, high_m = np.quantile(samples.z_m, (0.01, 0.99))
    return bool(high_m - low_m > ASSUMED.noise.still_span_sd * cell.robot.position_noise_rms_m)


def stated_cell(cell: CellFile) -> CellFile:
    """The nominal cell of a file: without the deviations and hypotheses that an earlier diagnosis wrote there."""
    return cell.with_estimated(None).model_copy(update={"uncertainty": ()})


def prepare(
    recordings: Sequence[Samples],
    cell: CellFile,
    library: Mapping[str, Effect],
    max_bins: int,
    rounding: Rounding | None = None,
    simulators: Sequence[UserSimulator] = (),
) -> tuple[PreparedRecording, ...]:
    """Prepare the recordings of a cell for comparison with its simulation.

    Args:
        cell: The nominal cell.
        library: Effects of that cell by id.
        max_bins: Largest number of bins of all recordings together, approximately; at least LEAST_BINS for each.
        rounding: Of fz; None where noise dithers it.
        simulators: A user's own simulator for each recording; empty where palpd itself simulates the nominal cell.
    """
    most = max(LEAST_BINS, max_bins // len(recordings))
    absent: list[UserSimulator | None] = [None] * len(recordings)
    of_each = zip(recordings, simulators or absent, strict=True)
    return tuple(_prepared(samples, cell, library, most, rounding, simulator) for samples, simulator in of_each)


def _prepared(
    samples: Samples, cell: CellFile, library: Mapping[str, Effect], most: int, rounding: Rounding | None, simulator: UserSimulator | None
) -> PreparedRecording:
    phases = find_phases(samples, cell)
    reports = find_reports(samples.t_s, samples.z_m)
    reported, command_m, simulated = (samples.z_cmd_m, samples.z_m), samples.z_cmd_m, None

    def estimated(z_m: Floats, v: Floats, its: Reports | None = None) -> TipMotion:
        return estimate_tip_motion(cell, samples.t_s, z_m, v, command_m, its)

    sampled = estimated(samples.z_m, samples.vz_m_per_s, reports)
    if simulator is not None:
        command_m = followed_command(simulator, cell, library, sampled, reported)
        sampled = estimated(samples.z_m, samples.vz_m_per_s, reports)
        simulated = simulated_nominal(simulator, cell, library, sampled, reported)
    again = estimated(sampled.z_m, sampled.vz_m_per_s)
    # A pulse of acceleration loses more than one average shows.
    twice = estimated(again.z_m, again.vz_m_per_s)
    averaged = [again, twice, *_on_damped_mounts(samples, sampled)]
    unreported_m = _unreported_height(cell, samples, sampled)
    command_m = samples.z_cmd_m if simulated is None else simulated.command_m
    held_command_s = controller_cycle.held_command_s(samples)
    cycle_s = held_command_s or controller_cycle.comb_period_s(samples, phases)
    step, cycle = _whole_cycles(_step_length(samples, cell, reports.rows_each), cycle_s, samples.rate_Hz)
    samples_per_step, samples_per_cycle = (Bins.of_equal_length(samples.t_s, length) for length in (step, cycle))
    cycles = make_bins(samples_per_cycle.mean(samples.t_s), phases, samples_per_cycle, most)
    steps = samples_per_step.joined_at(samples_per_cycle.merged(cycles))
    bins = samples_per_step.merged(steps)
    true_s = samples_per_step.mean(sampled.t_s)
    even_s = _even(true_s)

    def at_steps(values: Floats) -> Floats:
        return np.interp(even_s, true_s, samples_per_step.mean(values))

    def moved(of_samples: TipMotion) -> TipMotion:
        return _at_steps(of_samples, at_steps, even_s, nearly=even_s is not true_s)

    motion = moved(sampled)
    robot_t_s, z_cmd_m, z_means = _robot_grid(samples, command_m, reports, at_steps, steps, bins, true_s, even_s)
    still = np.isin(phases.phase, (FREE_STILL, HOLDING)) & (phases.since_s > 0.1 * phases.since_s.max())
    rest = still if samples.held is None else still & ~samples.held
    judged, noise_rms = _noise(samples, cell, reports, still, rest)
    if simulated is not None and simulated.heights_m is None:  # palpd's servo is not the one that is judged
        judged = (False, *judged[1:])
    if rounding is not None:  # the measured noise is that of the few forces that occur at rest
        noise_rms[FZ] = max(noise_rms[FZ], np.hypot(rounding.noise_rms_N, rounding.step_N / 12.0**0.5))
    return PreparedRecording(
        samples=samples,
        phases=phases,
        bins=bins,
        sampled=sampled,
        motion=motion,
        step_means=steps.means() @ straight_between(np.clip(true_s, even_s[0], even_s[-1]), even_s),
        otherwise=(
            moved(replace(sampled, z_m=again.z_m + unreported_m, vz_m_per_s=again.vz_m_per_s)),
            *(moved(replace(sampled, az_m_per_s2=each.az_m_per_s2)) for each in averaged),
        ),
        reports=reports,
        robot_t_s=robot_t_s,
        z_cmd_m=z_cmd_m,
        z_means=z_means,
        inertial_noise_N=_inertial_noise(samples, cell, sampled, reports, bins) if judged[FZ] else csr_array((len(bins), 1)),
        noise_rms=noise_rms,
        rest=rest,
        noise_measured=bool(still.sum() >= ASSUMED.noise.fewest_at_rest),
        judged=judged,
        held_command_s=held_command_s,
        cycle_s=cycle_s,
        start=starting_motion(cell, samples.t_s, samples.z_m, samples.vz_m_per_s) if simulated is None else None,
        simulated=None if simulated is None else simulated.with_steps(motion, at_steps),
    )


def _on_damped_mounts(samples: Samples, motion: TipMotion) -> Iterator[TipMotion]:
    """The motion with a share of its acceleration behind a heavily damped mount, once for each natural frequency.

    Averaging takes away pulses of acceleration, such as those of a controller that limits its jerk, and noise that remains drives the
    prediction. Such a mount undoes the one and averages the other. A mount that rings does neither.
    """
    for frequency_Hz in ASSUMED.noise.damped_mounts_Hz:
        if 4.0 * frequency_Hz < samples.rate_Hz:  # a faster one moves with its base
            behind = mounted(motion.az_m_per_s2, steps(samples.t_s), frequency_Hz, ASSUMED.noise.mount_damping_ratio, {})
            share = ASSUMED.noise.mount_share
            yield replace(motion, az_m_per_s2=(1.0 - share) * motion.az_m_per_s2 + share * behind)


def _unreported_height(cell: CellFile, samples: Samples, motion: TipMotion) -> Floats:
    """Heights (n,) by which the tip may differ from the reports in acceleration, as a standard deviation; 0 without a command."""
    if samples.z_cmd_m is None:
        return np.zeros(len(samples))
    return np.asarray(ASSUMED.noise.unreported_share * motion.az_m_per_s2 / (2.0 * np.pi * cell.robot.servo_natural_frequency_Hz) ** 2)


def _robot_grid(
    samples: Samples,
    command_m: Floats | None,
    reports: Reports,
    at_steps: Callable[[Floats], Floats],
    steps: Bins,
    bins: Bins,
    true_s: Floats,
    even_s: Floats,
) -> tuple[Floats, Floats | None, csr_array]:
    """Times at which the robot is simulated (k,), its commanded heights there (k,), and the matrix of means over the bins (b, k)."""
    if reports.rows_each > 1.0:
        z_means = bins.means() @ reports.joined @ straight_between(reports.t_s, samples.t_s)
        return samples.t_s - samples.t_s[0], command_m, z_means
    # A time that is off by a tenth of a step makes, by the robot's lag, a height that is off by more than its noise.
    z_cmd_m = None if command_m is None else at_steps(command_m)
    return even_s, z_cmd_m, steps.means() @ straight_between(true_s, even_s)


def _noise(
    samples: Samples, cell: CellFile, reports: Reports, still: NDArray[np.bool_], rest: NDArray[np.bool_]
) -> tuple[tuple[bool, ...], Floats]:
    """Which channels are compared, and the noise rms of one sample of each (7,): as measured, at least half of the stated."""
    declared = declared_rms(cell)
    judged, measured, digits = [], np.zeros(7), np.full(7, 1e-300)
    for channel in range(7):
        if channel == Z:
            usable = samples.z_cmd_m is not None and not dead(samples.z_m)
            signal, where = reports.values(samples.z_m), still[np.searchsorted(samples.t_s, reports.t_s)]
        else:
            signal, where = samples.wrench[:, channel - 1], rest
            usable = not dead(signal)
        judged.append(usable)
        if usable:
            enough = where.sum() >= ASSUMED.noise.fewest_at_rest
            rms = measured_rms(signal, where) if enough else measured_rms(signal)
            measured[channel] = rms if enough or declared[channel] == 0.0 else min(rms, declared[channel])
            digits[channel] = max(LAST_DIGITS * float(np.ptp(signal)), 1e-300)
    floor = np.where(declared > 0, declared, np.maximum(measured, digits))
    # Of readings that noise does not dither, those that happen to rest within a level show too little of it.
    least = np.where(undithered(cell), 1.0, ASSUMED.noise.least_share_of_stated) * floor
    return tuple(judged), np.where(measured > 0, np.maximum(measured, least), floor)


def _inertial_noise(samples: Samples, cell: CellFile, motion: TipMotion, reports: Reports, bins: Bins) -> csr_array:
    """Effect of one standard deviation of the error of each reported speed (r,) on the binned force of inertia (b,), in N.

    The error of one report pushes forth and back for the time over which slopes are taken, and for the memory of the sensor's filter
    after that. Bins share it.
    """
    n, dt_s = len(samples), 1.0 / samples.rate_Hz
    weights = cell.probe.mass_kg * motion.v_noise_m_per_s * slope_weights(dt_s, motion.slope_half)
    first = -(len(weights) // 2)
    if cell.sensor.filter_cutoff_Hz:
        per_step = 2.0 * np.pi * cell.sensor.filter_cutoff_Hz * dt_s
        remembered = np.exp(-per_step * np.arange(int(FILTER_MEMORY / per_step) + 1))
        weights, first = np.convolve(weights, remembered[::-1] / remembered.sum()), first - len(remembered) + 1
    weight = bins.mean(np.broadcast_to(motion.acceleration_weight, n))
    return csr_array(diags_array(weight) @ _means_of_sums(bins, weights, first, n) @ reports.joined)


def _means_of_sums(bins: Bins, weights: Floats, first: int, n: int) -> csr_array:
    """Matrix (b, n) that takes weighted sums of neighbours of n samples, from `first` on, and their mean over every bin."""
    reach = bins.count + len(weights) - 1
    row = np.repeat(np.arange(len(bins)), reach)
    k = np.arange(len(row)) - np.repeat(np.cumsum(reach) - reach, reach)
    column = bins.begin[row] + first + k
    total = np.concatenate([[0.0], np.cumsum(weights)])
    value = (total[np.minimum(k + 1, len(weights))] - total[np.maximum(k + 1 - bins.count[row], 0)]) / bins.count[row]
    inside = (column >= 0) & (column < n)
    return csr_array((value[inside], (row[inside], column[inside])), shape=(len(bins), n))


def _step_length(samples: Samples, cell: CellFile, samples_each: float) -> int:
    """Number of samples in a step of the simulation.

    A step takes at most a fifth of the time over which heights are averaged, and at least 4500 steps remain. It takes up to a third where
    the robot reports no more often, since no faster motion is known there.
    """
    averaged = 0.25 / cell.robot.servo_natural_frequency_Hz * samples.rate_Hz
    return max(1, min(int(averaged / 5.0), len(samples) // 4500), min(int(averaged / 3.0), int(samples_each)))


def _whole_cycles(step: int, cycle_s: float | None, rate_Hz: float) -> tuple[int, int]:
    """Samples in a step of the simulation and in the shortest bin: bins hold whole cycles of the controller where one was found.

    A part of a sample too few or too many changes the mean over a cycle little. Steps divide a cycle, and may be longer for it.
    """
    cycle = 1 if cycle_s is None else round(cycle_s * rate_Hz)
    if step >= cycle:
        return (step // cycle * cycle,) * 2
    return max(part for part in range(1, cycle + 1) if cycle % part == 0 and 3 * part <= 5 * step), cycle


def _at_steps(motion: TipMotion, at: Callable[[Floats], Floats], even_s: Floats, *, nearly: bool) -> TipMotion:
    """The motion at steps, of values that `at` takes there."""
    return replace(
        motion,
        t_s=even_s,
        z_m=at(motion.z_m),
        vz_m_per_s=at(motion.vz_m_per_s),
        az_m_per_s2=at(motion.az_m_per_s2),
        dt_s=steps(even_s),
        even_s=float(even_s[1] - even_s[0]) if nearly else 0.0,
    )


def _even(t_s: Floats) -> Floats:
    """Times (s,) of steps on an even grid, since a filter takes a tenth of the time over even steps.

    They move by up to half a step; the last step may be short and move further. Where that does not suffice they stay.
    """
    if len(t_s) < 4:
        return t_s
    step_s = float(t_s[-2] - t_s[0]) / (len(t_s) - 2)
    even_s = t_s[0] + step_s * np.arange(len(t_s))
    return even_s if float(np.abs(even_s - t_s)[:-1].max()) < 0.5 * step_s else t_s
