"""Indentations that other people measured on other machines, against the moduli they published."""

from pathlib import Path

import numpy as np
import pytest

from palpd.analysis.curves import Curve, Mapping, analyse_curve, read_curve
from palpd.interchange.import_files import ImportOptions, import_files
from palpd.recording.samples import read_csv
from tests.paths import SHARED_DATA

REAL = SHARED_DATA / "real"
pytestmark = pytest.mark.skipif(not REAL.is_dir(), reason="the measurements are not in the repository (their licences differ)")

ASMI = Mapping(
    "Corrected_Force(N)", height_column="Z_Position(mm)", length_unit="mm", compression_negative=True, time_column="Timestamp(s)"
)
ASMI_RADIUS_M, ASMI_STIFFNESS_N_PER_M = 0.0025, 64270.0
CHIARO_PA, CHIARO_RADIUS_M, CANTILEVER_N_PER_M = 117.007, 27.5e-6, 0.019


def well(name: str) -> Path:
    return next((REAL / "asmi_indentation").glob(f"well_{name}_*.csv"))


def chiaro(mapping: Mapping) -> Curve:
    return read_curve(next((REAL / "chiaro_nanoindentation").glob("*.csv")), mapping)


@pytest.mark.parametrize(
    ("name", "as_measured_Pa", "machine_out_Pa"), [("E5", 12.26e6, 22.93e6), ("E6", 11.25e6, 20.52e6), ("E7", 11.20e6, 20.53e6)]
)
def test_a_stiff_sample_has_the_modulus_that_its_makers_published(name: str, as_measured_Pa: float, machine_out_Pa: float) -> None:
    """They publish E/(1-ν²), which no Poisson's ratio changes."""
    curve = read_curve(well(name), ASMI)
    assert curve.skipped == 9
    for stiffness, published_Pa in ((None, as_measured_Pa), (ASMI_STIFFNESS_N_PER_M, machine_out_Pa)):
        for ratio in (0.5, 0.3):
            result = analyse_curve(curve, tip_radius_m=ASMI_RADIUS_M, poisson_ratio=ratio, machine_stiffness_N_per_m=stiffness)
            assert result["youngs_modulus_Pa"] / (1.0 - ratio**2) == pytest.approx(published_Pa, rel=0.001)
            assert result["ci95_Pa"][0] < result["youngs_modulus_Pa"] < result["ci95_Pa"][1]


@pytest.mark.parametrize("name", ["E5", "E6", "E7"])
def test_holding_the_makers_zero_or_freeing_it_matters_by_one_per_cent(name: str) -> None:
    result = analyse_curve(read_curve(well(name), ASMI), tip_radius_m=ASMI_RADIUS_M)
    assert result["baseline"] == "zero"
    assert result["other_baseline_youngs_modulus_Pa"] / result["youngs_modulus_Pa"] == pytest.approx(0.994, abs=0.005)


def test_a_soft_gel_has_the_modulus_that_the_instrument_gave() -> None:
    by_indentation = chiaro(Mapping("load_uN", "uN", depth_column="indentation_nm", length_unit="nm"))
    by_travel = chiaro(Mapping("load_uN", "uN", height_column="piezo_nm", height_down_positive=True, length_unit="nm"))
    one = analyse_curve(by_indentation, tip_radius_m=CHIARO_RADIUS_M)
    other = analyse_curve(by_travel, tip_radius_m=CHIARO_RADIUS_M, machine_stiffness_N_per_m=CANTILEVER_N_PER_M)
    for result in (one, other):
        assert result["youngs_modulus_Pa"] == pytest.approx(CHIARO_PA, rel=0.005)
        assert result["ci95_Pa"][0] < CHIARO_PA < result["ci95_Pa"][1]
    assert one["youngs_modulus_Pa"] == pytest.approx(other["youngs_modulus_Pa"], rel=1e-5)


def test_a_well_becomes_a_recording(tmp_path: Path) -> None:
    options = ImportOptions(
        "Corrected_Force(N)", height_column="Z_Position(mm)", length_unit="mm", compression_negative=True, time_columns=("Timestamp(s)",)
    )
    samples = import_files([well("E5")], options, tmp_path / "e5.csv").samples
    again = read_csv(tmp_path / "e5.csv")
    assert len(again) == len(samples) == 358
    assert np.array_equal(again.t_s, samples.t_s)
    assert again.wrench[:, 2].max() == pytest.approx(10.003)
    assert again.rate_Hz == pytest.approx(8.0, abs=0.5)


def test_the_height_of_a_relaxing_press_is_read_though_its_tip_is_unknown() -> None:
    for path in sorted((REAL / "silicone_relaxation").glob("*.csv")):
        curve = read_curve(path, Mapping("F_N", depth_column="u_mm", length_unit="mm", time_column="t_s"))
        result = analyse_curve(curve, tip_radius_m=0.005)
        assert 0.0 < result["contact_sigma_m"] < 1e-3
        assert result["samples"] < len(curve)  # the hold and the way back are left out
