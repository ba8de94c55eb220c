"""A command in the foreground clears the latch of the last stop, but not where it is refused."""

from pathlib import Path

import pytest
import yaml

from palpd.daemon.robot_stops import ProtectiveStops
from palpd.daemon.stored_state import Calibration, Latch, State, now
from tests.cli.test_history import refusal, typed

STOP = Latch("the force was 30 N", "2026-07-14T12:00:00+02:00")


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> State:
    """A folder with a configuration and a plan, in which the last run was stopped."""
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text(yaml.safe_dump({"paths": {"runs": "runs", "state": "state"}}))
    Path("plan.yaml").write_text(yaml.safe_dump({"sites": [{"name": "A"}], "depths_m": [0.004]}))
    state = State(tmp_path / "state")
    state.keep("latch", STOP)
    return state


@pytest.mark.parametrize(
    "command",
    ["run", "inject", "resolve", "resolve --here", "map --config config.yaml", "stiffness", "free-motion --out f.mcap"],
)
def test_a_command_that_is_refused_leaves_the_latch(state: State, command: str) -> None:
    assert "there is no reference tare" in refusal(*command.split())
    assert state.latch() == STOP


def test_a_check_that_is_needed_and_a_latch_do_not_wait_for_each_other(state: State) -> None:
    Path("config.yaml").write_text(yaml.safe_dump({"paths": {"runs": "runs", "state": "state"}, "check": {"require_check_h": 24}}))
    state.keep("calibration", Calibration((0.0,) * 6, now(), None))
    assert "run palpd check first" in refusal("run")
    assert "look at the cell, then palpd clear" in refusal("check")
    assert typed("clear").stdout == "cleared; no service answers\n"
    assert state.latch() is None


def test_without_a_service_a_clear_keeps_its_rules(state: State) -> None:
    state.keep("protective", ProtectiveStops().begin(now(), moved=True).begin(now(), moved=True))
    assert "palpd clear --cause TEXT" in refusal("clear")
    (state.folder / "contact.json").write_text("{half")
    assert "a contact is unfinished; palpd retract" in refusal("clear", "--cause", "the frame")
    assert state.latch() == STOP
    state.forget("contact")
    typed("clear", "--cause", "the frame")
    assert state.latch() is None
    assert state.protective_stops().stops[-1].cause == "the frame"
