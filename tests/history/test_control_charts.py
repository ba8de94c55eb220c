"""Control charts of the morning check, on figures that are drawn: what they find, what they leave alone, and what they call it."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpd.config import CheckTolerances
from palpd.errors import BadInput
from palpd.history.check_days import Baseline, MorningCheck, judge_today, keep_check, kept_checks, since_baseline
from palpd.history.check_features import DayFeatures
from palpd.history.control_charts import FEWEST_DAYS, CheckedDay, DayVerdict, judged

TYPICAL = DayFeatures(-50.0, 0.056, 0.0, 0.0, 70e3, 1e-3, 47e3, 4e-6, 0.0, 0.0, 0.0)
SD: Mapping[str, float] = {
    "zero_N": 0.05, "noise_N": 0.002, "drift_N_per_min": 0.01, "friction_N": 0.001, "puck_modulus_Pa": 240.0, "delay_s": 3e-4,
    "plate_stiffness_N_per_m": 280.0, "play_m": 2e-6,
}  # fmt: skip
"""Standard deviations from day to day."""


def healthy(days: int, seed: int = 0, room_sd: float = 0.0, **by_kelvin: float) -> list[CheckedDay]:
    rng = np.random.default_rng(seed)
    drawn = []
    for k in range(days):
        warmer_by = room_sd * float(rng.normal())
        values = {name: getattr(TYPICAL, name) + sd * float(rng.normal()) + by_kelvin.get(name, 0.0) * warmer_by for name, sd in SD.items()}
        drawn.append(CheckedDay(f"day {k:02d}", replace(TYPICAL, **values), 21.0 + warmer_by if room_sd else None))
    return drawn


def changed(day: CheckedDay, **shifts: float) -> CheckedDay:
    return replace(day, features=replace(day.features, **{name: getattr(day.features, name) + by for name, by in shifts.items()}))


def after(before: list[CheckedDay], *now: CheckedDay) -> list[DayVerdict]:
    return judged([*before, *now], CheckTolerances())[len(before) :]


def test_a_healthy_cell_warns_on_at_most_one_day_in_a_hundred() -> None:
    verdicts = [verdict for seed in range(100, 112) for verdict in judged(healthy(50, seed), CheckTolerances())]
    assert sum(verdict.level != "ok" for verdict in verdicts) <= 6


def test_three_standard_deviations_of_the_zero_are_found_within_two_days() -> None:
    count = 0
    for seed in range(40):
        days = healthy(42, seed)
        verdicts = after(days[:40], *(changed(day, zero_N=0.15) for day in days[40:]))
        count += any("zero" in verdict.causes for verdict in verdicts)
    assert count >= 34


@pytest.mark.parametrize(
    ("cause", "shifts"),
    [
        ("gain", {"puck_modulus_Pa": 1400.0, "plate_stiffness_N_per_m": 940.0}),
        ("puck", {"puck_modulus_Pa": -1400.0}),
        ("machine", {"plate_stiffness_N_per_m": -4700.0}),
        ("delay", {"delay_s": 0.01}),
        ("play", {"play_m": 1e-4}),
        ("noise", {"noise_N": 0.05}),
        ("drift", {"drift_N_per_min": 0.3}),
        ("friction", {"friction_N": 0.1}),
        ("sensor link", {"lost_frames_percent": 3.0}),
    ],
)
def test_a_change_is_found_and_named(cause: str, shifts: dict[str, float]) -> None:
    days = healthy(32, seed=5)
    verdicts = after(days[:30], *(changed(day, **shifts) for day in days[30:]))
    first = next(verdict for verdict in verdicts if verdict.level != "ok")
    assert first.causes[0] == cause
    assert first.sentence.endswith(".")
    assert "since day 3" in first.sentence


def test_a_day_that_warns_teaches_the_charts_nothing() -> None:
    days = healthy(40, seed=2)
    verdicts = after(days[:20], *(changed(day, puck_modulus_Pa=2100.0, plate_stiffness_N_per_m=1400.0) for day in days[20:]))
    assert [verdict.causes[:1] for verdict in verdicts[2:]] == [("gain",)] * 18
    assert verdicts[-1].changes[0].since == "day 20"


def test_what_creeps_is_found_by_the_first_day() -> None:
    days = [changed(day, play_m=3e-6 * k) for k, day in enumerate(healthy(50))]
    verdicts = judged(days, CheckTolerances())
    assert any("play" in verdict.causes for verdict in verdicts)


def test_before_there_are_charts_only_the_tolerances_judge() -> None:
    days = healthy(FEWEST_DAYS)
    (small,) = after(days[:5], changed(days[5], zero_N=0.3))
    (large,) = after(days[:5], changed(days[5], zero_N=0.7))
    assert (small.level, large.level) == ("ok", "warn")


def test_twice_a_tolerance_says_not_to_palpate() -> None:
    days = healthy(31)
    (verdict,) = after(days[:30], changed(days[30], delay_s=0.05))
    assert verdict.level == "stop"


def test_a_zero_that_follows_the_temperature_is_no_change() -> None:
    days = healthy(40, seed=3, room_sd=2.0, zero_N=0.05)
    warm = CheckedDay("warm", replace(TYPICAL, zero_N=TYPICAL.zero_N + 0.05 * 5.0), 26.0)
    assert after(days, warm)[0].level == "ok"
    assert "zero" in after(days, replace(warm, temperature_C=21.0))[0].causes


def test_a_cell_without_a_plate_has_no_play() -> None:
    days = [replace(day, features=replace(day.features, play_m=None, plate_stiffness_N_per_m=None)) for day in healthy(32)]
    verdict = after(days[:30], *(changed(day, puck_modulus_Pa=2100.0) for day in days[30:]))[1]
    assert verdict.causes == ("puck",)
    assert "play_m" not in [point.figure for point in verdict.points]


def test_a_plate_that_came_later_is_watched_from_its_first_day_on() -> None:
    """It was pressed each morning, and neither play nor the stiffness of the machine was judged, without a word."""
    days = healthy(32)
    bare = [replace(day, features=replace(day.features, play_m=None, plate_stiffness_N_per_m=None)) for day in days[:12]]
    loose = [changed(day, plate_stiffness_N_per_m=-4700.0) for day in days[30:]]
    verdicts = judged([*bare, *days[12:30], *loose], CheckTolerances())
    assert not any("machine" in verdict.causes for verdict in verdicts[:30])
    assert verdicts[-1].causes == ("machine",)


def test_kept_checks_are_in_the_order_of_time_where_the_clocks_go_back(tmp_path: Path) -> None:
    for name, date in (("summer", "2026-10-25T02:30:00+02:00"), ("winter", "2026-10-25T02:10:00+01:00")):
        keep_check(tmp_path / f"{name}.mcap", MorningCheck(CheckedDay(date, TYPICAL), DayVerdict("ok", (), ())))
    assert [recording.stem for recording, _ in kept_checks(tmp_path)] == ["summer", "winter"]
    keep_check(tmp_path / "odd.mcap", MorningCheck(CheckedDay("a Monday", TYPICAL), DayVerdict("ok", (), ())))
    with pytest.raises(BadInput, match=r"odd\.check\.json holds no check"):
        kept_checks(tmp_path)


def test_a_copy_of_a_check_counts_once_and_the_baseline_of_either_counts(tmp_path: Path) -> None:
    """With a copy of the runs below them, eight healthy days counted as sixteen, and the ninth was a warning."""
    (tmp_path / "backup").mkdir()
    days = healthy(9, seed=4)
    for number, day in enumerate(days[:8], start=1):
        check = MorningCheck(replace(day, date=f"2026-11-{number:02d}T08:00:00+01:00"), DayVerdict("ok", (), ()), number=number)
        for folder in (tmp_path, tmp_path / "backup"):
            keep_check(folder / f"{number}.mcap", check)
    kept = kept_checks(tmp_path)
    assert [path for path, _ in kept] == [tmp_path / f"{number}.mcap" for number in range(1, 9)]
    verdict, _, _ = judge_today(kept, changed(days[8], zero_N=0.3), CheckTolerances())
    assert verdict.level == "ok"
    renewed = replace(kept[3][1], baseline=Baseline("2026-11-04", "new mount"))
    keep_check(tmp_path / "backup" / "4.mcap", renewed)
    assert len(since_baseline(kept_checks(tmp_path))) == 5
