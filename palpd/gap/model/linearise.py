"""All that is within specification near a state of the cell, as a linear model: columns A with coefficients c ~ N(0, I)."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpd.cell.cell_file import CROSSTALK, CellFile, EffectValues
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FX, FY, FZ, TX, TY, Z
from palpd.gap.data.prepare import PreparedRecording
from palpd.gap.gaussian.nuisances import ColumnByChannel, Columns, Nuisances, Stretch, nuisances
from palpd.gap.model.fixed_nuisances import Column, bins_of, whitened_column
from palpd.gap.model.problem import RELATIVE, SHARED, Problem, own_tolerances, tolerance_key
from palpd.tick import Floats

LEAKS_INTO = {"fx_per_fz": FX, "fy_per_fz": FY, "tx_per_fz": TX, "ty_per_fz": TY}
LEAKS = np.isin(SHARED, CROSSTALK)


@dataclass(frozen=True)
class Linearisation:
    """Prediction and nuisances at one state (θ, η₀) of the cell, the point of linearisation.

    Attributes:
        effects: Parameters θ by effect.
        eta: Shared deviations η₀ (11,), in standard deviations.
        labels: What each of the m columns stands for. Effects change the list: a press that no longer touches has no columns.
        space: The columns A (m, 7, b), prepared to be projected out. The first 11 are ∂f/∂η of the shared deviations.
        prediction: Whitened prediction f (7, b) in that state.
        tolerance_columns: Whitened changes (p, 7, b) by one standard deviation of each tolerance that an effect stands for
            (`Effect.tolerance`). Their columns in A are zero.
    """

    effects: EffectValues
    eta: Floats
    labels: tuple[Column, ...]
    space: Nuisances
    prediction: Floats
    tolerance_columns: Floats

    def numbers(self, scope: str, name: str | None = None, channel: int | None = None) -> list[int]:
        """Numbers of the columns of one kind, in ascending order.

        Args:
            scope: `cell`, `recording`, `press` or `computation`, as in Column.
            name: As in Column; None: any.
            channel: As in Column; None: any.
        """
        return [
            k
            for k, label in enumerate(self.labels)
            if label.scope == scope and name in (None, label.name) and channel in (None, label.channel)
        ]

    def offset(self) -> Floats:
        """A (η₀, 0) (7, b), which is added to y - f: the coefficients c count from zero, and the prediction stands at η₀."""
        return self.space.explained(np.pad(self.eta, (0, len(self.labels) - len(self.eta))))

    def restricted_to(self, bins: NDArray[np.bool_]) -> "Linearisation":
        """The linearisation of a problem in which only some bins (b,) count."""
        prediction = np.where(bins[None, :], self.prediction, 0.0)
        replaced, space = np.where(bins[None, None, :], self.tolerance_columns, 0.0), nuisances(self.space.columns.restricted_to(bins))
        return Linearisation(self.effects, self.eta, self.labels, space, prediction, replaced)


def linearise(problem: Problem, effects: EffectValues, eta: Floats) -> Linearisation:
    """Columns A of the nuisances at a state of the cell, by forward differences.

    An effect may stand for a tolerance. That deviation is then fitted and not integrated out: its column is zero, and its η is 0. Its
    scatter from press to press stays, since an effect changes all presses alike.

    Args:
        effects: Parameters θ by effect.
        eta: Shared deviations η₀ (11,) in standard deviations.

    Returns:
        Columns in this order: shared deviations; what depends on the state, recording by recording; fixed nuisances.
    """
    eta = np.where(own_tolerances(problem.library[name] for name in effects), 0.0, eta)
    prediction = problem.predict(effects, eta)
    shared = _shared_columns(problem, effects, eta, prediction)
    labelled: list[tuple[Column, ColumnByChannel]] = [
        (Column("cell", name), dict(enumerate(column))) for name, column in zip(SHARED, shared, strict=True)
    ]
    labelled += _own_columns(problem, effects, eta, shared)
    keys = {problem.library[name].tolerance for name in effects}
    fixed = problem.fixed_nuisances
    labels = (*(label for label, _ in labelled), *fixed.labels)
    replaced = [label.scope != "press" and label.channel in (-1, FZ) and tolerance_key(label.name) in keys for label in labels]
    changing = Columns.of([{} if gone else column for gone, (_, column) in zip(replaced, labelled, strict=False)], prediction.shape)
    remaining, taken = fixed.columns.without(np.flatnonzero(replaced[len(labelled) :]))
    shared_gone = [Columns.of([column], prediction.shape).dense()[0] for gone, (_, column) in zip(replaced, labelled, strict=False) if gone]
    space = nuisances(changing.followed_by(remaining))
    return Linearisation(effects, eta, labels, space, prediction, np.array([*shared_gone, *taken]).reshape(-1, *prediction.shape))


def _shared_columns(problem: Problem, effects: EffectValues, eta: Floats, prediction: Floats) -> list[Floats]:
    """Forward differences ∂f/∂η (7, b) for every shared deviation, also for those that an effect stands for."""
    sd = problem.shared_sd
    leaking = eta + np.where(LEAKS, 0.5, 0.0)  # crosstalk leaks into four different axes, so one simulation gives all four
    leaks = (problem.predict(effects, leaking) - prediction) / 0.5 if sd[LEAKS].any() else np.zeros_like(prediction)
    columns = []
    for k, name in enumerate(SHARED):
        column = np.zeros_like(prediction)
        if sd[k] > 0.0 and name in LEAKS_INTO:
            column[LEAKS_INTO[name]] = leaks[LEAKS_INTO[name]]
        elif sd[k] > 0.0:
            step = 0.3 if name == "surface_z_m" else 0.5
            h = min(step, 0.05 / sd[k]) if name in RELATIVE else step
            there = eta.copy()
            there[k] += h
            column = (problem.predict(effects, there) - prediction) / h
        columns.append(column)
    return columns


def _own_columns(problem: Problem, effects: EffectValues, eta: Floats, shared: list[Floats]) -> Iterator[tuple[Column, ColumnByChannel]]:
    """Labelled columns of every recording in turn, (b,) by channel, that depend on the state: errors of the computation and presses."""
    cell = problem.cell_at(effects, eta)
    predicted = problem.binned_prediction(effects, eta)
    for number, bins in enumerate(bins_of(problem.recordings)):
        own = _computation_errors(problem, number, cell, predicted[:, bins])
        yield from ((label, whitened_column(problem.noise, label.channel, bins, values)) for label, values in own)
        yield from _press_columns(problem, problem.recordings[number], bins, shared)


def _computation_errors(problem: Problem, number: int, cell: CellFile, predicted: Floats) -> Iterator[tuple[Column, Floats]]:
    """Errors of the times of commanded heights and of the motion that drives the force; `predicted` (7, b) is f in this recording."""
    recording, z_m, fz_N = problem.recordings[number], predicted[Z], predicted[FZ]
    if recording.judged[Z]:
        # A target that is held between controller cycles is known to about a tenth of a step.
        slope = np.gradient(z_m, recording.t_s)
        yield (
            Column("computation", "time", Z),
            ASSUMED.noise.command_time_share * recording.reports.rows_each / recording.samples.rate_Hz * slope,
        )
    if recording.judged[Z] and fz_N.any():
        # A position loop gives way under load. What one report of the height cannot resolve is within specification.
        yield Column("recording", "give under load", Z), recording.noise_rms[Z] * fz_N / np.abs(fz_N).max()
    # Averaging removed a part of the motion; averaging once more removes about as much again, which is how uncertain the motion is. Of a
    # commanded path little is averaged, and what its reports leave out counts.
    for motion in recording.otherwise if recording.judged[FZ] else ():
        yield Column("computation", "motion", FZ), problem.binned_wrench(number, cell, motion)[FZ - 1] - fz_N


def _press_columns(
    problem: Problem, recording: PreparedRecording, mine: slice, shared: list[Floats]
) -> Iterator[tuple[Column, ColumnByChannel]]:
    """Scatter of stiffness and surface of every press, as the shared deviations act within it."""
    repeatability = problem.cell.repeatability
    scatters = []
    for name, deviation, scatter in (
        ("stiffness", "youngs_modulus", repeatability.stiffness),
        ("surface_z_m", "surface_z_m", repeatability.surface_z_m),
    ):
        source, sd = shared[SHARED.index(deviation)], problem.shared_sd[SHARED.index(deviation)]
        if sd > 0 and scatter > 0:
            scatters.append((name, {channel: source[channel] * (scatter / sd) for channel in np.flatnonzero(source.any(axis=1)).tolist()}))
    for press in range(recording.phases.presses):
        bins = np.flatnonzero(recording.bin_press == press)
        if not len(bins):
            continue
        # The bins of a press follow each other; one bin at either side belongs to it in part.
        first, end = mine.start + max(int(bins[0]) - 1, 0), mine.start + min(int(bins[-1]) + 2, len(recording.bins))
        for name, changes in scatters:
            if FZ in changes and changes[FZ][first:end].any():
                yield Column("press", name), {channel: Stretch(first, values[first:end]) for channel, values in changes.items()}
