"""Section 4 of Guo, Xiao, Ren 2019 done again: free motion, training, static and dynamic palpation, moduli and their bias.

On the emulated cell (`simulated`) or on recordings of a real one (`recorded`); both take the same path.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from palpd.analysis.enriched import enriched_modulus
from palpd.analysis.inclusion import FEWEST_HOLDS, FORCE_SIGMA_N, Inclusion, find_inclusion
from palpd.analysis.results import peak_width
from palpd.analysis.results import sites as site_results
from palpd.analysis.stiffness_map import Field, Map, Survey, search
from palpd.analysis.young import modulus_peak_Pa, ymbt
from palpd.cell.cell_file import PHANTOM, CellFile
from palpd.cell.motion_profile import Move, commanded_heights
from palpd.compensation.refusals import refuse_other_probe
from palpd.control.sequence import CLEAR_SHARE
from palpd.errors import BadInput, RecordingError
from palpd.gap.diagnosis import diagnose
from palpd.recording.reader import Recording
from palpd.recording.tick_rows import filled_slots
from palpd.study.inclusion_field import EmulatedField
from palpd.study.laboratory import STEP_S, Take, free_cell, setup, take
from palpd.study.methods import ConstantBias, ExportedModel, LinearModelWithRunningZero, Method, NoCorrection, corrections
from palpd.study.published import MEAN_FREE_N, POISSON_RATIO, SETUPS, STROKE_M, STROKE_S, TIP_RADIUS_M, static
from palpd.tick import Floats, Mode, Phase

DEPTHS_M = tuple(float(d) for d in static("A")[0])
PRESSES = 10
REPEATS = 10
DYNAMIC_DEPTH_M = 0.00373
"""Depth at which the published correction of the modulus and the published mean force of free motion agree (`depth_of_peaks_m`)."""
PAPER_SPEED_M_PER_S = STROKE_M / (STROKE_S - 0.1)
"""2 cm in 4 s; ramps and rest take 0.1 s of that."""
REST_M = STROKE_M - DYNAMIC_DEPTH_M
ZERO_MISS_M = {"A": 0.0005, "B": 0.0, "C": 0.0, "D": 0.0}
"""How far above the zero of depth the surface is: what Table 1 says of setup A, and of D that it is nothing."""
ZERO_SIGMA_M = 0.0005
"""One sigma of the zero of depth: the error that Table 1 shows for setup A."""
RATE_RATIO = {"A": 0.354, "B": 0.297, "C": 0.261, "D": 0.133}
RATE_TAU_S = 1.0
"""A standard linear solid of one second; its ratio makes the original YMBT that of Table 3. The paper gives no relaxation."""
BIAS_N = MEAN_FREE_N["with the probe"]
BIAS_BETWEEN_DAYS_N = 0.03
WARMUP_N, WARMUP_S = 0.05, 600.0
HYSTERESIS = {"width_N": 1.0, "amplitude_N": 0.02}
NAMED = (
    (
        "sensor.bias",
        f"{BIAS_N:g} N after the tare of a dynamic series, ± {BIAS_BETWEEN_DAYS_N:g} N from day to day",
        "mean force of free motion, section 4.2",
    ),
    (
        "sensor.warmup",
        f"up to ± {WARMUP_N:g} N over {WARMUP_S / 60:g} minutes",
        "data sheets give none; a cold HEX-E drifts by 0.82 N in 90 minutes",
    ),
    ("sensor.hysteresis", f"± {HYSTERESIS['amplitude_N']:g} N", "data sheet: below 2 % of 200 N"),
    ("rounding", "131 mN a count on Fz, each tare with a rounding error of its own", "data sheet: 125 to 133 mN"),
    ("zero of depth", "0.5 mm below the surface in setup A", "Table 1 against Hertz (docs/paper.md)"),
    (
        "tissue.viscoelastic",
        ", ".join(f"{name}: {ratio:.0%}" for name, ratio in RATE_RATIO.items()) + f", relaxing in {RATE_TAU_S:g} s",
        "fitted to Table 3's original YMBT",
    ),
    ("tissue.inclusion", "setups B and C, as the phantom's cell file has them", "fitted to Table 1"),
)
"""Effects that make this cell read like the paper's: effect, size, source."""


@dataclass(frozen=True, slots=True)
class Hold:
    """A static palpation: depth below the zero, mean force, modulus by equation 1."""

    depth_m: float
    force_N: float
    youngs_modulus_Pa: float


@dataclass(frozen=True)
class Palpated:
    """What was recorded of one setup. `presses` are the spans of samples of `dynamic`; depths count from `zero_z_m`.

    `enriched` is the cell file of a diagnosis of another recording, if there is one.
    """

    name: str
    holds: list[Hold]
    dynamic: Take
    presses: list[slice]
    zero_z_m: float = 0.0
    enriched: CellFile | None = None


@dataclass(frozen=True)
class Data:
    """All recordings: free motion without and with the probe, and the setups."""

    bare: list[Take]
    free: list[Take]
    setups: list[Palpated]
    simulated: bool


@dataclass(frozen=True)
class Peak:
    """One dynamic palpation: when and how deep its largest reading was, the forces and moduli there by method."""

    t_s: float
    depth_m: float
    force_N: dict[str, float]
    youngs_modulus_Pa: dict[str, float]


@dataclass(frozen=True)
class Judged:
    """One setup, evaluated.

    `modulus_Pa` and `ymbt` are by method; the enriched cell's modulus is the static one that it predicts. `inclusion` is the result of
    its holds, where there are enough of them.
    """

    palpated: Palpated
    corrected_N: dict[str, Floats]
    peaks: list[Peak]
    static_Pa: float
    modulus_Pa: dict[str, float]
    ymbt: dict[str, float]
    inclusion: Inclusion | None


NONE, BIAS, NETWORK, LINE, WINNER = "none", "bias only", "the paper's network", "m·a + bias", "m·a + running zero"
TRUTH = "the true contact force (known to the emulator only)"
ENRICHED = "enriched cell, bias fitted"
METHODS = (NONE, BIAS, NETWORK, LINE, WINNER)
MAP_SEED = 1
"""The field whose map is shown."""


@dataclass
class Study:
    """A whole study.

    `days` holds YMBT (methods by setup) of further days, by the same models; `field` a mapped field, its map, and the true centre and
    radius of its inclusion.
    """

    data: Data
    cards: dict[str, dict[str, Any]]
    setups: list[Judged]
    days: list[dict[str, dict[str, float]]] = field(default_factory=list)
    mapped: tuple[Survey, Map, tuple[float, float, float] | None] | None = None


def fitted(free: Sequence[Take]) -> dict[str, Method]:
    """The methods, learned from free motion."""
    methods: dict[str, Method] = {
        NONE: NoCorrection(),
        BIAS: ConstantBias(),
        NETWORK: ExportedModel("network", NETWORK),
        LINE: ExportedModel("linear", LINE),
        WINNER: LinearModelWithRunningZero(),
    }
    for method in methods.values():
        method.fit(free)
    return methods


def evaluate(data: Data, methods: dict[str, Method]) -> list[Judged]:
    """Evaluate every setup.

    Args:
        data: The recordings.
        methods: Methods that have learned, by name.

    Returns:
        Peaks, moduli and YMBT by setup.
    """
    return [_judged(palpated, methods) for palpated in data.setups]


def _judged(palpated: Palpated, methods: dict[str, Method]) -> Judged:
    run = palpated.dynamic
    corrected_N = {name: run.fz_N - corrections(method, run) for name, method in methods.items()}
    if np.isfinite(run.contact_N).all():
        corrected_N[TRUTH] = run.contact_N
    peaks = [_peak(palpated, corrected_N, span) for span in palpated.presses]
    static_Pa = float(np.mean([hold.youngs_modulus_Pa for hold in palpated.holds]))
    modulus_Pa = {name: float(np.mean([peak.youngs_modulus_Pa[name] for peak in peaks])) for name in corrected_N}
    if palpated.enriched is not None:
        by_enriched = enriched_modulus([run.samples()], palpated.enriched)
        modulus_Pa[ENRICHED] = by_enriched.static_Pa([hold.depth_m for hold in palpated.holds], palpated.zero_z_m)
    biases = {name: ymbt(value, static_Pa) for name, value in modulus_Pa.items()}
    return Judged(palpated, corrected_N, peaks, static_Pa, modulus_Pa, biases, inclusion_below(palpated.holds))


def inclusion_below(holds: Sequence[Hold], force_sigma_N: float = FORCE_SIGMA_N) -> Inclusion | None:
    """Evidence of an inclusion in the static holds of a setup, or None with too few depths."""
    if len({hold.depth_m for hold in holds}) < FEWEST_HOLDS:
        return None
    depths_m, forces_N = [hold.depth_m for hold in holds], [hold.force_N for hold in holds]
    return find_inclusion(depths_m, forces_N, surface_sigma_m=ZERO_SIGMA_M, force_sigma_N=force_sigma_N)


def _peak(palpated: Palpated, corrected_N: dict[str, Floats], span: slice) -> Peak:
    """The largest mean of 20 ms of the reading."""
    run = palpated.dynamic
    width = peak_width(run.t_s)
    mean = np.convolve(run.fz_N[span], np.full(width, 1.0 / width), mode="valid")
    first = span.start + int(np.argmax(mean))
    window = slice(first, first + width)
    depth_m = palpated.zero_z_m - float(run.z_m[window].mean())
    forces = {name: float(values[window].mean()) for name, values in corrected_N.items()}
    moduli = {name: modulus_peak_Pa(force, depth_m, TIP_RADIUS_M, POISSON_RATIO) for name, force in forces.items()}
    return Peak(float(run.t_s[window].mean()), depth_m, forces, moduli)


# the emulated cell


def study_cell(name: str) -> CellFile:
    """The true cell of a setup: the phantom, the zero of depth that the paper took, and the rate dependence that Table 3 asks for."""
    cell = setup(name, PHANTOM)
    assert cell.tissue is not None
    tissue = cell.tissue.model_copy(update={"surface_z_m": ZERO_MISS_M[name]})
    rate = {"tissue.viscoelastic": {"ratio": RATE_RATIO[name], "tau_s": RATE_TAU_S}, "sensor.hysteresis": HYSTERESIS}
    return cell.model_copy(update={"tissue": tissue, "effects": cell.effects | rate})


def believed_cell(name: str) -> CellFile:
    """The nominal cell before a diagnosis: no effects, the paper's zero, the modulus unknown."""
    true = study_cell(name)
    assert true.tissue is not None
    tissue = true.tissue.model_copy(update={"surface_z_m": 0.0, "youngs_modulus_Pa": 1e5})
    tolerances = true.tolerances.model_copy(update={"youngs_modulus": 1.0})
    return true.model_copy(update={"tissue": tissue, "effects": {}, "tolerances": tolerances})


def on_a_day(cell: CellFile, bias_N: float, rng: np.random.Generator) -> CellFile:
    """The cell with the bias and warm-up of a day.

    Args:
        bias_N: Bias after the tare.
    """
    day = {
        "sensor.bias": {"offset_N": bias_N},
        "sensor.warmup": {"amplitude_N": rng.uniform(-WARMUP_N, WARMUP_N), "tau_s": WARMUP_S},
    }
    return cell.model_copy(update={"effects": cell.effects | day})


def _up_and_down(seed: int, mass_kg: float, bias_N: float) -> Take:
    """2 cm up and down ten times in 80 s."""
    cell = study_cell("A")
    cell = on_a_day(free_cell(cell, {"sensor.hysteresis": HYSTERESIS}), bias_N, np.random.default_rng([seed, 5]))
    cell = cell.model_copy(update={"probe": cell.probe.model_copy(update={"mass_kg": mass_kg})})
    moves = [Move(REST_M, 0.02, 1.0)]
    moves += [Move(REST_M + way, PAPER_SPEED_M_PER_S, 0.09) for _ in range(PRESSES) for way in (STROKE_M, 0.0)]
    return take(cell, commanded_heights(REST_M, moves, STEP_S)[0], seed)


def simulated(seed: int) -> Data:
    """The paper's laboratory days on the emulated cell."""
    bare = [_up_and_down(seed * 1000 + 1, 0.02, MEAN_FREE_N["without the probe"])]
    enriched = {name: diagnosed(name, seed) for name in SETUPS}
    return Data(bare, free_motion(seed), palpated(seed, enriched), simulated=True)


def free_motion(seed: int) -> list[Take]:
    """Ten repeats with the probe, which the methods learn from."""
    rng = np.random.default_rng([seed, 6])
    return [_up_and_down(seed * 1000 + 10 + k, 0.2, BIAS_N + rng.normal(0.0, 0.005)) for k in range(REPEATS)]


def as_it_is(cell: CellFile) -> CellFile:
    """NoCorrection is changed."""
    return cell


def palpated(seed: int, enriched: dict[str, CellFile] | None = None, changed: Callable[[CellFile], CellFile] = as_it_is) -> list[Palpated]:
    """One day of static and dynamic palpation on all setups.

    Args:
        enriched: Cells enriched by a diagnosis, by setup; None: none is.
        changed: Changes each cell of that day.

    Returns:
        The recordings by setup.
    """
    rng = np.random.default_rng([seed, 7])
    setups = []
    for index, name in enumerate(SETUPS):
        cell = study_cell(name)
        holds = [_hold(changed(cell), depth_m, seed * 1000 + 100 + 10 * index + k) for k, depth_m in enumerate(DEPTHS_M)]
        moves = [Move(REST_M, 0.02, 1.0)]
        moves += [Move(z_m, PAPER_SPEED_M_PER_S, 0.09) for _ in range(PRESSES) for z_m in (-DYNAMIC_DEPTH_M, REST_M)]
        z_cmd_m, spans = commanded_heights(REST_M, moves, STEP_S)
        bias_N = BIAS_N + rng.normal(0.0, BIAS_BETWEEN_DAYS_N)
        dynamic = take(changed(on_a_day(cell, bias_N, rng)), z_cmd_m, seed * 1000 + 200 + index)
        presses = [slice(spans[k][0], spans[k + 1][1]) for k in range(1, 2 * PRESSES, 2)]
        setups.append(Palpated(name, holds, dynamic, presses, 0.0, (enriched or {}).get(name)))
    return setups


def _hold(cell: CellFile, depth_m: float, seed: int) -> Hold:
    """Press, wait until the force is stable (8 s), take the mean of 10 s; the sensor was tared just before."""
    z_cmd_m, _ = commanded_heights(REST_M, [Move(REST_M, 0.02, 0.5), Move(-depth_m, 0.01, 18.0)], STEP_S)
    run = take(cell, z_cmd_m, seed)
    held = run.t_s > run.t_s[-1] - 10.0
    force_N, at_m = float(run.fz_N[held].mean()), -float(run.z_m[held].mean())
    return Hold(depth_m, force_N, modulus_peak_Pa(force_N, at_m, TIP_RADIUS_M, POISSON_RATIO))


def diagnosed(name: str, seed: int) -> CellFile:
    """The nominal cell, enriched by a diagnosis of six presses of other depths and speeds on another day.

    Args:
        name: Name of the setup.
    """
    moves = [Move(REST_M, 0.02, 1.0)]
    for depth_m, speed in ((0.003, 0.005), (0.005, 0.01), (0.007, 0.02), (0.004, 0.04), (0.008, 0.01), (0.010, 0.005)):
        moves += [Move(-depth_m, speed, 3.0), Move(REST_M, speed, 1.0)]
    rng = np.random.default_rng([seed, 8])
    cell = on_a_day(study_cell(name), BIAS_N + rng.normal(0.0, BIAS_BETWEEN_DAYS_N), rng)
    run = take(cell, commanded_heights(REST_M, moves, STEP_S)[0], seed * 1000 + 300)
    return diagnose([run.samples()], believed_cell(name)).enriched_cell()


def study(seed: int = 0, days: int = 20) -> Study:
    """The study on the emulated cell: the paper's section 4 once in full, then further days with the same models.

    Args:
        seed: Seed of everything.
    """
    data = simulated(seed)
    methods = fitted(data.free)
    enriched = {each.name: each.enriched for each in data.setups if each.enriched is not None}
    result = Study(data, _cards(methods), evaluate(data, methods))
    for day in range(1, days + 1):
        judged = [_judged(each, methods) for each in palpated(seed * 100 + day, enriched)]
        result.days.append({each.palpated.name: each.ymbt for each in judged})
    emulated = EmulatedField(Field(), MAP_SEED)
    result.mapped = (*search(emulated.press, Field()), emulated.inclusion)
    return result


def _cards(methods: dict[str, Method]) -> dict[str, dict[str, Any]]:
    return {name: method.model.card for name, method in methods.items() if isinstance(method, ExportedModel)}


# recordings of a real cell


def take_of(rows: np.ndarray[Any, np.dtype[np.void]], name: str, clear_z_m: float = -math.inf) -> Take:
    """A recording of a real cell, as the methods take it; its true contact force is unknown.

    Args:
        rows: Ticks, with the fields of ROW of palpd.tick.
        name: Name of the recording, for errors.
        clear_z_m: Height above which nothing is touched.

    Raises:
        RecordingError: The recording is too short.
    """
    filled = filled_slots(rows)
    robot_t_s, first = np.unique(rows["robot_t_s"], return_index=True)
    t_s = rows["frame_t_s"][filled]
    if len(t_s) < 100 or len(robot_t_s) < 30:
        raise RecordingError(f"{name} holds {len(t_s)} sensor samples and {len(robot_t_s)} robot states; record for longer")
    states = rows[first]
    start_s = float(t_s[0])
    return Take(
        t_s - start_s,
        np.interp(t_s, robot_t_s, states["target_pose"][:, 2]),
        np.interp(t_s, robot_t_s, states["tcp_pose"][:, 2]),
        np.interp(t_s, robot_t_s, states["tcp_speed"][:, 2]),
        rows["tared"][filled][:, 2],
        robot_t_s - start_s,
        states["tcp_speed"][:, 2],
        states["target_speed"][:, 2],
        states["tool_acceleration_m_per_s2"][:, 2],
        np.full(len(t_s), math.nan),
        clear_z_m,
    )


def recorded(
    bare: Sequence[Recording], free: Sequence[Recording], palpation: Recording, enriched: dict[str, CellFile] | None = None
) -> Data:
    """The same study of recordings: `palpd free-motion` without and with the probe, and `palpd run` in both modes.

    Args:
        bare: `palpd free-motion` without the probe.
        free: `palpd free-motion` with the probe.
        palpation: A run of a plan with mode: both.
        enriched: Cells enriched by a diagnosis, by site; None: none is.

    Returns:
        The recordings as the study takes them.

    Raises:
        BadInput: Sensors or probes differ, or a site has no static or no dynamic presses.
    """
    serials = {run.path.name: run.header.get("about", {}).get("sensor_serial") for run in (*bare, *free, palpation)}
    if len({serial for serial in serials.values() if serial}) > 1:
        listed = ", ".join(f"{name} of {serial}" for name, serial in serials.items())
        raise BadInput(f"the recordings come from different sensors ({listed}); what one reads beside the contact, another does not")
    for run in free:
        refuse_other_probe(run, palpation.header.get("config", {}).get("cell", {}).get("probe", {}).get("mass_kg", math.nan))
    results = site_results(palpation.rows, palpation.header)
    setups = []
    for index, site in enumerate(results):
        rows = palpation.rows[palpation.rows["site"] == index]
        holds = [
            Hold(depth["commanded_m"], depth["force_N"], depth["E_Pa"])
            for depth in site["depths"]
            if depth["force_N"] is not None and depth["E_Pa"] is not None
        ]
        surface_z_m = site["surface_z_m"]
        rows = rows[(rows["mode"] == Mode.DYNAMIC) & np.isin(rows["phase"], (Phase.BASELINE, Phase.PRESS, Phase.RETRACT))]
        if not holds or not len(rows) or surface_z_m is None:
            raise BadInput(
                f"site {site['name']} holds {len(holds)} static presses and {len(rows)} dynamic ticks; run a plan with mode: both"
            )
        rest_z_m = float(np.median(rows["tcp_pose"][rows["phase"] == Phase.BASELINE, 2]))
        clear_z_m = surface_z_m + CLEAR_SHARE * (rest_z_m - surface_z_m)
        dynamic = take_of(rows, f"site {site['name']}", clear_z_m)
        keys = np.repeat(rows["depth_m"] * 1e6 + rows["repeat"] * 1e-3, rows["frames"])
        edges = np.concatenate(([0], np.flatnonzero(np.diff(keys)) + 1, [len(keys)]))
        presses = [slice(int(a), int(b)) for a, b in pairwise(edges)]
        setups.append(Palpated(site["name"], holds, dynamic, presses, surface_z_m, (enriched or {}).get(site["name"])))
    takes = [[take_of(run.rows[run.rows["phase"] == Phase.FREE_MOTION], run.path.name) for run in runs] for runs in (bare, free)]
    return Data(takes[0], takes[1], setups, simulated=False)


def study_of(data: Data) -> Study:
    """Everything on recordings."""
    methods = fitted(data.free)
    return Study(data, _cards(methods), evaluate(data, methods))
