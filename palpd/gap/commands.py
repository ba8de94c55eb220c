"""What the command line does with recordings of cells: diagnose one or several jointly, simulate, estimate tolerances."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np

from palpd.cell.cell_file import CellFile, cell_from, load_cell, parse_cell, save_cell
from palpd.cell.effects import EFFECTS, Effect, load_effects, save_learned
from palpd.cell.effects.adopted import load_adopted
from palpd.cell.effects.learned import held_sentence
from palpd.cell.plausible import ask, doubts_of_cell
from palpd.cell.simulation import share_outside, simulate
from palpd.errors import BadInput, RecordingError
from palpd.files import write_json
from palpd.gap.data.plausibility import check_recordings
from palpd.gap.data.prepare import stated_cell
from palpd.gap.diagnosis import Diagnosis, ShownSizes, diagnose, limits
from palpd.gap.first_cell import first_cell
from palpd.gap.healthy_reference import HealthyReference
from palpd.gap.plain import plain_answer
from palpd.gap.tolerances import estimate_tolerances
from palpd.gap.user_simulator import UserSimulator, simulate_with
from palpd.recording.oddities import questions_of
from palpd.recording.reader import Recording, holds_ticks, read_header, refuse_site, samples_of, visited_sites
from palpd.recording.samples import (
    COLUMNS,
    WRENCH_COLUMNS,
    Samples,
    common_site,
    named_once,
    read,
    read_columns,
    refuse_values,
    site_named_in,
    write_csv,
)
from palpd.tick import Floats


def library(effects: Path | None, without: Sequence[str] = (), adopted: Path | None = None) -> Mapping[str, Effect]:
    """The effects that may be present.

    Args:
        effects: A file with user effects (.py) or learned effects (.yaml); None: no such file.
        without: Effects that are known to be absent.
        adopted: The folder of a user's adopted effects; None: without these, so that they take part only where somebody asks for them.

    Raises:
        BadInput: An effect to leave out does not exist.
    """
    known = load_effects(effects)
    if adopted is not None:
        known = known | {name: law.effect() for name, law in load_adopted(adopted).items() if name not in known}
    if unknown := [name for name in without if name not in known]:
        raise BadInput(f"there is no effect {unknown[0]!r} to leave out; expected one of {', '.join(known)}")
    return {name: effect for name, effect in known.items() if name not in without}


def effects_named(names: Sequence[str], known: Mapping[str, Effect]) -> list[Effect]:
    """The effects of a library with these ids, in the order of `names`.

    Raises:
        BadInput: The library has no such effect.
    """
    if unknown := [name for name in names if name not in known]:
        raise BadInput(f"there is no effect {unknown[0]!r}; expected one of {', '.join(known)}")
    return [known[name] for name in names]


def nominal_cell(cell: Path | None, recordings: Sequence[Path], known: Mapping[str, Effect]) -> CellFile:
    """The cell to diagnose against.

    Args:
        cell: The cell file; None: the cell that the configuration of the first recording states.
        known: The effects that it may have.

    Raises:
        BadInput: No file is given, and a recording is not one of the daemon.
    """
    if cell is not None:
        return load_cell(cell, known)
    if not recordings or not all(path.suffix == ".mcap" for path in recordings):
        raise BadInput("--cell is required: give the cell.yaml that your simulator uses; palpd cell-from writes a first one")
    return parse_cell(read_header(recordings[0]).get("config", {}).get("cell"), f"{recordings[0].name}, config.cell", known)


def read_recording(path: Path, site: str | None = None, *, learns: bool = False) -> Samples:
    """Read a recording of samples (.csv, .parquet), or one site of a recording of the daemon (.mcap).

    Args:
        site: Site of a recording of the daemon; None where it holds a single site.
        learns: Whether a healthy cell is learned from it, which a run of `palpd inject` is not for.

    Raises:
        RecordingError: The file is no recording, or holds several sites and none is named, or nothing may be learned from it.
    """
    if not holds_ticks(path):
        refuse_site(path, site)
        return read(path)
    recording = Recording.load(path)
    if learns:
        recording.refuse_injected()
    visited = visited_sites(recording)
    if site is None and len(visited) > 1:
        raise RecordingError(
            f"{path.name} holds {len(visited)} sites ({', '.join(visited)}), expected one; choose one with --site, or site= in Python"
        )
    return samples_of(recording, next(iter(visited), None) if site is None else site)


def diagnose_files(
    recordings: Sequence[Path],
    cell: Path | None,
    *,
    json_out: Path | None = None,
    cell_out: Path | None = None,
    effects: Path | None = None,
    adopted: Path | None = None,
    without: Sequence[str] = (),
    propose: bool = True,
    site: str | None = None,
    calibrated: bool = True,
    simulated: Sequence[Path] = (),
    healthy: Sequence[Path] = (),
    show: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Diagnose recordings of one cell jointly.

    Args:
        cell: The cell file; None: the cell that recordings of the daemon state. Its modulus at a site counts as known only where it states
            one for that site.
        json_out: Where to write out.json, and next to it the motion of the next experiment and a learned law; None: nowhere.
        cell_out: Where to write the enriched cell; None: nowhere.
        effects: A file with user effects (.py) or learned effects (.yaml); None: no such file.
        adopted: The folder of a user's adopted effects, which take part like the others; None: without these.
        without: Effects that are known to be absent.
        propose: Whether to look for the next experiment.
        site: Site of recordings of the daemon; None where they hold a single site.
        calibrated: Whether to state scores (`calibration`); otherwise the probabilities of the posterior.
        simulated: The output of a user's own simulator for each recording, which is then the nominal prediction.
        healthy: Recordings of the same cell while it was healthy; only what changed since then is judged.
        show: Is called with the name of each step that begins.

    Raises:
        BadInput: There are not as many outputs as recordings.
        RecordingError: A recording cannot be judged, or an output does not fit it.
    """
    show("reading the recording")
    asked = _asked(recordings, cell, library(effects, without, adopted), site, simulated, healthy)
    diagnosis = diagnose(
        asked.recordings,
        asked.cell,
        asked.library,
        propose=propose,
        calibrated=calibrated,
        simulators=asked.simulators,
        adopted=adopted,
        show=show,
    )
    if json_out is not None:
        write_answer(json_out, diagnosis)
    if cell_out is not None:
        save_cell(cell_out, diagnosis.cell_with_uncertainty())
    return diagnosis


def since_healthy(
    healthy: Sequence[Samples], cell: CellFile | None, known: Mapping[str, Effect], now: Sequence[Samples]
) -> tuple[CellFile, Mapping[str, Effect], list[UserSimulator]]:
    """The nominal of a comparison with a healthy cell: its cell file, the effects beside it, and one simulator for each recording.

    Args:
        cell: The cell file of the healthy cell; None: estimated from these recordings.
        known: Effects that the cell file may have.
        now: The recordings that are compared.

    Raises:
        RecordingError: The recordings cannot be judged, or one of them is compared with itself, or with another site.
    """
    cell = cell_from(first_cell(healthy).content, "the cell of the healthy recordings") if cell is None else cell
    cell = stated_cell(cell.at_site(common_site(healthy)))
    check_recordings([*healthy, *now], cell, sized=False)
    reference = HealthyReference.of(healthy, cell, known)
    return reference.learned.compared_cell, reference.learned.library, [reference.simulator(recording) for recording in now]


def limits_of_files(
    recordings: Sequence[Path],
    cell: Path | None,
    *,
    effects: Path | None = None,
    adopted: Path | None = None,
    site: str | None = None,
    simulated: Sequence[Path] = (),
    healthy: Sequence[Path] = (),
) -> ShownSizes:
    """The smallest size of each effect that recordings of one cell would show, without a diagnosis.

    Args:
        cell: As in `diagnose_files`.
        effects: A file with user effects (.py) or learned effects (.yaml); None: no such file.
        adopted: The folder of a user's adopted effects; None: without these.
        site: Site of recordings of the daemon; None where they hold a single site.
        simulated: As in `diagnose_files`.
        healthy: As in `diagnose_files`; the sizes are then those of a change.

    Raises:
        BadInput: There are not as many outputs as recordings.
        RecordingError: A recording cannot be judged, or an output does not fit it.
    """
    asked = _asked(recordings, cell, library(effects, adopted=adopted), site, simulated, healthy)
    return limits(asked.recordings, asked.cell, asked.library, simulators=asked.simulators)


@dataclass(frozen=True)
class _Asked:
    """What is asked: recordings, the nominal that they are compared with, and the effects that may be present.

    `simulators` holds one for each recording where the nominal is not palpd's own simulation, else none.
    """

    recordings: Sequence[Samples]
    cell: CellFile
    library: Mapping[str, Effect]
    simulators: Sequence[UserSimulator]


def _asked(
    recordings: Sequence[Path],
    cell: Path | None,
    known: Mapping[str, Effect],
    site: str | None,
    simulated: Sequence[Path],
    healthy: Sequence[Path],
) -> _Asked:
    """Read what `diagnose_files` was given."""
    if simulated and len(simulated) != len(recordings):
        outputs, judged = (f"{len(paths)} ({', '.join(path.name for path in paths)})" for paths in (simulated, recordings))
        raise BadInput(
            f"files of --simulated: {outputs}; recordings: {judged}; expected one file for each recording, in their order; "
            "write --simulated before every file"
        )
    if healthy:
        samples = [read_recording(path, site) for path in recordings]
        before = [read_recording(path, site, learns=True) for path in healthy]
        return _Asked(samples, *since_healthy(before, None if cell is None else load_cell(cell, known), known, samples))
    nominal = nominal_cell(cell, recordings, known)
    samples = [read_recording(path, site) for path in recordings]
    nominal = nominal if cell is not None else nominal.assumed_at_site(common_site(samples))
    simulators = [UserSimulator.of_file(path, one.t_s) for path, one in zip(simulated, samples, strict=False)]
    return _Asked(samples, nominal, known, simulators)


def write_answer(path: Path, diagnosis: Diagnosis) -> None:
    """Write out.json to `path`, and next to it the motion of the next experiment and the learned effect where there are any."""
    content = diagnosis.to_json()
    if diagnosis.proposal is not None:
        motion = path.with_name(f"{path.stem}.next.csv")
        diagnosis.proposal.write_motion(motion)
        content["next_experiment"]["motion_csv"] = motion.name
    if diagnosis.decision.learned is not None:
        learned = path.with_name(f"{path.stem}.learned.yaml")
        save_learned(learned, [diagnosis.decision.learned])
        content["learned"]["file"] = learned.name
        content["plain"] = plain_answer(content, diagnosis.problem.library)
    write_json(path, content)


def simulate_file(
    motion: Path,
    cell: Path,
    csv_out: Path,
    *,
    from_commanded: bool = False,
    noise_seed: int | None = None,
    effects: Path | None = None,
    adopted: Path | None = None,
    say: Callable[[str], None] = lambda _: None,
    simulated: Path | None = None,
    nominal: Path | None = None,
    accept_implausible: bool = False,
) -> Samples:
    """Simulate the recording that a cell gives on the motion of a file.

    Args:
        motion: Its `z_m` drives the cell, or its `z_cmd_m` where that is absent.
        from_commanded: Drive it with `z_cmd_m` in any case.
        noise_seed: Seed of noise and rounding; None: neither.
        effects: A file with user effects (.py) or learned effects (.yaml); None: no such file.
        adopted: The folder of a user's adopted effects, which the cell file may name; None: without these.
        say: Is called with a sentence for every learned effect that leaves its range, and for every doubt that was accepted.
        simulated: The output of a user's own simulator for that motion, to which palpd(cell) - palpd(nominal cell) is added; None: palpd
            alone simulates.
        nominal: The file of the cell that this simulator simulates; None without `simulated`.
        accept_implausible: Whether an implausible cell or motion counts.

    Raises:
        BadInput: Only one of `simulated` and `nominal` is given, noise is asked for in addition, or something is implausible and
            `accept_implausible` is false.
        RecordingError: The motion lacks columns that are needed.
    """
    if (simulated is None) != (nominal is None):
        raise BadInput("--simulated and --nominal belong together: the output is that of your simulator for the nominal cell; give both")
    known = library(effects, adopted=adopted)
    columns = read_motion(motion)
    measured = "z_m" in columns and not from_commanded
    if from_commanded and "z_cmd_m" not in columns:
        raise RecordingError(f"{motion.name} has no column z_cmd_m; it is needed to simulate from the command.")
    enriched = load_cell(cell, known).at_site(site_named_in(motion))
    own = None if simulated is None or nominal is None else (UserSimulator.of_file(simulated, columns["t_s"]), load_cell(nominal, known))
    samples = simulate_columns(enriched, columns, measured=measured, noise_seed=noise_seed, library=known, own=own)
    for note in ask(
        [*doubts_of_cell(enriched), *questions_of(samples)], accept_implausible, "check the units of the motion and of the cell file"
    ):
        say(note)
    for name, share in share_outside(enriched, columns["t_s"], **_drive(columns, measured), library=known).items():
        if share > 0.0:
            say(held_sentence(name, share))
    write_csv(csv_out, samples)
    return samples


def simulate_columns(
    cell: CellFile,
    columns: Mapping[str, Floats],
    *,
    measured: bool,
    noise_seed: int | None = None,
    library: Mapping[str, Effect] = EFFECTS,
    own: tuple[UserSimulator, CellFile] | None = None,
) -> Samples:
    """Simulate the recording that a cell gives on a motion.

    Args:
        columns: `t_s`, and `z_m` (with `vz_m_per_s` where known) or `z_cmd_m`, each (n,).
        measured: Whether the reported heights drive the cell; else the commanded heights do.
        noise_seed: Seed of noise and rounding; None: neither.
        library: The effects that the cell may name.
        own: A user's own simulator and the nominal cell that it simulates; None: palpd alone simulates.

    Raises:
        BadInput: Noise is asked for with a user's own simulator, or its seed is negative.
        RecordingError: The simulated values are not finite.
    """
    if noise_seed is not None and not (noise_seed >= 0 and noise_seed == int(noise_seed)):
        raise BadInput(f"the seed of the noise is {noise_seed}, expected a whole number from 0 on; give another")
    t_s = columns["t_s"]
    if own is None:
        out = simulate(cell, t_s, **_drive(columns, measured), noise_seed=noise_seed, library=library)
    elif noise_seed is None:
        out = simulate_with(*own, cell, columns, library, measured=measured)
    else:
        raise BadInput("noise is added to palpd's own simulation, and the nominal is your simulator's; leave --noise or --simulated out")
    refuse_values({"t_s": t_s, **out}, "the simulation")
    speed = out.get("vz_m_per_s", columns.get("vz_m_per_s") if measured else None)
    return Samples(
        t_s,
        columns.get("z_cmd_m"),
        out["z_m"],
        np.gradient(out["z_m"], t_s) if speed is None else speed,
        np.column_stack([out[name] for name in WRENCH_COLUMNS]),
    )


class _Drive(TypedDict):
    """What moves a simulated cell."""

    z_cmd_m: Floats | None
    z_m: Floats | None
    vz_m_per_s: Floats | None


def _drive(columns: Mapping[str, Floats], measured: bool) -> _Drive:
    z_m, vz_m_per_s = (columns["z_m"], columns.get("vz_m_per_s")) if measured else (None, None)
    return {"z_cmd_m": columns.get("z_cmd_m"), "z_m": z_m, "vz_m_per_s": vz_m_per_s}


def read_motion(path: Path) -> dict[str, Floats]:
    """The columns (n,) of a motion: `t_s` and at least one of `z_cmd_m`, `z_m`; `vz_m_per_s` where present.

    Raises:
        RecordingError: The file is no such motion.
    """
    columns, _ = read_columns(path, _motion_columns)
    check_motion(columns, path.name)
    return columns


def check_motion(columns: Mapping[str, Floats], name: str) -> None:
    """Check the columns of a motion.

    Args:
        columns: `t_s` and further columns, each (n,).
        name: What errors call the motion.

    Raises:
        RecordingError: There are fewer than two rows, or a value that no motion has.
    """
    refuse_values(columns, name)
    if len(columns["t_s"]) < 2:
        raise RecordingError(f"{name} has {len(columns['t_s'])} rows; a motion needs two rows or more in the order of time.")


def _motion_columns(path: Path, header: Sequence[str]) -> list[str]:
    if "t_s" not in header or not {"z_cmd_m", "z_m"} & set(header):
        raise RecordingError(f"{path.name}: column t_s and one of z_cmd_m, z_m are needed in row 0 (the header).")
    return named_once(path, header, COLUMNS[:4])


def tolerances_of(recordings: Sequence[Path], cell: Path, accept_implausible: bool = False) -> dict[str, dict[str, float]]:
    """Estimate tolerances from the files of a healthy cell.

    Args:
        accept_implausible: Whether doubtful recordings and implausible tolerances count.

    Returns:
        The blocks `tolerances` and `repeatability`, in the units of the cell file.
    """
    samples = [read(path) for path in recordings]
    return estimate_tolerances(samples, load_cell(cell).at_site(common_site(samples)), accept_implausible)
