"""The stiffness map made by the daemon. Each press is a run of its own, with tare, surface search, guard and recording.

The arm stands above the field's corner at the start, and every run returns there.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Literal, TypedDict

from palpd.analysis import results
from palpd.analysis.results import SiteResult
from palpd.analysis.stiffness_map import Field, Map, Survey, search, write_presses
from palpd.cell.cell_file import CellFile
from palpd.config import Config, Plan
from palpd.daemon.display import Display
from palpd.daemon.motion_job import Job
from palpd.daemon.program_host import ProgramHost
from palpd.daemon.run_result import run_result
from palpd.daemon.session import ForegroundHost, calibrate, kept_in
from palpd.daemon.simulated_run import run
from palpd.errors import RecordingError, Refused, Stopped
from palpd.quantities import kilopascals
from palpd.study.inclusion_field import EmulatedField

Place = tuple[float, float]
Press = Callable[[Place], float]
MOST_PRESSES = 200
"""Largest number of presses of a map: a raster of 5 mm over the standard field has 169."""
NUMBER = re.compile(r"[\d.+-]+")
HOME_ABOVE_M = 0.012
"""Height above the surface at which a simulated arm begins. From higher, a search at 5 mm/s only takes longer."""


@dataclass(frozen=True, slots=True)
class Mapped:
    """A finished or interrupted survey. `stop_reason` is empty unless a press was stopped.

    `true_inclusion_m` is the x, y and radius of the inclusion; only an emulated field knows it.
    """

    survey: Survey
    true_inclusion_m: tuple[float, float, float] | None = None
    stop_reason: str = ""


class MapFigures(TypedDict):
    """The JSON of `palpd map`: `places_m` and `moduli_Pa` are the presses."""

    presses: int
    done: bool
    found_m: tuple[float, float] | None
    next_m: tuple[float, float]
    background_Pa: float
    sentence: str
    true_inclusion_m: tuple[float, float, float] | None
    verdict: Literal["done", "stopped"]
    reason: str
    places_m: list[Place]
    moduli_Pa: list[float]


def figures_of(mapped: Mapped) -> MapFigures:
    """What a survey says, for JSON."""
    survey, result = mapped.survey, mapped.survey.map()
    return {
        "presses": len(survey.places_m),
        "done": result.done,
        "found_m": result.found_m,
        "next_m": result.next_m,
        "background_Pa": result.background_Pa,
        "sentence": result.sentence,
        "true_inclusion_m": mapped.true_inclusion_m,
        "verdict": "stopped" if mapped.stop_reason else "done",
        "reason": mapped.stop_reason,
        "places_m": survey.places_m,
        "moduli_Pa": survey.moduli_Pa,
    }


def mapped(where: Field, out: Path, emulated: bool, seed: int, display: Display, most: int = MOST_PRESSES) -> Mapped:
    """Press an emulated or simulated field until the map is certain.

    Args:
        out: The picture.
        emulated: Whether to press on emulated wires instead of in simulation.
        display: Shows the presses.
        most: Largest number of presses.

    Returns:
        The survey, also where a press was stopped.
    """
    field = EmulatedField(where, seed)
    if emulated:
        return replace(_on_wires(where, field, out, display, most), true_inclusion_m=field.inclusion)
    display.say(f"The daemon presses a simulated field, seed {seed}.")
    return replace(surveyed(in_simulation(where, field.cell, seed), where, out, display, most), true_inclusion_m=field.inclusion)


def surveyed(press: Press, where: Field, out: Path, display: Display, most: int = MOST_PRESSES) -> Mapped:
    """Press until the map is certain. After each press, a CSV beside the picture holds all presses so far.

    Args:
        press: Presses one place and returns its modulus in Pa.
        most: Largest number of presses.

    Returns:
        The survey, also where a press was stopped.
    """
    survey = Survey(where)

    def show_press(survey: Survey, estimate: Map) -> None:
        write_presses(out.with_suffix(".csv"), survey)
        (x_m, y_m), modulus_Pa = survey.places_m[-1], survey.moduli_Pa[-1]
        where_mm = f"({x_m * 1e3:2.0f}, {y_m * 1e3:2.0f}) mm"
        display.say(f"{len(survey.places_m):3d}  {where_mm}  {kilopascals(modulus_Pa):>6} kPa  {estimate.sentence}")

    try:
        search(press, where, most, survey, show_press)
    except (Stopped, RecordingError, Refused) as error:
        if isinstance(error, Refused) and not survey.places_m:  # nothing was pressed, and nothing moved
            raise
        return Mapped(survey, stop_reason=str(error))
    return Mapped(survey)


def plan_at(place_m: Place, where: Field) -> Plan:
    """One press in motion. A press that nears the contact limit ends early and still has a modulus.

    Args:
        place_m: Way from the field's corner to the place, x and y.
        where: The field, for the depth.
    """
    return Plan.model_validate(
        {"sites": [{"name": "place", "x_m": place_m[0], "y_m": place_m[1]}], "mode": "dynamic", "depths_m": [where.depth_m], "repeats": 1}
    )


def on_the_robot(where: Field, host: ProgramHost, here: bool = False) -> Press:
    """Presses by the daemon on a cell or on emulated wires.

    Args:
        host: Carries out each press. Its display shows what makes a modulus doubtful, each kind of note once.
        here: The operator's word that the field's corner is where the arm stands, whatever palpation was not finished.

    Returns:
        The function that presses one place and returns its modulus in Pa.

    Raises:
        Stopped: By that function, where the run was stopped.
    """
    began = datetime.now()
    count, kinds = 0, set[str]()

    def press(place_m: Place) -> float:
        nonlocal count
        count += 1
        recording = host.config.paths.runs / f"{began:%Y%m%d-%H%M%S}-map-{count:03d}.mcap"
        report = host.carry_out("palpation", plan_at(place_m, where), recording, here=here)
        if report.exit_code:
            raise Stopped(f"the press at {_millimetres(place_m)} was stopped: {report.reason}")
        result = run_result(report)
        for note in result["notes"]:
            if (kind := NUMBER.sub("", note)) not in kinds:
                kinds.add(kind)
                host.display.say(f"note, the first of its kind, at {_millimetres(place_m)}: {note}")
        return _modulus_of(result["sites"][0], place_m)

    return press


def in_simulation(where: Field, cell_of: Callable[[int], CellFile], seed: int) -> Press:
    """Presses by the daemon's loop on simulated cells, faster than real time; each begins at the field's corner.

    Args:
        cell_of: The cell under each place, by the number of the press.
        seed: Seed of the noise.

    Returns:
        The function that presses one place and returns its modulus in Pa.

    Raises:
        Stopped: By that function, where the run was stopped.
    """
    count = 0

    def press(place_m: Place) -> float:
        nonlocal count
        count += 1
        work = Job("palpation", Config(), plan_at(place_m, where))
        simulated = run(work, cell_of(count), seed=1000 * seed + count, home_above_m=HOME_ABOVE_M)
        if simulated.outcome.verdict != "done":
            raise Stopped(f"the press at {_millimetres(place_m)} was stopped: {simulated.outcome.reason}")
        return _modulus_of(results.sites(simulated.rows, simulated.header)[0], place_m)

    return press


def _on_wires(where: Field, field: EmulatedField, out: Path, display: Display, most: int) -> Mapped:
    """Press the field behind real drivers and emulated wires; runs and state are kept in a folder of their own."""
    from palpd.daemon.demo import cell_on_wires
    from palpd.daemon.wiring import devices

    folder = kept_in(Path("runs"), "map")
    display.say(f"A UR5 and a HEX-70 are emulated; recordings are kept in {folder}.")
    with cell_on_wires(field.cell(0), folder) as config:
        host = ForegroundHost(config, devices, display)
        calibrate(host)
        return surveyed(on_the_robot(where, host), where, out, display, most)


def _modulus_of(site: SiteResult, place_m: Place) -> float:
    modulus_Pa: float | None = site["dynamic_corrected_Pa"]
    if modulus_Pa is None:
        raise RecordingError(f"the press at {_millimetres(place_m)} has no force peak below the surface; look at its recording")
    return modulus_Pa


def _millimetres(place_m: Place) -> str:
    return f"({place_m[0] * 1e3:.0f}, {place_m[1] * 1e3:.0f}) mm"
