"""A user's own simulator as the nominal: a file with its output for a recording, or a function that is asked for any motion.

Effects act on its output as they act on palpd's own cell (`palpd.cell.span`). Effects on the tissue and on lateral forces need
the force of its contact. An effect between robot and tip moves the tip off the height that the robot reports, and a changed surface does
the same for the contact. So a function is asked again for the same motion with the tip raised by a few distances, and its contact is
interpolated between these. A file knows the recorded motion alone, so a diagnosis leaves these effects out and says so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpd.cell.cell_file import CellFile
from palpd.cell.dynamics import filtered, steps, unfiltered
from palpd.cell.effects import Effect
from palpd.cell.effects.effect import SIDEWAYS, Parameter
from palpd.cell.physics import physics
from palpd.cell.simulation import commanded_motion, mean_reading, predict_motion
from palpd.cell.span import Constants, NominalOutput, TipMotion, Variation
from palpd.cell.tip_motion import estimate_tip_motion
from palpd.errors import BadInput, PalpdError, RecordingError
from palpd.recording.oddities import measured_rms
from palpd.recording.samples import COLUMNS, WRENCH_COLUMNS, named_once, read_columns, refuse_values
from palpd.tick import Floats

NEEDED_COLUMN = "fz_N"
CONTACT_COLUMN, FZ_AXIS = "contact_N", WRENCH_COLUMNS.index("fz_N")
PREDICTED = ("z_m", *WRENCH_COLUMNS, CONTACT_COLUMN)
"""Columns that a simulator may predict."""

RAISED, CLEAR = (-0.1, 0.0, 0.05, 0.15, 0.4, 1.0), (1.5, 2.0)
"""Distances by which the tip is raised, as shares of the deepest press: they lie densely where play and compliance of working rigs are.
Above the second ones nothing is touched."""

PRESSED = 0.02
"""Share of the largest contact force from which on it tells how much the contact pushes to the side."""

AGREEING = 0.3
"""Rms between the forces at two clear heights, in the noise of the sensor, up to which they are the same: the rest is no contact."""

DRIVE_NOISES = 0.5
"""Rms between heights of an output and reported ones, in the noise of these, below which the output repeats them: a prediction differs
from a noisy reading by more."""

SAME_M = 1e-8
"""The same for heights without noise: a file has no more digits."""

ASKED_VALUES = 7
"""Values of a parameter for which a simulator is asked: its output lies on a smooth curve through them."""

MotionColumns = Mapping[str, Floats]
"""What a function is asked for: `t_s` from 0, `z_m`, `vz_m_per_s`, `az_m_per_s2` of the tip behind noisy reports, and `z_cmd_m` where the
recording has it; arrays (n,)."""


@dataclass(frozen=True)
class OwnParameter:
    """A parameter of a user's own simulator, which the real cell may have another value of.

    Attributes:
        value: The value that the simulator has.
        lower: The smallest value that the real cell may have.
        upper: The largest.
    """

    name: str
    value: float
    lower: float
    upper: float

    @property
    def id(self) -> str:
        """Its id as an effect."""
        return f"simulator.{self.name}"

    @property
    def effect(self) -> Effect:
        """The effect that it is another one."""
        starts = tuple(self.value + 0.3 * (end - self.value) for end in (self.upper, self.lower) if end != self.value)
        value = Parameter("value", "1", self.lower, self.upper, starts, nominal=self.value, words=f"{self.name} of the real cell")

        def setting(c: Constants, values: Mapping[str, float]) -> None:
            c.simulator[self.name] = values["value"]

        what = f"{self.name} of your simulator is not that of the real cell"
        return Effect(self.id, "probe", what, (value,), setting=setting, formula=f"your simulator with {self.name} = value")

    @property
    def asked(self) -> Floats:
        """Values (g,) for which the simulator is asked, ascending; its own is one of them."""
        return np.union1d(np.linspace(self.lower, self.upper, ASKED_VALUES), [self.value])


@dataclass(frozen=True)
class SimulatorDoubt:
    """How a simulator that was learned may be wrong on a motion of n samples.

    Attributes:
        errors: Errors of its prediction (m, 7, n) in the units of the channels, each one standard deviation.
        known: Whether it was learned there (n,).
        unexplained: Rms (7, n) of means over some hundredths of a second, which it does not explain.
        price_nats: What each effect beside it costs, since nothing that was learned is exact; by its id, of what is unknown by "".
    """

    errors: Floats
    known: NDArray[np.bool_]
    unexplained: Floats
    price_nats: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class UserSimulator:
    """What a user's own simulator predicts.

    Attributes:
        name: What sentences call it.
        run: Gives columns by name for a motion (n rows), each (n,): `fz_N`, and what else of PREDICTED it predicts. Its own parameters
            follow by name.
        any_motion: Whether it can be asked for any motion; a file holds the output for a single motion.
        parameters: Parameters of its own that a diagnosis may change.
        doubt: Says for a motion how the prediction may be wrong; None where it was not learned.
        about: Sentences for the reader of an answer.
        onset_s: When in the recording the change from the healthy cell begins; None where no begin shows.
    """

    name: str
    run: Callable[..., Mapping[str, Floats]]
    any_motion: bool
    parameters: tuple[OwnParameter, ...] = ()
    doubt: Callable[[MotionColumns], SimulatorDoubt] | None = None
    about: tuple[str, ...] = ()
    onset_s: float | None = None

    @staticmethod
    def of_function(
        function: Callable[..., Mapping[str, Floats]], name: str, parameters: Mapping[str, tuple[float, float, float]] | None = None
    ) -> "UserSimulator":
        """A simulator that can be asked for any motion.

        Args:
            function: Takes a motion (`MotionColumns`), and its own parameters by name. Gives columns as `run` does.
            name: What sentences call it.
            parameters: By their names the value that the simulator has, and the smallest and largest one that the real cell may have;
                None: it takes none.

        Raises:
            BadInput: The limits of a parameter do not hold its value; or later, when the function is asked and fails.
        """
        own = tuple(OwnParameter(name, *map(float, values)) for name, values in (parameters or {}).items())
        for one in own:
            if not one.lower <= one.value <= one.upper or one.lower == one.upper:
                raise BadInput(
                    f"{one.name} is {one.value:g} with limits {one.lower:g} and {one.upper:g}; give its value, then a smaller and a larger "
                    "limit"
                )

        def run(motion: MotionColumns, **values: float) -> Mapping[str, Floats]:
            try:
                columns = function({column: values.copy() for column, values in motion.items()}, **values)
            except PalpdError:
                raise
            except Exception as error:  # a user's function may fail in any way
                raise BadInput(
                    f"the simulator {name} failed on a motion of {len(motion['t_s'])} rows ({type(error).__name__}: {error}); expected "
                    f"columns by name, at least {NEEDED_COLUMN}"
                ) from error
            return at_stamps(columns, motion["t_s"], f"the simulator {name}")

        return UserSimulator(name, run, any_motion=True, parameters=own)

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
class SimulatedNominal:
    """What a user's simulator predicts of the nominal cell, for one motion of n samples.

    Attributes:
        output: Its output for that motion by column, (n,) each.
        command_m: Commanded heights (n,), for which palpd's servo moves as the simulator's does; None without a command.
        heights_m: What the simulator's reported heights have beyond these of palpd's servo (n,); None where it predicts none.
        faster_m: What they change by (n,) if its servo is faster by the tolerance; None where it is a file, or predicts none.
        contact_known: Whether the output says what force the contact has.
        sampled: Its wrench, on which effects act, at the samples.
        doubt: How it may be wrong; None where it was not learned.
        at_steps: The same at the steps of a prepared recording; None where there is none.
    """

    simulator: UserSimulator
    output: Mapping[str, Floats]
    command_m: Floats | None
    heights_m: Floats | None
    faster_m: Floats | None
    contact_known: bool
    sampled: NominalOutput
    doubt: SimulatorDoubt | None = None
    at_steps: NominalOutput | None = None

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels that the simulator predicts."""
        return tuple(name for name in self.output if name in WRENCH_COLUMNS or self.heights_m is not None)

    def with_steps(self, motion: TipMotion, average: Callable[[Floats], Floats]) -> "SimulatedNominal":
        """The same with what it predicts at steps; arguments as those of `NominalOutput.averaged`."""
        return replace(self, at_steps=self.sampled.averaged(motion, average))

    def nominal(self, motion: TipMotion) -> NominalOutput:
        """What it predicts at the times of a motion, those of the samples or of the steps."""
        return self.sampled if self.at_steps is None or motion.t_s is self.sampled.motion.t_s else self.at_steps

    def heights(self, palpd_m: Floats, t_s: Floats) -> Floats:
        """The heights (m,) that a cell reports.

        Args:
            palpd_m: What palpd's servo makes of `command_m`, (m,).
            t_s: The times (m,) of these heights, from the first row.
        """
        return palpd_m if self.heights_m is None else palpd_m + np.interp(t_s, self.sampled.motion.t_s, self.heights_m)


def followed_command(
    simulator: UserSimulator, cell: CellFile, library: Mapping[str, Effect], motion: TipMotion, reported: tuple[Floats | None, Floats]
) -> Floats | None:
    """Commanded heights (n,) for which palpd's servo moves as the robot of a simulator does; those of the recording where it predicts none.

    The output in a file was driven by a motion that was estimated with the recorded command, so that counts there, too.

    Args:
        cell: The nominal cell.
        library: Effects of that cell by id.
        motion: As estimated with the recorded command, n samples.
        reported: Commanded heights (n,), None without a command, and heights (n,) as the robot reports them.
    """
    z_cmd_m, z_m = reported
    if z_cmd_m is None or not simulator.any_motion:
        return z_cmd_m
    plain = simulator.run(asked(motion, z_cmd_m))
    if "z_m" not in plain or _repeats(plain["z_m"], z_m, motion.z_m, cell):
        return z_cmd_m
    return _followed_command(cell.without_effects(), library, motion.t_s, plain["z_m"])


def simulated_nominal(
    simulator: UserSimulator,
    cell: CellFile,
    library: Mapping[str, Effect],
    motion: TipMotion,
    reported: tuple[Floats | None, Floats],
) -> SimulatedNominal:
    """Ask a user's simulator for a motion.

    Args:
        cell: The nominal cell; its effects act on the output.
        library: Effects of that cell by id.
        motion: The motion of the tip at n samples.
        reported: Commanded heights (n,), None without a command, and heights (n,) as the robot reports them.
    """
    _refuse_asking(simulator, cell, library)
    cell = cell.without_effects()
    z_cmd_m, z_m = reported
    constants = physics(cell, None, library).constants
    deepest_m = max(constants.surface_z_m - float(motion.z_m.min()), 0.0)
    touches = deepest_m > 0.0
    shares = (*RAISED, *CLEAR) if simulator.any_motion and touches else (0.0,)
    outputs = {share: simulator.run(asked(replace(motion, z_m=motion.z_m + share * deepest_m), z_cmd_m)) for share in shares}
    plain, raised_m, known = outputs[0.0], np.zeros(1), True
    contact_N = np.zeros((1, len(motion.t_s)))
    if touches:
        contact_N, known = _contact(outputs, constants, motion, cell.sensor.noise_rms_N)
        raised_m = np.array(RAISED) * deepest_m
    if len(contact_N) < len(raised_m):  # a file: as stiff as Hertz would have it, for what is within tolerance
        contact_N = _as_by_hertz(contact_N[0], constants, motion, raised_m)
    axes = {axis: plain[column] for axis, column in enumerate(WRENCH_COLUMNS) if column in plain}
    command_m, heights_m, faster_m = z_cmd_m, None, None
    if z_cmd_m is not None and "z_m" in plain and not _repeats(plain["z_m"], z_m, motion.z_m, cell):
        command_m = _followed_command(cell, library, motion.t_s, plain["z_m"])
        heights_m = plain["z_m"] - predict_motion(cell, motion.t_s, command_m, library)
        if simulator.any_motion:  # a servo on a slower motion is a faster servo on this one
            slower = replace(motion, t_s=motion.t_s * (1.0 + cell.tolerances.servo_natural_frequency))
            faster_m = simulator.run(asked(slower, z_cmd_m)).get("z_m", plain["z_m"]) - plain["z_m"]
    variations = {one.name: _variation(simulator, one, asked(motion, z_cmd_m), axes) for one in simulator.parameters}
    sideways = _sideways_shares(outputs, axes, contact_N[int(np.flatnonzero(raised_m == 0.0)[0])])
    nominal = NominalOutput(constants, motion, axes, contact_N, raised_m, sideways, variations)
    doubt = None if simulator.doubt is None else simulator.doubt(asked(motion, z_cmd_m))
    return SimulatedNominal(simulator, plain, command_m, heights_m, faster_m, known, nominal, doubt)


def _sideways_shares(outputs: Mapping[float, Mapping[str, Floats]], axes: Mapping[int, Floats], contact_N: Floats) -> dict[int, Floats]:
    """What a contact (n,) pushes on other axes, over its force; they are known where a function was asked high above the surface."""
    pressed = contact_N > PRESSED * float(contact_N.max())
    if CLEAR[0] not in outputs or not pressed.any():
        return {}
    free = {axis: outputs[CLEAR[0]][WRENCH_COLUMNS[axis]] for axis in axes if axis != FZ_AXIS}
    return {axis: np.where(pressed, (axes[axis] - beside) / np.where(pressed, contact_N, 1.0), 0.0) for axis, beside in free.items()}


def _variation(simulator: UserSimulator, parameter: OwnParameter, motion: MotionColumns, axes: Mapping[int, Floats]) -> Variation:
    """How a parameter changes an output whose readings are `axes`, (n,) by number of the axis."""
    outputs = [simulator.run(motion, **{parameter.name: value}) for value in parameter.asked.tolist()]
    changes = {axis: np.array([output[WRENCH_COLUMNS[axis]] - values for output in outputs]) for axis, values in axes.items()}
    if not any(change.any() for change in changes.values()):
        raise BadInput(
            f"{parameter.name} from {parameter.lower:g} to {parameter.upper:g} changes no force of {simulator.name}; leave it out, or "
            "correct its limits"
        )
    return Variation(parameter.asked, {axis: change for axis, change in changes.items() if change.any()})


def _contact(outputs: Mapping[float, Mapping[str, Floats]], constants: Constants, motion: TipMotion, noise_N: float) -> tuple[Floats, bool]:
    """Contact forces (k, n) with the tip raised by k distances, 0 for a file, and whether they are known.

    They are a column of the output. Else a function is asked high above the surface, where its force is not the contact's. Else the inertia
    of the stated mass is taken away. That is known to be right if the output then is zero in the air, and if inertia is as large there as
    in contact, or below the noise in both.
    """
    plain, touching = outputs[0.0], motion.z_m < constants.surface_z_m
    levels = [share for share in outputs if share not in CLEAR]
    if CONTACT_COLUMN in plain:
        return np.array([outputs[share][CONTACT_COLUMN] for share in levels]), True

    def contact_N(beside_N: Floats) -> Floats:
        """What an output exceeds another force on the sensor by, before the filter."""
        return np.array([unfiltered(outputs[share][NEEDED_COLUMN] - beside_N, motion.t_s, constants.cutoff_Hz) for share in levels])

    if len(levels) > 1:
        free_N, freer_N = (outputs[share][NEEDED_COLUMN] for share in CLEAR)
        if float(np.sqrt(np.mean((free_N - freer_N) ** 2))) < AGREEING * noise_N:
            return contact_N(free_N), True
    inertia_N = -constants.mass_kg * motion.az_m_per_s2
    beside_N = filtered(inertia_N, steps(motion.t_s), constants.cutoff_Hz)
    in_air_N = (plain[NEEDED_COLUMN] - beside_N)[~touching]
    alone = bool(float(np.sum(in_air_N**2)) <= noise_N**2 * len(in_air_N))
    seen_N = max(noise_N, float(np.abs(inertia_N[~touching]).max(initial=0.0)))
    estimated_N = contact_N(beside_N)
    if len(levels) == 1:
        estimated_N = np.where(touching, estimated_N, 0.0)
    return estimated_N, alone and float(np.abs(inertia_N[touching]).max()) <= seen_N


def _as_by_hertz(contact_N: Floats, constants: Constants, motion: TipMotion, raised_m: Floats) -> Floats:
    """Contact forces (k, n) with the tip raised by distances (k,), from those of one motion (n,): over Hertz they stay the same."""
    one = NominalOutput(constants, motion, {}, contact_N[None], np.zeros(1))
    depth_m = constants.surface_z_m - motion.z_m
    levels = [one.over_hertz * constants.elastic_force_N(np.maximum(depth_m - up_m, 0.0)) for up_m in raised_m]
    return np.array([contact_N if up_m == 0.0 else level for up_m, level in zip(raised_m.tolist(), levels, strict=True)])


def _followed_command(cell: CellFile, library: Mapping[str, Effect], t_s: Floats, z_m: Floats) -> Floats:
    """Commanded heights (n,) for which the servo of a cell would report the heights `z_m` (n,): z + 2ζ/ω z' + z''/ω²."""
    from scipy.interpolate import CubicSpline  # here, since only a simulator of the user needs its 0.1 s

    c = physics(cell, None, library).constants
    omega = 2.0 * np.pi * c.servo_natural_frequency_Hz
    path = CubicSpline(t_s, z_m)
    return np.asarray(z_m + 2.0 * c.servo_damping_ratio / omega * path(t_s, 1) + path(t_s, 2) / omega**2)


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


def unjudged(given: Sequence[SimulatedNominal], cell: CellFile, library: Mapping[str, Effect]) -> dict[str, tuple[str, ...]]:
    """Effects that cannot be judged with the output of a user's simulator.

    Args:
        given: What the simulator predicts for each recording.
        cell: Beside a healthy one without tissue nothing is touched.
        library: The effects that may be present.

    Returns:
        Their ids by the reason.
    """
    name, out = given[0].simulator.name, {}
    asking = () if all(one.simulator.any_motion for one in given) else _asking(library)
    if asking:
        out[f"{name} holds no motion but the recorded one"] = asking
    if any(one.command_m is not None and one.heights_m is None for one in given):
        out[f"{name} does not predict z_m"] = tuple(id_ for id_, effect in library.items() if effect.motion)
    on_contact = tuple(id_ for id_, effect in library.items() if effect.site == "tissue" or _sideways(effect))
    if cell.tissue is None and all(one.doubt is not None for one in given):
        out["nothing is touched"] = tuple(id_ for id_ in on_contact if id_ not in asking)
    elif not all(one.contact_known for one in given):
        of_contact = f"{name} does not say which part of {NEEDED_COLUMN} is the contact's; add that as {CONTACT_COLUMN}"
        out[of_contact] = tuple(id_ for id_ in on_contact if id_ not in asking)
    return out


def own_effects(simulator: UserSimulator) -> dict[str, Effect]:
    """Effects by id: one for each parameter of a simulator."""
    return {one.id: one.effect for one in simulator.parameters}


def _asking(library: Mapping[str, Effect]) -> tuple[str, ...]:
    """Effects for which a simulator must be asked with the tip elsewhere."""
    return tuple(name for name, effect in library.items() if effect.site == "tip" or effect.moves_surface)


def _sideways(effect: Effect) -> bool:
    return effect.site == "probe" and effect.family == SIDEWAYS


def _refuse_asking(simulator: UserSimulator, cell: CellFile, library: Mapping[str, Effect], *, reported: bool = True) -> None:
    """Refuse the effects of a cell for which a file had to be asked again; one on the robot where its heights are not reported."""
    asking = {*_asking(library), *(name for name, effect in library.items() if effect.motion and not reported)}
    moved = [name for name in cell.effects if name in asking]
    if moved and not simulator.any_motion:
        raise BadInput(
            f"{moved[0]} changes the motion, and {simulator.name} holds the output for one motion; take {moved[0]} out of the cell, or ask "
            "your simulator from Python (docs/my-simulator.md)"
        )


def simulate_with(
    simulator: UserSimulator,
    nominal: CellFile,
    cell: CellFile,
    columns: Mapping[str, Floats],
    library: Mapping[str, Effect],
    *,
    measured: bool,
) -> dict[str, Floats]:
    """The recording that a cell gives on a motion: the user's output, with what the cell has beyond the nominal cell.

    Args:
        nominal: The cell that the simulator simulates, without any effect.
        cell: The same cell with effects and deviations, as a diagnosis has enriched it.
        columns: `t_s`, and `z_m` (with `vz_m_per_s` where known) or `z_cmd_m`, each (n,).
        library: Effects by id.
        measured: Whether the reported heights drive the cell; else the commanded heights do.

    Returns:
        Heights and wrench (n,) by column.

    Raises:
        BadInput: The cell moves otherwise than the nominal cell, and the simulator is a file.
    """
    _refuse_asking(simulator, cell, library, reported=measured)
    t_s, z_cmd_m = columns["t_s"], columns.get("z_cmd_m")
    if measured or z_cmd_m is None:
        motion = estimate_tip_motion(nominal, t_s, columns["z_m"], columns.get("vz_m_per_s"), z_cmd_m)
    else:
        motion = commanded_motion(cell, t_s, z_cmd_m, library)
    z_m = columns["z_m"] if measured else motion.z_m
    given = simulated_nominal(simulator, nominal, library, motion, (z_cmd_m, z_m))
    wrench = mean_reading(cell, motion, library, nominal=given.sampled).wrench(len(t_s))
    if measured or given.command_m is None:
        heights_m = z_m
    else:
        heights_m = given.heights(predict_motion(cell, t_s, given.command_m, library), motion.t_s)
    return {"z_m": heights_m} | {name: wrench[:, axis] for axis, name in enumerate(WRENCH_COLUMNS)}
