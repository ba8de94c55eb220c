"""What the terminal says of a diagnosis."""

from typing import Any

import pytest

from palpd.cell.effects import EFFECTS
from palpd.cli.tables import diagnosis_lines
from palpd.gap.plain import plain_answer

SHRINK = {"channel": "fz_N", "before_rms": 0.4, "after_rms": 0.2, "noise_floor": 0.131, "closed": 0.94, "ci95": [0.9, 1.0], "on": "cycles"}
CONTENT: dict[str, Any] = {
    "verdict": "effects", "where": {"channel": "fz_N", "phase": "holding"}, "shrink": SHRINK, "p_none": 0.0, "p_unknown": 0.1, "basis": "",
    "gap": [{"channel": "fz_N", "phase": "holding", "rms": 0.31, "noise_floor": 0.06, "excess": 5.1}],
    "effects": [
        {
            "id": "tissue.viscoelastic", "probability": 0.9, "indistinguishable_from": [], "family": None, "at_bound": [],
            "parameters": {"ratio": {"value": 0.31, "ci95": [0.29, 0.33]}},
        }
    ],
    "candidates": [], "next_experiment": None, "decisive": [], "notes": [],
}  # fmt: skip


def lines_of(**changes: Any) -> list[str]:
    content = CONTENT | changes
    return diagnosis_lines(content | {"plain": plain_answer(content, EFFECTS)})


@pytest.mark.parametrize("ci95", [[0.9, 1.0], None])
def test_closed_is_a_share_of_what_noise_and_tolerances_do_not_explain(ci95: list[float] | None) -> None:
    _, line, *_ = lines_of(shrink=SHRINK | {"ci95": ci95})
    interval = " (90 to 100 %)" if ci95 else ""
    assert f"94 %{interval} of the gap closes on cycles: from 0.4 N to 0.2 N rms, with noise of 0.13 N." in line
    _, line, *_ = lines_of(shrink=SHRINK | {"ci95": ci95, "before_rms": 0.133, "after_rms": 0.130})
    assert "agrees with cycles, to within the noise: 0.13 N rms, 0.13 N without." in line
    assert "%" not in line


def test_a_cause_is_said_in_plain_words_with_its_parameters_and_what_to_do_next() -> None:
    lines = lines_of()
    assert lines[0] == "The gap has one cause: the tissue relaxes."
    assert "It shows most in the vertical force (fz) during holds: 0.31 N rms, where a healthy cell shows 0.06 N." in lines[1]
    assert lines[2:4] == [
        "  tissue.viscoelastic: The tissue relaxes: the force decays while the probe is held. 90 of 100 such answers are right. "
        "No other cause in the list fits as well.",
        "    ratio: decaying force over lasting force 0.310 (0.290 to 0.330)",
    ]
    assert any(line.startswith("Next: ") and "--cell-out enriched.yaml" in line for line in lines)


def test_what_makes_a_verdict_doubtful_stands_above_it_and_once() -> None:
    notes = ["fz_N is dead.", "z_cmd_m is absent."]
    lines = lines_of(decisive=notes[:1], notes=notes)
    assert lines[0] == "Doubtful: fz_N is dead."
    assert lines[-1] == "Note: z_cmd_m is absent."
    assert sum("fz_N is dead" in line for line in lines) == 1
