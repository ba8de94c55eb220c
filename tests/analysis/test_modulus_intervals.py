"""The interval of a modulus holds what is not known of the probe's weight, where the slopes of Fz part at zero load."""

from typing import Any

import numpy as np
import pytest

from palpd.analysis.modulus_intervals import NORMAL_95, KnownWeight, Measured, mean_ci95_Pa
from palpd.analysis.results import analysed, sites
from palpd.cell.cell_file import CellFile, SensorBlock
from palpd.config import Config, Plan
from palpd.control.slopes import GRAVITY_N_PER_KG
from palpd.daemon.motion_job import Job
from palpd.daemon.simulated_run import SimulatedRecording
from palpd.recording.header import RecordingHeader
from palpd.testing.parted_sensor import RATIO, pressed

SIGMA_KG = 0.02
PLAN = Plan.model_validate({"sites": [{"name": "A"}], "depths_m": [0.006, 0.008], "hold_s": 0.5, "repeats": 1, "mode": "both"})

CELL = CellFile.model_validate({"sensor": SensorBlock(rate_Hz=1000.0).model_dump(), "tissue": {"youngs_modulus_Pa": 72e3}})


def config(setting: str = "both", sigma_kg: float = SIGMA_KG) -> Config:
    return Config.model_validate({"sensor": {"fz_slopes": setting}, "cell": {"tolerances": {"mass_kg": sigma_kg}}})


def header(setting: str = "both", sigma_kg: float = SIGMA_KG, ratio: float | None = RATIO) -> RecordingHeader:
    return {"config": config(setting, sigma_kg).model_dump(mode="json"), "about": {"pulled_over_pressed": ratio}}


def half(interval: list[float] | None) -> float:
    assert interval is not None
    return (interval[1] - interval[0]) / 2.0


@pytest.fixture(scope="module")
def heavier() -> SimulatedRecording:
    """A run whose probe weighs two standard deviations more than the configuration says."""
    mass_kg = config().cell.probe.mass_kg + 2.0 * SIGMA_KG
    return pressed(Job("palpation", config(), PLAN), CELL, "load", mass_kg, seed=3)


def with_tolerance(run: SimulatedRecording, **about: Any) -> RecordingHeader:
    return {**run.header, **header(**about)}


def test_the_header_of_a_recording_says_what_the_weight_leaves_uncertain() -> None:
    weight = KnownWeight.of(header())
    assert weight.weight_N == pytest.approx(0.2 * GRAVITY_N_PER_KG)
    assert weight.force_sigma_N == pytest.approx((RATIO - 1.0) * GRAVITY_N_PER_KG * SIGMA_KG)
    np.testing.assert_array_equal(weight.shift_N(np.array([1.0, 3.0])), [0.0, weight.force_sigma_N])


@pytest.mark.parametrize("without", [header("pressed"), header(ratio=None), header(ratio=1.0), RecordingHeader()])
def test_readings_that_were_not_corrected_do_not_depend_on_the_weight(without: RecordingHeader) -> None:
    assert KnownWeight.of(without).force_sigma_N == 0.0


def test_the_weight_does_not_average_out_and_noise_does() -> None:
    weight = KnownWeight(1.0, 0.03)
    one, four = ([Measured(60e3, 3.0, 0.006, 0.01)] * n for n in (1, 4))
    assert half(mean_ci95_Pa(one, 0.0, KnownWeight())) == pytest.approx(2.0 * half(mean_ci95_Pa(four, 0.0, KnownWeight())))
    quiet = [each._replace(noise_sigma_N=0.0) for each in four]
    assert half(mean_ci95_Pa(quiet, 0.0, weight)) == pytest.approx(NORMAL_95 * 60e3 * 0.03 / 3.0)
    assert half(mean_ci95_Pa([each._replace(force_N=0.9) for each in quiet], 0.0, weight)) == 0.0
    assert half(mean_ci95_Pa(quiet, 2e-5, KnownWeight())) == pytest.approx(NORMAL_95 * 1.5 * 60e3 * 2e-5 / 0.006)
    assert mean_ci95_Pa([], 1e-5, weight) is None
    assert mean_ci95_Pa(one, None, weight) is None


def test_a_probe_that_is_heavier_than_stated_shifts_every_modulus_by_what_its_interval_allows(heavier: SimulatedRecording) -> None:
    (known,) = sites(heavier.rows, with_tolerance(heavier, sigma_kg=1e-9))
    (site,) = sites(heavier.rows, with_tolerance(heavier))
    shift_N = (RATIO - 1.0) * GRAVITY_N_PER_KG * 2.0 * SIGMA_KG
    for name, forces_N in (
        ("static", [depth["force_N"] for depth in site["depths"]]),
        ("dynamic_corrected", [press["original_N"] for press in site["presses"]]),
    ):
        modulus_Pa = site["static_youngs_modulus_Pa" if name == "static" else "dynamic_corrected_Pa"]
        interval, narrow = site[f"{name}_ci95_Pa"], known[f"{name}_ci95_Pa"]  # type: ignore[literal-required]
        assert modulus_Pa is not None
        added = np.sqrt(half(interval) ** 2 - half(narrow) ** 2)
        mean_inverse = float(np.mean([1.0 / force_N for force_N in forces_N if force_N is not None]))
        assert added / modulus_Pa == pytest.approx(NORMAL_95 * shift_N / 2.0 * mean_inverse, rel=0.05), name
    static_Pa = site["static_youngs_modulus_Pa"]
    assert static_Pa is not None
    assert static_Pa / 72e3 - 1.0 == pytest.approx(
        shift_N * float(np.mean([1.0 / d["force_N"] for d in site["depths"] if d["force_N"]])), abs=0.01
    )


def test_the_interval_of_a_loading_curve_holds_the_weight_too(heavier: SimulatedRecording) -> None:
    (narrow,), (wide,) = (analysed(heavier.rows, with_tolerance(heavier, sigma_kg=kg)) for kg in (1e-9, SIGMA_KG))
    assert narrow["youngs_modulus_Pa"] == wide["youngs_modulus_Pa"]
    assert half(wide["ci95_Pa"]) > 1.5 * half(narrow["ci95_Pa"])
