"""The marker of a contact: written before the first motion, kept over a restart, removed by a probe that is confirmed to be free."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpd.config import Config, Plan, parse_config
from palpd.control.plan_place import PlanPlace
from palpd.control.probe_state import ContactMarker, ProbeIdentity, ProbeState
from palpd.daemon.contact_marker import MarkedRun
from palpd.daemon.motion_job import Kind
from palpd.daemon.run_header import header_of
from palpd.daemon.session import calibrate, measured_job
from palpd.daemon.stored_state import Calibration, State
from palpd.daemon.supervisor import Report
from palpd.errors import ConfigError, Refused
from palpd.recording.ring import Rows
from palpd.tick import ROW, Phase

HOME = (0.0, 0.0, 0.130, math.pi, 0.0, 0.0)
ZERO = (1.0, -2.0, -50.0, 0.0, 0.0, 0.0)
ABOUT: Any = {"sensor_serial": "PRE00042"}
DEVICES: Any = ABOUT | {"delay_s": 0.0, "epoch_offset_s": 0.0}
SURFACE_M = 0.100


def settings(folder: Path) -> Config:
    return parse_config({"paths": {"state": str(folder / "state"), "runs": str(folder / "runs")}}, "the test's configuration")


def rows(phase: Phase, z_m: float, force_N: float = 0.0, surface_z_m: float = math.nan, site: int = 0, count: int = 50) -> Rows:
    """Ticks at rest at that height, with that force against the zero."""
    ticks = np.zeros(count, ROW)
    ticks["now_s"] = np.arange(count) * 0.008
    ticks["phase"], ticks["site"], ticks["surface_z_m"] = phase, site, surface_z_m
    ticks["tcp_pose"] = (*HOME[:2], z_m, *HOME[3:])
    ticks["frames"] = 8
    ticks["wrench"][:, :8] = ZERO
    ticks["wrench"][:, :8, 2] -= force_N
    return ticks


@pytest.fixture
def state(tmp_path: Path) -> State:
    state = State(tmp_path / "state")
    state.keep("calibration", Calibration(ZERO, "2026-01-01", "PRE00042"))
    return state


def marked(tmp_path: Path, state: State, kind: Any = "palpation") -> MarkedRun:
    job = measured_job(kind, settings(tmp_path), Plan())
    return MarkedRun(job, state, ABOUT, ZERO, HOME, "20260101-palpation")


def test_a_run_marks_its_contact_before_it_moves_and_a_free_end_removes_the_mark(tmp_path: Path, state: State) -> None:
    run = marked(tmp_path, state)
    assert state.marker() is not None
    run.follow(rows(Phase.TRAVEL, HOME[2]))
    run.follow(rows(Phase.PRESS, SURFACE_M - 0.004, 2.0, SURFACE_M))
    kept = state.marker()
    assert kept is not None
    assert (kept.start_free, kept.site, kept.surface_z_m, kept.at_rest) == (True, "A", SURFACE_M, False)
    assert run.end(rows(Phase.DONE, HOME[2], site=-1), level=False, came_to_rest=True).state == ProbeState.FREE
    assert state.marker() is None


def test_a_stop_in_the_tissue_leaves_a_mark_that_only_a_way_out_removes(tmp_path: Path, state: State) -> None:
    run = marked(tmp_path, state)
    assert run.end(rows(Phase.PRESS, SURFACE_M - 0.004, 2.2, SURFACE_M), level=False, came_to_rest=True).state == ProbeState.PRESSED
    again = State(state.folder)  # a restart
    again.clear_latch()
    with pytest.raises(Refused, match="no reference tare was kept: the probe is pressed"):
        calibrate(Host(settings(tmp_path), 2.2, SURFACE_M - 0.004), probe_free=True)
    job = measured_job("retract", settings(tmp_path), Plan())
    assert job.unfinished
    assert job.clear_z_m == pytest.approx(SURFACE_M + 0.005)
    assert job.reference == ZERO
    way_out = MarkedRun(job, again, ABOUT, ZERO, (*HOME[:2], SURFACE_M - 0.004, *HOME[3:]), "retract")
    kept = again.marker()
    assert kept is not None
    assert kept.surface_z_m == SURFACE_M, "the way out forgets nothing"
    assert way_out.end(rows(Phase.RETRACT, SURFACE_M + 0.006, site=-1), level=True, came_to_rest=True).state == ProbeState.FREE
    assert again.marker() is None


def test_the_force_at_the_end_is_that_of_the_arm_at_rest_and_not_a_mean_of_the_press(tmp_path: Path, state: State) -> None:
    pressing = rows(Phase.PRESS, SURFACE_M - 0.004, 4.2, SURFACE_M)
    pressing["tcp_pose"][:, 2] += np.linspace(0.004, 0.0, len(pressing))
    pressing["wrench"][:, :8, 2] += np.linspace(4.2, 0.0, len(pressing))[:, None]
    answer = marked(tmp_path, state).end(pressing, level=False, came_to_rest=True)
    assert answer.away_N == pytest.approx(4.2, abs=0.1)
    pressing["frames"][-10:] = 0  # the sensor fell silent while the arm pressed on
    answer = marked(tmp_path, state).end(pressing, level=False, came_to_rest=True)
    assert answer.state == ProbeState.PRESSED
    assert answer.away_N is not None
    assert answer.away_N < 4.2, "what was seen last is all that is known"


def test_a_run_whose_process_died_cannot_say_where_it_left_the_arm(tmp_path: Path, state: State) -> None:
    run = marked(tmp_path, state)
    answer = run.end(rows(Phase.TRAVEL, HOME[2]), level=False, came_to_rest=False)
    assert answer.state == ProbeState.UNKNOWN
    kept = state.marker()
    assert kept is not None
    assert not kept.at_rest


def test_a_run_that_was_refused_before_it_moved_leaves_what_was_known(tmp_path: Path, state: State) -> None:
    marked(tmp_path, state).undo()
    assert state.marker() is None
    marked(tmp_path, state, "level_test").end(rows(Phase.LIFT, HOME[2], 0.9, site=-1), level=True, came_to_rest=True)
    level = state.level()
    marked(tmp_path, state).undo()
    assert (state.marker(), state.level()) == (None, level)


def test_a_run_that_ended_on_its_first_way_up_does_not_say_that_its_start_was_free(tmp_path: Path, state: State) -> None:
    answer = marked(tmp_path, state).end(rows(Phase.DONE, HOME[2], site=-1), level=False, came_to_rest=True)
    assert answer.state == ProbeState.UNKNOWN
    kept = state.marker()
    assert kept is not None
    assert not kept.start_free


def test_an_unfinished_contact_is_forgotten_only_when_the_next_run_was_level(tmp_path: Path, state: State) -> None:
    marked(tmp_path, state).end(rows(Phase.PRESS, SURFACE_M - 0.004, 2.2, SURFACE_M), level=False, came_to_rest=True)
    again = MarkedRun(measured_job("palpation", settings(tmp_path), Plan()), state, ABOUT, (0.0,) * 6, HOME, "again")
    kept = state.marker()
    assert kept is not None
    assert (kept.run, kept.surface_z_m, kept.reference) == ("20260101-palpation", SURFACE_M, ZERO)
    again.follow(rows(Phase.TRAVEL, HOME[2]))
    kept = state.marker()
    assert kept is not None
    assert (kept.run, kept.surface_z_m, kept.start_free) == ("again", None, True)


def test_a_run_without_a_tick_leaves_its_mark(tmp_path: Path, state: State) -> None:
    answer = marked(tmp_path, state).end(np.zeros(0, ROW), level=False, came_to_rest=True)
    assert answer.state == ProbeState.UNKNOWN
    assert state.marker() is not None


def test_a_level_test_that_found_something_leaves_a_mark_and_opens_the_way_out(tmp_path: Path, state: State) -> None:
    answer = marked(tmp_path, state, "level_test").end(rows(Phase.LIFT, 0.1, 0.2, site=-1), level=False, came_to_rest=True)
    assert answer.ways == {"retract", "level_test"}
    assert state.marker() is not None


def test_a_level_test_that_was_level_frees_a_probe_whose_zero_has_moved_until_the_next_motion(tmp_path: Path, state: State) -> None:
    host = Host(settings(tmp_path), 0.9)
    with pytest.raises(Refused, match=r"0\.90 N off the reference tare.*--probe-free"):
        calibrate(host)
    answer = marked(tmp_path, state, "level_test").end(rows(Phase.LIFT, HOME[2], 0.9, site=-1), level=True, came_to_rest=True)
    assert answer.state == ProbeState.FREE
    assert calibrate(host).basis == "level"
    marked(tmp_path, state)
    assert state.level() is None


def test_a_damaged_marker_is_none_that_is_forgotten(tmp_path: Path, state: State) -> None:
    (state.folder / "contact.json").write_text('{"date": "today"}')
    with pytest.raises(ConfigError, match="no contact that can be read"):
        measured_job("palpation", settings(tmp_path), Plan())


def test_a_marker_comes_back_from_the_disk_as_it_was(state: State) -> None:
    marker = ContactMarker(
        "today", "run", HOME, HOME, 0.005, ZERO, ProbeIdentity("PRE00042", (0.2, 0.005, 0.08), None), "A", 0.1, True, True
    )
    state.keep("contact", marker)
    assert state.marker() == marker


# --- a new reference --------------------------------------------------------------------------------------------------------------


class Host:
    """Hands out one reference tare, of that force against the zero."""

    operator = "Ann"

    def __init__(self, config: Config, force_N: float, z_m: float = HOME[2]) -> None:
        self.config, self.force_N, self.z_m = config, force_N, z_m

    def carry_out(self, *_: Any) -> Report:
        from palpd.daemon.probe_record import evidence_of

        wrench = (*ZERO[:2], ZERO[2] - self.force_N, *ZERO[3:])
        return Report("done", about=ABOUT, evidence=evidence_of(self.config, ABOUT, (*HOME[:2], self.z_m, *HOME[3:]), wrench))


def taken(tmp_path: Path, force_N: float, **options: Any) -> Calibration:
    return calibrate(Host(settings(tmp_path), force_N), **options)  # type: ignore[arg-type]


def test_the_first_reference_of_a_state_folder_is_itself_the_yes_and_called_unconfirmed(tmp_path: Path) -> None:
    first = taken(tmp_path, 0.0)
    assert (first.basis, first.by, first.away_N) == ("unconfirmed", "Ann", None)
    assert taken(tmp_path, 0.1).basis == "free"


def test_a_yes_is_kept_with_who_said_it_and_both_numbers(tmp_path: Path) -> None:
    taken(tmp_path, 0.0)
    with pytest.raises(Refused, match="--probe-free"):
        taken(tmp_path, 1.2)
    kept = taken(tmp_path, 1.2, probe_free=True)
    assert (kept.basis, kept.by, kept.away_N, kept.first) == ("yes", "Ann", pytest.approx(1.2), ZERO)


def test_small_steps_do_not_add_up_beyond_3_N_from_the_first_reference(tmp_path: Path) -> None:
    taken(tmp_path, 0.0)
    for force_N in (1.4, 2.8):
        taken(tmp_path, force_N, probe_free=True)
    with pytest.raises(Refused, match=r"4\.2 N off the first reference tare"):
        taken(tmp_path, 4.2, probe_free=True)
    assert taken(tmp_path, 2.9).basis == "free"


def test_another_sensor_begins_a_new_first_reference_with_a_yes(tmp_path: Path) -> None:
    State(tmp_path / "state").keep("calibration", replace(taken(tmp_path, 0.0), sensor_serial="PRE00007"))
    with pytest.raises(Refused, match="PRE00007"):
        taken(tmp_path, 8.0)
    kept = taken(tmp_path, 8.0, probe_free=True)
    assert kept.first == kept.wrench


def test_a_run_that_takes_its_own_reference_has_the_operators_word_in_a_new_folder_only(tmp_path: Path, state: State) -> None:
    fresh = settings(tmp_path / "fresh")
    assert measured_job("palpation", fresh, Plan(), take_reference=True).confirmed
    assert not measured_job("palpation", settings(tmp_path), Plan(), take_reference=True).confirmed


def test_a_recording_holds_the_date_of_the_reference_that_its_forces_count_from(tmp_path: Path, state: State) -> None:
    kept = state.calibration()
    assert kept is not None
    job = measured_job("palpation", settings(tmp_path), Plan())
    assert header_of(job, DEVICES, kept.wrench, HOME)["reference_date"] == kept.date
    own = measured_job("palpation", settings(tmp_path / "fresh"), Plan(), take_reference=True)
    assert header_of(own, DEVICES, kept.wrench, HOME)["reference_date"]


def test_jobs_that_move_show_on_a_way_up_that_they_are_free(tmp_path: Path, state: State) -> None:
    kinds: tuple[Kind, ...] = ("palpation", "free_motion", "stiffness", "level_test")
    assert [measured_job(kind, settings(tmp_path), Plan()).lifts_first for kind in kinds] == [True, True, True, False]


def test_a_return_is_refused_where_no_palpation_is_unfinished(tmp_path: Path, state: State) -> None:
    """It counted the sites from wherever the arm stood: site A of the table was the tissue under site B."""
    ended = PlanPlace("2026-01-01", "20260101-palpation", (0.03, 0.0), (0.03, 0.0, 0.13), 0.135, (), returned=True)
    for last in (None, ended):
        if last is not None:
            state.keep("place", last)
        with pytest.raises(Refused, match="no palpation is unfinished, so there is no start to return to"):
            measured_job("palpation", settings(tmp_path), Plan(), choice="return")
    state.keep("place", replace(ended, returned=False))
    assert measured_job("palpation", settings(tmp_path), Plan(), choice="return").back_to_m == ended.start_m


def test_a_state_file_that_cannot_be_removed_is_a_refusal(state: State) -> None:
    """On a disk that became read-only during a run, the end of the run and the service died of an OSError."""
    (state.folder / "latch.json").mkdir()
    with pytest.raises(Refused, match=r"latch\.json cannot be removed"):
        state.clear_latch()
