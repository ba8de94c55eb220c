"""palpd inject as a user types it, as far as no device is needed."""

import json
from pathlib import Path

import pytest
import yaml

from tests.cli.test_history import refusal, runs, simulated, typed
from tests.history.test_injections import NOTHING, injected

__all__ = ["runs", "simulated"]


@pytest.fixture
def config(runs: Path) -> Path:
    path = runs.parent / "config.yaml"
    path.write_text(yaml.safe_dump({"paths": {"runs": "runs", "state": "state"}}))
    return path


def test_a_report_without_injections_says_how_many_are_needed(config: Path, tmp_path: Path) -> None:
    printed = typed("inject", "--report", "--config", config, "--json", tmp_path / "out.json").stdout
    assert printed == "Judged: 0 of the 30 runs that limits and probabilities of this cell need.\n"
    answer = json.loads((tmp_path / "out.json").read_text())
    assert (answer["injections"], answer["limits"], answer["unopened"], answer["reason"]) == (0, [], [], "")


def test_several_sites_and_what_is_no_injection_are_refused(config: Path, tmp_path: Path) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(yaml.safe_dump({"sites": [{"name": "A"}, {"name": "B", "x_m": 0.02}], "depths_m": [0.004]}))
    assert "the plan has 2 sites, expected one" in refusal("inject", "--config", config, "--plan", plan)
    assert "day-0.mcap is no run of palpd inject" in refusal("inject", "--config", config, "--open", "day-0")
    assert "--here and --return contradict each other" in refusal("inject", "--config", config, "--plan", plan, "--here", "--return")


def test_a_run_whose_seal_was_never_opened_is_named_with_the_command_that_opens_it(config: Path, runs: Path) -> None:
    path = injected(runs / "1-injection.mcap", runs / "day-2.mcap")
    (config.parent / "state" / "injections").mkdir(parents=True)
    (config.parent / "state" / "injections" / f"{NOTHING.seal}.json").write_text(NOTHING.text)
    assert f"{path} was never opened; palpd inject --open {path} does it." in typed("inject", "--report", "--config", config).stdout
    printed = typed("inject", "--open", "1-injection", "--config", config).stdout
    assert "Planted was nothing; it was not judged: the run ended stopped" in printed
    assert "was never opened" not in printed
    assert "was opened before" in refusal("inject", "--open", path, "--config", config)


def test_who_looks_at_a_run_of_palpd_inject_learns_that_nothing_planted_is_in_it(runs: Path) -> None:
    path = injected(runs / "1-injection.mcap", runs / "day-0.mcap")
    assert "1-injection.mcap is a run of palpd inject: this is what the sensor measured" in typed("analyse", path).stdout
    assert "is a run of palpd inject" not in typed("analyse", runs / "day-0.mcap").stdout
    assert "1-injection: injection, 2026" in typed("info", path).stdout
    assert "injection done" in typed("runs", "--folder", runs).stdout
