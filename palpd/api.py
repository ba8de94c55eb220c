"""The Python API: load recordings, find moduli, simulate a cell, and diagnose its sim-to-real gap.

    import palpd

    recording = palpd.load("run.csv")                      # or run.mcap with site="A"
    answer = palpd.diagnose(recording, "cell.yaml")        # or a data frame with the same columns
    answer.sentence
    answer.cell.save("enriched.yaml")

Names and signatures of `__all__` stay as they are within a minor version. A change is announced in CHANGELOG.md one minor version before.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self, TypeAlias

import numpy as np

from palpd.cell.cell_file import CellFile, load_cell, nominal, save_cell
from palpd.cell.cell_file import cell_from as cell_of
from palpd.cell.effects import EFFECTS, Effect
from palpd.cell.tip_motion import estimate_tip_motion
from palpd.documents import nearest
from palpd.errors import BadInput, RecordingError
from palpd.gap.commands import check_motion, read_motion, read_recording, simulate_columns, since_healthy
from palpd.gap.diagnosis import Diagnosis
from palpd.gap.diagnosis import diagnose as diagnose_samples
from palpd.gap.user_simulator import UserSimulator, asked, own_effects
from palpd.recording.samples import (
    COLUMNS,
    JOINT_COLUMNS,
    Samples,
    columns_of,
    common_site,
    numbers_of,
    samples_from_columns,
    site_named_in,
    write_csv,
)
from palpd.tick import Floats

if TYPE_CHECKING:
    import pandas as pd  # type: ignore[import-untyped]
    from matplotlib.figure import Figure


__all__ = [
    "Analysis", "Cell", "Effect", "GapDiagnosis", "LoadedRecording", "analyse", "cell_from", "diagnose", "export_sim", "import_file",
    "load", "simulate", "tip_motion", "tolerances",
]  # fmt: skip

TableRow: TypeAlias = dict[str, Any]


class DataFrame(Protocol):
    """What palpd needs of a data frame (pandas, polars): its columns by name."""

    @property
    def columns(self) -> Any:
        """Names of the columns."""

    def __getitem__(self, name: str, /) -> Any:
        """One column."""


class _Shown(ABC):
    """What a notebook shows: a sentence and a table."""

    @property
    @abstractmethod
    def sentence(self) -> str:
        """The result in words."""

    @abstractmethod
    def table(self) -> list[TableRow]:
        """The figures, a row each, as plain data."""

    def __str__(self) -> str:
        return self.sentence

    def _repr_html_(self) -> str:
        rows = self.table()
        head = "".join(f"<th>{escape(str(name))}</th>" for name in (rows[0] if rows else ()))
        body = "".join(f"<tr>{''.join(f'<td>{escape(_plain(value))}</td>' for value in row.values())}</tr>" for row in rows)
        return f"<p>{escape(self.sentence)}</p><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


@dataclass(frozen=True)
class Cell:
    """A cell as a simulator knows it: robot, sensor, probe, tissue, tolerances, and known effects.

    Attributes:
        notes: Sentences of `cell_from` on what it found, and what it guessed.
    """

    file: CellFile
    notes: tuple[str, ...] = ()

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a cell.yaml. Raises ConfigError."""
        return cls(load_cell(path))

    @classmethod
    def of(cls, **blocks: Any) -> Self:
        """A cell of blocks as they stand in cell.yaml; what is absent is as in the emulated cell.

        Args:
            blocks: Such as `tissue={"youngs_modulus_Pa": 50e3}`.

        Raises:
            ConfigError: A value is not possible.
        """
        return cls(cell_of(blocks, "Cell.of"))

    @classmethod
    def nominal(cls) -> Self:
        """The emulated cell without an effect."""
        return cls(nominal())

    def with_effects(self, effects: Mapping[str, Mapping[str, float]]) -> Cell:
        """The same cell with effects.

        Args:
            effects: Parameters by name, by the id of the effect.

        Raises:
            ConfigError: There is no such effect or parameter.
        """
        checked = cell_of({"effects": {name: dict(values) for name, values in effects.items()}}, "with_effects")
        return Cell(self.file.with_effects(checked.effects))

    def save(self, path: str | Path) -> None:
        """Write the cell as YAML. Raises BadInput where the file cannot be written."""
        save_cell(path, self.file)


@dataclass(frozen=True)
class LoadedRecording(_Shown):
    """A recording of one cell, row by row in time. `recording["fz_N"]` is a column (n,); the names carry their units.

    Attributes:
        notes: Sentences of `import_file` on units, axes, and what was left out.
    """

    samples: Samples
    name: str = "recording"
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, column: str) -> Floats:
        columns = self.columns
        if column not in columns:
            raise BadInput(f"{self.name} has no column {column!r}; it has {', '.join(columns)}")
        return columns[column]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    @property
    def columns(self) -> dict[str, Floats]:
        """Every column (n,) by its name, in the order of the CSV."""
        return columns_of(self.samples)

    def to_pandas(self) -> pd.DataFrame:
        """The columns as a data frame of pandas, which must be installed (palpd[notebook])."""
        try:
            import pandas as pd
        except ImportError:
            raise BadInput("pandas is not installed; install palpd[notebook]") from None
        return pd.DataFrame(self.columns)

    def save(self, path: str | Path) -> None:
        """Write the recording as CSV; a file that palpd did not write is not overwritten. Raises BadInput."""
        write_csv(Path(path), self.samples)

    @property
    def sentence(self) -> str:
        """Length, rate and range in words."""
        samples = self.samples
        travel = float(np.ptp(samples.z_m))
        shown = f"{travel:.2f} rad" if samples.joint else f"{1e3 * travel:.1f} mm"
        return f"{self.name}: {len(samples)} rows in {samples.duration_s:.1f} s ({samples.rate_Hz:.0f} Hz), {shown} of travel."

    def table(self) -> list[TableRow]:
        """Least, mean and largest value of every column."""
        return [
            {"column": name, "least": float(values.min()), "mean": float(values.mean()), "largest": float(values.max())}
            for name, values in self.columns.items()
        ]

    def figure(self) -> Figure:
        """Height and vertical force over time."""
        from palpd.analysis.figure_style import BLUE, INK, styled_figure, thinned

        samples = self.samples
        with styled_figure(10.0, 4.0) as figure:
            above, below = figure.subplots(2, 1, sharex=True)
            motion = (samples.z_m, "angle, rad") if samples.joint else (1e3 * samples.z_m, "height, mm")
            force = "torque, Nm" if samples.joint else "fz, N"
            for axes, values, colour, label in ((above, motion[0], INK, motion[1]), (below, samples.wrench[:, 2], BLUE, force)):
                axes.plot(*thinned(samples.t_s, values), color=colour)
                axes.set_ylabel(label)
            below.set_xlabel("time, s")
        return figure


Source: TypeAlias = "str | Path | LoadedRecording | Samples | Mapping[str, Any] | DataFrame"
"""What can be given for a recording: a file, a recording, or a data frame or mapping with the columns of the CSV."""
CellSource: TypeAlias = "str | Path | Cell | CellFile | Mapping[str, Any]"
"""What can be given for a cell: a file, a cell, or the content of a cell.yaml."""
Simulator: TypeAlias = "Callable[..., Source]"
"""A user's own simulator as a function: it takes a motion (`t_s`, `z_m`, `vz_m_per_s`, `az_m_per_s2`, and `z_cmd_m` where known), and its
parameters by name, and gives columns, at least `fz_N`."""
OwnParameters: TypeAlias = "Mapping[str, tuple[float, float, float]]"
"""Parameters of a user's own simulator by name: the value that it has, the smallest and the largest one that the real cell may have."""
Simulated: TypeAlias = "Simulator | Source"
"""The nominal prediction of a user's own simulator: the function, or its output for the motion at hand."""


@dataclass(frozen=True)
class Analysis(_Shown):
    """Young's modulus of each site with its interval.

    Attributes:
        sites: The figures of each site: `name`, `youngs_modulus_Pa`, `ci95_Pa`, `contact_point_m`, and `warnings`.
    """

    sites: tuple[Mapping[str, Any], ...]

    @property
    def sentence(self) -> str:
        """The moduli in words, with the notes on each."""
        return " ".join(self._of(site) for site in self.sites)

    def table(self) -> list[TableRow]:
        """A row a site."""
        rows = []
        for site in self.sites:
            low, high = site.get("ci95_Pa") or (None, None)
            notes = "; ".join(site.get("warnings", ()))
            rows.append({"site": site.get("name", ""), "E_Pa": site["youngs_modulus_Pa"], "low_Pa": low, "high_Pa": high, "notes": notes})
        return rows

    def figure(self) -> Figure:
        """Moduli with their 95 % intervals."""
        from palpd.analysis.figure_style import BLUE, styled_figure

        rows = [row for row in self.table() if row["E_Pa"] is not None]
        with styled_figure(6.0, 3.0) as figure:
            axes = figure.subplots()
            for row in rows:
                axes.plot(row["site"], row["E_Pa"] / 1e3, "o", color=BLUE)
                if row["low_Pa"] is not None:
                    axes.vlines(row["site"], row["low_Pa"] / 1e3, row["high_Pa"] / 1e3, color=BLUE)
            axes.set(xlabel="site", ylabel="Young's modulus, kPa")
        return figure

    @staticmethod
    def _of(site: Mapping[str, Any]) -> str:
        label = f"{site['name']}: " if site.get("name") else ""
        if site["youngs_modulus_Pa"] is None:
            return f"{label}no modulus ({'; '.join(site.get('warnings', ()))})."
        low, high = site.get("ci95_Pa") or (None, None)
        interval = "" if low is None or high is None else f" (95 %: {low / 1e3:.3g} to {high / 1e3:.3g})"
        notes = "".join(f" Note: {note}." for note in site.get("warnings", ()))
        return f"{label}E = {site['youngs_modulus_Pa'] / 1e3:.3g} kPa{interval}.{notes}"


@dataclass(frozen=True)
class GapDiagnosis(_Shown):
    """Why a cell does not behave like its simulation.

    Attributes:
        answer: The whole answer, with the data behind it; its parts may change between versions.
    """

    answer: Diagnosis

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        return self.answer.sentence

    @property
    def verdict(self) -> str:
        """One of `effects`, `none`, `unknown`, `ambiguous`."""
        return self.answer.verdict

    @property
    def probabilities(self) -> dict[str, float]:
        """Probability of every effect, of `none` and of `unknown`."""
        return {**self.answer.decision.candidates, "none": self.answer.decision.p_none, "unknown": self.answer.decision.p_unknown}

    @property
    def cell(self) -> Cell:
        """The cell with what was found."""
        return Cell(self.answer.cell_with_uncertainty())

    def to_json(self) -> dict[str, Any]:
        """The content of out.json (schema palpd.diagnosis/1)."""
        return self.answer.to_json()

    def table(self) -> list[TableRow]:
        """A row for each parameter of each named effect."""
        return [
            {
                "effect": effect["id"],
                "probability": effect["probability"],
                "parameter": name,
                "value": figure["value"],
                "low": figure["ci95"][0],
                "high": figure["ci95"][1],
                "cannot be told from": ", ".join(effect["indistinguishable_from"]),
            }
            for effect in self.to_json()["effects"]
            for name, figure in (effect["parameters"] or {"": {"value": None, "ci95": (None, None)}}).items()
        ]

    def figure(self) -> Figure:
        """The channel with the largest gap: measured less simulated, by the cell as stated and with what was found."""
        from palpd.analysis.figure_style import ENRICHED, NOMINAL, styled_figure, thinned
        from palpd.gap.data.noise import CHANNELS
        from palpd.gap.plain import channel_words, unit_of
        from palpd.gap.report.page import curves_of

        curves, content = curves_of(self.answer), self.to_json()
        channel = (content["where"] or content["shrink"])["channel"]
        before, after = curves.gaps(CHANNELS.index(channel))
        with styled_figure(10.0, 3.0) as figure:
            axes = figure.subplots()
            axes.plot(*thinned(curves.t_s, before), color=NOMINAL, label="as stated")
            axes.plot(*thinned(curves.t_s, after), color=ENRICHED, label="with what was found")
            axes.set(xlabel="time, s", ylabel=f"measured less simulated {channel_words(channel, content)}, {unit_of(channel, content)}")
            axes.legend()
        return figure

    def report(self, path: str | Path, title: str = "recording") -> None:
        """Write the page that `palpd diagnose --report` writes.

        Args:
            path: The HTML file.
            title: Names the recordings.

        Raises:
            BadInput: The file cannot be written.
        """
        from palpd.gap.report.page import write

        write(Path(path), self.answer, title)


def load(path: str | Path, site: str | None = None) -> LoadedRecording:
    """Read a recording.

    Args:
        path: A CSV or Parquet file, or a recording of the daemon (.mcap).
        site: Site of a recording of the daemon; None where it holds one only.

    Raises:
        BadInput: That is no path.
        RecordingError: The file is no recording, or holds several sites and none is named.
    """
    if not isinstance(path, str | Path):
        raise BadInput(f"a {type(path).__name__} is no path of a recording; load takes a file, and diagnose takes data frames as they are")
    return LoadedRecording(read_recording(Path(path), site), Path(path).name)


def import_file(files: str | Path | Sequence[str | Path], **options: Any) -> LoadedRecording:
    """Read what another machine recorded, as `palpd import` does.

    Args:
        files: A table, bag, TDMS, MATLAB or AFM file; or two, one with the motion and one with the force.
        options: Options of that command, as the fields of `palpd.interchange.import_files.ImportOptions`, such as `force_column="Fz (N)"`.

    Raises:
        BadInput: There is no such option, the options do not fit the files, or a unit is not confirmed.
        RecordingError: A file cannot be read or is no recording.
    """
    from palpd.interchange.import_files import ImportOptions, read_files

    known = [field.name for field in fields(ImportOptions)]
    for name in options:
        if name not in known:
            raise BadInput(f"import_file has no option {name}{nearest(name, known)}; it has {', '.join(known)}")
    paths = [Path(file) for file in ([files] if isinstance(files, str | Path) else files)]
    if not paths:
        raise BadInput("no file was given; give one, or one with the motion and one with the force")
    if isinstance(options.get("time_columns"), str):
        options["time_columns"] = [options["time_columns"]]
    imported = read_files(paths, ImportOptions(**options))
    return LoadedRecording(imported.samples, " and ".join(path.name for path in paths), imported.notes)


def cell_from(
    recordings: Source | Sequence[Source],
    *,
    tip_radius_m: float | None = None,
    contact: bool = True,
    accept_implausible: bool = False,
) -> Cell:
    """Write a first cell from recordings, as `palpd cell-from` does: rates, noise, resolution, the touch and a stiffness that is not known.

    Args:
        recordings: One recording or several of the same cell.
        tip_radius_m: Radius of the spherical tip; None where it is not known.
        contact: Whether the probe touches something in them.
        accept_implausible: Whether implausible values count.

    Raises:
        RecordingError: fz never changes, or forces or heights have the wrong sign.
        BadInput: The radius is impossible, or a value is implausible.
    """
    from palpd.gap.first_cell import first_cell

    first = first_cell([_samples(each) for each in _several(recordings)], tip_radius_m, accept_implausible, contact=contact)
    return Cell(cell_of(first.content, "cell_from"), first.sentences)


def tolerances(recordings: Source | Sequence[Source], cell: CellSource, *, accept_implausible: bool = False) -> dict[str, dict[str, float]]:
    """Estimate tolerances from recordings of a healthy cell, as `palpd tolerances` does.

    Args:
        accept_implausible: Whether doubtful recordings and implausible tolerances count.

    Returns:
        The blocks `tolerances` and `repeatability` of a cell file, in its units.

    Raises:
        RecordingError: A recording cannot be judged.
        BadInput: A recording is doubtful or a tolerance implausible.
    """
    from palpd.gap.tolerances import estimate_tolerances

    samples = [_samples(each) for each in _several(recordings)]
    return estimate_tolerances(samples, _cell(cell).at_site(common_site(samples)), accept_implausible)


def export_sim(
    cell: CellSource, folder: str | Path, to: Literal["mujoco", "fmu"], *, draws: int = 0, seed: int = 0, site: str | None = None
) -> Path:
    """Write a cell for another simulator, as `palpd export-sim` does, and check it against palpd's own simulation.

    Args:
        folder: Folder to write; it must not exist, or be empty.
        draws: Number of further cells, drawn from what a diagnosis left open.
        seed: Seed of the draws.
        site: Site of a cell with several; None for the cell's own tissue.

    Raises:
        BadInput: The folder holds something, a package is missing, or an effect cannot be exported.
    """
    from palpd.cell.draws import drawn_cells
    from palpd.interchange.simulators.export import export_cell

    file = _cell(cell)
    return export_cell(file, to, Path(folder), draws=drawn_cells(file, draws, seed) if draws else (), site=site).folder


def tip_motion(recording: Source, cell: CellSource) -> dict[str, Floats]:
    """The motion of the tip behind the noisy reports of a recording: what to drive your own simulator with.

    Args:
        cell: The cell; its servo and the noise of its robot and sensor say what is noise.

    Returns:
        `t_s` as recorded, `z_m`, `vz_m_per_s`, `az_m_per_s2`, and `z_cmd_m` where the recording has it, each (n,).

    Raises:
        RecordingError: The recording lacks a column.
    """
    samples = _samples(recording)
    motion = estimate_tip_motion(_cell(cell), samples.t_s, samples.z_m, samples.vz_m_per_s, samples.z_cmd_m)
    return {**asked(motion, samples.z_cmd_m), "t_s": samples.t_s}


def simulate(
    motion: Source,
    cell: CellSource,
    *,
    drive: Literal["measured", "commanded"] = "measured",
    noise_seed: int | None = None,
    simulated: Simulated | None = None,
    nominal: CellSource | None = None,
    parameters: OwnParameters | None = None,
) -> LoadedRecording:
    """Simulate what a cell's sensor and robot report on a motion.

    Args:
        motion: A recording, or a data frame with `t_s` and `z_m` or `z_cmd_m`.
        drive: `measured` takes the reported heights, `commanded` the commanded ones through the robot's servo.
        noise_seed: Seed of noise and rounding; neither without one.
        simulated: Your own simulator, or its output for this motion; what the cell has beyond `nominal` is added to it.
        nominal: The cell that your simulator simulates; None without `simulated`.
        parameters: As for `diagnose`.

    Raises:
        BadInput: Only one of `simulated` and `nominal` is given, or the seed is negative.
        RecordingError: The motion lacks a column, or holds what no motion has.
    """
    columns = _columns(motion)
    if "z_m" not in columns:
        drive = "commanded"
    needed = "z_m" if drive == "measured" else "z_cmd_m"
    missing = [name for name in ("t_s", needed) if name not in columns]
    if missing:
        raise RecordingError(f"the motion has no column {missing[0]}; it has {', '.join(columns) or 'none'}")
    check_motion({name: columns[name] for name in ("t_s", needed, "vz_m_per_s", "z_cmd_m") if name in columns}, "the motion")
    if (simulated is None) != (nominal is None):
        raise BadInput("simulated= and nominal= belong together: the first is your simulator of the second; give both")
    own = None if simulated is None or nominal is None else (_simulator(simulated, columns["t_s"], parameters), _cell(nominal))
    library = EFFECTS if own is None else {**EFFECTS, **own_effects(own[0])}
    at = _cell(cell).at_site(_site_of(motion))
    samples = simulate_columns(at, columns, measured=drive == "measured", noise_seed=noise_seed, library=library, own=own)
    return LoadedRecording(samples, "simulated")


def diagnose(
    recordings: Source | Sequence[Source],
    cell: CellSource | None = None,
    *,
    effects: Mapping[str, Effect] = EFFECTS,
    propose: bool = False,
    simulated: Simulated | Sequence[Source] | None = None,
    parameters: OwnParameters | None = None,
    healthy: Source | Sequence[Source] | None = None,
) -> GapDiagnosis:
    """Say where recordings of one cell differ from its simulation, and which effect causes it.

    Args:
        recordings: One recording or several of the same cell.
        cell: The cell as the simulator knows it; None only with `healthy`: estimated from these.
        effects: The effects that may be present, by id.
        propose: Whether to look for the motion that would decide what is open.
        simulated: Your own simulator as the nominal, or its output for each recording; the cell then says what is within specification.
            None: palpd simulates the cell.
        parameters: Parameters of your simulator that may be wrong, by name: the value that it has, the smallest and the largest one. It is
            called as `simulated(motion, name=value)`, and each is an effect `simulator.name`.
        healthy: Recordings of the same cell while it was healthy; only what changed since then is judged. None: the cell is the nominal.

    Raises:
        BadInput: There is neither a cell nor a healthy recording, or `healthy` beside `simulated`. There are not as many outputs as
            recordings, or a parameter has no function.
        RecordingError: The recordings cannot be judged, or an output does not fit its recording.
    """
    samples = [_samples(each) for each in _several(recordings)]
    simulators: list[UserSimulator] = []
    if healthy is not None and simulated is not None:
        raise BadInput("healthy= and simulated= are two nominals; leave one out")
    if healthy is not None:
        before = [_samples(each) for each in _several(healthy)]
        nominal, effects, simulators = since_healthy(before, None if cell is None else _cell(cell), effects, samples)
        return GapDiagnosis(diagnose_samples(samples, nominal, effects, propose=propose, simulators=simulators))
    if cell is None:
        raise BadInput("no cell is given; give cell=, or healthy= recordings to compare with")
    if simulated is not None:
        given = [simulated] * len(samples) if callable(simulated) else _several(simulated)
        if len(given) != len(samples):
            raise BadInput(f"simulated= has {len(given)} outputs for {len(samples)} recordings; give one for each, in their order")
        simulators = [_simulator(each, one.t_s, parameters) for each, one in zip(given, samples, strict=True)]
        effects = {**effects, **own_effects(simulators[0])}
    return GapDiagnosis(diagnose_samples(samples, _cell(cell), effects, propose=propose, simulators=simulators))


def analyse(source: Source, cell: CellSource | None = None, *, site: str | None = None) -> Analysis:
    """Young's modulus with its interval.

    Args:
        source: A recording of the daemon (.mcap), or with a cell any recording.
        cell: A cell, as a diagnosis enriched it: what it knows no longer passes for stiffness. Needed where the source is not the daemon's.
        site: One site of a recording of the daemon; None for all.

    Raises:
        BadInput: A cell is needed and none is given.
        RecordingError: There is no contact.
    """
    if cell is None:
        return Analysis(tuple(_daemon_sites(source, site)))
    from palpd.analysis.enriched import enriched_modulus, figures_of

    samples = _samples(source, site)
    return Analysis((figures_of(enriched_modulus([samples], _cell(cell).at_site(common_site([samples]))), site or ""),))


def _daemon_sites(source: Source, site: str | None) -> Sequence[Mapping[str, Any]]:
    from palpd.analysis.results import analysed_sites
    from palpd.recording.reader import Recording, holds_ticks

    if not isinstance(source, str | Path) or not holds_ticks(Path(source)):
        raise BadInput("a modulus of a recording that is not the daemon's needs a cell, which says how large the tip is; give cell=")
    return analysed_sites(Recording.load(Path(source)), site)


def _several(sources: Source | Sequence[Source]) -> list[Source]:
    return list(sources) if isinstance(sources, Sequence) and not isinstance(sources, str) else [sources]


def _simulator(simulated: Simulated, t_s: Floats, parameters: OwnParameters | None = None) -> UserSimulator:
    if parameters and not callable(simulated):
        raise BadInput("parameters= are those of a function; give your simulator as one in simulated=")
    if isinstance(simulated, str | Path):
        return UserSimulator.of_file(Path(simulated), t_s)
    if callable(simulated):
        function: Simulator = simulated
        inner = getattr(function, "func", function)  # of a functools.partial
        name = str(getattr(inner, "__name__", type(inner).__name__))
        return UserSimulator.of_function(lambda motion, **values: _columns(function(dict(motion), **values)), name, parameters)
    return UserSimulator.of_columns(_columns(simulated), t_s, "the simulated output")


def _cell(source: CellSource) -> CellFile:
    if isinstance(source, Cell):
        return source.file
    if isinstance(source, CellFile):
        return source
    return load_cell(source) if isinstance(source, str | Path) else cell_of(source, "cell")


def _samples(source: Source, site: str | None = None) -> Samples:
    if isinstance(source, str | Path):
        return load(source, site).samples
    if isinstance(source, Samples):
        return source
    return source.samples if isinstance(source, LoadedRecording) else samples_from_columns(_columns(source), "the data frame")


def _site_of(source: Source) -> str | None:
    """The site that a motion names."""
    if isinstance(source, str | Path):
        return site_named_in(Path(source))
    samples = source.samples if isinstance(source, LoadedRecording) else source
    return common_site([samples]) if isinstance(samples, Samples) else None


def _columns(source: Source) -> dict[str, Floats]:
    """The known columns of anything that has columns."""
    if isinstance(source, str | Path):
        return read_motion(Path(source))
    if isinstance(source, Samples):
        source = LoadedRecording(source)
    if not isinstance(source, Mapping) and not hasattr(source, "columns"):
        raise BadInput(
            f"a {type(source).__name__} is no recording; give a file, a recording, or a data frame or mapping with the columns "
            f"{', '.join(COLUMNS)}"
        )
    names = list(source) if isinstance(source, Mapping) else list(source.columns)
    try:
        return {name: numbers_of(source[name], "the data frame", name) for name in (*COLUMNS, *JOINT_COLUMNS) if name in names}
    except (TypeError, ValueError) as error:
        raise RecordingError(f"a column of the data frame holds something that is no number ({error})") from None


def _plain(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)
