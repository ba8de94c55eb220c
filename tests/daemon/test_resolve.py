"""The loop of `palpd resolve`: when it asks, when it records, when it is over. The diagnoses are invented; wires: tests/hil."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from palpd.cell.cell_file import nominal
from palpd.cell.effects import EFFECTS
from palpd.config import Config, Plan
from palpd.daemon import resolve as loop
from palpd.daemon.display import NoDisplay
from palpd.daemon.program_host import ProposedMotion
from palpd.errors import BadInput
from palpd.gap.advise.motions import TestMotion
from palpd.gap.advise.next_experiment import Advice, ExperimentProposal

PAIR = ("sensor.gain", "tissue.modulus")


def proposal(gain: float = 3.0) -> ExperimentProposal:
    motion = TestMotion("move up and down in the air, fast", strokes=4, stroke_speed_m_per_s=0.05)
    t_s, z_m = motion.heights(0.01, 0.0, 0.03, 0.5)
    return ExperimentProposal("Move up and down.", motion.plan(), t_s, z_m, gain, motion)


def answer(shares: dict[str, float], verdict: str = "effects") -> tuple[Any, Advice]:
    """A diagnosis as far as the loop looks at it, and advice to it."""
    rest = [name for name in shares if shares[name] > 0.04 * max(shares.values())]
    named = [SimpleNamespace(id=rest[0], indistinguishable_from=rest[1:])]
    weighed = [SimpleNamespace(name=name, share=share) for name, share in shares.items()]
    attribution = SimpleNamespace(hypotheses=weighed)
    resolved = verdict == "effects" and not rest[1:]
    diagnosis = SimpleNamespace(
        verdict=verdict,
        effects=named,
        resolved=resolved,
        sentence="…",
        attribution=attribution,
        problem=None,
        finding=None,
        to_json=dict,
    )
    proposed = proposal() if len(rest) > 1 else None
    pair = (rest[0], rest[1]) if len(rest) > 1 else None
    return diagnosis, Advice(tuple(rest), np.array([shares[name] for name in rest]), proposed, pair, 3.0 if proposed else 0.0)


def carried_out(
    monkeypatch: pytest.MonkeyPatch, folder: Path, answers: list[tuple[Any, Advice]], agree: bool = True, rounds: int = 4, refusal: str = ""
) -> tuple[dict[str, Any], list[Plan], list[ProposedMotion]]:
    """The loop with made-up recordings and diagnoses: what it returned, the plans that it had carried out, what it asked."""
    plans: list[Plan] = []
    asked: list[ProposedMotion] = []
    coming = iter(answers)
    advices: list[Advice] = []

    def record(setting: loop.Setting, plan: Plan, number: int) -> tuple[str, Any]:
        plans.append(plan)
        return ("the guard stopped it", None) if refusal == "run" and number == 2 else ("", SimpleNamespace(duration_s=20.0))

    def diagnose(*_: Any, **__: Any) -> Any:
        diagnosis, advice = next(coming)
        advices.append(advice)
        return diagnosis

    class Host:
        config, display = Config(), NoDisplay()

        def approve(self, motion: ProposedMotion) -> bool:
            asked.append(motion)
            return agree

    for name, stand_in in {
        "_record": record,
        "diagnose": diagnose,
        "advise": lambda *_: advices[-1],
        "_limits": lambda *_: None,
        "_keep": lambda *_: None,
        "_rehearsed": lambda *_: loop.Rehearsal(20.0, 4.0, "rehearsal stopped" if refusal == "rehearsal" else ""),
        "replace": lambda thing, **changes: thing if isinstance(thing, SimpleNamespace) else REPLACE(thing, **changes),
    }.items():
        monkeypatch.setattr(loop, name, stand_in)
    setting = loop.Setting(Host(), nominal(), folder, EFFECTS)  # type: ignore[arg-type]
    return loop.resolve(setting, rounds=rounds), plans, asked


REPLACE = loop.replace


def test_it_asks_records_and_ends_when_resolved(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    answers = [answer({PAIR[0]: 0.6, PAIR[1]: 0.3}), answer({PAIR[0]: 0.98, PAIR[1]: 0.001})]
    resolution, plans, asked = carried_out(monkeypatch, tmp_path, answers)
    assert resolution["resolved"]
    assert resolution["reason"] == "Resolved: sensor.gain."
    assert len(plans) == 2
    assert plans[1].free is not None
    assert plans[1].free.strokes == 4
    assert len(asked) == 1
    assert (asked[0].duration_s, asked[0].expected_peak_N, asked[0].limit_N) == (20.0, 4.0, Config().safety.contact_limit_N)
    assert asked[0].plan["free"]["strokes"] == 4
    assert "sensor.gain 0.60, tissue.modulus 0.30" in asked[0].decides
    second = resolution["rounds"][1]
    assert second["pair"] == PAIR
    assert second["gained"] == pytest.approx(np.log(0.98 / 0.001) - np.log(0.6 / 0.3))
    assert not second["reversal"]
    assert not second["settled"]


def test_a_healthy_cell_needs_no_second_recording(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    healthy = answer({"no effect": 0.9, "sensor.bias": 0.05}, "none")
    healthy[0].decision = SimpleNamespace(p_none=0.9)
    resolution, plans, asked = carried_out(monkeypatch, tmp_path, [healthy])
    assert resolution["resolved"]
    assert "0.90" in resolution["reason"]
    assert (len(plans), asked) == (1, [])


def test_a_law_outside_the_list_is_resolved_when_nothing_is_alike_and_its_odds_are_not_those_of_the_list(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first, second = answer({"no effect": 0.9, PAIR[0]: 0.05}, "unknown"), answer({"no effect": 0.9}, "unknown")
    for diagnosis, _ in (first, second):
        law = SimpleNamespace(learned=SimpleNamespace(id="learned.air_of_height"))
        diagnosis.decision = SimpleNamespace(beyond=SimpleNamespace(law=law))
    alike = ("learned.air_of_height", "learned.air_of_gap")
    open_ = Advice(alike, np.array([0.6, 0.4]), proposal(), alike, 3.0)
    settled = Advice(alike[:1], np.array([1.0]), None, None, 0.0)
    resolution, plans, _ = carried_out(monkeypatch, tmp_path, [(first[0], open_), (second[0], settled)])
    assert resolution["resolved"]
    assert resolution["reason"] == "Resolved: learned.air_of_height, a law outside the list, which holds in all recordings."
    assert len(plans) == 2
    assert resolution["rounds"][1]["gained"] is None


def test_a_turn_of_the_odds_is_a_reversal_with_a_negative_gain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    answers = [answer({PAIR[0]: 0.6, PAIR[1]: 0.3}), answer({PAIR[1]: 0.99, PAIR[0]: 0.005})]
    second = carried_out(monkeypatch, tmp_path, answers)[0]["rounds"][1]
    assert second["reversal"]
    assert second["gained"] < 0.0


def test_a_rival_that_is_dropped_is_settled_and_its_gain_a_bound(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    answers = [answer({PAIR[0]: 0.6, PAIR[1]: 0.3}), answer({PAIR[0]: 1.0})]
    second = carried_out(monkeypatch, tmp_path, answers)[0]["rounds"][1]
    assert second["settled"]
    assert second["gained"] == pytest.approx(np.log(1e6) - np.log(2.0))


@pytest.mark.parametrize(
    ("changes", "verdict", "runs"),
    [
        ({"agree": False}, "declined", 1),
        ({"refusal": "rehearsal"}, "stopped", 1),
        ({"refusal": "run"}, "stopped", 2),
        ({"rounds": 2}, "done", 2),
    ],
)
def test_it_ends_without_a_result_where_it_must(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, changes: dict[str, Any], verdict: str, runs: int
) -> None:
    resolution, plans, _ = carried_out(monkeypatch, tmp_path, [answer({PAIR[0]: 0.6, PAIR[1]: 0.3})] * 3, **changes)
    assert resolution["verdict"] == verdict
    assert not resolution["resolved"]
    assert resolution["reason"]
    assert len(plans) == runs


def test_a_plan_of_several_sites_is_refused(tmp_path: Path) -> None:
    plan = Plan.model_validate({"sites": [{"name": "A"}, {"name": "B", "x_m": 0.03}]})
    setting = loop.Setting(None, nominal(), tmp_path, EFFECTS)  # type: ignore[arg-type]
    with pytest.raises(BadInput, match="one site"):
        loop.resolve(setting, plan)
