"""The moduli of a run as they come, and the process beside the server that computes them."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

from palpd.cell.cell_file import PHANTOM
from palpd.config import Config, Plan, PlanSite
from palpd.daemon.motion_job import Job
from palpd.daemon.run_result import simulated_result
from palpd.daemon.simulated_run import SimulatedRecording, run
from palpd.errors import RecordingError, Refused
from palpd.recording.mcap_file import RecordingWriter
from palpd.web.aside import Aside
from palpd.web.site_moduli import LiveModuli, moduli_of

PLAN = Plan(sites=(PlanSite(name="A"), PlanSite(name="B", x_m=0.03)), depths_m=(0.004,), mode="static", hold_s=0.5)


@pytest.fixture(scope="module")
def simulated() -> SimulatedRecording:
    """A run over two sites."""
    return run(Job("palpation", Config(), PLAN), PHANTOM)


@pytest.fixture(scope="module")
def unfinished(simulated: SimulatedRecording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its recording while it is still written: it has no end."""
    path = tmp_path_factory.mktemp("runs") / "20260714-101502-palpation.mcap"
    writer = RecordingWriter(path, {"kind": "palpation", "dry": False, **simulated.header})
    writer.write(simulated.rows)
    writer.flush()
    return writer.part


def test_the_moduli_of_an_unfinished_recording_are_those_of_its_run(simulated: SimulatedRecording, unfinished: Path) -> None:
    result = simulated_result(simulated)
    live = moduli_of(str(unfinished))
    assert [site["name"] for site in live] == ["A", "B"]
    for ours, theirs in zip(live, result["sites"], strict=True):
        assert ours["static_Pa"] == pytest.approx(theirs["static_youngs_modulus_Pa"])
        assert ours["static_ci95_Pa"] == pytest.approx(theirs["static_ci95_Pa"])
        assert ours["dynamic_Pa"] is None
    assert live[0]["x_m"] is not None
    assert live[1]["x_m"] == pytest.approx(live[0]["x_m"] + 0.03, abs=1e-3)
    assert moduli_of(str(unfinished.with_suffix(".mcap"))) == live, "it may be renamed while somebody asks"


def test_a_recording_that_is_gone_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be read"):
        moduli_of(str(tmp_path / "absent.part"))


class Beside(Aside):
    """Computes at once, and remembers what."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[str] = []

    async def compute(self, function: Any, *arguments: Any, **named: Any) -> Any:
        self.asked.append(Path(arguments[0]).name)
        if "bad" in arguments[0]:
            raise Refused("this was not computed")
        return [{"name": Path(arguments[0]).stem}]


def heard(statuses: list[dict[str, Any]]) -> tuple[list[str], dict[str, Any]]:
    """Which files were analysed after these statuses, and what pages hear at the end."""

    async def follow() -> tuple[list[str], dict[str, Any]]:
        aside = Beside()
        moduli = LiveModuli(aside, lambda event: None)
        for status in statuses:
            moduli.hear(status)
            await asyncio.sleep(0.05)
        return aside.asked, moduli.event()

    return asyncio.run(follow())


def test_a_site_is_analysed_when_the_next_one_begins_and_once_more_at_the_end() -> None:
    under_way = {"active": {"id": "1", "program": "run"}, "job": "palpation", "recording": "/r/one.part"}
    ended = {"active": None, "last": {"recording": "/r/one.mcap"}}
    asked, event = heard([under_way | {"site": 0}, under_way | {"site": 0}, ended, ended])
    assert asked == ["one.mcap"]
    assert event["sites"] == [{"name": "one"}]
    asked, _ = heard([under_way | {"site": 0}, under_way | {"site": 1}])
    assert asked == ["one.part"]


def test_a_map_keeps_the_places_of_all_its_runs_and_a_new_job_begins_empty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("palpd.web.site_moduli.LEAST_REST_S", 0.0)

    def of_run(job: str, name: str) -> list[dict[str, Any]]:
        return [
            {"active": {"id": job, "program": "map"}, "job": "palpation", "recording": f"/r/{name}.part", "site": 0},
            {"active": {"id": job, "program": "map"}, "last": {"recording": f"/r/{name}.mcap"}},
        ]

    _, event = heard([*of_run("map", "one"), *of_run("map", "two")])
    assert [site["name"] for site in event["sites"]] == ["one", "two"]
    _, event = heard([*of_run("map", "one"), of_run("run", "next")[0]])
    assert event["sites"] == []


@pytest.mark.parametrize("program", ["retract", "level-test", "calibrate", "doctor", "recover", "free-motion", "stiffness"])
def test_what_does_not_palpate_leaves_the_sites_of_the_palpation_before(program: str) -> None:
    before = {"active": {"id": "1", "program": "run"}, "job": "palpation", "recording": "/r/one.part"}
    after = {"active": {"id": "2", "program": program}, "job": program, "recording": "/r/up.part"}
    _, event = heard([before | {"site": 0}, {"active": None, "last": {"recording": "/r/one.mcap"}}, after])
    assert (event["job"], event["sites"]) == ("1", [{"name": "one"}])


def test_what_cannot_be_computed_is_said() -> None:
    _, event = heard([
        {"active": {"id": "1", "program": "run"}, "job": "palpation", "recording": "/r/bad.part", "site": 0},
        {"active": None, "last": {"recording": "/r/bad.mcap"}},
    ])  # fmt: skip
    assert (event["sites"], event["error"]) == ([], "this was not computed")


def _ends_its_process() -> None:
    import os

    os._exit(1)


def test_a_process_that_dies_is_one_sentence_and_the_next_question_has_a_new_one() -> None:
    async def ask() -> int:
        aside = Aside()
        with pytest.raises(Refused, match="has died"):
            await aside.compute(_ends_its_process)
        answer = await aside.compute(abs, -3)
        aside.close()
        return answer

    assert asyncio.run(ask()) == 3
