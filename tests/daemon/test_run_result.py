"""What a run says of itself: presses that were cut short, and what a dry run saw."""

from dataclasses import replace

import numpy as np
import pytest

from palpd.analysis.results import dry_figures
from palpd.cell.cell_file import PHANTOM, CellFile
from palpd.config import Config, Plan, load_config, load_plan
from palpd.daemon.motion_job import Job
from palpd.daemon.run_result import simulated_result
from palpd.daemon.simulated_run import run
from palpd.history.course import SHOWN_POINTS
from tests.paths import ROOT

CUT_SHORT = "5 N limit reached (the sequence ends a press at 0.9 x contact_limit_N)"


def test_no_press_of_the_shipped_plan_is_cut_short_on_the_hardest_site_of_the_shipped_phantom() -> None:
    shipped = load_plan(ROOT / "plan.yaml")
    hardest = tuple(site for site in shipped.sites if site.name == "B")
    plan = shipped.model_copy(update={"sites": hardest, "hold_s": 0.2})
    result = simulated_result(run(Job("palpation", load_config(ROOT / "config.yaml"), plan), PHANTOM))
    site = result["sites"][0]
    assert result["verdict"] == "done", result["reason"]
    assert site["cut_short_depths_m"] == []
    assert site["peak_force_N"] is not None
    assert site["peak_force_N"] > 8.0, "B is hard"


def test_a_press_that_was_cut_short_says_which_limit_ended_it() -> None:
    plan = Plan.model_validate({"sites": [{"name": "A"}], "depths_m": [0.003, 0.009], "repeats": 2, "hold_s": 0.2})
    config = Config.model_validate({"safety": {"contact_limit_N": 5.0}})
    result = simulated_result(run(Job("palpation", config, plan), CellFile()))
    course = result["course"]
    assert result["duration_s"] == pytest.approx(course["t_s"][-1], abs=0.1)
    assert len(course["t_s"]) <= SHOWN_POINTS < result["loop"]["ticks"]
    assert result["peak_force_N"] == pytest.approx(max(filter(None, course["force_high_N"])), rel=1e-6)
    assert 4.4 < result["peak_force_N"] < 5.5
    notes = result["notes"]
    assert notes[1:] == [f"site A, {kind} press to 9 mm: {CUT_SHORT}" for kind in ("static", "dynamic")]


def test_a_dry_run_says_force_noise_and_pose() -> None:
    rows = run(Job("palpation", Config(), Plan(), dry=True), CellFile(), home_above_m=0.02).rows
    figures = dry_figures(rows)
    assert figures is not None
    assert figures["force_N"] == pytest.approx([0.0, 0.0, 0.0], abs=0.02)
    assert 0.0 < figures["noise_N"] < 0.2
    assert figures["tcp_pose"] == pytest.approx([0.0, 0.0, 0.02, np.pi, 0.0, 0.0], abs=1e-4)
    assert dry_figures(rows[:10]) is None


def test_a_dry_run_prints_them_and_no_empty_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    from palpd.cli import printing

    lines: list[str] = []
    monkeypatch.setattr(printing, "terminal", lambda: type("Console", (), {"print": lambda _, *each, **__: lines.extend(map(str, each))})())
    done = run(Job("palpation", Config(), Plan(), dry=True), CellFile())
    result = {**simulated_result(replace(done, header={**done.header, "sites": []})), "dry": dry_figures(done.rows), "notes": []}
    printing.print_run(result)  # type: ignore[arg-type]
    assert lines[0].startswith("Force (")
    assert "noise of fz" in lines[0]
    assert lines[1].startswith("Tip at (")
    assert len(lines) == 3
