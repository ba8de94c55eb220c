"""palpd inject: the draw, the sealed answer through every end of a run, and a motion process that never gets what is planted."""

import hashlib
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from palpd.config import Config, PathsConfig, Plan, PlanSite
from palpd.daemon import injection as program
from palpd.daemon import supervisor
from palpd.daemon.display import NoDisplay
from palpd.daemon.injection import HEALTHY_SHARE, drawn_effect, inject, open_injection, unopened
from palpd.daemon.interrupts import Interrupted
from palpd.daemon.motion_job import Job
from palpd.daemon.replay import replay
from palpd.daemon.stored_state import State
from palpd.daemon.supervisor import JobRun, Report
from palpd.errors import BadInput, PalpdError, Refused
from palpd.history.injections import SIZES, kept_injections
from palpd.recording.reader import Recording
from palpd.recording.recovery import recover
from palpd.recording.ring import Ring
from palpd.recording.second_channel import LAWS, SealedAnswer
from tests.history.conftest import simulated
from tests.history.test_injections import injected

__all__ = ["simulated"]

PLAN = Plan(sites=(PlanSite(name="A"),))
PLANTED = SealedAnswer("sensor.bias", {"offset_N": 0.5}, "salt")


@pytest.fixture
def config(tmp_path: Path) -> Config:
    (tmp_path / "runs").mkdir()
    return Config(paths=PathsConfig(runs=tmp_path / "runs", state=tmp_path / "state"))


def answers(config: Config) -> list[Path]:
    return sorted((config.paths.state / "injections").glob("*"))


def sealed(config: Config, text: str = PLANTED.text) -> Path:
    path = config.paths.state / "injections" / f"{PLANTED.seal}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def opened(config: Config, recording: Path) -> Any:
    return open_injection(config, recording, None, {})


# --- the draw


def test_all_six_effects_and_none_are_drawn_with_sizes_of_two_decades_and_both_signs() -> None:
    drawn = [drawn_effect(12.0, np.random.default_rng(seed)) for seed in range(1200)]
    counts = Counter(each.effect for each in drawn)
    assert set(counts) == set(LAWS) == {"", *SIZES}
    assert counts[""] / 1200 == pytest.approx(HEALTHY_SHARE, abs=0.04)
    for effect, size in SIZES.items():
        sizes = [size.of(each) for each in drawn if each.effect == effect]
        assert len(sizes) > 100
        assert max(sizes) / min(sizes) == pytest.approx(100.0, rel=0.2)
        signed = {np.sign(each.parameters[size.parameter]) for each in drawn if each.effect == effect}
        assert signed == ({-1.0, 1.0} if effect in ("sensor.gain", "sensor.bias", "sensor.drift") else {1.0})
    again = drawn_effect(12.0, np.random.default_rng(7))
    assert (again.effect, again.parameters) == (drawn[7].effect, drawn[7].parameters)
    assert len({each.salt for each in drawn}) == 1200  # the salt is no part of the seed


def test_the_motion_process_never_gets_what_is_planted(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[Job] = []
    fake = SimpleNamespace(pipe=SimpleNamespace(send=sent.append))
    monkeypatch.setattr(supervisor, "MotionProcess", lambda *_: fake)
    monkeypatch.setattr(supervisor, "Witness", lambda *_: None)
    with closing(Ring.create(125.0)) as ring:
        run = JobRun(Job("palpation", config, PLAN, planted=PLANTED), lambda *_: pytest.fail("no"), ring, State(config.paths.state), "run")
    assert run.job.planted == PLANTED
    assert sent == [Job("palpation", config, PLAN)]


# --- the sealed answer through a run


@pytest.fixture
def carried_out(config: Config, simulated: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Carries out `inject` with another `carry_out`, and returns what it says."""

    def injects(end: Callable[[Path, SealedAnswer], Report]) -> list[str]:
        lines: list[str] = []

        def carry_out(work: Job, build: object, display: object, name: str) -> Report:
            del build, display
            assert work.planted is not None
            (path,) = answers(config)
            assert lines == [f"Sealed before the run: {hashlib.sha256(path.read_bytes()).hexdigest()}"]
            assert path.stem == work.planted.seal
            return end(config.paths.runs / f"{name}.mcap", work.planted)

        monkeypatch.setattr(program, "job", lambda *_, **__: Job("palpation", config, PLAN))
        monkeypatch.setattr(program, "carry_out", carry_out)
        display: Any = NoDisplay()
        display.say = lines.append
        with_end = inject(config, PLAN, None, {}, lambda *_: pytest.fail("no device"), display)
        assert with_end.exit_code == 3
        return lines

    return injects


def test_a_run_that_was_stopped_is_opened_and_not_judged(config: Config, simulated: Path, carried_out: Callable[..., list[str]]) -> None:
    def end(path: Path, planted: SealedAnswer) -> Report:
        return Report("stopped", exit_code=3, recording=injected(path, simulated / "day-2.mcap", planted))

    lines = carried_out(end)
    (kept,) = kept_injections(config.paths.runs)
    assert lines[0].endswith(kept.seal)
    assert hashlib.sha256(kept.planted.text.encode()).hexdigest() == kept.seal
    assert (kept.verdict, answers(config), unopened(config)) == ("", [], [])
    assert "it was not judged: the run ended stopped: contact force" in lines[1]


@pytest.mark.parametrize("failure", [Refused("the probe is pressed"), Interrupted("while the devices were being opened")])
def test_an_answer_that_no_file_holds_is_forgotten(config: Config, carried_out: Callable[..., list[str]], failure: BaseException) -> None:
    def end(_: Path, __: SealedAnswer) -> Report:
        raise failure

    with pytest.raises(type(failure)):
        carried_out(end)
    assert answers(config) == []


def test_a_loop_that_refused_is_opened_too(config: Config, simulated: Path, carried_out: Callable[..., list[str]]) -> None:
    def end(path: Path, planted: SealedAnswer) -> Report:
        injected(path, simulated / "day-2.mcap", planted)
        raise Refused("the force varies")

    with pytest.raises(Refused, match="the force varies"):
        carried_out(end)
    assert (len(kept_injections(config.paths.runs)), answers(config)) == (1, [])


def test_a_signal_after_the_last_motion_keeps_the_answer_until_it_is_opened(
    config: Config, simulated: Path, carried_out: Callable[..., list[str]]
) -> None:
    def end(path: Path, planted: SealedAnswer) -> Report:
        injected(path, simulated / "day-2.mcap", planted)
        raise Interrupted("interrupted by SIGINT after the last motion")

    with pytest.raises(Interrupted):
        carried_out(end)
    assert len(answers(config)) == 1
    (waiting,) = unopened(config)
    opened(config, waiting)
    assert (unopened(config), answers(config)) == ([], [])


def test_a_run_that_was_cut_off_keeps_the_answer_until_it_is_recovered_and_opened(
    config: Config, simulated: Path, carried_out: Callable[..., list[str]]
) -> None:
    def end(path: Path, planted: SealedAnswer) -> Report:
        whole = injected(path, simulated / "day-0.mcap", planted)
        whole.with_suffix(".part").write_bytes(whole.read_bytes()[:-2000])
        whole.unlink()
        return Report("stopped", "the run was stopped because it was no longer recorded", 3)

    assert len(carried_out(end)) == 1  # nothing is opened
    (part,) = unopened(config)
    assert part.suffix == ".part"
    recovered = recover(part).path
    assert unopened(config) == [recovered]
    assert "holds 0 frames of a second channel" in opened(config, recovered).reason
    assert unopened(config) == []


def test_several_sites_or_a_service_are_refused_before_anything_is_sealed(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = Plan(sites=(PlanSite(name="A"), PlanSite(name="B", x_m=0.02)))
    with pytest.raises(BadInput, match="the plan has 2 sites, expected one"):
        inject(config, plan, None, {}, lambda *_: pytest.fail("no device"), NoDisplay())
    monkeypatch.setattr(program, "service_at", lambda path: path == config.paths.control_socket)
    with pytest.raises(Refused, match="the service of this cell may begin a run at any time"):
        inject(config, PLAN, None, {}, lambda *_: pytest.fail("no device"), NoDisplay())
    assert not config.paths.state.exists()


# --- opening


@pytest.fixture
def stopped(config: Config, simulated: Path) -> Path:
    return injected(config.paths.runs / "1-injection.mcap", simulated / "day-2.mcap", PLANTED)


def test_a_seal_is_opened_once(config: Config, stopped: Path) -> None:
    sealed(config)
    assert opened(config, stopped).planted == PLANTED
    sealed(config)  # as if this computer had ended between the two files
    with pytest.raises(Refused, match=r"1-injection\.mcap was opened before; 1-injection\.injection\.json beside it says"):
        opened(config, stopped)
    assert answers(config) == []


def test_what_is_no_injection_of_this_cell_is_refused(config: Config, simulated: Path, stopped: Path) -> None:
    with pytest.raises(BadInput, match=r"day-0\.mcap is no run of palpd inject"):
        opened(config, simulated / "day-0.mcap")
    with pytest.raises(Refused, match=r"1-injection\.mcap is a run of another cell, or was opened under another name"):
        opened(config, stopped)


@pytest.mark.parametrize("text", [replace(PLANTED, effect="sensor.gain").text, PLANTED.text + "\n", ""])
def test_an_altered_answer_is_refused_before_the_diagnosis_and_nothing_is_kept(config: Config, stopped: Path, text: str) -> None:
    path = sealed(config, text)
    with pytest.raises(BadInput, match=f"is not what was sealed: its SHA-256 is {hashlib.sha256(text.encode()).hexdigest()}"):
        opened(config, stopped)
    assert (path.exists(), kept_injections(config.paths.runs)) == (True, [])


def test_a_full_disk_keeps_the_answer(config: Config, stopped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> Path:
        raise BadInput("no space is left")

    path = sealed(config)
    monkeypatch.setattr(program, "keep_injection", full)
    with pytest.raises(PalpdError, match="no space is left"):
        opened(config, stopped)
    assert path.exists()
    assert unopened(config) == [stopped]


def test_a_replay_of_an_injected_run_makes_the_same_decisions_bit_for_bit(config: Config, simulated: Path) -> None:
    path = injected(config.paths.runs / "1-injection.mcap", simulated / "day-0.mcap", PLANTED)
    replayed, plain = replay(Recording.load(path)), replay(Recording.load(simulated / "day-0.mcap"))
    assert replayed["decisions_identical"]
    assert (replayed["ticks"], replayed["peak_force_N"]) == (plain["ticks"], plain["peak_force_N"])
