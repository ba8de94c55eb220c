"""Recordings of other rigs: made by a few lines of their own, and measured by other people."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpd.cell.cell_file import CellFile, cell_from
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.interchange.import_files import ImportOptions, import_files
from palpd.recording.samples import Samples, read, samples_from_columns
from palpd.tick import Floats
from tests.paths import SHARED_DATA

REAL = SHARED_DATA / "real"
measured = pytest.mark.skipif(not REAL.is_dir(), reason="the measurements are not in the repository (their licences differ)")


def rig(
    rate_Hz: float = 10.0,
    seconds: float = 5.0,
    radius_m: float = 5e-3,
    modulus_Pa: float = 5e4,
    mass_kg: float = 0.0,
    friction_N: float = 0.0,
    relaxing: float = 0.0,
    uneven: float = 0.0,
    tissue: bool = True,
    **tolerances: float,
) -> tuple[Samples, CellFile]:
    """Presses of half a tip radius with a hold, by Hertz; friction, a relaxing part and inertia; noise 0.5 % of the peak."""
    rng = np.random.default_rng(1)
    n = int(rate_Hz * seconds)
    t_s = (np.arange(n) + uneven * rng.random(n)) / rate_Hz
    phase = 2.0 * t_s / seconds % 1.0
    z_m = radius_m * (0.5 - np.clip(4.0 * np.minimum(phase, 1.0 - phase), 0.0, 1.0) * 1.0)
    depth_m = np.maximum(-z_m, 0.0) if tissue else 0.0 * z_m
    v = np.gradient(z_m, t_s)
    elastic_N = 16.0 / 9.0 * modulus_Pa * np.sqrt(radius_m) * depth_m**1.5
    arm_N, last_N = np.zeros(n), 0.0
    for k in range(1, n):
        last_N = last_N * np.exp(-(t_s[k] - t_s[k - 1]) / (0.06 * seconds)) + elastic_N[k] - elastic_N[k - 1]
        arm_N[k] = last_N
    peak_N = 16.0 / 9.0 * modulus_Pa * radius_m**2 * 0.5**1.5
    force_N = np.maximum(elastic_N + relaxing * arm_N, 0.0) - mass_kg * np.gradient(v, t_s) - friction_N * peak_N * np.sign(v)
    noise_N, noise_m = 0.005 * peak_N, 1e-4 * radius_m
    wrench = np.zeros((n, 6))
    wrench[:, 2] = force_N + noise_N * rng.standard_normal(n)
    content: dict[str, Any] = {
        "probe": {"mass_kg": mass_kg, "tip_radius_m": radius_m, "tip_length_m": 10 * radius_m},
        "sensor": {"rate_Hz": rate_Hz, "filter_cutoff_Hz": None, "noise_rms_N": noise_N, "noise_rms_Nm": 0.0}
        | dict.fromkeys(("resolution_fxy_N", "resolution_fz_N", "resolution_Nm"), 0.0),
        "robot": {"position_noise_rms_m": noise_m, "velocity_noise_rms_m_per_s": 20 * noise_m / seconds},
        "tissue": {"youngs_modulus_Pa": modulus_Pa} if tissue else None,
        "tolerances": tolerances,
    }
    samples = Samples(t_s, None, z_m + noise_m * rng.standard_normal(n), v, wrench)
    return samples, cell_from(content, "rig")


def quick(samples: Samples, cell: CellFile) -> Diagnosis:
    return diagnose([samples], cell, max_bins=600, propose=False)


def names(diagnosis: Diagnosis) -> set[str]:
    return {name for effect in diagnosis.effects for name in (effect.id, *effect.indistinguishable_from)}


@pytest.mark.parametrize(
    "kind",
    [
        {"rate_Hz": 10.0, "seconds": 5.0},
        {"rate_Hz": 5.0, "seconds": 12.0},
        {"rate_Hz": 15.0, "seconds": 2.0},
        {"rate_Hz": 2000.0, "seconds": 2.0},
        {"rate_Hz": 20.0, "seconds": 10.0, "uneven": 0.6},
        {"radius_m": 1e-5, "modulus_Pa": 500.0},
        {"radius_m": 0.3, "modulus_Pa": 1e6, "mass_kg": 100.0, "rate_Hz": 50.0},
    ],
    ids=["50 samples", "5 Hz", "30 samples", "2000 Hz", "uneven", "nanonewtons", "100 kg"],
)
def test_a_healthy_rig_of_any_size_and_rate_is_not_accused(kind: dict[str, float]) -> None:
    samples, cell = rig(**kind)
    diagnosis = quick(samples, cell)
    assert not diagnosis.effects, diagnosis.sentence
    assert diagnosis.verdict != "effects"


@pytest.mark.parametrize("kind", [{"radius_m": 1e-5, "modulus_Pa": 500.0}, {}, {"radius_m": 0.3, "modulus_Pa": 1e6}], ids=["µm", "mm", "m"])
def test_tissue_that_relaxes_is_found_on_a_slow_indenter_of_any_size(kind: dict[str, float]) -> None:
    diagnosis = quick(*rig(rate_Hz=5.0, seconds=40.0, relaxing=0.4, **kind))
    assert "tissue.viscoelastic" in names(diagnosis), diagnosis.sentence
    assert any("creep" in note for note in diagnosis.notes)


def test_an_axis_with_friction_and_no_tissue_is_told_so() -> None:
    diagnosis = quick(*rig(rate_Hz=50.0, seconds=10.0, mass_kg=2.0, friction_N=0.3, tissue=False))
    assert {"cable.friction", "sensor.hysteresis"} & names(diagnosis), diagnosis.sentence


def test_a_modulus_that_nobody_knows_is_fitted_and_what_hides_in_it_is_said() -> None:
    samples, cell = rig(seconds=20.0, youngs_modulus=1.0)
    assert cell.tissue is not None
    cell = cell.model_copy(update={"tissue": cell.tissue.model_copy(update={"youngs_modulus_Pa": 2e4})})
    diagnosis = quick(samples, cell)
    assert diagnosis.verdict == "none", diagnosis.sentence
    assert "the fit gives 50 kPa" in diagnosis.sentence
    assert any("cannot be distinguished" in note for note in diagnosis.notes)


def strokes(seconds: float = 16.0, rate_Hz: float = 100.0) -> tuple[Floats, Floats]:
    """Times and heights of two sines that begin and end at rest."""
    t_s = np.arange(int(seconds * rate_Hz)) / rate_Hz
    ramp = np.clip(np.minimum(t_s, seconds - 1.0 - t_s), 0.0, 1.0)
    both_m = 0.02 * np.sin(np.pi * t_s) + 0.008 * np.sin(0.26 * np.pi * t_s + 1.0)
    return t_s, (both_m - both_m[0]) * ramp**2 * (3.0 - 2.0 * ramp)


def test_a_friction_damper_with_play_is_both_and_nothing_else() -> None:
    """A slider of Coulomb behind a spring with play, in place of the library's smooth build-up."""
    t_s, z_m = strokes()
    slider_m, stiffness_N_per_m, play_m, limit_N, force_N = z_m[0], 3e6, 4e-3, 8000.0, []
    for at_m in z_m:
        way, ahead_m = float(np.sign(at_m - slider_m)), abs(at_m - slider_m)
        if ahead_m > 0.5 * play_m + limit_N / stiffness_N_per_m:
            slider_m, ahead_m = at_m - way * (0.5 * play_m + limit_N / stiffness_N_per_m), 0.5 * play_m + limit_N / stiffness_N_per_m
        force_N.append(-way * stiffness_N_per_m * max(ahead_m - 0.5 * play_m, 0.0))
    wrench = np.zeros((len(t_s), 6))
    wrench[:, 2] = np.array(force_N) * (1.0 + 0.04 * np.sin(3.0 * t_s)) + 8.0 * np.random.default_rng(5).standard_normal(len(t_s))
    cell = foreign_cell(5e-3, 1e3, 0.0, 100.0, 8.0, bias_N=20.0)
    diagnosis = quick(Samples(t_s, None, z_m, np.gradient(z_m, t_s), wrench), cell.model_copy(update={"tissue": None}))
    assert {effect.id for effect in diagnosis.effects} == {"cable.friction", "robot.backlash"}, diagnosis.sentence
    assert diagnosis.verdict == "effects"


# measured by others


@measured
@pytest.mark.parametrize("name", ["230515-P002-1", "230515-P002-laser-5"])
def test_silicone_that_relaxes_is_viscoelastic_against_an_elastic_cell(name: str, tmp_path: Path) -> None:
    """Load and hold, as far as the height stays; no modulus is known and the touch only to half a millimetre."""
    path = REAL / "silicone_relaxation" / f"{name}.csv"
    options = ImportOptions("F_N", depth_column="u_mm", length_unit="mm", time_columns=("t_s",))
    whole = import_files([path], options, tmp_path / "s.csv").samples
    end = int(np.flatnonzero(whole.z_m < whole.z_m.min() + 2e-5)[-1]) + 1
    held = Samples(whole.t_s[:end], None, whole.z_m[:end], whole.vz_m_per_s[:end], whole.wrench[:end])
    diagnosis = quick(held, foreign_cell(5e-3, 8e3, 0.0, 10.0, 0.002, youngs_modulus=1.0, surface_z_m=5e-4))
    assert diagnosis.effects[0].id == "tissue.viscoelastic", diagnosis.sentence
    assert len(diagnosis.effects) <= 2  # the tip is not a known sphere, so what bends the force curve may stand beside it
    assert diagnosis.gap.where is not None
    assert diagnosis.gap.where["phase"] in {"loading", "holding"}
    assert any("creep" in note for note in diagnosis.notes)


@measured
def test_a_stiff_sample_against_a_rigid_machine_says_what_its_modulus_hides(tmp_path: Path) -> None:
    """Fitted as if the machine were rigid, it has the modulus that the makers give as measured: 12.26 MPa, less by 1 - ν²."""
    well = next((REAL / "asmi_indentation").glob("well_E5_*.csv"))
    options = ImportOptions(
        "Corrected_Force(N)", height_column="Z_Position(mm)", length_unit="mm", compression_negative=True, time_columns=("Timestamp(s)",)
    )
    samples = import_files([well], options, tmp_path / "e5.csv").samples
    diagnosis = quick(samples, foreign_cell(2.5e-3, 17e6, -0.07705, 8.0, 0.003, youngs_modulus=1.0))
    assert diagnosis.verdict in {"none", "ambiguous"}, diagnosis.sentence
    assert "robot.compliance" in diagnosis.sentence
    estimated = diagnosis.enriched_cell().estimated
    assert estimated is not None
    assert 17e6 * (1.0 + estimated.youngs_modulus) / 0.75 == pytest.approx(12.26e6, rel=0.03)


def foreign_cell(radius_m: float, modulus_Pa: float, surface_m: float, rate_Hz: float, noise_N: float, **tolerances: float) -> CellFile:
    sensor = {"rate_Hz": rate_Hz, "filter_cutoff_Hz": None, "noise_rms_N": noise_N, "noise_rms_Nm": 0.0}
    content = {
        "probe": {"mass_kg": 0.0, "tip_radius_m": radius_m},
        "sensor": sensor | dict.fromkeys(("resolution_fxy_N", "resolution_fz_N", "resolution_Nm"), 0.0),
        "robot": {"position_noise_rms_m": 1e-6, "velocity_noise_rms_m_per_s": 1e-5},
        "tissue": {"surface_z_m": surface_m, "youngs_modulus_Pa": modulus_Pa},
        "tolerances": tolerances,
    }
    return cell_from(content, "foreign")


# reading


def test_a_parquet_recording_is_the_same_recording(tmp_path: Path) -> None:
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    samples, _ = rig()
    columns: dict[str, Floats] = {"t_s": samples.t_s, "z_m": samples.z_m, "vz_m_per_s": samples.vz_m_per_s}
    columns |= {name: samples.wrench[:, k] for k, name in enumerate(("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm"))}
    parquet.write_table(arrow.table(columns), tmp_path / "r.parquet")
    again, same = read(tmp_path / "r.parquet"), samples_from_columns(columns, "r")
    assert np.array_equal(again.wrench, same.wrench)
    assert np.array_equal(again.t_s, same.t_s)
