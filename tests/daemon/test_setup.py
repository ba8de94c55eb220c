"""The flow of `palpd setup` without devices: what is kept, what is offered, and what the report says."""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from palpd.config import Config, load_config
from palpd.daemon.display import NoDisplay
from palpd.daemon.finding import Finding
from palpd.daemon.robot_stops import ProtectiveStops
from palpd.daemon.setup import flow
from palpd.daemon.setup.cell import NoOperator, SetupCell
from palpd.daemon.setup.commission import Commission, StepResult, seen
from palpd.daemon.setup.discovery import sensor_ports
from palpd.daemon.setup.flow import STEPS, SetupStep, set_up
from palpd.daemon.setup.report import ASSUMPTIONS, measured_cell
from palpd.daemon.setup.watchdog import SILENT_S, SPOKEN_S, SilentRobot, stopped_after_s
from palpd.daemon.starting_files import write_starting_files
from palpd.daemon.stored_state import now
from palpd.errors import BadInput, ConfigError, Refused, SensorError
from palpd.migration import with_values
from palpd.tick import ROW, Robot
from tests.paths import ROOT


class Answers:
    """An operator with a list of answers; the last one is repeated."""

    def __init__(self, *answers: str) -> None:
        self.answers, self.shown = list(answers), list[str]()

    def say(self, sentence: str) -> None:
        self.shown.append(sentence)

    def ask(self, question: str, usual: str = "") -> str:
        self.shown.append(question)
        return (self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]) or usual

    def choose(self, question: str, answers: Sequence[str], moves: str = "") -> str:
        assert moves not in answers[:1], "Enter alone would move the arm"
        answer = self.ask(f"{question} {answers}", answers[0])
        return answer if answer in answers else answers[0]


def cell(folder: Path, *answers: str) -> tuple[SetupCell, Answers]:
    operator = Answers(*answers)
    return SetupCell(folder, operator, NoDisplay()), operator


def steps(monkeypatch: pytest.MonkeyPatch, **carried_out: Callable[[SetupCell], Sequence[Finding]]) -> None:
    """Three steps in place of the real ones: the last moves and needs the first."""

    def fine(_: SetupCell) -> Sequence[Finding]:
        return [seen("thing", "1 N", "1 N", force_N=1.0)]

    three = tuple(
        SetupStep(name, f"Does {name}.", carried_out.get(name, fine), ("one",) if name == "three" else (), moves=name == "three")
        for name in ("one", "two", "three")
    )
    monkeypatch.setattr(flow, "STEPS", three)
    monkeypatch.setattr(flow, "NAMES", tuple(step.name for step in three))


def verdicts(commission: Commission) -> dict[str, str]:
    return {name: result.verdict for name, result in commission.steps.items()}


def test_the_rows_of_the_report_are_those_of_the_readme() -> None:
    section = (ROOT / "README.md").read_text().split("## Never tested on hardware")[1].split("## ")[0]
    rows = [line.split(" | ")[0].removeprefix("| ") for line in section.splitlines() if line.startswith("| ")]
    assert rows[1:] == [assumption.rests_on for assumption in ASSUMPTIONS]


def test_the_steps_of_the_page_are_those_of_the_flow() -> None:
    page = (ROOT / "docs" / "how-to" / "setup.md").read_text()
    rows = re.findall(
        r"^\| `([a-z-]+)` \| .* \| ([^|]*) \| ([^|]*) ?\|$", page.split("| step |")[1].split("**Never")[0], flags=re.MULTILINE
    )
    assert [(name, set(re.findall("`([a-z-]+)`", needs)), not stands.startswith("stands")) for name, stands, needs in rows] == [
        (step.name, set(step.needs), step.moves) for step in STEPS
    ]


def test_a_kill_in_a_step_loses_nothing_that_was_measured_and_the_same_command_goes_on_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(_: SetupCell) -> Sequence[Finding]:
        raise KeyboardInterrupt

    steps(monkeypatch, two=killed)
    with pytest.raises(KeyboardInterrupt):
        set_up(cell(tmp_path, "go")[0])
    kept = json.loads((tmp_path / "state" / "commission.json").read_text())["steps"]
    assert kept["one"]["verdict"] == "ok"
    assert kept["one"]["findings"][0]["figures"] == {"force_N": 1.0}
    steps(monkeypatch)
    setup, operator = cell(tmp_path, "go")
    assert verdicts(set_up(setup)) == dict.fromkeys(("one", "two", "three"), "ok")
    assert "1/3 one: ok on" in operator.shown[0]


def test_a_step_that_moves_is_not_offered_after_a_failure_or_without_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: SetupCell) -> Sequence[Finding]:
        raise SensorError("the sensor is silent; plug it in")

    steps(monkeypatch, two=fails)
    setup, operator = cell(tmp_path, "go", "go", "stop")
    assert verdicts(set_up(setup)) == {"one": "ok", "two": "fail"}
    assert any("FAIL  two: the sensor is silent" in shown for shown in operator.shown)
    failed = Commission({"one": StepResult("", "ok"), "two": StepResult("", "fail")})
    assert flow.missing_for(flow.STEPS[2], failed) == ["two"]
    assert flow.missing_for(flow.STEPS[2], Commission({"one": StepResult("", "skipped"), "two": StepResult("", "skipped")})) == ["one"]
    assert flow.missing_for(flow.STEPS[2], Commission({"one": StepResult("", "warn"), "two": StepResult("", "skipped")})) == []


def test_a_step_that_moves_waits_for_the_written_cause_of_a_second_protective_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps(monkeypatch)
    setup, operator = cell(tmp_path, "go", "go", "go", "stop")
    setup.state.keep("protective", ProtectiveStops().begin(now(), moved=True).begin(now(), moved=True))
    assert verdicts(set_up(setup)) == {"one": "ok", "two": "ok", "three": "fail"}
    assert any("its cause must be written down. Do: palpd recover-robot" in shown for shown in operator.shown)


def test_a_step_is_skipped_redone_and_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps(monkeypatch)
    assert verdicts(set_up(cell(tmp_path, "go")[0], skip=("two",))) == {"one": "ok", "two": "skipped", "three": "ok"}
    assert verdicts(set_up(cell(tmp_path, "go")[0], redo=("two",)))["two"] == "ok"
    assert verdicts(set_up(cell(tmp_path, "go")[0], skip=("two",)))["two"] == "ok", "what was measured stays"
    with pytest.raises(BadInput, match="'four' is no step of palpd setup; expected one of one, two, three"):
        set_up(cell(tmp_path, "go")[0], redo=("four",))


def test_a_question_that_nobody_answers_ends_the_flow_and_is_no_failed_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def asks(_: SetupCell) -> Sequence[Finding]:
        raise NoOperator("nobody answers; use a terminal")

    steps(monkeypatch, two=asks)
    with pytest.raises(NoOperator):
        set_up(cell(tmp_path, "go")[0])
    assert verdicts(cell(tmp_path, "go")[0].state.commission()) == {"one": "ok"}


def test_a_key_is_set_and_the_rest_of_the_file_stays(tmp_path: Path) -> None:
    write_starting_files(tmp_path, "ur5", 12.0, ())
    setup, before = cell(tmp_path, "")[0], (tmp_path / "config.yaml").read_text()
    setup.change(
        {("robot", "host"): "192.168.1.9", ("sensor", "counts_per_N"): [41.0, 41.0, 7.6], ("sensor", "counts_per_Nm"): [1.0, 1.0, 1.0]}
    )
    after = (tmp_path / "config.yaml").read_text()
    assert load_config(tmp_path / "config.yaml").robot.host == "192.168.1.9"
    changed = [pair for pair in zip(before.splitlines(), after.splitlines(), strict=True) if pair[0] != pair[1]]
    assert len(changed) == 3
    assert all(old.partition("#")[2] == new.partition("#")[2] for old, new in changed)
    with pytest.raises(ConfigError):
        setup.change({("robot", "model"): "ur16"})
    assert (tmp_path / "config.yaml").read_text() == after


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("robot:\n  # mine\n  host: a  # b\n", 'robot:\n  # mine\n  model: "ur5"\n  host: a  # b\n'),
        ("robot: {host: a}\n", 'robot: {model: "ur5", host: a}\n'),
        ("sensor: {port: a}\n", 'sensor: {port: a}\nrobot:\n  model: "ur5"\n'),
    ],
)
def test_a_key_that_is_absent_is_added(text: str, expected: str) -> None:
    assert with_values(text, {("robot", "model"): "ur5"}) == expected


def test_a_daq_is_known_by_its_usb_identity(tmp_path: Path) -> None:
    by_id, tty = tmp_path / "by-id", tmp_path / "tty"
    by_id.mkdir()
    for number, product in enumerate(("000a", "6001")):
        device = tmp_path / f"usb{number}"
        (device / "interface").mkdir(parents=True)
        (device / "idVendor").write_text("04d8\n")
        (device / "idProduct").write_text(f"{product}\n")
        (tty / f"ttyACM{number}").mkdir(parents=True)
        (tty / f"ttyACM{number}" / "device").symlink_to(device / "interface")
        (by_id / f"usb-device-{number}").symlink_to(f"/dev/ttyACM{number}")
    assert sensor_ports(by_id, tty, tmp_path / "absent") == [by_id / "usb-device-0"]
    assert sensor_ports(tmp_path / "none", tty, by_id) == [by_id]


def test_a_silent_robot_keeps_speeds_back_for_half_a_second_and_passes_each_stop() -> None:
    sent: list[str] = []
    robot = SimpleNamespace(move=lambda _: sent.append("move"), stop=lambda: sent.append("stop"), end=lambda: None, read=lambda: None)
    silent = SilentRobot(cast(Robot, robot), rate_Hz=100.0)
    for speed_m_per_s in (*[0.0] * 30, *[0.005] * 100):
        silent.move((0.0, 0.0, speed_m_per_s))
    assert len(sent) == 130 - 100 * SILENT_S
    silent = SilentRobot(cast(Robot, robot), rate_Hz=100.0)
    sent.clear()
    for _ in range(round(100 * SPOKEN_S) + 3):
        silent.move((0.0, 0.0, 0.005))
    silent.stop()
    assert sent == ["move"] * round(100 * SPOKEN_S) + ["stop"]


def test_the_watchdogs_time_counts_from_the_last_speed_that_went_out() -> None:
    rows = np.zeros(80, ROW)
    rows["now_s"] = rows["robot_t_s"] = np.arange(80) * 0.01
    rows["work_us"], rows["runtime_state"] = 2000.0, 2
    rows["command_m_per_s"][10:, 2] = 0.005
    assert stopped_after_s(rows, 100.0) is None
    rows["runtime_state"][55:] = 1
    assert stopped_after_s(rows, 100.0) == pytest.approx(0.55 - (0.10 + 0.39 + 0.002))


def commissioned() -> Commission:
    def result(finding: Finding) -> StepResult:
        return StepResult("2026-11-01", finding.verdict, (finding,))

    return Commission(
        {
            "look": result(seen("noise", "", "", noise_fxy_N=0.04, rate_Hz=1000.0, arrival_every_ms=16.0, warns=True)),
            "sensor": result(seen("filter", "", "", filter_cutoff_Hz=None, from_registers=1)),
            "weight": result(seen("known weight", "", "", ratio=1.02, slopes_part_at="load")),
            "watchdog": result(seen("watchdog", "", "", stopped_after_ms=53.0)),
            "stiffness": result(seen("machine stiffness", "", "", stiffness_N_per_m=45_000.0)),
        }
    )


def test_each_row_is_confirmed_different_or_not_tried() -> None:
    states = [assumption.state(commissioned()) for assumption in ASSUMPTIONS]
    assert states == [
        "not tried",
        "not tried",
        "confirmed: after 53 ms",
        "not tried",
        "not tried",
        "different: they part at the load",
        "confirmed: a hung weight reads +1.02 of itself",
        "confirmed: a known weight reads 1.02 of itself",
        "different: 1000 frames/s; order and place of the filter not tried",
        "different: frames arrive every 16.0 ms",
        "not tried",
    ]
    assert {assumption.state(Commission()) for assumption in ASSUMPTIONS} == {"not tried"}


def test_the_cell_file_takes_what_was_measured_and_keeps_the_rest() -> None:
    config: Any = Config()
    cell_file = measured_cell(config, commissioned())
    assert (cell_file.sensor.noise_rms_N, cell_file.sensor.filter_cutoff_Hz) == (0.04, None)
    assert cell_file.effects == {"robot.compliance": {"stiffness_N_per_m": 45_000.0}}
    assert cell_file.robot == config.cell.robot


def test_a_cell_whose_service_runs_is_refused_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_starting_files(tmp_path, "ur5", 12.0, ())
    monkeypatch.setattr(flow, "service_at", lambda _: True)
    with pytest.raises(Refused, match=r"the service of this cell holds the devices; stop it \(systemctl stop palpd\)"):
        set_up(cell(tmp_path, "go")[0])


def test_enter_alone_moves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps(monkeypatch)
    assert verdicts(set_up(cell(tmp_path, "")[0])) == {"one": "ok", "two": "ok"}
