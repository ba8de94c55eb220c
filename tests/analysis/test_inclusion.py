"""Finding inclusions: by the holds of one site, and by presses over a field."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpd.analysis.inclusion import DEPTHS_M, find_inclusion, stiffening
from palpd.analysis.stiffness_map import Field, Survey, draw, raster, read_presses, search, write_presses
from palpd.config import Config, Plan
from palpd.daemon import stiffness_survey as mapping_robot
from palpd.daemon.display import NoDisplay
from palpd.daemon.finding import Finding
from palpd.daemon.motion_job import Kind
from palpd.daemon.program_host import ProposedMotion
from palpd.daemon.stiffness_survey import in_simulation, on_the_robot, surveyed
from palpd.daemon.supervisor import Report
from palpd.errors import BadInput, RecordingError, Refused, Stopped
from palpd.study.inclusion_field import EmulatedField

HOLDS_M = np.tile(np.arange(1, 11) / 1000.0, 2)


def forces_N(rng: np.random.Generator, inclusion_m: float | None, contrast: float = 1.5, surface_m: float = 0.0) -> np.ndarray:
    depth_m = HOLDS_M + surface_m + rng.normal(0.0, 2e-5, len(HOLDS_M))
    force_N = 4.0 / 3.0 * 8e4 / 0.75 * math.sqrt(0.005) * depth_m**1.5 * (1.0 + rng.normal(0.0, 0.01, len(HOLDS_M)))
    return force_N * (1.0 if inclusion_m is None else stiffening(depth_m, inclusion_m, contrast)) + rng.normal(0.0, 0.01, len(HOLDS_M))


def test_plain_tissue_is_not_accused() -> None:
    inclusions = [find_inclusion(HOLDS_M, forces_N(np.random.default_rng(k), None, surface_m=5e-5 * (k % 3 - 1))) for k in range(40)]
    assert sum(each.probability > 0.5 for each in inclusions) <= 2
    assert np.mean([each.probability for each in inclusions]) < 0.15


@pytest.mark.parametrize("inclusion_m", DEPTHS_M)
def test_an_inclusion_is_found_with_its_depth_and_contrast(inclusion_m: float) -> None:
    inclusions = [find_inclusion(HOLDS_M, forces_N(np.random.default_rng(k), inclusion_m)) for k in range(20)]
    assert all(each.probability > 0.95 for each in inclusions)
    assert np.mean([each.depth_m == inclusion_m for each in inclusions]) >= 0.8
    assert np.mean([each.contrast_ci95[0] * 0.95 <= 1.5 <= each.contrast_ci95[1] * 1.05 for each in inclusions]) >= 0.9
    assert sum(inclusions[0].depth_probability.values()) == pytest.approx(1.0)


def test_a_surface_that_was_missed_is_no_inclusion() -> None:
    missed = forces_N(np.random.default_rng(0), None, surface_m=-3e-4)
    assert find_inclusion(HOLDS_M, missed).probability > 0.9  # accused, if the surface is believed to 50 µm
    assert find_inclusion(HOLDS_M, missed, surface_sigma_m=3e-4).probability < 0.3


def test_too_shallow_holds_say_so() -> None:
    depth_m = np.array([0.0005, 0.001, 0.0015, 0.002])
    inclusion = find_inclusion(depth_m, 5.0 * (depth_m / 0.002) ** 1.5)
    assert 0.1 < inclusion.probability < 0.6
    assert "too shallow to feel an inclusion 5 mm down" in inclusion.warnings[0]


def test_too_few_holds_are_refused() -> None:
    with pytest.raises(RecordingError, match="an inclusion needs 4 or more at different depths"):
        find_inclusion([0.001, 0.002, 0.003], [1.0, 2.0, 3.0])


def test_a_field_is_searched_with_fewer_presses_than_a_raster_and_ends_by_itself() -> None:
    where = Field()
    used = []
    for seed in (0, 1, 2):
        emulated = EmulatedField(where, seed)
        survey, stiffness_map = search(emulated.press, where)
        assert stiffness_map.done
        assert stiffness_map.found_m is not None
        assert emulated.inclusion is not None
        assert math.dist(stiffness_map.found_m, emulated.inclusion[:2]) < 0.005
        used.append(len(survey.places_m))
    assert max(used) < 0.4 * len(raster(where))


def test_a_plain_field_ends_with_nothing_found() -> None:
    where = Field(0.03, 0.03)
    survey, stiffness_map = search(EmulatedField(where, 5, contrast=0.0).press, where)
    assert stiffness_map.done
    assert stiffness_map.found_m is None
    assert len(survey.places_m) < len(raster(where))
    assert "no place is likelier" in stiffness_map.sentence


def test_presses_from_a_file_give_the_next_place_and_a_picture(tmp_path: Path) -> None:
    file = tmp_path / "presses.csv"
    file.write_text("x_m,y_m,youngs_modulus_Pa\n0.01,0.01,80000\n0.03,0.01,81000\n0.03,0.03,120000\n")
    survey = read_presses(file, Field())
    stiffness_map = survey.map()
    assert not stiffness_map.done
    assert math.dist(stiffness_map.next_m, (0.03, 0.03)) < 0.01  # around what is hard
    draw(survey, stiffness_map, tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_a_press_outside_the_field_or_without_a_modulus_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"the press at \(0.07, 0\) m lies outside the field of 0.06 × 0.06 m"):
        Survey().add((0.07, 0.0), 1e5)
    with pytest.raises(BadInput, match="has a modulus of nan Pa"):
        Survey().add((0.0, 0.0), math.nan)
    (tmp_path / "p.csv").write_text("x_m,y_m\n1,2\n")
    with pytest.raises(BadInput, match=r"p\.csv: the header has no column youngs_modulus_Pa; expected x_m, y_m, youngs_modulus_Pa"):
        read_presses(tmp_path / "p.csv", Field())


def test_the_name_of_the_column_says_the_unit_and_moduli_that_no_sensor_would_feel_are_questioned(tmp_path: Path) -> None:
    file, rows = tmp_path / "presses.csv", "0.01,0.01,80\n0.03,0.01,81\n0.03,0.03,120\n"
    file.write_text("x_m,y_m,youngs_modulus_kPa\n" + rows)
    assert read_presses(file, Field()).moduli_Pa == [80e3, 81e3, 120e3]
    file.write_text("x_m,y_m,youngs_modulus_Pa\n" + rows)
    with pytest.raises(BadInput, match=r"presses\.csv: the moduli are about 81 Pa, so a press to 5 mm makes 0\.0036 N, expected more"):
        read_presses(file, Field())
    assert read_presses(file, Field(), accept_implausible=True).moduli_Pa == [80.0, 81.0, 120.0]


def test_the_daemon_presses_an_emulated_field_in_simulation() -> None:
    where = Field(width_m=0.03, height_m=0.03)
    field = EmulatedField(where, 2, contrast=2.0)
    assert field.inclusion is not None
    press = in_simulation(where, field.cell, 2)
    grid = where.grid()
    away_m = np.linalg.norm(grid - field.inclusion[:2], axis=1)
    hard, soft = (press((float(x), float(y))) for x, y in (grid[np.argmin(away_m)], grid[np.argmax(away_m)]))
    assert hard / soft > 1.3
    assert soft == pytest.approx(field.youngs_modulus_Pa * 1.08, rel=0.08)  # pressed in motion: its rate dependence is in it


def test_presses_made_before_a_stop_are_kept_and_read_again(tmp_path: Path) -> None:
    survey, calls = Survey(), []

    def press(place_m: tuple[float, float]) -> float:
        calls.append(place_m)
        if len(calls) == 3:
            raise Stopped("the contact limit was reached")
        return 6e4

    with pytest.raises(Stopped):
        search(press, Field(), survey=survey, watch=lambda survey, _: write_presses(tmp_path / "presses.csv", survey))
    assert read_presses(tmp_path / "presses.csv", Field()).moduli_Pa == survey.moduli_Pa == [6e4, 6e4]


class Arm:
    """Returns to the field's corner after each run; a run presses the emulated field at its site, and the third may be stopped."""

    def __init__(self, field: EmulatedField, stopped_in: int | None = None) -> None:
        self.at_m, self.runs, self._field, self._stopped_in = (0.0, 0.0), 0, field, stopped_in

    config, display, refused_in = Config(), NoDisplay(), 0

    def carry_out(self, kind: Kind, plan: Plan, recording: Path | None = None, take_reference: bool = False, here: bool = False) -> Report:
        self.runs += 1
        if self.runs == self._stopped_in:
            return Report("stopped", "the contact limit was reached", 3)
        if self.runs == self.refused_in:
            raise Refused("the force moved by 0.3 N during the tare")
        (site,) = plan.sites
        self.at_m = (site.x_m, site.y_m)
        return Report("done")

    def observe(self, watch_s: float) -> tuple[Finding, ...]:
        raise AssertionError("a map examines no device")

    def approve(self, motion: ProposedMotion) -> bool:
        raise AssertionError("a map asks for no consent")

    def run_result(self, report: Report) -> dict[str, list[Any]]:
        return {"sites": [{"dynamic_corrected_Pa": self._field.press(self.at_m)}], "notes": [f"a cable pulls by {self.runs} N"]}


@pytest.mark.parametrize("stopped_in", [None, 3])
def test_the_robot_goes_from_place_to_place_and_a_stop_keeps_what_was_pressed(
    stopped_in: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where, field = Field(), EmulatedField(Field(), 1)
    arm = Arm(field, stopped_in)
    monkeypatch.setattr(mapping_robot, "run_result", arm.run_result)
    pressed = surveyed(on_the_robot(where, arm), where, tmp_path / "map.png", NoDisplay())
    survey, reason = pressed.survey, pressed.stop_reason
    stiffness_map = survey.map()
    assert pressed.true_inclusion_m is None, "of a real field nobody knows"
    assert arm.at_m == pytest.approx(survey.places_m[-1])
    assert np.allclose(read_presses(tmp_path / "map.csv", where).places_m, survey.places_m, atol=1e-4)
    if stopped_in is None:
        assert not reason
        assert stiffness_map.found_m is not None
        assert field.inclusion is not None
        assert math.dist(stiffness_map.found_m, field.inclusion[:2]) < where.inclusion_m / 2.0
    else:
        assert "was stopped: the contact limit was reached" in reason
        assert len(survey.places_m) == stopped_in - 1
        assert not stiffness_map.done


def test_a_map_shows_each_kind_of_doubt_once_and_a_press_that_is_refused_keeps_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map of hours whose next tare was refused ended without a picture, and what a run says of its moduli was not said of a map's."""
    where, lines = Field(), list[str]()
    arm = Arm(EmulatedField(where, 1))
    arm.refused_in = 4
    monkeypatch.setattr(arm.display, "say", lines.append)
    monkeypatch.setattr(mapping_robot, "run_result", arm.run_result)
    mapped = surveyed(on_the_robot(where, arm), where, tmp_path / "map.png", NoDisplay())
    assert (len(mapped.survey.places_m), mapped.stop_reason) == (3, "the force moved by 0.3 N during the tare")
    assert [line.partition(": ")[2] for line in lines] == ["a cable pulls by 1 N"]
    arm.runs, arm.refused_in = 0, 1
    with pytest.raises(Refused):
        surveyed(on_the_robot(where, arm), where, tmp_path / "other.png", NoDisplay())
