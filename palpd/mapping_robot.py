"""The map made by the daemon: each press is a run of its own, with tare, surface search, guard and recording, where the last map says.

The field's corner is where the arm stands at the start; between runs it stays above the last place.
"""

from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from palpd import results
from palpd.cell_file import CellFile
from palpd.config import Config, Plan, load_config
from palpd.errors import RecordingError, Stopped
from palpd.mapping import Field, Survey, search, write_presses
from palpd.mapping_field import EmulatedField
from palpd.motion import Build, Job
from palpd.session import calibrate, carry_out, findings, job, kept_in
from palpd.sim import run

Place = tuple[float, float]
Press = Callable[[Place], float]
HOME_ABOVE_M = 0.012
"""Where a simulated arm begins: a search of 5 mm/s from higher only takes longer."""


def mapped(
    where: Field, out: Path, config: Path | None, emulated: bool, seed: int, console: Console
) -> tuple[Survey, tuple[float, float, float] | None, str | None]:
    """Press until the map says stop: the presses, the true inclusion of an emulated field, and why a press was stopped, if one was.

    The presses so far stand beside the picture as CSV after each of them.
    """
    survey = Survey(where)
    truth = None

    def watch(survey: Survey, found: Any) -> None:
        write_presses(out.with_suffix(".csv"), survey)
        (x_m, y_m), modulus_Pa = survey.places_m[-1], survey.moduli_Pa[-1]
        console.print(f"{len(survey.places_m):3d}  ({x_m * 1e3:2.0f}, {y_m * 1e3:2.0f}) mm  {modulus_Pa / 1e3:6.1f} kPa  {found.sentence}")

    try:
        if config is not None:
            from palpd.wiring import devices

            search(on_the_robot(where, load_config(config), devices, console), where, survey=survey, watch=watch)
        else:
            field = EmulatedField(where, seed)
            truth = field.inclusion
            if emulated:
                _on_wires(where, field, survey, watch, console)
            else:
                console.print(f"The daemon presses a simulated field, seed {seed}.")
                search(in_simulation(where, field.cell, seed), where, survey=survey, watch=watch)
    except (Stopped, RecordingError) as error:
        return survey, truth, str(error)
    return survey, truth, None


def plan_at(way_m: Place, where: Field) -> Plan:
    """One press in motion, that far from where the arm stands. A press that nears the contact limit ends early and still has a modulus."""
    return Plan.model_validate(
        {"sites": [{"name": "place", "x_m": way_m[0], "y_m": way_m[1]}], "mode": "dynamic", "depths_m": [where.depth_m], "repeats": 1}
    )


def on_the_robot(where: Field, config: Config, build: Build, console: Console) -> Press:
    """Presses by the daemon on what `build` opens: a cell, or emulated wires. A press raises Stopped where its run was not done."""
    began = datetime.now()
    stands: list[Place] = [(0.0, 0.0)]

    def press(place_m: Place) -> float:
        way_m = (place_m[0] - stands[-1][0], place_m[1] - stands[-1][1])
        name = f"{began:%Y%m%d-%H%M%S}-map-{len(stands):03d}"
        report = carry_out(job("palpation", config, plan_at(way_m, where)), build, console, name)
        if report.exit_code:
            raise Stopped(f"the press at {_told(place_m)} was stopped: {report.reason}")
        stands.append(place_m)
        return _modulus_of(findings(report)["sites"][0], place_m)

    return press


def in_simulation(where: Field, cell_of: Callable[[int], CellFile], seed: int) -> Press:
    """Presses by the daemon's loop on the physics of `cell_of(press)`, faster than real time; each begins at the field's corner."""
    count = 0

    def press(place_m: Place) -> float:
        nonlocal count
        count += 1
        work = Job("palpation", Config(), plan_at(place_m, where))
        done = run(work, cell_of(count), seed=1000 * seed + count, home_above_m=HOME_ABOVE_M)
        if done.outcome.verdict != "done":
            raise Stopped(f"the press at {_told(place_m)} was stopped: {done.outcome.reason}")
        return _modulus_of(results.sites(done.rows, done.header)[0], place_m)

    return press


def _on_wires(where: Field, field: EmulatedField, survey: Survey, watch: Callable[[Survey, Any], None], console: Console) -> None:
    """The same field behind real drivers and emulated wires; runs and state are kept in a folder of their own."""
    from palpd.demo import cell_on_wires
    from palpd.wiring import devices

    folder = kept_in(Path("runs"), "map")
    console.print(f"A UR5 and a HEX-70 are emulated; recordings are kept in {folder}.")
    with cell_on_wires(field.cell(0), folder) as config:
        calibrate(config, devices, console)
        search(on_the_robot(where, config, devices, console), where, survey=survey, watch=watch)


def _modulus_of(site: dict[str, Any], place_m: Place) -> float:
    found: float | None = site["dynamic_corrected_Pa"]
    if found is None:
        raise RecordingError(f"the press at {_told(place_m)} has no force peak below the surface; look at its recording")
    return found


def _told(place_m: Place) -> str:
    return f"({place_m[0] * 1e3:.0f}, {place_m[1] * 1e3:.0f}) mm"
