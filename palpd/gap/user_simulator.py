"""A user's own simulator as the nominal: a file with its output for a recording, or a function that is asked for any motion.

The prediction of a cell in any state is the user's output + palpd(cell in that state) - palpd(nominal cell). So the engine only needs
the difference of the two nominal predictions, `NominalDifference`, and adds it wherever it simulates the cell.

An effect between robot and tip moves the tip off the height that the robot reports, and the user's simulator then has another motion.
A function is asked again for the same motion with the tip raised by a few distances, and its output is interpolated between these. A
file knows the recorded motion alone, so a diagnosis leaves these effects out and says so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from palpd.cell.cell_file import CellFile
from palpd.cell.dynamics import TipMotion
from palpd.cell.effects import Effect
from palpd.cell.simulation import MeanReading, capture, commanded_motion, mean_reading, predict_motion, wrench_of
from palpd.cell.tip_motion import estimate_tip_motion
from palpd.errors import BadInput, PalpdError, RecordingError
from palpd.recording.oddities import measured_rms
from palpd.recording.samples import COLUMNS, WRENCH_COLUMNS, named_once, read_columns, refuse_values
from palpd.tick import Floats

NEEDED_COLUMN = "fz_N"
PREDICTED = ("z_m", *WRENCH_COLUMNS)
"""Columns that a simulator may predict."""

RAISED = (-0.1, 0.0, 0.05, 0.15, 0.4, 1.0)
"""Distances by which the tip is raised, as shares of the deepest press: they lie densely where play and compliance of working rigs are."""

DRIVE_NOISES = 0.5
"""Rms between heights of an output and reported ones, in the noise of these, below which the output repeats them: a prediction differs
from a noisy reading by more."""

SAME_M = 1e-8
"""The same for heights without noise: a file has no more digits."""

MotionColumns = Mapping[str, Floats]
"""What a function is asked for: `t_s` from 0, `z_m`, `vz_m_per_s`, `az_m_per_s2` of the tip behind noisy reports, and `z_cmd_m` where the
recording has it; arrays (n,)."""


@dataclass(frozen=True)
class UserSimulator:
    """What a user's own simulator predicts.

    Attributes:
        name: What sentences call it.
        run: Gives columns by name for a motion (n rows), each (n,): `fz_N`, and what else of PREDICTED it predicts.
        any_motion: Whether it can be asked for any motion; a file holds the output for a single motion.
    """

    name: str
    run: Callable[[MotionColumns], Mapping[str, Floats]]
    any_motion: bool

    @staticmethod
    def of_function(function: Callable[[MotionColumns], Mapping[str, Floats]], name: str) -> "UserSimulator":
        """A simulator that can be asked for any motion.

        Args:
            function: Takes a motion (`MotionColumns`), gives columns as `run` does.
            name: What sentences call it.

        Raises:
            BadInput: Later, when it is asked and fails.
        """

        def run(motion: MotionColumns) -> Mapping[str, Floats]:
            try:
                columns = function({column: values.copy() for column, values in motion.items()})
            except PalpdError:
                raise
            except Exception as error:  # a user's function may fail in any way
                raise BadInput(
                    f"the simulator {name} failed on a motion of {len(motion['t_s'])} rows ({type(error).__name__}: {error}); expected "
                    f"columns by name, at least {NEEDED_COLUMN}"
                ) from error
            return at_stamps(columns, motion["t_s"], f"the simulator {name}")

        return UserSimulator(name, run, any_motion=True)

    @staticmethod
    def of_columns(columns: Mapping[str, Floats], t_s: Floats, name: str) -> "UserSimulator":
        """The output of a simulator for a single motion.

        Args:
            columns: `t_s`, `fz_N`, and what else of PREDICTED it predicts, (m,).
            t_s: Times (n,) of that motion.
            name: What sentences call it.

        Raises:
            RecordingError: The output does not fit the motion.
        """
        fitting = at_stamps(columns, t_s, name)
        return UserSimulator(name, lambda _: fitting, any_motion=False)

    @staticmethod
    def of_file(path: Path, t_s: Floats) -> "UserSimulator":
        """The output of a simulator for a single motion, from a CSV file.

        Args:
            t_s: Times (n,) of that motion.

        Raises:
            RecordingError: The file is no such output, or does not fit the motion.
        """
        return UserSimulator.of_columns(read_columns(path, _present)[0], t_s, path.name)


def _present(path: Path, header: Sequence[str]) -> list[str]:
    missing = [name for name in ("t_s", NEEDED_COLUMN) if name not in header]
    if missing:
        raise RecordingError(
            f"{path.name}: column {', '.join(missing)} is missing in row 0 (the header); the output of a simulator has t_s, "
            f"{NEEDED_COLUMN} and what else it predicts of {', '.join(name for name in PREDICTED if name != NEEDED_COLUMN)}."
        )
    return named_once(path, header, COLUMNS)


def at_stamps(columns: Mapping[str, Floats], t_s: Floats, name: str) -> dict[str, Floats]:
    """The output of a simulator at the times of a motion: row by row where these are equal, else on straight lines between its rows.

    Args:
        columns: The output, (m,) each; `t_s` may be missing where m is n.
        t_s: Times (n,) of the motion.
        name: What errors call the output.

    Returns:
        The columns of PREDICTED that it has, (n,).

    Raises:
        RecordingError: A column is missing, is not finite, or does not cover the motion.
    """
    if NEEDED_COLUMN not in columns:
        raise RecordingError(f"{name} has the columns {', '.join(columns) or 'none'}, and {NEEDED_COLUMN} is needed; add it.")
    rows = {column: values.shape for column, values in columns.items()}
    stamps = columns.get("t_s", t_s)
    wrong = [column for column, shape in rows.items() if shape != stamps.shape]
    if wrong:
        raise RecordingError(
            f"{name}: {wrong[0]} has the shape {rows[wrong[0]]} and the motion has {len(t_s)} rows; give one value for each row, or t_s "
            "with the output's own times."
        )
    refuse_values({"t_s": stamps} | dict(columns), name)
    edge_s = 1.5 * float(np.median(np.diff(t_s)))  # one row more or less is no other motion
    if stamps[0] > t_s[0] + edge_s or stamps[-1] < t_s[-1] - edge_s:
        raise RecordingError(
            f"{name} covers {stamps[0]:.6g} s to {stamps[-1]:.6g} s in {len(stamps)} rows and the recording {t_s[0]:.6g} s to "
            f"{t_s[-1]:.6g} s in {len(t_s)}, expected all of it; simulate the whole motion, with the recording's t_s."
        )
    same = np.array_equal(stamps, t_s)
    return {column: columns[column] if same else np.interp(t_s, stamps, columns[column]) for column in PREDICTED if column in columns}


@dataclass(frozen=True)
class NominalDifference:
    """What a user's simulator predicts beyond palpd's nominal cell, for one motion of n samples.

    Attributes:
        output: Its output for that motion by column, (n,) each.
        t_s: Times (n,) from the first row.
        heights_m: Difference of the reported heights (n,); None where palpd's own servo predicts them.
        wrench: Difference of the wrench by axis, (k, n) with the tip raised by k distances; axes without a difference are missing.
        raised_m: These distances (k,), ascending.
    """

    simulator: UserSimulator
    output: Mapping[str, Floats]
    cell: CellFile
    t_s: Floats
    heights_m: Floats | None
    wrench: Mapping[int, Floats]
    raised_m: Floats

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels that the simulator predicts."""
        return tuple(name for name in self.output if name != "z_m" or self.heights_m is not None)

    def heights(self, t_s: Floats) -> Floats | float:
        """What to add to the heights that palpd predicts: (m,) in m, or 0 where palpd's own servo predicts them.

        Args:
            t_s: Times (m,) from the first row.
        """
        return 0.0 if self.heights_m is None else np.interp(t_s, self.t_s, self.heights_m)

    def reading(self, cell: CellFile, motion: TipMotion, library: Mapping[str, Effect]) -> MeanReading:
        """Mean reading of a cell: palpd's, plus what the user's simulator predicts beyond palpd's nominal cell.

        Args:
            cell: The nominal cell with the effects and deviations of a state.
            motion: Motion of the tip as the robot reports it, at some times within that of the difference.
            library: Effects by id.
        """
        reading = mean_reading(cell, motion, library)
        if len(self.raised_m) == 1 or _tip_effects(cell, library) == _tip_effects(self.cell, library):
            plain = int(np.flatnonzero(self.raised_m == 0.0)[0])
            return reading.plus({axis: np.interp(motion.t_s, self.t_s, levels[plain]) for axis, levels in self.wrench.items()})
        at = {axis: np.array([np.interp(motion.t_s, self.t_s, level) for level in levels]) for axis, levels in self.wrench.items()}
        raised_m = _tip_m(cell, motion, library) - _tip_m(self.cell, motion, library)
        return reading.plus({axis: _between(levels, self.raised_m, raised_m) for axis, levels in at.items()})


def difference(
    simulator: UserSimulator,
    cell: CellFile,
    library: Mapping[str, Effect],
    motion: TipMotion,
    reported: tuple[Floats | None, Floats],
    deepest_m: float = 0.0,
) -> NominalDifference:
    """Ask a user's simulator for a motion, and compare it with palpd's nominal cell.

    Args:
        library: Effects of the nominal cell by id.
        motion: The motion of the tip at n samples.
        reported: Commanded heights (n,), None without a command, and heights (n,) as the robot reports them.
        deepest_m: Depth of the deepest press; 0 where nothing is touched, and the tip is then never raised.
    """
    z_cmd_m, z_m = reported
    shares = RAISED if simulator.any_motion and deepest_m > 0.0 else (0.0,)
    outputs, own = {}, {}
    for share in shares:
        raised = replace(motion, z_m=motion.z_m + share * deepest_m)
        own[share] = wrench_of(cell, raised, library)
        outputs[share] = simulator.run(asked(raised, None if z_cmd_m is None else z_cmd_m + share * deepest_m))
    plain = outputs[0.0]
    predicted = [(axis, column) for axis, column in enumerate(WRENCH_COLUMNS) if column in plain]
    wrench = {axis: np.array([outputs[share][column] - own[share][:, axis] for share in shares]) for axis, column in predicted}
    wrench = {axis: levels for axis, levels in wrench.items() if levels.any()}
    heights_m = None
    if z_cmd_m is not None and "z_m" in plain and not _repeats(plain["z_m"], z_m, motion.z_m, cell):
        heights_m = plain["z_m"] - predict_motion(cell, motion.t_s, z_cmd_m, library)
    return NominalDifference(simulator, plain, cell, motion.t_s, heights_m, wrench, np.array(shares) * deepest_m)


def asked(motion: TipMotion, z_cmd_m: Floats | None) -> MotionColumns:
    """The motion for which a function is asked, as columns (n,) by name.

    Args:
        motion: The motion of the tip at n samples.
        z_cmd_m: Commanded heights (n,); None without a command.
    """
    columns = {"t_s": motion.t_s, "z_m": motion.z_m, "vz_m_per_s": motion.vz_m_per_s, "az_m_per_s2": motion.az_m_per_s2}
    return columns if z_cmd_m is None else columns | {"z_cmd_m": z_cmd_m}


def _repeats(heights_m: Floats, reported_m: Floats, tip_m: Floats, cell: CellFile) -> bool:
    """Whether heights in an output are those that drove the simulator, and no prediction."""
    noise_m = min(cell.robot.position_noise_rms_m, measured_rms(reported_m))

    def apart_m(other_m: Floats) -> float:
        return float(np.sqrt(np.mean((heights_m - other_m) ** 2)))

    return apart_m(reported_m) < max(DRIVE_NOISES * noise_m, SAME_M) or apart_m(tip_m) < SAME_M


def _tip_effects(cell: CellFile, library: Mapping[str, Effect]) -> dict[str, Mapping[str, float]]:
    return {name: values for name, values in cell.effects.items() if library[name].site == "tip"}


def _tip_m(cell: CellFile, motion: TipMotion, library: Mapping[str, Effect]) -> Floats:
    """Heights (n,) of the tip while the robot reports those of the motion."""
    return capture(cell, library, "probe", lambda c, known: wrench_of(c, motion, known)).tip_m


def _between(levels: Floats, raised_m: Floats, at_m: Floats) -> Floats:
    """Values (n,) on straight lines between levels (k, n) that are known for the distances `raised_m` (k,); constant beyond their ends."""
    at_m = np.clip(at_m, raised_m[0], raised_m[-1])
    above = np.clip(np.searchsorted(raised_m, at_m), 1, len(raised_m) - 1)
    share = (at_m - raised_m[above - 1]) / (raised_m[above] - raised_m[above - 1])
    row = np.arange(len(at_m))
    return (1.0 - share) * levels[above - 1, row] + share * levels[above, row]


def left_out(simulators: Sequence[UserSimulator], cell: CellFile, library: Mapping[str, Effect]) -> tuple[str, ...]:
    """Effects that cannot be judged, since they change the motion of the tip and an output is a file.

    Args:
        simulators: The user's simulator for each recording; empty where palpd itself simulates the nominal cell.
        cell: The nominal cell; effects that it has are in every output.
        library: The effects that may be present.

    Returns:
        Their ids.
    """
    if all(simulator.any_motion for simulator in simulators):
        return ()
    return tuple(name for name, effect in library.items() if effect.site == "tip" and name not in cell.effects)


def simulate_with(
    simulator: UserSimulator,
    nominal: CellFile,
    cell: CellFile,
    columns: Mapping[str, Floats],
    library: Mapping[str, Effect],
    *,
    measured: bool,
) -> dict[str, Floats]:
    """The recording that a cell gives on a motion: the user's output + palpd(cell) - palpd(nominal cell).

    Args:
        nominal: The cell that the simulator simulates.
        cell: The same cell in another state, as a diagnosis has enriched it.
        columns: `t_s`, and `z_m` (with `vz_m_per_s` where known) or `z_cmd_m`, each (n,).
        library: Effects by id.
        measured: Whether the reported heights drive the cell; else the commanded heights do.

    Returns:
        Heights and wrench (n,) by column.

    Raises:
        BadInput: The cell moves otherwise than the nominal cell, and the simulator is a file.
    """
    moved = [
        name
        for name, values in cell.effects.items()
        if nominal.effects.get(name) != values and (library[name].site == "tip" or (library[name].motion and not measured))
    ]
    if moved and not simulator.any_motion:
        raise BadInput(
            f"{moved[0]} changes the motion, and {simulator.name} holds the output for one motion; take {moved[0]} out of the cell, or ask "
            "your simulator from Python (docs/my-simulator.md)"
        )
    t_s, z_cmd_m = columns["t_s"], columns.get("z_cmd_m")
    if measured or z_cmd_m is None:
        motion = estimate_tip_motion(nominal, t_s, columns["z_m"], columns.get("vz_m_per_s"), z_cmd_m)
    else:
        motion = commanded_motion(cell, t_s, z_cmd_m, library)
    z_m = columns["z_m"] if measured else motion.z_m
    deepest_m = 0.0 if nominal.tissue is None else max(nominal.tissue.surface_z_m - float(motion.z_m.min()), 0.0)
    beyond = difference(simulator, nominal, library, motion, (z_cmd_m, z_m), deepest_m)
    wrench = beyond.reading(cell, motion, library).wrench(len(t_s))
    heights_m = z_m if measured else z_m + beyond.heights(motion.t_s)
    return {"z_m": heights_m} | {name: wrench[:, axis] for axis, name in enumerate(WRENCH_COLUMNS)}
