"""Plans that the service keeps under a name: who may change them, what is refused, and what a rehearsal beside them is worth."""

from pathlib import Path
from typing import Any

import pytest

from palpd.config import load_plan, parse_config, parse_plan
from palpd.daemon import kept_plans
from palpd.daemon.kept_plans import rehearsed_config_sha256
from palpd.daemon.service import Service
from palpd.daemon.stored_state import MOST_BYTES
from tests.daemon.test_service import PLAN, ScriptedRun, armed, refusal, service, settings

__all__ = ["service"]

OTHER = {**PLAN, "depths_m": [0.005]}
FIGURES = {"verdict": "done", "duration_s": 61.5, "peak_force_N": 9.1, "presses": 24, "cut_short": 14, "config_sha256": "0f" * 32}


def ask(service: Service, do: str, **more: Any) -> dict[str, Any]:
    answer = service.answer({"do": do, **more})  # type: ignore[typeddict-item]
    assert isinstance(answer, dict)
    assert answer["ok"], answer
    return answer  # type: ignore[return-value]


def keep(service: Service, name: str = "morning", plan: object = PLAN, **more: Any) -> dict[str, Any]:
    (kept,) = ask(service, "keep-plan", name=name, plan=plan, **more)["plans"]
    return kept


def folder(service: Service) -> Path:
    return service._state.folder / "plans"


def test_a_kept_plan_survives_the_service_and_is_a_plan_file(service: Service) -> None:
    lease = ask(service, "take", name="anna")["lease"]
    kept = keep(service, plan={**PLAN, "press_speed_m_per_s": 0.0123456789}, lease=lease)
    assert (kept["name"], kept["by"], kept["rehearsal"]) == ("morning", "anna", None)
    again = Service(service._config, service._run._build)
    try:
        assert ask(again, "plans")["plans"] == [kept]
        answer = ask(again, "plans", name="morning")
    finally:
        again._ring.close()
    assert answer["plans"] == [kept]
    file = folder(service) / "morning.yaml"
    assert file.read_text().partition("\n")[2] == answer["yaml"]
    assert load_plan(file) == parse_plan({**PLAN, "press_speed_m_per_s": 0.0123456789}, "it")


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        ".hidden",
        "../morning",
        "/etc/passwd",
        "a/b",
        "a\\b",
        "a\0",
        "morning\n",
        "a b",
        "é",
        "n" * 65,
        None,
        7,
        ["a"],
        {"a": 1},
    ],
)
def test_what_is_no_name_keeps_reads_and_forgets_nothing(service: Service, name: object) -> None:
    (service._state.folder).mkdir(parents=True)
    outside = service._state.folder / "morning.yaml"
    outside.write_text("mine")
    for request in ({"do": "keep-plan", "plan": PLAN}, {"do": "forget-plan"}, {"do": "plans"}):
        if name is not None or request["do"] != "plans":
            assert "is no name of a plan, expected 1 to 64 letters" in refusal(service, **request, name=name)
    assert outside.read_text() == "mine"
    assert not folder(service).exists()


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (None, "expected keys and values"),
        ({"sites": [{"name": "A"}]}, "depths_m is not given"),
        ({**PLAN, "depths_m": [4]}, "depths are in metres"),
        ({**PLAN, "press_speed_m_per_s": 0.05, "search": {"speed_m_per_s": 0.9}}, "search.speed_m_per_s is 0.9"),
    ],
)
def test_a_plan_that_no_start_would_take_is_not_kept(service: Service, plan: object, words: str) -> None:
    assert words in refusal(service, do="keep-plan", name="morning", plan=plan)
    assert ask(service, "plans")["plans"] == []


def test_a_plan_above_the_speed_limit_of_the_cell_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("palpd.daemon.run_under_way.JobRun", ScriptedRun)
    slow = Service(settings(tmp_path, safety={"max_speed_m_per_s": 0.005}), lambda *_: pytest.fail("nothing is opened here"))
    try:
        assert "above safety.max_speed_m_per_s of 0.005" in refusal(slow, do="keep-plan", name="fast", plan=PLAN)
    finally:
        slow._ring.close()


def test_too_large_a_plan_and_too_many_are_refused_and_an_old_one_may_still_be_changed(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    large = {**PLAN, "sites": [{"name": "n" * 28 + str(k), "x_m": -0.1 - k / 7e3, "y_m": -0.1 - k / 7.1e3} for k in range(1000)]}
    sentence = refusal(service, do="keep-plan", name="large", plan=large)
    assert f"expected at most {MOST_BYTES}; give it fewer sites" in sentence
    monkeypatch.setattr(kept_plans, "MOST_PLANS", 2)
    first = keep(service, "a")
    keep(service, "b")
    assert "2 plans are kept already" in refusal(service, do="keep-plan", name="c", plan=PLAN)
    keep(service, "a", OTHER, was=first["sha256"])
    ask(service, "forget-plan", name="b", was=first["sha256"])
    keep(service, "c")
    assert [plan["name"] for plan in ask(service, "plans")["plans"]] == ["a", "c"]


def test_what_another_operator_has_changed_is_neither_overwritten_nor_forgotten(service: Service) -> None:
    lease = ask(service, "take", name="anna")["lease"]
    first = keep(service, lease=lease)
    assert "the plan morning is kept already (by anna" in refusal(service, do="keep-plan", name="morning", plan=OTHER, lease=lease)
    second = keep(service, plan=OTHER, was=first["sha256"], lease=lease)
    text = (folder(service) / "morning.yaml").read_text()
    for request in ({"do": "keep-plan", "plan": {**PLAN, "depths_m": [0.006]}}, {"do": "forget-plan"}):
        assert "was changed meanwhile" in refusal(service, **request, name="morning", was=first["sha256"], lease=lease)
    assert (folder(service) / "morning.yaml").read_text() == text
    assert ask(service, "forget-plan", name="morning", was=second["sha256"], lease=lease)["plans"] == []
    assert "no plan morning is kept" in refusal(service, do="plans", name="morning")


def test_who_does_not_hold_the_controls_may_read_and_change_nothing(service: Service) -> None:
    kept = keep(service)
    ask(service, "take", name="anna")
    assert "anna holds the controls" in refusal(service, do="keep-plan", name="b", plan=PLAN)
    assert "anna holds the controls" in refusal(service, do="forget-plan", name="morning", was=kept["sha256"])
    assert "never yours" in refusal(service, do="keep-plan", name="b", plan=PLAN, lease="guessed")
    assert ask(service, "plans")["plans"] == [kept]


def test_during_a_run_plans_are_read_only(service: Service) -> None:
    kept = keep(service)
    armed(service)
    ask(service, "start", plan=PLAN)
    assert "the arm is at work" in refusal(service, do="keep-plan", name="b", plan=PLAN)
    assert "the arm is at work" in refusal(service, do="forget-plan", name="morning", was=kept["sha256"])
    assert ask(service, "plans")["plans"] == [kept]


def test_a_rehearsal_stands_beside_its_plan_until_that_is_another_one(service: Service) -> None:
    lease = ask(service, "take", name="anna")["lease"]
    first = keep(service, lease=lease)
    ask(service, "release", lease=lease)
    kept = keep(service, rehearsal=FIGURES)  # of the same plan, by whoever has rehearsed it: no `was` is needed
    assert {key: kept["rehearsal"][key] for key in FIGURES} == FIGURES
    assert kept["rehearsal"]["date"]
    assert (kept["sha256"], kept["by"], kept["kept"]) == (first["sha256"], "anna", first["kept"])
    assert keep(service)["rehearsal"] == kept["rehearsal"]
    assert keep(service, plan=OTHER, was=kept["sha256"])["rehearsal"] is None


@pytest.mark.parametrize(
    "wrong", [7, [], {}, {**FIGURES, "more": 1}, {**FIGURES, "presses": -1}, {**FIGURES, "config_sha256": "x" * 10_000}]
)
def test_a_rehearsal_that_is_none_is_refused_and_keeps_nothing(service: Service, wrong: object) -> None:
    assert "the rehearsal has not the keys" in refusal(service, do="keep-plan", name="morning", plan=PLAN, rehearsal=wrong)
    assert ask(service, "plans")["plans"] == []


def test_files_that_people_put_there_are_read_and_what_is_none_is_left_out(service: Service) -> None:
    keep(service, "b")
    text = (folder(service) / "b.yaml").read_text().partition("\n")[2]
    (folder(service) / "a.yaml").write_text("# a note of mine\n" + text)
    (folder(service) / "c.yaml").write_text("# kept by palpd: {half\n" + text)
    (folder(service) / "no name.yaml").write_text(text)
    (folder(service) / "huge.yaml").write_text("#" * (2 * MOST_BYTES + 1))
    (folder(service) / "folder.yaml").mkdir()
    assert [(plan["name"], plan["by"], plan["rehearsal"]) for plan in ask(service, "plans")["plans"]] == [
        ("a", "", None),
        ("b", "a client without the controls", None),
        ("c", "", None),
    ]


def test_a_folder_that_cannot_be_written_is_a_sentence(service: Service) -> None:
    service._state.folder.mkdir(parents=True)
    folder(service).write_text("")
    assert "cannot be made" in refusal(service, do="keep-plan", name="morning", plan=PLAN)


def test_what_a_rehearsal_depends_on_changes_its_hash_and_a_folder_does_not(tmp_path: Path) -> None:
    model = tmp_path / "inertial.onnx"
    model.write_bytes(b"one")

    def sha256(**values: object) -> str:
        return rehearsed_config_sha256(parse_config(values, "it"))

    usual = sha256()
    assert sha256(paths={"runs": "elsewhere"}) == usual
    hashes = {usual, sha256(safety={"contact_limit_N": 11.0}), sha256(cell={"probe": {"tip_radius_m": 0.006}})}
    hashes.add(sha256(model={"path": str(model)}))
    model.write_bytes(b"two")
    hashes.add(sha256(model={"path": str(model)}))
    assert len(hashes) == 5
