"""The morning check as a program: runs of the real sequence on a simulated cell, the files that it keeps, and what a palpation needs."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from palpd.cell.cell_file import cell_from
from palpd.cli.jobs import carried_out
from palpd.config import CheckConfig, Config, PathsConfig, Plan, PlanSite, parse_plan
from palpd.control.plan_place import PlanPlace
from palpd.daemon import morning_check as program
from palpd.daemon.display import NoDisplay
from palpd.daemon.finding import Finding
from palpd.daemon.interrupts import Interrupted
from palpd.daemon.motion_job import Job, Kind
from palpd.daemon.program_host import ProposedMotion
from palpd.daemon.programs import PROGRAMS, CheckArguments
from palpd.daemon.required_check import check_plan, refuse_unchecked, still_on_the_check
from palpd.daemon.simulated_run import run
from palpd.daemon.stored_state import LastCheck, Latch, State, now
from palpd.daemon.supervisor import Report
from palpd.errors import BadInput, ConfigError, PalpdError, Refused, SensorError
from palpd.history.check_days import kept_checks, since_baseline
from palpd.testing.simulated_recording import write_rows

HEALTHY: Mapping[str, Mapping[str, float]] = {"robot.compliance": {"stiffness_N_per_m": 50e3}}
OTHER: Mapping[str, Mapping[str, float]] = {
    "robot.compliance": {"stiffness_N_per_m": 40e3}, "sensor.gain": {"error": 0.08}, "sensor.latency": {"delay_s": 0.01},
    "robot.backlash": {"width_m": 1e-4},
}  # fmt: skip
NOW = datetime.fromisoformat("2026-11-22T08:00:00+01:00")


@dataclass
class SimulatedHost:
    """Carries out the runs of a check on a simulated cell with effects; the plate is a wall."""

    config: Config
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: HEALTHY)
    operator: str = "test"
    display: NoDisplay = field(default_factory=NoDisplay)
    runs: int = 0

    def carry_out(self, kind: Kind, plan: Plan, recording: Path | None = None, take_reference: bool = False, here: bool = False) -> Report:
        self.runs += 1
        content: dict[str, Any] = {"effects": self.effects}
        if kind == "stiffness":
            content["wall"] = {"z_m": 0.0, "stiffness_N_per_m": 1e6}
        work = Job(kind, self.config, plan, reference=(0.0,) * 6, lifts_first=True)
        simulated = run(work, cell_from(content, "the cell"), home_above_m=0.006, seed=self.runs)
        assert simulated.outcome.verdict == "done", simulated.outcome.reason
        folder = self.config.paths.runs
        folder.mkdir(parents=True, exist_ok=True)
        about: Any = {"sensor_serial": "SIM", "delay_s": 1.06e-3, "epoch_offset_s": 1.79e9}
        path = write_rows(folder / f"{len(list(folder.glob('*.mcap')))}-{kind}.mcap", simulated.rows, work, about, {"verdict": "done"})
        return Report("done", "", 0, recording=path)

    def observe(self, watch_s: float) -> tuple[Finding, ...]:
        raise AssertionError(watch_s)

    def approve(self, motion: ProposedMotion) -> bool:
        raise AssertionError(motion)


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return Config(check=CheckConfig(plate=True), paths=PathsConfig(runs=tmp_path / "runs", state=tmp_path / "state"))


def test_a_check_measures_what_the_cell_has_and_a_second_one_finds_the_change(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program, "compared", lambda healthy, today: {"verdict": "effects", "effects": [{"id": f"of {len(healthy)}"}]})
    _, first = program.morning_check(SimulatedHost(config), 21.0)
    assert first is not None
    assert (first["level"], first["diagnosis"], first["causes"]) == ("ok", None, [])
    features = first["features"]
    assert features["puck_modulus_Pa"] == pytest.approx(72e3, rel=0.05)
    assert features["plate_stiffness_N_per_m"] == pytest.approx(1.0 / (1.0 / 50e3 + 1e-6), rel=0.03)
    assert abs(features["play_m"]) < 1e-5
    assert abs(features["delay_s"]) < 1e-3
    _, second = program.morning_check(SimulatedHost(config, OTHER), None)
    assert second is not None
    features = second["features"]
    assert features["play_m"] == pytest.approx(1e-4, rel=0.25)
    assert features["delay_s"] == pytest.approx(0.01, abs=0.0015)
    assert features["plate_stiffness_N_per_m"] == pytest.approx(1.08 / (1.0 / 40e3 + 1e-6), rel=0.03)
    assert (second["level"], second["named"]) == ("stop", ["of 1"])
    last = State(config.paths.state).last_check()
    assert last is not None
    assert last.level == "stop"
    # what was on purpose begins a new baseline, and is well then
    renewed = program.renewed_baseline(config, " new mount ")
    assert (renewed["level"], renewed["baseline"]["note"], renewed["recording"]) == ("ok", "new mount", second["recording"])
    assert State(config.paths.state).last_check() == LastCheck(second["date"], "ok", "Nothing has changed.", 2)
    assert len(since_baseline(kept_checks(config.paths.runs))) == 1
    with pytest.raises(BadInput, match="the note of a new baseline is empty"):
        program.renewed_baseline(config, " ")
    # one that was stopped since then shows no change that could be on purpose
    program.morning_check(StoppedHost(config), None)
    with pytest.raises(BadInput, match="is not; repeat palpd check first"):
        program.renewed_baseline(config, "new mount")


def test_checks_are_in_the_order_of_their_making_where_the_clock_was_set_back(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """The newest check was judged and shown as the oldest, and a new baseline of it was refused with "repeat palpd check first"."""
    monkeypatch.setattr(program, "compared", lambda healthy, today: {})
    for date in ("2026-12-24T08:00:00+01:00", "2026-11-24T08:00:00+01:00"):
        monkeypatch.setattr(program, "now", lambda date=date: date)
        program.morning_check(SimulatedHost(config), None)
    assert [check.day.date[:7] for _, check in kept_checks(config.paths.runs)] == ["2026-12", "2026-11"]
    renewed = program.renewed_baseline(config, "new mount")
    assert renewed["date"].startswith("2026-11")
    assert len(since_baseline(kept_checks(config.paths.runs))) == 1


def test_a_kept_check_that_cannot_be_read_is_said_before_the_arm_moves(config: Config) -> None:
    config.paths.runs.mkdir()
    (config.paths.runs / "odd.check.json").write_text("{}")
    host = SimulatedHost(config)
    with pytest.raises(BadInput, match=r"odd\.check\.json holds no check"):
        program.morning_check(host, None)
    assert (host.runs, State(config.paths.state).last_check()) == (0, None)


def test_another_number_of_the_configuration_is_said_and_is_no_change_of_the_puck(config: Config) -> None:
    bare = config.model_copy(update={"check": CheckConfig()})
    program.morning_check(SimulatedHost(bare), None)
    softer = bare.model_copy(update={"cell": cell_from({"tissue": {"poisson_ratio": 0.3}}, "the cell")})
    _, second = program.morning_check(SimulatedHost(softer), None)
    assert second is not None
    assert second["level"] == "ok", second["sentence"]
    assert "The configuration has changed since the check of" in second["note"]
    assert "(cell.tissue.poisson_ratio from 0.5 to 0.3)" in second["note"]
    _, third = program.morning_check(SimulatedHost(softer, {"sensor.gain": {"error": 0.08}}), None)
    assert third is not None
    assert (third["causes"], third["note"]) == (["puck"], "")


def test_checks_that_are_gone_are_said_and_those_that_come_back_are_earlier(config: Config, tmp_path: Path) -> None:
    """With paths.runs on a new disk a scale that was off by 8 % became the commissioning: "ok: nothing has changed"."""
    bare = config.model_copy(update={"check": CheckConfig()})
    program.morning_check(SimulatedHost(bare), None)
    moved = bare.with_runs(tmp_path / "new-disk")
    _, second = program.morning_check(SimulatedHost(moved, {"sensor.gain": {"error": 0.08}}), None)
    assert second is not None
    assert (second["level"], second["causes"]) == ("ok", [])
    assert f"Checks before number 2 of {second['date'][:10]} are no longer in {tmp_path / 'new-disk'}" in second["note"]
    for path in bare.paths.runs.glob("*.check.json"):
        path.rename(moved.paths.runs / f"back-{path.name}")
    assert [check.number for _, check in kept_checks(moved.paths.runs)] == [1, 2]
    _, third = program.morning_check(SimulatedHost(moved, {"sensor.gain": {"error": 0.08}}), None)
    assert third is not None
    assert (third["causes"], third["note"]) == (["puck"], "")
    assert program.renewed_baseline(moved, "another puck")["note"] == ""


def test_a_new_baseline_needs_a_check(config: Config) -> None:
    with pytest.raises(BadInput, match="there is no check in"):
        program.renewed_baseline(config, "new mount")


@pytest.mark.parametrize(
    ("last", "words"),
    [
        (None, "no check of this cell is kept"),
        (LastCheck((NOW - timedelta(hours=25)).isoformat(), "ok", ""), "the last check is 25.0 h old, expected at most 24 h"),
        (LastCheck((NOW + timedelta(hours=1)).isoformat(), "ok", ""), "after now: the clock was set back, so its age is not known"),
        (LastCheck(NOW.isoformat(), "stop", "The force comes later."), "says not to palpate. The force comes later."),
    ],
)
def test_a_palpation_without_its_check_is_refused(config: Config, last: LastCheck | None, words: str) -> None:
    plan = Plan(sites=(PlanSite(name="A"),))
    asks = config.model_copy(update={"check": CheckConfig(require_check_h=24.0)})
    with pytest.raises(Refused, match=words):
        refuse_unchecked(asks, plan, last, NOW)
    refuse_unchecked(config, plan, last, NOW)  # absent: none is needed
    # the check itself needs none, also where its plan came as a job's message
    refuse_unchecked(asks, parse_plan(check_plan(asks).model_dump(mode="json"), "the plan of the job"), last, NOW)


def test_a_fresh_check_that_warns_lets_a_palpation_through(config: Config) -> None:
    asks = config.model_copy(update={"check": CheckConfig(require_check_h=24.0)})
    refuse_unchecked(asks, Plan(), LastCheck((NOW - timedelta(hours=1)).isoformat(), "warn", "The puck has changed."), NOW)


@pytest.mark.parametrize("content", ['{"a": 1}', '{"date": "yesterday", "level": "ok", "sentence": "Nothing has changed."}'])
def test_a_kept_check_that_is_damaged_is_refused_with_a_way_out_that_leads_on(config: Config, content: str) -> None:
    """It said to run palpd check, which reads the same file, and a date that is none was a traceback."""
    state = State(config.paths.state)
    state.keep("check", LastCheck(now(), "ok", "Nothing has changed."))
    (state.folder / "check.json").write_text(content)
    with pytest.raises(ConfigError, match=r"check\.json holds no check; delete it, and run palpd check again"):
        program.morning_check(SimulatedHost(config), None)


def test_a_check_clears_no_latch(config: Config) -> None:
    state = State(config.paths.state)
    state.keep("latch", Latch("the probe was caught", "2026-11-22"))
    with pytest.raises(Refused, match="the last run was stopped on 2026-11-22: the probe was caught"):
        carried_out("check", {}, config, config.paths.state)
    assert state.latch() is not None


class StoppedHost(SimulatedHost):
    """A cell without a puck."""

    def carry_out(self, kind: Kind, plan: Plan, recording: Path | None = None, take_reference: bool = False, here: bool = False) -> Report:
        if kind == "stiffness":
            return super().carry_out(kind, plan)
        return Report("stopped", "no contact of 1 N was met", 3)


def test_a_check_that_is_stopped_counts_as_none_whatever_the_one_before_gave(config: Config) -> None:
    state = State(config.paths.state)
    state.keep("check", LastCheck(now(), "ok", "Nothing has changed."))
    _, figures = program.morning_check(StoppedHost(config), None)
    assert figures is None
    asks = config.model_copy(update={"check": CheckConfig(require_check_h=24.0)})
    with pytest.raises(Refused, match="did not come to its end: no contact of 1 N was met"):
        refuse_unchecked(asks, Plan(), state.last_check(), datetime.now().astimezone())


def test_a_check_whose_program_died_counts_as_none(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    state = State(config.paths.state)
    state.keep("check", LastCheck(now(), "ok", "Nothing has changed."))

    def died(*_: object, **__: object) -> Report:
        raise MemoryError

    monkeypatch.setattr(SimulatedHost, "carry_out", died)
    with pytest.raises(MemoryError):
        program.morning_check(SimulatedHost(config), None)
    asks = config.model_copy(update={"check": CheckConfig(require_check_h=24.0)})
    with pytest.raises(Refused, match=r"the last check says not to palpate\. It did not come to its end"):
        refuse_unchecked(asks, Plan(), state.last_check(), datetime.now().astimezone())


@pytest.mark.parametrize("before", [None, LastCheck("2026-11-22T08:00:00+01:00", "ok", "Nothing has changed.")])
@pytest.mark.parametrize("why", [Refused("the sensor is cold"), SensorError("the sensor is cold")], ids=["refused", "no device"])
def test_a_check_that_was_refused_before_it_moved_leaves_the_one_before(
    config: Config, before: LastCheck | None, why: PalpdError, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = State(config.paths.state)
    if before is not None:
        state.keep("check", before)

    def refused(*_: object, **__: object) -> Report:
        raise why

    monkeypatch.setattr(SimulatedHost, "carry_out", refused)
    with pytest.raises(type(why), match="cold"):
        program.morning_check(SimulatedHost(config), None)
    assert state.last_check() == before


def interrupted(*_: object, **__: object) -> Report:
    raise Interrupted("interrupted by SIGINT while the devices were being opened")


def test_no_plate_is_pressed_where_the_last_palpation_did_not_return_before_the_operator_says_so(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    State(config.paths.state).keep("place", PlanPlace("2026-11-22", "a-run", (0.0, 0.0), (0.0, 0.0, 0.1), 0.1, (("A", 0.03, 0.0),)))
    host = SimulatedHost(config)
    with pytest.raises(Refused, match=r"the run a-run of 2026-11-22 was not finished.*with --here"):
        program.morning_check(host, None)
    assert host.runs == 0
    last = State(config.paths.state).place()
    (config.paths.state / "check.json").write_text("{}")
    with pytest.raises(ConfigError, match="holds no check"):
        PROGRAMS["check"].carry_out(host, CheckArguments(here=True), Path())
    assert (host.runs, State(config.paths.state).place()) == (0, last), "the word counted for a check that was refused"
    (config.paths.state / "check.json").unlink()
    with monkeypatch.context() as patch:
        patch.setattr(SimulatedHost, "carry_out", interrupted)
        with pytest.raises(Interrupted):
            PROGRAMS["check"].carry_out(host, CheckArguments(here=True), Path())
    assert State(config.paths.state).place() == last, "the word counted for a check that Ctrl-C has ended before it moved"
    end = PROGRAMS["check"].carry_out(host, CheckArguments(here=True), Path())
    assert (end.verdict, end.figures["level"]) == ("done", "ok")


def test_a_palpation_over_the_plate_of_the_last_check_is_questioned_and_a_check_is_not() -> None:
    check = PlanPlace("today", "check", (0.4, 0.1), (0.4, 0.1, 0.2), 0.205, (("puck", 0.03, 0.0),), returned=True)
    run = replace(check, run="run", sites=(("A", 0.1, 0.0), ("B", 0.001, 0.0)))
    assert "site B is where the check before this run pressed its plate" in still_on_the_check(run, check, plate=True)
    assert not still_on_the_check(run, check, plate=False)
    assert not still_on_the_check(check, check, plate=True)
    assert not still_on_the_check(run, run, plate=True)
