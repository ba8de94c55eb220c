"""A recording that is diagnosed again with what the first diagnosis found has no gap, and a further effect is still found."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fixed_point import asked_twice
from palpd.cell.cell_file import save_cell
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.recording.samples import Samples, write_csv
from palpd.testing.plain_cells import cell_of, recording

PLAIN = cell_of("second order")
STATED = ("noise_rms_N", "noise_rms_Nm", "resolution_fxy_N", "resolution_fz_N", "resolution_Nm")
CELL = PLAIN.model_copy(update={"sensor": PLAIN.sensor.model_copy(update={name: getattr(PLAIN.sensor, name) for name in STATED})})


def quick(samples: Samples, again: Diagnosis | None = None) -> Diagnosis:
    return diagnose([samples], CELL if again is None else again.enriched_cell(), max_bins=1500, propose=False)


def with_lateral(samples: Samples) -> Samples:
    """A lateral force that grows faster than the contact force: no formula of the list is exact."""
    wrench = samples.wrench.copy()
    wrench[:, 0] += 0.2 * np.maximum(wrench[:, 2], 0.0) ** 1.15
    return replace(samples, wrench=wrench)


def with_drag(samples: Samples) -> Samples:
    wrench = samples.wrench.copy()
    wrench[:, 2] -= 3.0 * np.gradient(samples.z_m, samples.t_s)
    return replace(samples, wrench=wrench)


def with_coarse_step(samples: Samples) -> Samples:
    wrench = samples.wrench.copy()
    wrench[:, 2] = 0.4 * np.rint(wrench[:, 2] / 0.4)
    return replace(samples, wrench=wrench)


def with_more_noise(samples: Samples) -> Samples:
    wrench, rng = samples.wrench.copy(), np.random.default_rng(5)
    wrench += 2.0 * np.repeat([CELL.sensor.noise_rms_N, CELL.sensor.noise_rms_Nm], 3) * rng.standard_normal(wrench.shape)
    return replace(samples, wrench=wrench)


def with_held_rows(samples: Samples) -> Samples:
    wrench = samples.wrench.copy()
    for row in range(700, len(wrench) - 50, 1500):
        wrench[row : row + 25] = wrench[row]
    return replace(samples, wrench=wrench)


def with_gradual_limit(samples: Samples) -> Samples:
    """An amplifier that runs into its limit gradually (Rapp 1991): no cell file holds how gradually."""
    wrench = samples.wrench.copy()
    limit_N = 0.93 * np.quantile(wrench[:, 2], 0.995)
    wrench[:, 2] /= (1.0 + np.abs(wrench[:, 2] / limit_N) ** 14) ** (1.0 / 14)
    return replace(samples, wrench=wrench)


@pytest.mark.parametrize("changed", [with_lateral, with_drag, with_coarse_step, with_more_noise, with_held_rows, with_gradual_limit])
def test_what_a_diagnosis_has_found_is_no_gap_of_the_cell_that_it_writes(changed: Callable[[Samples], Samples]) -> None:
    samples = changed(recording("second order", 101))
    first = quick(samples)
    assert first.verdict == "effects", first.sentence
    second = quick(samples, first)
    assert second.verdict == "none", second.sentence


def test_a_limit_that_is_reached_gradually_is_a_limit_and_no_change_of_the_slope() -> None:
    answer = quick(with_gradual_limit(recording("second order", 101)))
    assert [effect.id for effect in answer.effects] == ["sensor.saturation"], answer.sentence


def test_a_known_effect_does_not_hide_a_further_one() -> None:
    lateral = with_lateral(recording("second order", 101))
    first = quick(lateral)
    second = quick(with_drag(lateral), first)
    assert [effect.id for effect in second.effects] == ["cable.viscous"], second.sentence


def test_the_benchmark_asks_each_recording_twice(tmp_path: Path) -> None:
    write_csv(tmp_path / "drag.csv", with_drag(recording("second order", 101)))
    save_cell(tmp_path / "drag.yaml", CELL)
    answers = asked_twice(tmp_path / "drag.csv", bins=1500)
    assert (answers.first, answers.second, answers.named) == ("effects", "none", ("cable.viscous",))
    assert answers.line == "drag: cable.viscous; then none: nothing"
