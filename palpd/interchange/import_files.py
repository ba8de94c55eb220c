"""From foreign files to a recording: which channels are meant, in which units, and how they fit together."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np

from palpd.cell.plausible import ask
from palpd.documents import nearest
from palpd.errors import BadInput, RecordingError
from palpd.interchange.alignment import (
    Axis,
    TipPath,
    Wrench,
    continuous,
    orientations_in,
    overlap,
    quaternions_of,
    refuse_turn,
    rotated,
    tared,
    turned,
)
from palpd.interchange.channels import Channel, ChannelData, FileReader, Kind, listing
from palpd.interchange.registry import reader_of
from palpd.interchange.table import OPTICS11_TIP
from palpd.interchange.units import Quantity, UnitScale, refuse_unconfirmed, scale_of, unit_named
from palpd.recording.oddities import dead, fall_where_lowest_N, questions_of, refuse_dead
from palpd.recording.samples import JOINT_COLUMNS, MIN_SAMPLES, WRENCH_COLUMNS, Samples, samples_from_columns, write_csv
from palpd.tick import Floats

ROLES: dict[str, Quantity] = {
    "z_cmd_m": "length", "vz_m_per_s": "speed", "fx_N": "force", "fy_N": "force", "tx_Nm": "torque", "ty_Nm": "torque", "tz_Nm": "torque",
}  # fmt: skip
"""Columns of a recording that --column may name, beside time, height and force."""
MOTION_ROLES = ("z_cmd_m", "vz_m_per_s")
"""Those that belong to the motion."""
JOINT: Mapping[Quantity, Quantity] = {"length": "angle", "speed": "angular speed", "force": "torque"}
"""What is asked of a joint in place of what is asked of an axis."""
OWN = ("fz_N", "z_m", "t_s")
"""Force, height and time as our own tables and those of `palpd export` call them."""
OWN_JOINT = ("torque_Nm", "angle_rad", "t_s")
"""Torque, angle and time as tables of a joint call them."""
KNOWN_COLUMNS = (
    OWN,
    OWN_JOINT,
    ("force", "tip position", "time"),
    ("force", "height (measured)", "time"),
    ("Load (uN)", OPTICS11_TIP, "Time (s)"),
)
"""Names of force, height and time that formats fix, so that nobody need give them."""
CLEAR_SHARE = 0.05
"""Share of the swing of the force that it may have at the start before a note asks for a tare."""
LARGEST_RATE_HZ = 1e6
"""Largest rate that the user may state."""
SLOPE_ERROR = 0.2
"""Largest error of the integral of speeds, as a share of the heights' own deviation, with which the speeds belong to the heights."""


@dataclass(frozen=True)
class ImportOptions:
    """What the user says of foreign files; what is absent is found where there is one choice only.

    `time_columns` is one name for all files, or one for each. `rate_Hz` stands for times that no column holds. `columns` names further
    columns of the recording (ROLES). `offset_s` is added to the times of the force, `tare_s` is the length of the still start,
    `accept_implausible` lets implausible values count. `joint`: the columns hold angle and torque, and the recording is one of a joint.
    """

    force_column: str | None = None
    depth_column: str | None = None
    height_column: str | None = None
    time_columns: Sequence[str] = ()
    rate_Hz: float | None = None
    columns: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    force_unit: str | None = None
    length_unit: str | None = None
    time_unit: str | None = None
    force_N_per_V: float | None = None
    length_m_per_V: float | None = None
    units_confirmed: bool = False
    height_down_positive: bool = False
    compression_negative: bool = False
    wrench: str | None = None
    pose: str | None = None
    twist: str | None = None
    command: str | None = None
    wrench_in: Literal["tool", "base"] | None = None
    axis: Axis | None = None
    offset_s: float | None = None
    tare_s: float | None = None
    accept_implausible: bool = False
    joint: bool = False


@dataclass(frozen=True)
class Source:
    """A foreign file with its reader and what it holds."""

    path: Path
    reader: FileReader
    channels: Sequence[Channel]

    def named(self, name: str) -> bool:
        """Whether a channel has this name; a topic of transforms is named with a frame behind a colon."""
        names = {channel.name for channel in self.channels}
        return name in names or name.partition(":")[0] in {each.name for each in self.channels if each.kind == "transforms"}

    def of_kind(self, kind: Kind) -> list[Channel]:
        """The channels of a kind."""
        return [channel for channel in self.channels if channel.kind == kind]


@dataclass(frozen=True)
class Imported:
    """The recording, and sentences about how it was made: units, axes, what was left out."""

    samples: Samples
    notes: tuple[str, ...]


def source_of(path: Path) -> Source:
    """Open a foreign file. Raises RecordingError where no reader takes it or it cannot be read."""
    reader = reader_of(path)
    return Source(path, reader, reader.channels(path))


def columns_given(assignments: Sequence[str]) -> dict[str, str]:
    """Columns as the command line names them: "fx_N=Fx". Raises BadInput where one is not spelled so, or names a column twice."""
    columns: dict[str, str] = {}
    for text in assignments:
        role, equals, name = text.partition("=")
        if not equals or not name or role in columns:
            raise BadInput(f"--column {text} is no assignment, expected one such as fx_N=Fx for each of {', '.join(ROLES)}")
        columns[role] = name
    return columns


def import_files(paths: Sequence[Path], options: ImportOptions, csv_out: Path) -> Imported:
    """Write foreign files as one recording.

    Args:
        paths: One file, or one with the motion and one with the force.
        options: What the user says of them.

    Returns:
        The recording and notes about it.

    Raises:
        RecordingError: A file cannot be read or is no recording.
        BadInput: The options do not fit the files, or a unit is not confirmed.
    """
    imported = read_files(paths, options)
    write_csv(csv_out, imported.samples)
    return imported


def read_files(paths: Sequence[Path], options: ImportOptions) -> Imported:
    """Make a recording of foreign files, as `import_files` does, without writing it.

    Args:
        paths: One file, or one with the motion and one with the force.
        options: What the user says of them.

    Returns:
        The recording and notes about it.

    Raises:
        RecordingError: A file cannot be read or is no recording.
        BadInput: The options do not fit the files, or a unit is not confirmed.
    """
    sources = [source_of(path) for path in paths]
    _refuse_contradictions(options)
    reading = _Reading(sources, options)
    path, wrench = reading.tip_path(), reading.wrench()
    reading.refuse_unconfirmed()
    names = " and ".join(source.path.name for source in sources)
    offset_s = options.offset_s or 0.0
    wrench = replace(wrench, t_s=wrench.t_s + offset_s) if offset_s else wrench
    usable = overlap(path, wrench, names)
    notes = list(dict.fromkeys(reading.notes))
    if not usable.all():
        notes.append(f"{int((~usable).sum())} samples of the force lie outside the times of the motion and were left out.")
    t_s, readings = wrench.t_s[usable], wrench.wrench[usable]
    if len(t_s) < MIN_SAMPLES:
        raise RecordingError(
            f"{names}: {len(t_s)} samples of force and motion overlap, {MIN_SAMPLES} or more are needed; record for longer"
        )
    at_force = {"z_m": path.z_m, "vz_m_per_s": np.gradient(path.z_m, path.t_s) if path.vz_m_per_s is None else path.vz_m_per_s}
    if path.vz_m_per_s is None:
        notes.append("No speed was recorded, so it is the slope of the heights.")
    if path.z_cmd_m is not None:
        at_force["z_cmd_m"] = path.z_cmd_m
    columns = {name: np.interp(t_s, path.t_s, values) for name, values in at_force.items()}
    if path.orientation is not None:
        readings = _in_base_axes(readings, t_s, path, wrench.frame, options, names, notes)
    if options.axis is not None and wrench.frame is not None:
        readings = turned(readings, options.axis)
    if options.compression_negative:
        readings = 0.0 - readings  # which leaves 0.0 what it is
    if options.tare_s is not None:
        readings = tared(t_s, columns["z_m"], readings, options.tare_s)
    columns |= {"t_s": t_s - t_s[0], **dict(zip(WRENCH_COLUMNS, np.ascontiguousarray(readings.T), strict=True))}
    samples = replace(samples_from_columns(columns, names), joint=reading.options.joint)
    refuse_dead(samples, f"{names}: ")
    check = "check columns, --force-unit, --length-unit, --time-unit and the signs (--axis, --compression-negative, --height-column)"
    notes += ask([f"{names}: {each}" for each in _questions(samples, options)], options.accept_implausible, check)
    return Imported(samples, (*notes, *_tare_notes(samples, options)))


class _Reading:
    """Finds the channels of a motion and of a force in some files and brings them into SI."""

    def __init__(self, sources: Sequence[Source], options: ImportOptions) -> None:
        self.sources = sources
        self.options = options
        self.notes: list[str] = []
        self._scales: dict[tuple[Path, str], UnitScale] = {}
        named = {name: options.__dict__[name] for name in ("force_column", "depth_column", "height_column")}
        if not any(named.values()):
            self.options = options = self._with_known_columns(options)
        self._wrench = None if self.options.force_column else self._vector("wrench", options.wrench, needed=True)
        self._pose = None if self.options.height_column or self.options.depth_column else self._vector("pose", options.pose, needed=True)
        self._refuse_unused()
        together = [each for each in (self._pose, self._wrench) if each is not None]
        optional: list[tuple[Kind, str | None]] = [("twist", options.twist), ("command", options.command)]
        self._twist, self._command = (self._vector(kind, name) if self._pose is not None else None for kind, name in optional)
        self._tables = self._columns_by_file()
        vectors = [*together, *(each for each in (self._twist, self._command) if each is not None)]
        self._columns = self._read([*vectors, *((source, name) for source, names in self._tables for name in names)])
        origins_ns = [self._columns[source.path, name].origin_ns for source, name in vectors]
        self._origin_ns = min(origins_ns + [column.origin_ns for column in self._columns.values() if column.origin_ns], default=0)

    def _refuse_unused(self) -> None:
        """Refuse options that the chosen motion and force would ignore. Raises BadInput."""
        given = self.options
        motion = [role for role in given.columns if role in MOTION_ROLES]
        force = [role for role in given.columns if role not in MOTION_ROLES]
        if self._pose is not None and motion:
            raise BadInput(f"--column {motion[0]} belongs to --height-column or --depth-column; with a pose give --twist or --command")
        if self._wrench is not None and force:
            raise BadInput(f"--column {force[0]} belongs to --force-column; a wrench holds all six axes")
        if self._pose is None and (given.twist or given.command):
            option = "vz_m_per_s" if given.twist else "z_cmd_m"
            raise BadInput(f"--{'twist' if given.twist else 'command'} belongs to --pose; with columns give --column {option}=NAME")
        if self._pose is not None and (given.length_unit or given.length_m_per_V or given.height_down_positive):
            raise BadInput(
                "--length-unit, --length-m-per-V and --height-down-positive belong to columns; a pose is in m, and --axis -z turns it"
            )
        if self._wrench is not None and (given.force_unit or given.force_N_per_V):
            raise BadInput("--force-unit and --force-N-per-V belong to --force-column; a wrench is in N and Nm")
        if self._wrench is None and given.wrench_in:
            raise BadInput("--wrench-in belongs to --wrench; a column of force is along the height")

    def refuse_unconfirmed(self) -> None:
        """Refuse units that were guessed and not confirmed. Raises BadInput."""
        name = " and ".join(source.path.name for source in self.sources)
        refuse_unconfirmed(list(self._scales.values()), self.options.units_confirmed, name)
        self.notes.extend(f"{scale}." for scale in self._scales.values())

    def tip_path(self) -> TipPath:
        """The motion of the tip, from a pose or from columns."""
        if self._pose is None:
            return self._path_of_columns()
        pose = self._columns[self._pose[0].path, self._pose[1]]
        axis = self.options.axis or "z"
        t_s = self._times(pose)
        vz_m_per_s = z_cmd_m = None
        z_m = turned(np.ascontiguousarray(pose.values[:, :3]), axis)[:, 2]
        if self._twist is not None:
            twist = self._columns[self._twist[0].path, self._twist[1]]
            vz_m_per_s = _at(t_s, self._times(twist), turned(twist.values, axis)[:, 2], f"{self._twist[1]} and {self._pose[1]}")
            if self.options.twist is None and not _is_slope(t_s, z_m, vz_m_per_s):
                self.notes.append(f"{self._twist[1]} is not the speed of {self._pose[1]} and was not used; name it with --twist if it is.")
                vz_m_per_s = None
        if self._command is not None:
            command = self._columns[self._command[0].path, self._command[1]]
            heights_m = turned(np.ascontiguousarray(command.values[:, :3]), axis)[:, 2]
            z_cmd_m = _at(t_s, self._times(command), heights_m, f"{self._command[1]} and {self._pose[1]}")
        return TipPath(t_s, z_m, vz_m_per_s, z_cmd_m, pose.values[:, 3:], pose.frame)

    def wrench(self) -> Wrench:
        """What the sensor read, from a wrench or from columns."""
        if self._wrench is None:
            return self._wrench_of_columns()
        column = self._columns[self._wrench[0].path, self._wrench[1]]
        return Wrench(self._times(column), column.values, column.frame)

    def _with_known_columns(self, options: ImportOptions) -> ImportOptions:
        """The options with the columns of a format that fixes their names, where a file has them."""
        for source in self.sources:
            names = [channel.name for channel in source.channels]
            for force, height, time in KNOWN_COLUMNS:
                if force in names and height in names and not (options.wrench or options.pose):
                    times = options.time_columns or ((time,) if time in names else ())
                    further = _further(force, names)
                    self.notes.append(f"{source.path.name}: force is {force}, height is {height}.")
                    columns = {**further, **options.columns}
                    joint = options.joint or force == OWN_JOINT[0]
                    return replace(options, force_column=force, height_column=height, time_columns=times, columns=columns, joint=joint)
        return options

    def _vector(self, kind: Kind, name: str | None, *, needed: bool = False) -> tuple[Source, str] | None:
        """The channel of a kind: the named one, or the only one there is."""
        if name is not None:
            source = self._source_with(name)
            if any(channel.name == name and channel.kind == "column" for channel in source.channels):
                raise BadInput(f"{name} is a column of numbers, expected a {kind}; name it with {self._column_option(kind)}")
            _refuse_other_kind(source, name, kind)
            return source, name
        choices = [(source, channel.name) for source in self.sources for channel in source.of_kind(kind)]
        if len(choices) == 1:
            self.notes.append(f"{kind} is {choices[0][1]}.")
            return choices[0]
        if not needed:
            return None
        if choices:
            raise BadInput(
                f"there are {len(choices)} channels with a {kind} ({', '.join(each for _, each in choices[:12])}); "
                f"give --{kind} with one of them"
            )
        raise BadInput(self._nothing(kind))

    def _nothing(self, kind: Kind) -> str:
        columns = [channel for source in self.sources for channel in source.of_kind("column")]
        held = "; ".join(f"{source.path.name} holds {listing(source.channels)}" for source in self.sources)
        if columns:
            return f"{self._column_option(kind)} is missing: palpd does not know the names of these columns, so name them ({held})"
        hint = ", or --pose TOPIC:FRAME where a topic holds transforms" if kind == "pose" else ""
        return f"no topic holds a {kind} ({held}); name a topic with --{kind}{hint}, or record one"

    @staticmethod
    def _column_option(kind: Kind) -> str:
        return "--force-column" if kind == "wrench" else "--depth-column or --height-column"

    def _source_with(self, name: str) -> Source:
        having = [source for source in self.sources if source.named(name)]
        if len(having) == 1:
            return having[0]
        every = [channel for source in self.sources for channel in source.channels]
        files = " and ".join(source.path.name for source in self.sources)
        if having:
            raise BadInput(f"{name} stands in {files}; import one file, or rename it in one of them")
        question = nearest(name, [channel.name for channel in every])
        raise BadInput(f"there is no {name} in {files}{question}; they hold {listing(every)}" if len(self.sources) > 1 else
                       f"there is no {name} in {files}{question}; it holds {listing(every)}")  # fmt: skip

    def _read(self, chosen: Iterable[tuple[Source, str]]) -> dict[tuple[Path, str], ChannelData]:
        """Read channels, those of one file at once: it is read once, and their times have one origin."""
        columns: dict[tuple[Path, str], ChannelData] = {}
        chosen = list(chosen)
        for source in self.sources:
            names = list(dict.fromkeys(name for its, name in chosen if its is source))
            if names:
                columns |= {(source.path, name): column for name, column in source.reader.columns(source.path, names).items()}
        for column in columns.values():
            self.notes.extend(column.notes)
        return columns

    def _times(self, column: ChannelData) -> Floats:
        """Times of a channel on the clock of all; without an origin they are their own."""
        assert column.t_s is not None  # else a column is named for it
        shift_ns = column.origin_ns - self._origin_ns if column.origin_ns else 0
        return column.t_s + shift_ns * 1e-9 if shift_ns else column.t_s

    def _named_columns(self, *, motion: bool) -> dict[str, Quantity]:
        """Quantity of each named column of the motion, or of the force; none where a pose or a wrench holds it."""
        name = (self.options.depth_column or self.options.height_column) if motion else self.options.force_column
        further = {column: ROLES[role] for role, column in self.options.columns.items() if (role in MOTION_ROLES) == motion}
        named: dict[str, Quantity] = {name: "length" if motion else "force", **further} if name is not None else {}
        return {column: JOINT.get(quantity, quantity) for column, quantity in named.items()} if self.options.joint else named

    def _columns_by_file(self) -> list[tuple[Source, list[str]]]:
        """Which columns are read of each file: those of motion and force, and the time."""
        named = [*self._named_columns(motion=True), *self._named_columns(motion=False)]
        having = {name: self._source_with(name) for name in named}
        tables = []
        for source in self.sources:
            names = [name for name in named if having[name] is source]
            if names:
                time = self._time_column(source, names)
                names += [time] if time else []
                if len(set(names)) < len(names):
                    raise BadInput(f"one column of {source.path.name} is named for two of force, length and time; name one for each")
                tables.append((source, names))
        return tables

    def _scaled(self, source: Source, name: str, quantity: Quantity) -> Floats:
        """A column in SI; its unit is kept, to be shown and confirmed."""
        options = self.options
        given: dict[Quantity, str | None] = {"force": options.force_unit, "length": options.length_unit, "time": options.time_unit}
        given |= {"torque": options.force_unit, "angle": options.length_unit} if options.joint else {}
        per_volt: dict[Quantity, float | None] = {"force": options.force_N_per_V, "length": options.length_m_per_V}
        stated = next(channel.unit for channel in source.channels if channel.name == name)
        unit = f"{options.length_unit}/s" if quantity == "speed" and options.length_unit in ("m", "mm", "um", "nm") else given.get(quantity)
        if name in options.columns.values() and unit_named(name, stated) not in (None, unit):
            unit = None  # a further column that states a unit of its own keeps it
        values = self._columns[source.path, name].values
        scale = scale_of(name, quantity, values, stated=stated, given=unit, per_volt=per_volt.get(quantity))
        self._scales[source.path, name] = scale
        return values * scale.factor if scale.factor != 1.0 else values

    def _time_column(self, source: Source, columns: Sequence[str]) -> str | None:
        """Name of the column of time of a file; None where its columns have times of their own."""
        given = self.options.time_columns
        if len(given) not in (0, 1, len(self.sources)):
            raise BadInput(f"{len(given)} time columns are given for {len(self.sources)} files; give one for all, or one for each")
        if given:
            name = given[0] if len(given) == 1 else given[self.sources.index(source)]
            if not source.named(name):
                raise BadInput(f"{source.path.name} has no column {name}; it holds {listing(source.channels)}")
            return name
        rates = {channel.name: channel.rate_Hz for channel in source.channels}
        if self.options.rate_Hz is None and any(rates.get(name) is None for name in columns):
            raise BadInput(
                f"a recording needs time and no column of {source.path.name} is named for it; give --time-column, or --rate-Hz where it "
                f"holds none ({listing(source.channels)})"
            )
        return None

    def _table(self, named: Mapping[str, Quantity]) -> tuple[Floats, dict[str, Floats]]:
        """Times (n,) and columns in SI."""
        sources = {self._source_with(name).path: self._source_with(name) for name in named}
        if len(sources) > 1:
            files = " and ".join(path.name for path in sources)
            raise BadInput(f"the columns {', '.join(named)} stand in {files}, expected one file for them; leave one out")
        source = next(iter(sources.values()))
        time = self._time_column(source, list(named))
        lengths = {name: len(self._columns[source.path, name].values) for name in [*named, *([time] if time else [])]}
        if len(set(lengths.values())) > 1:
            shown = ", ".join(f"{name} has {length}" for name, length in lengths.items())
            raise RecordingError(f"{source.path.name}: columns have unequal lengths ({shown}); name columns that were sampled together")
        if 0 in lengths.values():
            raise RecordingError(f"{source.path.name}: {next(iter(lengths))} holds no number; name another column, or record it")
        scaled = {name: self._scaled(source, name, quantity) for name, quantity in named.items()}
        if self.options.rate_Hz is not None:
            return np.arange(next(iter(lengths.values()))) / self.options.rate_Hz, scaled
        t_s = self._scaled(source, time, "time") if time else self._times(self._columns[source.path, next(iter(named))])
        _refuse_disorder(t_s, time or "time", source.path.name)
        return t_s, scaled

    def _path_of_columns(self) -> TipPath:
        options = self.options
        t_s, scaled = self._table(self._named_columns(motion=True))
        self._refuse_turning_tool(self._source_with(options.depth_column or options.height_column or ""))
        sign = -1.0 if options.depth_column is not None or options.height_down_positive else 1.0
        optional = {role: sign * scaled[column] for role, column in options.columns.items() if role in MOTION_ROLES}
        height = sign * scaled[options.depth_column or options.height_column or ""]
        return TipPath(t_s, height, optional.get("vz_m_per_s"), optional.get("z_cmd_m"))

    def _refuse_turning_tool(self, source: Source) -> None:
        """Refuse a table whose columns of orientation say that the tool turns, as a pose that turns is. Raises RecordingError."""
        for names, kind in orientations_in([channel.name for channel in source.of_kind("column")]):
            try:
                read = source.reader.columns(source.path, names)
            except RecordingError:
                continue  # what cannot be read says nothing of a turn
            quaternions = quaternions_of(np.column_stack([read[name].values for name in names]), kind, names)
            if float(np.linalg.norm(quaternions, axis=1).min()) > 0.0:  # else no orientation was recorded
                what = f"{source.path.name} ({', '.join(names)} as {kind})"
                refuse_turn(continuous(quaternions, what), what)

    def _wrench_of_columns(self) -> Wrench:
        options = self.options
        t_s, scaled = self._table(self._named_columns(motion=False))
        wrench = np.zeros((len(t_s), 6))
        wrench[:, WRENCH_COLUMNS.index("fz_N")] = scaled[options.force_column or ""]
        for role, column in options.columns.items():
            if role not in MOTION_ROLES:
                wrench[:, WRENCH_COLUMNS.index(role)] = scaled[column]
        return Wrench(t_s, wrench, None)


def _further(force: str, names: Sequence[str]) -> dict[str, str]:
    """Further columns of our own tables, by their roles."""
    if force == OWN[0]:
        return {role: role for role in ROLES if role in names}
    own = {axis: name for name, axis in JOINT_COLUMNS.items() if name in names and axis in ROLES}
    return own if force == OWN_JOINT[0] else {}


def _refuse_other_kind(source: Source, name: str, kind: Kind) -> None:
    """Refuse a topic that holds something else than the option it was given for. Raises BadInput."""
    fitting: dict[Kind, tuple[Kind, ...]] = {"pose": ("pose", "command", "transforms"), "command": ("command", "pose", "transforms")}
    for channel in source.channels:
        if channel.name == name and channel.kind not in (*fitting.get(kind, (kind,)), "other"):
            raise BadInput(
                f"--{kind} {name}: it holds a {channel.kind}, expected a {kind}; {source.path.name} holds {listing(source.channels)}"
            )


def _at(t_s: Floats, own_s: Floats, values: Floats, names: str) -> Floats:
    """Values at other times."""
    if own_s[-1] < t_s[0] or own_s[0] > t_s[-1]:
        raise BadInput(f"{names} do not overlap in time; their stamps come from two clocks")
    return np.interp(t_s, own_s, values)


def _is_slope(t_s: Floats, z_m: Floats, vz_m_per_s: Floats) -> bool:
    """Whether speeds (n,) lead to the heights (n,) that were reported."""
    steps_m = 0.5 * (vz_m_per_s[1:] + vz_m_per_s[:-1]) * np.diff(t_s)
    way_m = np.concatenate(([0.0], np.cumsum(steps_m)))
    error_m = (way_m - way_m.mean()) - (z_m - z_m.mean())
    return bool(np.sqrt(np.mean(error_m**2)) <= SLOPE_ERROR * np.std(z_m))


def _in_base_axes(
    readings: Floats, t_s: Floats, path: TipPath, frame: str | None, options: ImportOptions, names: str, notes: list[str]
) -> Floats:
    """Readings (n, 6) in axes of the pose; a tool that turns is refused."""
    assert path.orientation is not None
    where = "base" if frame is None else options.wrench_in or ("base" if frame and frame == path.frame else "tool" if frame else None)
    if where is None:
        raise BadInput(f"{names}: nothing says in which axes the wrench is; give --wrench-in tool or --wrench-in base")
    if where == "base" and float(np.linalg.norm(path.orientation, axis=1).min()) == 0.0:
        return readings  # no orientation was recorded, and none is needed
    orientation = continuous(path.orientation, names)
    refuse_turn(orientation, names)
    if where == "base":
        return readings
    notes.append(f"The wrench in axes of {frame or 'the tool'} was turned into those of {path.frame or 'the base'} by the pose.")
    between = np.column_stack([np.interp(t_s, path.t_s, orientation[:, k]) for k in range(4)])
    between /= np.linalg.norm(between, axis=1)[:, None]
    return rotated(readings, between)


def _refuse_disorder(t_s: Floats, column: str, name: str) -> None:
    steps = np.diff(t_s)
    wrong = np.flatnonzero(steps <= 0.0)
    if len(wrong):
        row = int(wrong[0])
        how = "runs backwards" if steps[row] < 0 else "stands still"
        raise RecordingError(
            f"{name}: {column} {how} in row {row + 2} of the numbers ({t_s[row]:.9g} s, then {t_s[row + 1]:.9g} s); a recording needs "
            "rows in the order of time, each with its own: correct the column, or name another one"
        )


def _refuse_contradictions(options: ImportOptions) -> None:
    if options.depth_column is not None and options.height_column is not None:
        raise BadInput("--depth-column and --height-column were both given; give the one that the curve is to be judged by")
    if options.depth_column is not None and options.height_down_positive:
        raise BadInput("--height-down-positive belongs to --height-column; a depth always grows inwards")
    if options.force_column and options.wrench:
        raise BadInput("--force-column and --wrench were both given; give the one that holds the force")
    if options.pose and (options.depth_column or options.height_column):
        raise BadInput("--pose and a column of height or depth were both given; give the one that holds the height")
    if options.joint and (options.wrench or options.pose):
        raise BadInput("--joint belongs to columns of angle and torque; name them with --height-column and --force-column")
    if options.rate_Hz is not None and not 0.0 < options.rate_Hz <= LARGEST_RATE_HZ:
        raise BadInput(f"--rate-Hz is {options.rate_Hz:g}, expected above 0 and at most {LARGEST_RATE_HZ:g}; give the rows per second")
    if options.rate_Hz is not None and (options.time_columns or options.wrench or options.pose):
        raise BadInput("--rate-Hz stands for times that no column holds; leave it out where a time column or topics give them")
    if options.axis and (options.depth_column or options.height_column):
        raise BadInput("--axis belongs to --pose; of single columns, name the one along the axis")
    for role in options.columns:
        if role not in ROLES:
            raise BadInput(f"--column {role} is no column of a recording{nearest(role, list(ROLES))}; expected {', '.join(ROLES)}")


def _questions(samples: Samples, options: ImportOptions) -> list[str]:
    """What is implausible in the result, such as a force that falls while the tip presses."""
    fz_N = samples.wrench[:, 2]
    if samples.joint:
        return ["torque_Nm never changes, expected noise at least"] if dead(fz_N) else []
    if dead(fz_N):
        return [*questions_of(samples), f"fz_N is {fz_N[0]:g} throughout, expected noise at least"]
    fall_N = fall_where_lowest_N(samples.z_m, fz_N)
    if not fall_N:
        return questions_of(samples)
    option = "--axis or --compression-negative" if options.axis else "--compression-negative"
    return [*questions_of(samples), f"fz_N falls by {fall_N:.3g} N where the tip is lowest, and pressing gives a positive force ({option})"]


def _tare_notes(samples: Samples, options: ImportOptions) -> list[str]:
    """A note where the force does not look tared."""
    fz_N = samples.wrench[:, 2]
    start_N = float(np.median(fz_N[: max(3, len(fz_N) // 100)]))
    if samples.joint or options.tare_s is not None or abs(start_N) <= CLEAR_SHARE * float(np.ptp(fz_N)):
        return []
    return [f"fz_N begins at {start_N:.3g} N; a diagnosis expects a tared sensor: give --tare-s if the probe is free at the start."]
