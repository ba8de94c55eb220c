"""What the terminal says of a diagnosis."""

from typing import Any

import pytest

from palpd.cli.tables import diagnosis_lines


@pytest.mark.parametrize("ci95", [[0.9, 1.0], None])
def test_closed_is_a_share_of_what_noise_and_tolerances_do_not_explain(ci95: list[float] | None) -> None:
    shrink = {
        "channel": "fz_N",
        "before_rms": 0.133,
        "after_rms": 0.130,
        "noise_floor": 0.131,
        "closed": 0.98,
        "ci95": ci95,
        "on": "cycles",
    }
    content: dict[str, Any] = {"effects": [], "shrink": shrink, "next_experiment": None, "decisive": [], "notes": []}
    _, line = diagnosis_lines("verdict", content)
    assert "0.133 rms before, 0.13 after, 0.131 of noise" in line
    assert f"Of the part that noise and tolerances do not explain, 98% closed{' (95 %: 90% to 100%)' if ci95 else ''} on cycles" in line


def test_what_makes_a_verdict_doubtful_stands_above_it_and_once() -> None:
    shrink = {"closed": None}
    notes = ["fz_N is dead.", "z_cmd_m is absent."]
    content: dict[str, Any] = {"effects": [], "shrink": shrink, "next_experiment": None, "decisive": notes[:1], "notes": notes}
    assert diagnosis_lines("verdict", content) == ["Doubtful: fz_N is dead.", "verdict", "Note: z_cmd_m is absent."]
