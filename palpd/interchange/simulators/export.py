"""Write a cell for another simulator: a folder that appears whole, after its rollout has been compared with palpd's own simulation."""

import json
import runpy
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from hashlib import sha256
from importlib.metadata import version
from importlib.util import find_spec
from math import ceil, isfinite
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple

import numpy as np

from palpd.cell.cell_file import CellFile, save_cell
from palpd.cell.effects import EFFECTS, Effect
from palpd.cell.effects.effect import SITES, Site
from palpd.cell.effects.learned import learned_law_of
from palpd.cell.motion_profile import Move, commanded_heights
from palpd.cell.physics import physics, place_named
from palpd.cell.simulation import simulate
from palpd.cell.span import Constants
from palpd.cell.stages import reporting_of
from palpd.errors import BadInput, ConfigError
from palpd.files import check_folder, copy_file, write_text
from palpd.interchange.simulators.bundle import Definition, bundled
from palpd.interchange.simulators.exported_cell import COLUMNS, at_rows, row_times
from palpd.interchange.simulators.readme import TEMPLATES, Agreement, readme
from palpd.tick import Floats

Target = Literal["mujoco", "fmu"]
NEEDS: dict[Target, str] = {"mujoco": "mujoco", "fmu": "pythonfmu3"}
OTHER_SIMULATORS = (
    "fmu is for programs that load FMI 3.0, and those whose Python may load fmpy; Isaac Sim, Gazebo, Simulink and Drake were not tried. "
    "Any simulator can be compared with a recording: palpd diagnose --simulated FILE (docs/what-works.md)"
)
"""What does work, for whoever asks for another simulator."""
HERE = Path(__file__).parent

LONGEST_STEP_S, STEP_OF_SERVO = 0.002, 0.25
"""Longest step of the simulators, and that times the angular frequency of the servo: MuJoCo's integrator follows it to 1e-5."""
SHORTEST_STEP_S = 5e-5
"""Shortest step: ten seconds then take minutes."""

MOST_OFF = 0.2
"""Largest rms difference to palpd's simulation, in rms of the stated noise of the channel, at which an export is written."""

CLEARANCE_M, DEPTH_OF_RADIUS, MOST_DEPTH_M, MOST_FORCE_N = 0.005, 0.3, 0.01, 5.0
"""The example motion starts that far above the surface, and presses to that share of the tip's radius, that depth or that force,
whichever is least."""

ROBOT_KG = 1e5
"""Armature of the slide: 10 N of contact then move the tip by less than 0.1 µm."""

LATE_READINGS = 3
"""Readings that the engine's buffer holds beyond the delay: the two that it interpolates between, and the newest."""


class Exported(NamedTuple):
    """What was written: the folder, the number of drawn cells, and how well the rollout agrees with palpd."""

    folder: Path
    draws: int
    agreement: Agreement


def export_cell(
    cell: CellFile,
    target: Target,
    folder: Path,
    *,
    draws: Sequence[CellFile] = (),
    library: Mapping[str, Effect] = EFFECTS,
    site: str | None = None,
) -> Exported:
    """Write a folder with a cell for another simulator.

    Args:
        folder: Folder to write; it must not exist, or be empty.
        draws: Further cells, drawn from what a diagnosis left open.
        site: Name of a site of the cell, or None for the cell's own tissue.

    Returns:
        What was written.

    Raises:
        BadInput: The folder holds something, a package is missing, an effect cannot be exported or is outside its range, or the rollout
            differs from palpd's simulation.
    """
    check_target(target, folder)
    for one in (cell, *draws):
        check_ranges(one, library)
    numbers = [_numbers(one, library, site) for one in (cell, *draws)]
    definitions, laws = _laws((cell, *draws), library, site)
    with _appearing(folder) as place:
        write_text(place / "cells.json", json.dumps({"cells": numbers}, indent=1) + "\n")
        save_cell(place / "cell.yaml", cell)
        if draws:
            (place / "draws").mkdir()
        for k, one in enumerate(draws, 1):
            save_cell(place / "draws" / f"draw-{k:03d}.yaml", one)
        t_s, z_cmd_m = motion = example_motion(cell, site, library)
        np.savetxt(place / "motion.csv", np.column_stack(motion), "%.9g", ",", header="t_s,z_cmd_m", comments="")
        rows = _WRITERS[target](place, _Content(cell, numbers, definitions, laws, motion))
        agreement = agreement_of(cell, rows, simulate(cell, t_s, z_cmd_m=z_cmd_m, library=library, site=site))
        _require(agreement, cell)
        write_text(place / "README.md", readme(target, cell, numbers[0], len(draws), agreement))
    return Exported(folder, len(draws), agreement)


def check_target(target: Target, folder: Path) -> None:
    """Refuse what cannot become an export before any work begins.

    Args:
        target: The simulator.

    Raises:
        BadInput: A package is missing, or the folder holds something or cannot be written.
    """
    if find_spec(NEEDS[target]) is None:
        raise BadInput(f"--to {target} needs {NEEDS[target]}, which is not installed; install palpd[sim] (pip install 'palpd[sim]')")
    check_folder(folder, empty=True)


@contextmanager
def _appearing(folder: Path) -> Iterator[Path]:
    """A folder that appears whole when the block ends, and not at all where it raises."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    place = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        yield place
        shutil.rmtree(place / "__pycache__", ignore_errors=True)
        place.chmod(0o755)
        if not folder.exists() or not any(folder.iterdir()):
            place.replace(folder)
            return
        for file in filter(Path.is_file, place.rglob("*")):
            (folder / file.relative_to(place)).parent.mkdir(exist_ok=True)
            copy_file(file, folder / file.relative_to(place))
    except OSError as error:
        raise BadInput(f"{folder} cannot be written ({error.strerror}); give another --out") from error
    finally:
        shutil.rmtree(place, ignore_errors=True)


# what a cell is in numbers


def check_ranges(cell: CellFile, library: Mapping[str, Effect] = EFFECTS) -> None:
    """Refuse a parameter outside the range in which its law means something; a range that depends on a recording is not judged.

    Raises:
        ConfigError: A parameter is outside.
    """
    for effects in (cell.effects, *(site.effects for site in cell.sites)):
        for name, values in effects.items():
            for parameter in library[name].named_parameters:
                if parameter.name not in values:
                    continue
                value = values[parameter.name]
                lower = parameter.lower if isinstance(parameter.lower, int | float) else -np.inf
                upper = parameter.upper if isinstance(parameter.upper, int | float) else np.inf
                if not lower <= value <= upper or (parameter.log and value <= 0.0):
                    least = "more than 0" if (parameter.log and lower <= 0.0) or lower == -np.inf else f"{lower:g} or more"
                    expected = least if upper == np.inf else f"{lower:g} to {upper:g}"
                    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
                    raise ConfigError(f"{name}.{parameter.name} is {value:g}{unit}, expected {expected}; correct the cell file")


def _numbers(cell: CellFile, library: Mapping[str, Effect], site: str | None) -> dict[str, Any]:
    """The numbers of a cell, as `cells.json` holds them."""
    what = physics(cell, place_named(cell, site), library)
    constants = asdict(what.constants)
    del constants["simulator"]  # a user's own, which this one is not
    if constants["surface_z_m"] == -np.inf:
        constants["surface_z_m"] = -1e3  # nothing in reach
    return {
        "constants": {key: value if isfinite(value) else None for key, value in constants.items()},
        "laws": {law.id: dict(law.values) for place in SITES for law in what.laws.get(place, ())},
        "reporting": reporting_of(cell)._asdict(),
        "step_s": step_of(cell.sensor.rate_Hz, what.constants.servo_natural_frequency_Hz),
        "start_z_m": start_height_m(what.constants),
    }


def step_of(rate_Hz: float, servo_natural_frequency_Hz: float) -> float:
    """The step of the simulators: the period of the sensor, or a whole part of it.

    Returns:
        The step in s.

    Raises:
        ConfigError: It would be too short.
    """
    longest_s = min(LONGEST_STEP_S, STEP_OF_SERVO / (2.0 * np.pi * servo_natural_frequency_Hz))
    step_s = 1.0 / (rate_Hz * max(ceil(1.0 / (rate_Hz * longest_s) - 1e-9), 1))
    if step_s < SHORTEST_STEP_S:
        raise ConfigError(
            f"a sensor at {rate_Hz:g} Hz and a servo at {servo_natural_frequency_Hz:g} Hz need steps of {step_s:.2g} s, expected "
            f"{SHORTEST_STEP_S:g} s or more; correct sensor.rate_Hz and robot in the cell file"
        )
    return step_s


def start_height_m(c: Constants) -> float:
    """Where the tip starts: above whatever it may touch.

    Args:
        c: Numbers of the cell.
    """
    touched = [c.surface_z_m] if c.surface_z_m > -1e3 else []
    return max([*touched, *([c.wall_z_m] if c.wall_stiffness_N_per_m else [])], default=0.0) + CLEARANCE_M


def example_motion(cell: CellFile, site: str | None = None, library: Mapping[str, Effect] = EFFECTS) -> tuple[Floats, Floats]:
    """Two presses that any cell can take: a slow one with a hold, and a faster one.

    Args:
        site: Name of a site of the cell, or None for the cell's own tissue.

    Returns:
        Times (n,) in s and commanded heights (n,) in m, in the steps of the simulators.
    """
    c = physics(cell, place_named(cell, site), library).constants
    start_m, depth_m = start_height_m(c), min(DEPTH_OF_RADIUS * c.tip_radius_m, MOST_DEPTH_M)
    if c.youngs_modulus_Pa > 0.0:
        depth_m *= min(1.0, (MOST_FORCE_N / float(c.elastic_force_N(np.array([depth_m]))[0])) ** (2.0 / 3.0))
    if c.wall_stiffness_N_per_m:
        depth_m = min(depth_m, MOST_FORCE_N / c.wall_stiffness_N_per_m)
    low_m, step_s = start_m - CLEARANCE_M - depth_m, step_of(cell.sensor.rate_Hz, c.servo_natural_frequency_Hz)
    moves = [Move(start_m, 0.01, 0.2), Move(low_m, 0.004, 0.8), Move(start_m, 0.008, 0.2), Move(low_m, 0.02, 0.1), Move(start_m, 0.02, 0.3)]
    moved_m, _ = commanded_heights(start_m, moves, step_s)
    heights_m = np.concatenate(([start_m], moved_m))
    return np.arange(len(heights_m), dtype=np.float64) * step_s, heights_m


def _laws(cells: Sequence[CellFile], library: Mapping[str, Effect], site: str | None) -> tuple[list[Definition], str]:
    """What an export needs of palpd for the laws of its cells, and the lines that list them."""
    acting = {law.id for cell in cells for place in physics(cell, place_named(cell, site), library).laws.values() for law in place}
    learned = {one.id: one for cell in cells for one in cell.learned}
    definitions: list[Definition] = []
    lines = []
    for name in [*(name for name in library if name in acting), *learned]:
        law = learned.get(name) or learned_law_of(library[name])
        if law is not None:
            definitions.append((Path(str(find_spec("palpd.cell.effects.learned").origin)), "LearnedEffect"))  # type: ignore[union-attr]
            stands_at: Site = law.site
            shown = f"LearnedEffect.model_validate({law.model_dump(mode='json', exclude_none=True)!r}).act"
        else:
            definition = _plain_function(library[name])
            definitions.append(definition)
            shown, stands_at = definition[1], library[name].site
        lines.append(f"    {name!r}: ({stands_at!r}, {shown}),")
    return definitions, "\n".join(("LAWS.update({", *lines, "})")) if lines else ""


def _plain_function(effect: Effect) -> Definition:
    """The file and the name of an effect's law. Raises BadInput where it has none that can be copied."""
    code = getattr(effect.law, "__code__", None)
    if code is None or code.co_name == "<lambda>" or "<locals>" in code.co_qualname:
        raise BadInput(
            f"the law of {effect.id} is no function at the top of a file, so it cannot be copied; write it as one (docs/examples/), "
            "or leave the effect out of the cell"
        )
    return Path(code.co_filename), code.co_name


# what stands in the folder


def _origin() -> str:
    return (
        f"Written by palpd export-sim (palpd {version('palpd')}, MIT licence). The laws are palpd's own source, word by word, and\n"
        "only those that the cells of this folder need. The numbers of the cells stand in cells.json."
    )


@dataclass(frozen=True)
class _Content:
    """What a folder is written from: numbers of the cells, what they need of palpd, and the motion that the rollout is judged on."""

    cell: CellFile
    numbers: list[dict[str, Any]]
    definitions: list[Definition]
    laws: str
    motion: tuple[Floats, Floats]


def _write_mujoco(place: Path, content: _Content) -> Floats:
    """Write model and callback; the rows (n, 8) that they give on the motion."""
    write_text(place / "cell.xml", model_xml(content.numbers, content.cell.probe.tip_length_m))
    module = place / "palpd_cell.py"
    write_text(module, bundled(HERE / "mujoco_cell.py", content.definitions, content.laws, _origin()))
    try:
        rows: Floats = runpy.run_path(str(module))["rollout"](*content.motion)
    except ValueError as error:
        why = ", ".join(str(error).splitlines())
        raise BadInput(f"MuJoCo takes no model of this cell ({why}); correct the sizes of probe and tissue in the cell file") from error
    return rows


def model_xml(numbers: Sequence[Mapping[str, Any]], tip_length_m: float) -> str:
    """The MJCF of cells that differ in their numbers only.

    Args:
        numbers: Cells of `cells.json`, the exported one first.
        tip_length_m: Distance from the sensor to the tip.
    """
    first, c = numbers[0], numbers[0]["constants"]
    radius_m, length_m = c["tip_radius_m"], max(tip_length_m, c["tip_radius_m"])
    tissue_z_m = c["wall_z_m"] if c["wall_stiffness_N_per_m"] else c["surface_z_m"]
    readings = ceil(max(0.0, *(one["constants"]["delay_s"] for one in numbers)) / first["step_s"]) + LATE_READINGS
    return TEMPLATES.get_template("cell.xml.j2").render(
        first=first, radius_m=radius_m, length_m=length_m, tissue_z_m=tissue_z_m, readings=readings, robot_kg=ROBOT_KG, columns=COLUMNS[1:]
    )


def _write_fmu(place: Path, content: _Content) -> Floats:
    """Write the FMU and its rollout; the rows (n, 8) that its slave gives on the motion."""
    from pythonfmu3 import FmuBuilder

    text = bundled(HERE / "fmu_cell.py", content.definitions, content.laws, _origin())
    write_text(place / "rollout.py", bundled(HERE / "fmu_rollout.py", [], "", _origin()))
    with tempfile.TemporaryDirectory() as folder:
        # Python keeps modules by name, so two FMUs in one process need two names.
        module = Path(folder) / f"palpd_cell_{sha256(text.encode()).hexdigest()[:12]}.py"
        write_text(module, text)
        shutil.copy(place / "cells.json", folder)
        sys.modules[module.stem] = ModuleType(module.stem)  # the builder runs the file without entering it here, as dataclasses expect
        try:
            FmuBuilder.build_FMU(module, dest=place, project_files=[place / "cells.json"])
        finally:
            del sys.modules[module.stem]
        return _driven(runpy.run_path(str(module))["PalpdCell"](instance_name="judged", resources=folder), content)


def _driven(slave: Any, content: _Content) -> Floats:
    """What a slave reports, driven as a master drives an FMU that steps as fast as the sensor."""
    t_s, z_cmd_m = content.motion
    numbers = content.numbers[0]
    slave.z_cmd_m = float(z_cmd_m[0])
    slave.exit_initialization_mode()
    step_s, rows_s = numbers["step_s"], row_times(t_s, numbers)
    times_s = np.arange(ceil(rows_s[-1] / step_s - 1e-6) + 1) * step_s
    values = [[getattr(slave, name) for name in COLUMNS]]
    for now_s in times_s[:-1].tolist():
        slave.z_cmd_m = float(np.interp(now_s, t_s, z_cmd_m))
        slave.do_step(now_s, step_s)
        values.append([getattr(slave, name) for name in COLUMNS])
    return at_rows(rows_s, times_s, np.array(values), noisy=False)


_WRITERS: dict[Target, Callable[[Path, _Content], Floats]] = {"mujoco": _write_mujoco, "fmu": _write_fmu}


# how good it is


def agreement_of(cell: CellFile, rows: Floats, expected: Mapping[str, Floats]) -> Agreement:
    """How far a rollout is from palpd's own simulation, in rms of the stated noise of each channel.

    Args:
        rows: Values (n, 8) of COLUMNS.
        expected: The columns (n,) of palpd's simulation.
    """
    sensor, robot = cell.sensor, cell.robot
    torque_Nm = sensor.noise_rms_Nm or sensor.noise_rms_N * cell.probe.tip_length_m
    noise = dict.fromkeys(COLUMNS[2:5], sensor.noise_rms_N) | dict.fromkeys(COLUMNS[5:], torque_Nm)
    noise |= {"z_m": robot.position_noise_rms_m or 5e-6, "vz_m_per_s": robot.velocity_noise_rms_m_per_s or 2e-4}
    with np.errstate(over="ignore"):  # a difference that is too large for a number is infinite, and refused as such
        off = {name: float(np.sqrt(np.mean((rows[:, k] - expected[name]) ** 2))) / noise[name] for k, name in enumerate(COLUMNS)}
    return Agreement(off, max(off, key=lambda name: off[name]))


def _require(agreement: Agreement, cell: CellFile) -> None:
    """Refuse an export that is not the cell."""
    if not agreement.worst <= MOST_OFF:
        names = ", ".join([*cell.effects, *(one.id for one in cell.learned)]) or "no effect"
        raise BadInput(
            f"the rollout of this cell ({names}) differs from palpd's simulation by {agreement.worst:.2g} times the noise of "
            f"{agreement.channel}, expected at most {MOST_OFF:g}; nothing was written, so use palpd simulate for it"
        )
