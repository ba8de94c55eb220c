"""The palpation sequence, on the cell's own physics without wires."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpd.analysis import results
from palpd.cell.cell_file import CellFile
from palpd.config import Config, Plan, PlanSite
from palpd.control.sequence import ArmGeometry, Palpation, Sequence
from palpd.daemon.motion_job import Job, Kind
from palpd.daemon.simulated_run import SimulatedRecording, run
from palpd.errors import RecordingError
from palpd.tick import NO_FRAMES, ForceSensor, Mode, Phase, Request, SensorFrames, Trip
from tests.scenes import contact, observation, robot
from tests.simulated import cell_file, ran

ONE = Plan(depths_m=(0.005,), repeats=1, hold_s=1.0)


@pytest.mark.parametrize(
    ("modulus_Pa", "effects"),
    [
        (62_500, {}),
        (132_350, {}),
        (92_140, {"tissue.inclusion": {"contrast": 2.1, "depth_m": 0.01517}}),
        (20_000, {}),
        (62_500, {"cable.spring": {"stiffness_N_per_m": 10.0}}),
        (62_500, {"sensor.drift": {"rate_N_per_s": 0.01}}),
        (62_500, {"sensor.warmup": {"amplitude_N": 0.5, "tau_s": 30.0}}),
    ],
)
def test_the_surface_is_found_within_a_tenth_of_a_millimetre(modulus_Pa: float, effects: dict[str, dict[str, float]]) -> None:
    for seed in range(3):
        done = ran(cell_file(tissue={"youngs_modulus_Pa": modulus_Pa, "surface_z_m": 0.0123}, effects=effects), ONE, seed=seed)
        site = results.sites(done.rows, done.header)[0]
        assert done.outcome.verdict == "done", done.outcome
        assert abs(site["surface_z_m"] - 0.0123) < 1e-4


def test_a_cable_that_pulls_to_1_N_in_the_air_is_no_surface() -> None:
    done = ran(cell_file(effects={"cable.spring": {"stiffness_N_per_m": 60.0}}), ONE)
    assert done.outcome.verdict == "stopped"
    assert "does not show where" in done.outcome.reason
    assert "expected at most 1 mm" in done.outcome.reason
    assert not (done.rows["phase"] == Phase.PRESS).any()


def test_depths_are_reached_within_a_twentieth_and_never_overshot_by_a_tenth() -> None:
    done = ran(cell_file(), Plan(depths_m=(0.003, 0.006, 0.010), repeats=1, hold_s=0.5), safety={"contact_limit_N": 15})
    site = results.sites(done.rows, done.header)[0]
    assert len(site["depths"]) == len(site["presses"]) == 3
    for press in site["depths"] + site["presses"]:
        assert abs(press["achieved_m"] - press["commanded_m"]) < 5e-5
    lowest_m = done.rows["tcp_pose"][:, 2].min()
    assert lowest_m > site["surface_z_m"] - 0.010 - 1e-4


def test_the_hold_gives_the_modulus_of_the_cell() -> None:
    done = ran(cell_file(), Plan(repeats=1, hold_s=1.0))
    site = results.sites(done.rows, done.header)[0]
    assert site["static_youngs_modulus_Pa"] == pytest.approx(72_000, rel=0.03)
    assert site["dynamic_original_Pa"] == pytest.approx(72_000, rel=0.05)


def test_a_bias_that_the_tare_did_not_see_spoils_the_dynamic_modulus_and_not_the_static_one() -> None:
    done = ran(cell_file(effects={"sensor.bias": {"offset_N": 0.4}}), Plan(repeats=1, hold_s=1.0))
    site = results.sites(done.rows, done.header)[0]
    assert site["static_youngs_modulus_Pa"] == pytest.approx(72_000, rel=0.03)
    assert site["dynamic_original_Pa"] > 1.08 * 72_000


def test_the_sequence_ends_a_press_before_the_guard_has_to() -> None:
    done = ran(cell_file(), Plan(depths_m=(0.010,), repeats=1), safety={"contact_limit_N": 5.0})
    site = results.sites(done.rows, done.header)[0]
    assert done.outcome.verdict == "done"
    assert site["cut_short"] is True
    assert site["cut_short_depths_m"] == [0.010]
    assert site["depths"][0]["E_Pa"] is None
    assert 4.4 < site["peak_force_N"] < 5.0


def test_a_machine_that_gives_way_is_corrected_by_its_stiffness() -> None:
    soft = cell_file(effects={"robot.compliance": {"stiffness_N_per_m": 10_000.0}})
    plan = Plan(repeats=1, hold_s=1.0)
    ignored, corrected = ran(soft, plan), ran(soft, plan, machine_stiffness_N_per_m=10_000.0)
    without = results.sites(ignored.rows, ignored.header)[0]["static_youngs_modulus_Pa"]
    with_it = results.sites(corrected.rows, corrected.header)[0]["static_youngs_modulus_Pa"]
    assert without < 0.92 * 72_000
    assert with_it == pytest.approx(72_000, rel=0.03)


def test_pressing_a_rigid_plate_measures_the_machine() -> None:
    plate = cell_file(wall={"z_m": 0.0, "stiffness_N_per_m": 1e7}, effects={"robot.compliance": {"stiffness_N_per_m": 80_000.0}})
    done = ran(plate, Plan(search={"max_travel_m": 0.04}), kind="stiffness")  # type: ignore[arg-type]
    assert done.outcome.verdict == "done", done.outcome
    value, (low, high) = results.machine_stiffness(done.rows)
    assert value == pytest.approx(80_000, rel=0.03)
    assert low < value < high


def test_something_soft_in_place_of_the_plate_is_no_machine() -> None:
    rubber = cell_file(tissue={"surface_z_m": 0.0, "youngs_modulus_Pa": 3e6})  # 12 N for 1 mm, above the softest machine
    done = ran(rubber, Plan(search={"max_travel_m": 0.04}), kind="stiffness")  # type: ignore[arg-type]
    assert done.outcome.verdict == "done", done.outcome
    with pytest.raises(RecordingError, match=r"measure 12\.\d N for 1 mm, and their upper half is 1\.3\d times as stiff"):
        results.machine_stiffness(done.rows)


def test_free_motion_goes_up_and_down_ten_times_and_touches_nothing() -> None:
    done = ran(cell_file(), kind="free_motion")
    z_m = done.rows["tcp_pose"][:, 2]
    assert done.outcome.verdict == "done"
    assert np.ptp(z_m) == pytest.approx(0.02, abs=2e-4)
    assert done.rows["repeat"].max() == 9
    assert z_m[-1] == pytest.approx(z_m[0], abs=1e-4)


def test_where_nothing_is_met_the_run_ends_with_the_distance() -> None:
    done = ran(cell_file(tissue=None), Plan(search={"speed_m_per_s": 0.02, "max_travel_m": 0.02}))  # type: ignore[arg-type]
    assert done.outcome.verdict == "stopped"
    assert "0.02 m" in done.outcome.reason


TWO_SITES = {"sites": [{"name": "A"}, {"name": "B", "x_m": 0.02, "y_m": -0.01}], "depths_m": [0.004], "mode": "dynamic", "repeats": 1}


def test_a_run_that_is_done_returns_to_its_start_above_the_tissue() -> None:
    done = ran(cell_file(), Plan.model_validate(TWO_SITES))
    back = done.rows[done.rows["phase"] == Phase.RETURN]
    assert done.outcome.verdict == "done"
    assert done.rows["target_pose"][-1, :3] == pytest.approx(done.rows["target_pose"][0, :3], abs=2e-5)
    assert back["tcp_pose"][:, 2] == pytest.approx(done.rows["tcp_pose"][0, 2], abs=1e-3), "at the height of the start"
    assert np.hypot(*back["command_m_per_s"][:, :2].T).max() == pytest.approx(0.05, rel=1e-6), "at the speed of travel"
    assert set(back["site"]) == {-1}, "the way back belongs to no site"


def test_a_run_that_the_operator_aborted_stays_where_it_is() -> None:
    plan = Plan.model_validate(TWO_SITES)
    whole = ran(cell_file(), plan)
    at_second_site = int(np.flatnonzero(whole.rows["site"] == 1)[-1])
    aborted = ran(cell_file(), plan, requests={at_second_site: Request.ABORT})
    assert not (aborted.rows["phase"] == Phase.RETURN).any()
    assert aborted.rows["target_pose"][-1, 0] > 0.015


def test_sites_count_from_the_origin_where_the_plan_gives_one_and_the_arm_returns_all_the_same() -> None:
    done = ran(cell_file(), Plan.model_validate({**TWO_SITES, "origin": {"x_m": -0.04, "y_m": 0.03}}))
    for index, place_m in enumerate([(-0.04, 0.03), (-0.02, 0.02)]):
        pressing = done.rows[(done.rows["site"] == index) & (done.rows["phase"] == Phase.PRESS)]
        assert pressing["target_pose"][:, :2] == pytest.approx(np.tile(place_m, (len(pressing), 1)), abs=2e-5)
    assert done.rows["target_pose"][-1, :2] == pytest.approx(done.rows["target_pose"][0, :2], abs=2e-5)


def test_an_origin_that_is_too_far_away_is_refused_before_anything_moves() -> None:
    done = ran(cell_file(), Plan.model_validate({**TWO_SITES, "origin": {"x_m": 0.31, "y_m": 0.0}}))
    assert (done.outcome.verdict, done.outcome.refused) == ("stopped", True)
    assert "0.310 m from where the arm stands" in done.outcome.reason
    assert not done.rows["command_m_per_s"].any()


def test_an_abort_stops_within_the_tick() -> None:
    done = ran(cell_file(), ONE, requests={600: Request.ABORT})
    assert len(done.rows) == 601
    assert done.rows["command_stop"][-1]
    assert [trip.trip for trip in done.outcome.trips] == [Trip.OPERATOR]


def test_a_hard_wall_where_tissue_was_expected_trips_the_guard_which_retracts() -> None:
    wall = cell_file(wall={"z_m": 0.0, "stiffness_N_per_m": 20_000.0})
    done = ran(wall, Plan(depths_m=(0.004,), search={"speed_m_per_s": 0.02}))  # type: ignore[arg-type]
    assert [trip.trip for trip in done.outcome.trips] == [Trip.CONTACT_FORCE]
    assert done.rows["tcp_pose"][-1, 2] > 0.02
    assert done.rows["command_stop"][-1]


def test_free_strokes_come_before_the_presses_or_instead_of_them() -> None:
    alone = ran(cell_file(), Plan.model_validate({"depths_m": [], "free": {"strokes": 2, "speed_m_per_s": 0.05}}))
    assert alone.outcome.verdict == "done"
    z_m = alone.rows["tcp_pose"][:, 2]
    assert np.ptp(z_m) == pytest.approx(0.02, abs=2e-4)
    assert z_m.min() > z_m[0] - 1e-4, "nothing below the start"
    assert np.abs(alone.rows["target_speed"][:, 2]).max() == pytest.approx(0.05, rel=1e-6)
    both = ran(cell_file(), Plan.model_validate({"depths_m": [0.004], "mode": "dynamic", "repeats": 1, "free": {"strokes": 1}}))
    phases = [int(phase) for phase in dict.fromkeys(both.rows["phase"].tolist())]
    assert phases.index(Phase.FREE_MOTION) < phases.index(Phase.SEARCH) < phases.index(Phase.PRESS)


def stepped(sequence: Sequence, force_N: Callable[[Phase, float], float]) -> list[Phase]:
    """Carry out a sequence on an arm that follows at once, with that force by phase and x; the phase of each tick."""
    phases, now_s, x_m, y_m, z_m = [Phase.IDLE], 10.0, 0.0, 0.0, 0.03
    while not sequence.over and now_s < 60.0:
        pose = (x_m, y_m, z_m, np.pi, 0.0, 0.0)
        seen = replace(robot(now_s), tcp_pose=pose, target_pose=pose)
        tared = np.zeros((8, 6))
        tared[:, 2] = force_N(phases[-1], x_m)
        proposal = sequence.step(observation(now_s, robot=seen, contact=contact(tared=tared)))
        phases.append(proposal.progress.phase)
        x_m, y_m, z_m = (at + 0.008 * v for at, v in zip((x_m, y_m, z_m), proposal.command.velocity_m_per_s, strict=True))
        now_s += 0.008
    return phases


@pytest.mark.parametrize(("standing_N", "why"), [(5.0, "touches something already"), (-1.5, "zero moves, or its sign is wrong")])
def test_a_force_that_stands_there_when_the_search_begins_is_no_surface(standing_N: float, why: str) -> None:
    sequence = Sequence(Palpation(ONE, ArmGeometry(tip_radius_m=0.005, contact_limit_N=12.0, max_speed_m_per_s=0.05, delay_s=0.001)))
    stepped(sequence, lambda phase, _: standing_N if phase == Phase.SEARCH else 0.0)
    assert sequence.failure is not None
    assert why in sequence.failure


@pytest.mark.parametrize(("modulus_Pa", "deep_m"), [(5_000, 0.004), (62_500, 0.001), (62_500, 0.0001), (143_000, 0.0005)])
def test_a_site_that_stands_higher_than_the_start_is_not_searched_from_within(modulus_Pa: float, deep_m: float) -> None:
    high = {"youngs_modulus_Pa": modulus_Pa, "surface_z_m": 0.03 + deep_m}
    cell = cell_file(tissue=None, sites=[{"name": "A", "tissue": None}, {"name": "B", "x_m": 0.02, "tissue": high}])
    done = ran(cell, ONE.model_copy(update={"sites": (PlanSite(name="B", x_m=0.02),)}))
    assert done.outcome.verdict == "stopped"
    assert done.outcome.reason.endswith("start higher above the tissue")
    assert not (done.rows["phase"] == Phase.PRESS).any()


# --- a pause ------------------------------------------------------------------------------------------------------------------

BOTH = Plan.model_validate({"sites": [{"name": "A", "x_m": 0.01}, {"name": "B"}], "depths_m": [0.004], "repeats": 2, "hold_s": 0.5})
PAUSE_TICKS = 400


@pytest.fixture(scope="module")
def plain() -> SimulatedRecording:
    return ran(cell_file(), BOTH)


def paused_at(tick: int, ticks: int = PAUSE_TICKS, **more: Any) -> SimulatedRecording:
    return ran(cell_file(), BOTH, requests={tick: Request.PAUSE, tick + ticks: Request.RESUME}, **more)


def ticks_of(rows: Any, phase: Phase, mode: Mode) -> Any:
    return np.flatnonzero((rows["phase"] == phase) & (rows["mode"] == mode) & (rows["site"] == 0))


@pytest.mark.parametrize(
    ("phase", "mode", "share", "again"),
    [
        (Phase.TRAVEL, Mode.NONE, 0.4, 0),
        (Phase.BASELINE, Mode.SEARCH, 0.5, 1),
        (Phase.SEARCH, Mode.SEARCH, 0.3, 1),
        (Phase.SEARCH, Mode.SEARCH, 1.0, 1),
        (Phase.RETRACT, Mode.SEARCH, 0.1, 0),
        (Phase.BASELINE, Mode.STATIC, 0.5, 1),
        (Phase.PRESS, Mode.STATIC, 0.3, 1),
        (Phase.PRESS, Mode.STATIC, 1.0, 1),
        (Phase.HOLD, Mode.STATIC, 0.5, 1),
        (Phase.RETRACT, Mode.STATIC, 0.1, 0),
        (Phase.PRESS, Mode.DYNAMIC, 0.45, 1),
        (Phase.RETRACT, Mode.DYNAMIC, 0.1, 0),
        (Phase.RETRACT, Mode.NONE, 0.5, 0),
    ],
)
def test_a_pause_leaves_the_tissue_and_the_press_begins_again(
    plain: SimulatedRecording, phase: Phase, mode: Mode, share: float, again: int
) -> None:
    ticks = ticks_of(plain.rows, phase, mode)
    at = int(ticks[round(share * (len(ticks) - 1))])
    paused = paused_at(at)
    rows = paused.rows
    assert paused.outcome.verdict == "done"
    waiting = np.flatnonzero(rows["phase"] == Phase.PAUSED)
    assert len(waiting) > 100
    assert waiting[-1] == at + PAUSE_TICKS - 1, "it goes on with the tick of the resume"
    assert not rows["command_m_per_s"][waiting].any()
    surface_m = results.sites(plain.rows, plain.header)[0]["surface_z_m"]
    assert rows["tcp_pose"][waiting[30:], 2].min() > surface_m + BOTH.safe_height_m - 1e-4, "at the safe height or higher"
    assert rows["force_N"][waiting[60:]].max() < 0.2
    on_its_way = rows[at : waiting[0]]
    assert (on_its_way["proposed_m_per_s"][:, 2] >= -1e-6).all(), "a pause never goes down"
    assert len(paused.outcome.notes) == again
    for site, expected in zip(results.sites(rows, paused.header), results.sites(plain.rows, plain.header), strict=True):
        assert [len(site["depths"]), len(site["presses"])] == [1, 2]
        assert site["static_youngs_modulus_Pa"] == pytest.approx(expected["static_youngs_modulus_Pa"], rel=0.05)
        assert site["dynamic_corrected_Pa"] == pytest.approx(expected["dynamic_corrected_Pa"], rel=0.05)
        assert not site["cut_short"]


def test_a_press_that_was_paused_twice_counts_once_and_is_said_twice(plain: SimulatedRecording) -> None:
    at = int(ticks_of(plain.rows, Phase.HOLD, Mode.STATIC)[30])
    requests = {at: Request.PAUSE, at + 200: Request.RESUME, at + 300: Request.PAUSE, at + 600: Request.RESUME}
    paused = ran(cell_file(), BOTH, requests=requests)
    assert paused.outcome.notes == ["site A, static press to 4 mm: a pause interrupted it, and it was begun again from its start"] * 2
    assert len(results.sites(paused.rows, paused.header)[0]["depths"]) == 1


def test_a_resume_on_the_way_up_still_reaches_the_safe_height_first(plain: SimulatedRecording) -> None:
    at = int(ticks_of(plain.rows, Phase.HOLD, Mode.STATIC)[30])
    paused = paused_at(at, ticks=5)
    assert Phase.PAUSED not in paused.rows["phase"]
    assert len(paused.outcome.notes) == 1
    assert paused.outcome.verdict == "done"


def test_free_motion_stands_still_in_a_pause_and_goes_on() -> None:
    paused = ran(cell_file(), kind="free_motion", requests={700: Request.PAUSE, 900: Request.RESUME})
    assert set(paused.rows["phase"][700:900]) == {Phase.PAUSED}
    assert np.ptp(paused.rows["target_pose"][720:900, 2]) == 0.0
    assert paused.outcome.verdict == "done"
    assert paused.rows["repeat"].max() == 9


def test_a_paused_press_on_a_rigid_plate_is_begun_again_and_measures_the_same() -> None:
    plate = cell_file(wall={"z_m": 0.0, "stiffness_N_per_m": 1e7}, effects={"robot.compliance": {"stiffness_N_per_m": 80_000.0}})
    plan = Plan(search={"max_travel_m": 0.04})  # type: ignore[arg-type]
    whole = ran(plate, plan, kind="stiffness")
    at = int(np.flatnonzero((whole.rows["phase"] == Phase.PRESS) & (whole.rows["repeat"] == 1))[-40])
    assert whole.rows["force_N"][at] > 3.0
    done = ran(plate, plan, kind="stiffness", requests={at: Request.PAUSE, at + PAUSE_TICKS: Request.RESUME})
    waiting = done.rows[done.rows["phase"] == Phase.PAUSED]
    assert waiting["tcp_pose"][:, 2].min() == pytest.approx(done.rows["tcp_pose"][0, 2], abs=1e-4), "where it began"
    assert results.machine_stiffness(done.rows)[0] == pytest.approx(80_000, rel=0.03)


class _Disturbed:
    """A sensor that from a tick on is silent, or reads another force."""

    def __init__(self, sensor: ForceSensor, from_read: int, shift_N: float | None) -> None:
        self._sensor, self._left, self._shift_N = sensor, from_read, shift_N

    def read(self) -> SensorFrames:
        frames = self._sensor.read()
        self._left -= 1
        if self._left > 0:
            return frames
        if self._shift_N is None:
            return NO_FRAMES
        return replace(frames, wrench=frames.wrench + np.array([0.0, 0.0, -self._shift_N, 0.0, 0.0, 0.0]))

    def close(self) -> None:
        self._sensor.close()


@pytest.mark.parametrize(("shift_N", "trip"), [(None, Trip.SENSOR_STALE), (13.0, Trip.CONTACT_FORCE), (40.0, Trip.ABSOLUTE_FORCE)])
@pytest.mark.parametrize("later", [2, 200])
def test_the_limits_hold_on_the_way_up_and_while_it_waits(plain: SimulatedRecording, shift_N: float | None, trip: Trip, later: int) -> None:
    at = int(ticks_of(plain.rows, Phase.HOLD, Mode.STATIC)[30])
    job = Job("palpation", Config(), BOTH)
    done = run(job, cell_file(), requests={at: Request.PAUSE}, behind=lambda sensor: _Disturbed(sensor, at + later, shift_N))
    assert done.outcome.verdict == "stopped"
    assert [verdict.trip for verdict in done.outcome.trips] == [trip]
    assert done.rows["phase"][-1] in (Phase.PAUSE_RETRACT, Phase.PAUSED)
    assert done.rows["command_stop"][-1]
    assert len(done.rows) < at + later + 200


def test_a_recording_of_an_earlier_version_paused_where_the_arm_was(plain: SimulatedRecording) -> None:
    at = int(ticks_of(plain.rows, Phase.HOLD, Mode.STATIC)[30])
    job = Job("palpation", Config(), BOTH, pauses_in_place=True)
    done = run(job, cell_file(), requests={at: Request.PAUSE, at + 200: Request.RESUME})
    assert set(done.rows["phase"][at : at + 200]) == {Phase.PAUSED}
    assert np.ptp(done.rows["target_pose"][at + 20 : at + 200, 2]) == 0.0
    assert done.outcome.verdict == "done"


# --- leaving the tissue after a stop ------------------------------------------------------------------------------------------


def retracted(start_above_m: float, cell: CellFile | None = None, requests: dict[int, Request] | None = None) -> SimulatedRecording:
    """A retract that begins there, with the tip below the surface where negative."""
    return run(Job("retract", Config()), cell or cell_file(), home_above_m=start_above_m, requests=requests or {})


def test_a_retract_leaves_the_tissue_straight_up_and_slowly() -> None:
    done = retracted(-0.006)
    commands = done.rows["command_m_per_s"]
    assert done.rows["force_N"][50] > 4.0, "it began loaded"
    assert done.outcome.verdict == "done", done.outcome
    assert not commands[:, :2].any()
    assert commands[:, 2].min() >= 0.0
    assert commands[:, 2].max() <= 0.005
    assert 0.003 < done.rows["tcp_pose"][-1, 2] < 0.008, "clear of the tissue, and not far above it"


def test_a_retract_of_a_clear_arm_is_refused_and_moves_nothing() -> None:
    done = retracted(0.01)
    assert (done.outcome.verdict, done.outcome.refused) == ("stopped", True)
    assert "clear of the tissue" in done.outcome.reason
    assert not done.rows["command_m_per_s"].any()


def test_a_retract_goes_no_farther_than_its_limit() -> None:
    drifting = cell_file(effects={"sensor.drift": {"rate_N_per_s": 0.3}}, wall={"z_m": 0.0, "stiffness_N_per_m": 400.0}, tissue=None)
    done = retracted(-0.008, drifting)
    assert done.outcome.verdict == "stopped"
    assert "not clear after 60 mm" in done.outcome.reason
    assert done.rows["target_pose"][-1, 2] < -0.008 + 0.0601


def test_a_retract_of_an_unfinished_contact_goes_up_at_any_force_and_above_the_clear_height() -> None:
    light = cell_file(tissue={"youngs_modulus_Pa": 3_000, "surface_z_m": 0.0})
    assert "clear of the tissue" in retracted(-0.002, light).outcome.reason
    job = Job("retract", Config(), unfinished=True, clear_z_m=0.012)
    done = run(job, light, home_above_m=-0.002)
    assert done.outcome.verdict == "done", done.outcome
    assert done.outcome.level
    assert done.rows["tcp_pose"][-1, 2] == pytest.approx(0.012, abs=5e-4)
    assert not done.rows["command_m_per_s"][:, :2].any()


@pytest.mark.parametrize("kind", ["palpation", "free_motion", "stiffness"])
@pytest.mark.parametrize("depth_m", [0.002, 0.004, 0.008])
def test_a_run_that_was_tared_in_the_tissue_ends_on_its_first_way_up(kind: Kind, depth_m: float) -> None:
    done = run(Job(kind, Config(), lifts_first=True), cell_file(), home_above_m=-depth_m)
    assert done.outcome.verdict == "stopped"
    assert done.outcome.reason.startswith("tared in contact: the force changed by")
    assert set(done.rows["phase"]) == {Phase.TARE, Phase.LIFT, Phase.DONE}
    assert not done.rows["command_m_per_s"][:, :2].any(), "nothing goes sideways"
    assert done.rows["command_m_per_s"][:, 2].min() >= 0.0, "nothing goes down"
    assert done.rows["command_m_per_s"][:, 2].max() <= 0.005
    assert not done.outcome.level


@pytest.mark.parametrize("mode", ["static", "dynamic"])
@pytest.mark.parametrize("depth_m", [0.002, 0.004])
def test_a_site_that_begins_in_contact_ends_the_run(mode: str, depth_m: float) -> None:
    """Its surface stands above the height of travel: a search from 4 mm deep gave 116 kPa for 62.5, and "done"."""
    high = {"name": "B", "x_m": 0.03, "tissue": {"surface_z_m": 0.010 + depth_m}}
    cell = cell_file(sites=[{"name": "A"}, high])
    plan = Plan.model_validate({"sites": [{"name": "A"}, {"name": "B", "x_m": 0.03}], "depths_m": [0.004], "mode": mode, "repeats": 1})
    done = run(Job("palpation", Config(), plan), cell, home_above_m=0.010)
    assert done.outcome.verdict == "stopped"
    assert done.outcome.reason.startswith("site B begins in contact: the force changed by 0.5")
    assert done.rows["command_m_per_s"][done.rows["site"] == 1, 2].min() >= 0.0, "nothing goes down there"


def test_a_force_that_changes_on_the_way_to_a_site_and_not_with_the_height_is_no_contact() -> None:
    plan = Plan.model_validate({"sites": [{"name": "A", "x_m": 0.01}], "depths_m": [0.004]})
    sequence = Sequence(Palpation(plan, ArmGeometry(tip_radius_m=0.005, contact_limit_N=12.0, max_speed_m_per_s=0.05, delay_s=0.001)))
    phases = stepped(sequence, lambda _, x_m: 0.6 if x_m > 0.005 else 0.0)
    assert phases.index(Phase.TRAVEL) < phases.index(Phase.LIFT) < phases.index(Phase.SEARCH)
    assert "no contact of 1 N was met" in str(sequence.failure)


def test_a_run_in_free_air_comes_back_from_its_first_way_up_and_finds_the_same_moduli() -> None:
    plan = Plan(depths_m=(0.005,), repeats=1, hold_s=1.0)
    lifted, plain = (run(Job("palpation", Config(), plan, lifts_first=lifts), cell_file()) for lifts in (True, False))
    way = lifted.rows[lifted.rows["phase"] == Phase.LIFT]
    assert lifted.outcome.verdict == "done", lifted.outcome
    assert np.ptp(way["target_pose"][:, 2]) == pytest.approx(0.005, abs=2e-5)
    assert way["target_pose"][-1, 2] == pytest.approx(way["target_pose"][0, 2], abs=2e-5)
    static_Pa = [results.sites(done.rows, done.header)[0]["static_youngs_modulus_Pa"] for done in (lifted, plain)]
    assert static_Pa[0] == pytest.approx(static_Pa[1], rel=5e-3)


@pytest.mark.parametrize(("above_m", "level"), [(0.01, True), (0.0005, True), (-0.0015, False), (-0.006, False)])
def test_a_level_test_goes_up_once_and_tells_free_air_from_tissue(above_m: float, level: bool) -> None:
    done = run(Job("level_test", Config()), cell_file(), home_above_m=above_m)
    assert done.outcome.level == level
    assert done.outcome.verdict == ("done" if level else "stopped")
    assert level or "the probe touches something; palpd retract leaves it" in done.outcome.reason
    assert not done.rows["command_m_per_s"][:, :2].any()
    assert done.rows["command_m_per_s"][:, 2].min() >= 0.0
    assert np.ptp(done.rows["target_pose"][:, 2]) <= 0.00501


@pytest.mark.parametrize(("depth_m", "stiffness_N_per_m", "trip"), [(0.004, 7000.0, Trip.ABSOLUTE_FORCE)])
def test_a_retract_above_the_absolute_limit_is_left_to_hands(depth_m: float, stiffness_N_per_m: float, trip: Trip) -> None:
    done = retracted(-depth_m, cell_file(tissue=None, wall={"z_m": 0.0, "stiffness_N_per_m": stiffness_N_per_m}))
    assert [each.trip for each in done.outcome.trips] == [trip]
    assert not done.rows["command_m_per_s"].any()


def test_a_retract_above_the_contact_limit_is_still_slow() -> None:
    done = retracted(-0.004, cell_file(tissue=None, wall={"z_m": 0.0, "stiffness_N_per_m": 4000.0}))
    assert done.rows["force_N"][50] > 12.0
    assert done.outcome.verdict == "done", done.outcome
    assert done.rows["command_m_per_s"][:, 2].max() <= 0.005


def test_an_abort_stops_a_retract() -> None:
    done = retracted(-0.006, requests={120: Request.ABORT})
    assert [trip.trip for trip in done.outcome.trips] == [Trip.OPERATOR]
    assert done.rows["command_stop"][-1]


def test_a_run_goes_back_to_where_an_unfinished_one_began_straight_up_first_and_counts_from_there() -> None:
    start_m = (0.02, -0.01, 0.028)
    done = run(Job("palpation", Config(), Plan.model_validate(TWO_SITES), back_to_m=start_m, top_z_m=0.04), cell_file(), home_above_m=0.02)
    way = done.rows[done.rows["phase"] == Phase.RETURN]
    sideways = np.hypot(*way["command_m_per_s"][:, :2].T) > 0.0
    assert done.outcome.verdict == "done", done.outcome
    first_sideways = int(np.argmax(sideways))
    assert way["target_pose"][first_sideways, 2] == pytest.approx(0.04, abs=2e-5), "at the greatest height of the unfinished run"
    searches = done.rows[done.rows["phase"] == Phase.SEARCH]
    places = [tuple(searches["target_pose"][searches["site"] == site][0, :2]) for site in (0, 1)]
    assert places[0] == pytest.approx((0.02, -0.01), abs=2e-5)
    assert places[1] == pytest.approx((0.04, -0.02), abs=2e-5)
    assert done.rows["target_pose"][-1, :3] == pytest.approx(start_m, abs=2e-5)
