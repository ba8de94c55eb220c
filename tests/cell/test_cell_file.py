"""cell.yaml: defaults, refusals, and the paper's phantom."""

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml

from palpd.cell.cell_file import PHANTOM, CellFile, Estimated, cell_from, load_cell, nominal, save_cell
from palpd.cell.effects import load_effects
from palpd.cell.simulation import equilibrium_force_N
from palpd.documents import parse_yaml
from palpd.errors import ConfigError
from tests.paths import EXAMPLE
from tests.paths import SHARED_DATA as DATA


def test_a_file_that_states_nothing_but_its_version_is_the_nominal_cell_and_an_empty_one_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text("")
    with pytest.raises(ConfigError, match="is empty"):
        load_cell(tmp_path / "cell.yaml")
    (tmp_path / "cell.yaml").write_text("version: 1\n")
    cell = load_cell(tmp_path / "cell.yaml")
    assert cell == nominal()
    assert cell.tissue is not None
    assert cell.tissue.youngs_modulus_Pa == 72000.0
    assert cell.sensor.resolution_fz_N == 0.131
    assert cell.effects == {}
    assert cell.estimated is None


def test_absent_tolerances_follow_from_noise_mass_and_tip() -> None:
    cell = cell_from(
        {
            "probe": {"mass_kg": 3.0, "tip_radius_m": 0.02},
            "sensor": {"noise_rms_N": 2.0},
            "tolerances": {"gain": 0.01, "bias_N": 9.0},
        },
        "cell",
    )
    assert cell.tolerances.bias_N == 9.0
    assert cell.tolerances.drift_N_per_min == pytest.approx(0.4)
    assert cell.tolerances.mass_kg == pytest.approx(0.045)
    assert cell.tolerances.surface_z_m == pytest.approx(1.2e-4)
    assert cell.repeatability.surface_z_m == pytest.approx(8e-5)
    assert cell.tolerances.gain == 0.01
    assert cell.tolerances.latency_s == 0.001


def test_the_defaults_are_those_of_the_printed_example() -> None:
    spread = nominal()
    assert spread.tolerances.bias_N == pytest.approx(0.02)
    assert spread.tolerances.drift_N_per_min == pytest.approx(0.01)
    assert spread.tolerances.mass_kg == pytest.approx(0.003)
    assert spread.tolerances.surface_z_m == pytest.approx(3.0e-5)
    assert spread.repeatability.surface_z_m == pytest.approx(2.0e-5)
    assert spread.repeatability.stiffness == 0.01


def test_a_modulus_tolerance_of_one_means_not_known() -> None:
    assert nominal().tolerances.modulus_known
    assert not cell_from({"tolerances": {"youngs_modulus": 1.0}}, "cell").tolerances.modulus_known


def test_no_tissue_and_no_filter_are_null() -> None:
    cell = cell_from(yaml.safe_load("tissue: null\nsensor: {filter_cutoff_Hz: null}"), "cell")
    assert cell.tissue is None
    assert cell.sensor.filter_cutoff_Hz is None


def test_what_a_site_does_not_say_of_its_tissue_is_the_common_one() -> None:
    given = {
        "tissue": {"surface_z_m": 0.02, "youngs_modulus_Pa": 5e4},
        "sites": [{"name": "same"}, {"name": "soft", "tissue": {"youngs_modulus_Pa": 1e4}}, {"name": "none", "tissue": None}],
    }
    same, soft, none = cell_from(given, "cell").sites
    assert same.tissue is not None
    assert soft.tissue is not None
    assert (same.tissue.surface_z_m, same.tissue.youngs_modulus_Pa) == (0.02, 5e4)
    assert (soft.tissue.surface_z_m, soft.tissue.youngs_modulus_Pa) == (0.02, 1e4)
    assert none.tissue is None
    assert cell_from({"tissue": None, "sites": [{"name": "A"}]}, "cell").sites[0].tissue is None


def test_numbers_without_a_point_before_the_exponent_are_numbers() -> None:
    cell = cell_from(parse_yaml("tissue: {youngs_modulus_Pa: 72e3, surface_z_m: 1e-3}", "cell").content, "cell")
    assert cell.tissue is not None
    assert cell.tissue.youngs_modulus_Pa == 72000.0


@pytest.mark.parametrize(
    "cell",
    [
        nominal(),
        PHANTOM,
        cell_from({"tissue": None, "sensor": {"filter_cutoff_Hz": None}}, "cell"),
        cell_from({"wall": {"z_m": -0.01, "stiffness_N_per_m": 2e4, "appears_after_s": 3.0}}, "cell"),
        nominal()
        .with_effects({"tissue.viscoelastic": {"ratio": 0.3, "tau_s": 1.5}})
        .with_estimated(Estimated(bias_N=1e-6, crosstalk=(0.001, 0.0, 0.0, -0.002))),
    ],
)
def test_what_is_saved_is_loaded_back_equal(cell: CellFile, tmp_path: Path) -> None:
    save_cell(tmp_path / "cell.yaml", cell)
    assert load_cell(tmp_path / "cell.yaml") == cell


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("probe: {tip_radius_mm: 5}", "there is no key 'probe.tip_radius_mm' (did you mean 'tip_radius_m'?)"),
        ("probes: {}", "there is no key 'probes' (did you mean 'probe'?)"),
        ("probe: {tip_radius_m: 5}", "probe.tip_radius_m is 5 (is it in millimetres?)"),
        ("tissue: {surface_z_m: -40}", "tissue.surface_z_m is -40 (is it in millimetres?)"),
        ("tissue: {youngs_modulus_Pa: 0.072}", "tissue.youngs_modulus_Pa is 0.072 (is it in kPa or MPa?)"),
        ("tissue: {youngs_modulus_Pa: 72 kPa}", "tissue.youngs_modulus_Pa is '72 kPa'"),
        ("tissue: {poisson_ratio: 0.7}", "tissue.poisson_ratio is 0.7"),
        ("sensor: {noise_rms_N: .nan}", "sensor.noise_rms_N is nan"),
        ("sensor: {noise_rms_N: 0}", "sensor.noise_rms_N is 0"),
        ("robot: 8", "robot is 8"),
        ("tolerances: {bias: 1}", "there is no key 'tolerances.bias' (did you mean 'bias_N'?)"),
        ("effects: {tissue.viscoelastc: {ratio: 1}}", "there is no effect 'tissue.viscoelastc' (did you mean 'tissue.viscoelastic'?)"),
        ("effects: {sensor.gain: {errors: 1}}", "effects.sensor.gain: there is no parameter 'errors'; expected error"),
        ("effects: {tissue.viscoelastic: {ratio: 1}}", "effects.tissue.viscoelastic: tau_s not given; expected ratio, tau_s"),
        ("effects: {sensor.asymmetry: {ratio: 0.1, at_N: 0, side: 2}}", "effects.sensor.asymmetry.side is 2, expected 1 or -1"),
        ("effects: {sensor.gain: {error: big}}", "effects.sensor.gain.error is 'big'"),
        ("sites: [{name: A, effects: {x: {}}}]", "sites.A.effects: there is no effect 'x'"),
        ("sites: [{x_m: 0.0}]", "sites.0.name is not given"),
        ("estimated: {crosstalk: [0.1]}", "estimated.crosstalk"),
        ("wall: {z_m: 0.0}", "wall.stiffness_N_per_m is not given"),
        ("- 1", "holds a list"),
        ("a: [", "line 1: this is not YAML"),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence_that_names_the_key(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as refused:
        load_cell(path)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
    assert str(path) in str(refused.value)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_cell(tmp_path / "none.yaml")


def test_a_cell_may_name_an_effect_of_the_users_own_library() -> None:
    given = {"effects": {"tissue.pulse": {"share": 0.1, "frequency_Hz": 1.2, "phase_rad": 0.0}}}
    with pytest.raises(ConfigError, match=r"there is no effect 'tissue\.pulse'"):
        cell_from(given, "cell")
    assert "tissue.pulse" in cell_from(given, "cell", load_effects(EXAMPLE)).effects


@pytest.mark.skipif(not (DATA / "seed" / "table1_static.csv").exists(), reason="the paper's tables are not here")
@pytest.mark.parametrize(
    ("site", "setup", "zero_error_m"),
    [("A", "none", 0.0005), ("B", "inclusion_5mm", 0.0), ("C", "inclusion_8mm", 0.0), ("D", "inclusion_10mm", 0.0)],
)
def test_each_site_of_the_phantom_reproduces_table_1(site: str, setup: str, zero_error_m: float) -> None:
    with (DATA / "seed" / "table1_static.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["setup"] == setup]
    assert len(rows) == 8
    relative = [equilibrium_force_N(PHANTOM, float(row["depth_m"]) + zero_error_m, site) / float(row["force_N"]) - 1.0 for row in rows]
    assert np.sqrt(np.mean(np.square(relative))) < 0.05


def test_the_sites_of_the_phantom_stand_30_mm_apart() -> None:
    assert [(site.name, round(site.x_m * 1000), site.y_m) for site in PHANTOM.sites] == [
        ("A", 0, 0.0),
        ("B", 30, 0.0),
        ("C", 60, 0.0),
        ("D", 90, 0.0),
    ]


def test_a_number_beyond_every_unit_is_refused(tmp_path: Path) -> None:
    """It overflowed in the recording of a simulated run."""
    (tmp_path / "cell.yaml").write_text("probe: {mass_kg: 1.0e+300}\n")
    with pytest.raises(ConfigError, match=r"probe.mass_kg is 1e\+300; expected less than or equal to"):
        load_cell(tmp_path / "cell.yaml")
