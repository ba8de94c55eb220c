"""Recordings that no cell can make are refused or questioned before any effect is named."""

from dataclasses import replace

import numpy as np
import pytest

from palpd.cell.cell_file import CellFile, cell_from, nominal
from palpd.cell.effects import EFFECTS
from palpd.errors import RecordingError
from palpd.gap.commands import simulate_columns
from palpd.gap.data.plausibility import channel_notes, check_recordings, recording_notes
from palpd.gap.data.prepare import prepare
from palpd.recording.samples import Samples
from palpd.tick import Floats
from tests.gap.test_diagnosis import quick, recording

HEALTHY = recording(nominal(), {})


def with_forces(factor: float | Floats) -> Samples:
    return replace(HEALTHY, wrench=HEALTHY.wrench * factor)


def with_modulus_unknown() -> CellFile:
    return cell_from({"tolerances": {"youngs_modulus": 1.0}}, "unknown")


def test_a_healthy_recording_gets_no_note() -> None:
    assert check_recordings([HEALTHY], nominal()) == []


@pytest.mark.parametrize("axes", [[2], [0, 1, 2, 3, 4, 5]], ids=["fz", "all"])
@pytest.mark.parametrize("cell", [nominal(), with_modulus_unknown()], ids=["known", "unknown modulus"])
def test_a_force_that_is_constant_while_the_probe_presses_is_refused_as_dead(axes: list[int], cell: CellFile) -> None:
    wrench = HEALTHY.wrench.copy()
    wrench[:, axes] = 0.0
    with pytest.raises(RecordingError, match=r"fz_N is 0 throughout while the probe goes 7\.\d+ mm into the tissue.*dead"):
        check_recordings([replace(HEALTHY, wrench=wrench)], cell)


def strokes_in_the_air(mass_kg: float = 0.2, resolution_fz_N: float = 0.131) -> tuple[Samples, CellFile]:
    """Strokes of 20 mm at 20 mm/s above the surface, with the sensor that the emulated cell has."""
    sensor = {"noise_rms_N": 0.03, "resolution_fz_N": resolution_fz_N}
    cell = cell_from({"probe": {"mass_kg": mass_kg}, "sensor": sensor, "tissue": None}, "in the air")
    t_s = np.arange(0.0, 16.0, 0.002)
    z_cmd_m = 0.01 + 0.02 * np.interp(t_s % 4.0, [0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 0.0, 1.0, 1.0, 0.0])
    return simulate_columns(cell, {"t_s": t_s, "z_cmd_m": z_cmd_m}, measured=False, noise_seed=1), cell


def test_a_coarse_and_quiet_sensor_in_free_air_is_not_called_dead() -> None:
    samples, cell = strokes_in_the_air()
    assert len(np.unique(samples.wrench[:, 2])) > 1
    assert check_recordings([samples], cell) == []


@pytest.mark.parametrize(("mass_kg", "resolution_N", "is_dead"), [(0.5, 0.131, True), (0.2, 0.131, False), (0.2, 0.01, True)])
def test_a_constant_force_in_free_air_is_dead_where_inertia_exceeds_a_step(mass_kg: float, resolution_N: float, is_dead: bool) -> None:
    samples, cell = strokes_in_the_air(mass_kg, resolution_N)
    samples.wrench[:, 2] = 0.131
    if is_dead:
        with pytest.raises(RecordingError, match=r"fz_N is 0\.131 throughout while the inertia of"):
            check_recordings([samples], cell)
    else:
        assert check_recordings([samples], cell) == [
            "fz_N is 0.131 throughout, so nothing vertical is judged; check that the sensor is alive, and press the tissue."
        ]


def test_a_wrench_without_a_live_axis_is_refused_also_where_nothing_is_in_reach() -> None:
    samples, cell = strokes_in_the_air()
    samples.wrench[:] = 0.0
    with pytest.raises(RecordingError, match="no other axis of the force changes, while the probe moves by 20 mm"):
        check_recordings([samples], cell)


def test_two_wrong_signs_that_cancel_are_questioned() -> None:
    assert HEALTHY.z_cmd_m is not None
    both = replace(
        HEALTHY, z_m=-HEALTHY.z_m, z_cmd_m=-HEALTHY.z_cmd_m, vz_m_per_s=-HEALTHY.vz_m_per_s, wrench=HEALTHY.wrench * [1, 1, -1, 1, 1, 1]
    )
    assert any("both signs look wrong" in note for note in check_recordings([both], nominal()))


def test_the_same_recording_twice_is_no_further_evidence() -> None:
    again = replace(HEALTHY, wrench=HEALTHY.wrench.copy())
    with pytest.raises(RecordingError, match="recordings 1 and 2 hold the same samples"):
        check_recordings([HEALTHY, again], nominal())


def test_a_cell_that_cannot_be_carried_is_said_above_the_verdict() -> None:
    heavy = cell_from({"probe": {"mass_kg": 106.0}}, "heavy")
    diagnosis = quick(HEALTHY, heavy)
    assert any("probe.mass_kg is 106 kg, expected 0 to 5 kg" in note for note in diagnosis.to_json()["decisive"])


def test_dead_lateral_axes_are_noted_and_the_rest_is_judged() -> None:
    wrench = HEALTHY.wrench.copy()
    wrench[:, [0, 1, 3, 4, 5]] = 0.0
    diagnosis = quick(replace(HEALTHY, wrench=wrench), nominal())
    assert diagnosis.verdict == "none"
    assert any("fx_N (always 0)" in note for note in diagnosis.notes)


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "mN"), (1e-3, "kN")])
def test_forces_in_another_unit_are_refused_with_the_unit(factor: float, unit: str) -> None:
    stated = cell_from({"sensor": {"noise_rms_N": 5e-5, "resolution_fz_N": 1.31e-4}}, "fine")
    with pytest.raises(RecordingError, match=f"looks like {unit}"):
        check_recordings([with_forces(factor)], stated if factor < 1 else nominal())


def test_an_odd_force_is_questioned_and_not_refused() -> None:
    assert any("check the unit of fz_N" in note for note in check_recordings([with_forces(30.0)], nominal()))


@pytest.mark.parametrize(
    ("effect", "size"),
    [("cable.viscous", {"coefficient_N_s_per_m": 3.0}), ("cable.friction", {"force_N": 0.2}), ("probe.mass", {"delta_kg": 0.3})],
)
def test_what_pushes_a_probe_in_the_air_is_no_touch(effect: str, size: dict[str, float]) -> None:
    cell = cell_from({"sensor": {"noise_rms_N": 0.01, "resolution_fz_N": 0.0}}, "fine")
    t_s = np.arange(0.0, 20.0, 0.002)
    strokes = np.interp(t_s % 4.0, [0.0, 1.5, 1.6, 2.0, 2.1, 4.0], [0.012, 0.012, 0.002, 0.002, 0.012, 0.012])
    z_m = np.where(t_s < 12.0, strokes, np.interp(t_s, [12.0, 13.0, 14.0, 16.0, 17.0], [0.012, 0.012, -0.004, -0.004, 0.012]))
    samples = simulate_columns(cell.with_effects({effect: size}), {"t_s": t_s, "z_cmd_m": z_m}, measured=False, noise_seed=1)
    assert check_recordings([samples], cell) == []


def test_play_behind_a_coarse_step_is_no_dead_sensor_and_rests_in_the_air_are_not_saturated() -> None:
    t_s = np.arange(0.0, 12.0, 0.002)
    z_m = np.interp(t_s, [0.0, 1.0, 3.0, 6.0, 6.2, 8.0, 9.0, 12.0], [0.004, 0.004, -4e-4, -4e-4, -3.5e-4, -3.5e-4, 0.004, 0.004])
    cell = cell_from({"sensor": {"noise_rms_N": 1e-3, "resolution_fz_N": 0.05}, "tissue": {"youngs_modulus_Pa": 5e6}}, "rubber")
    with_play = simulate_columns(cell.with_effects({"robot.backlash": {"width_m": 5e-5}}), {"t_s": t_s, "z_cmd_m": z_m}, measured=False)
    wrench = with_play.wrench.copy()
    wrench[:, 2] = np.rint((wrench[:, 2] - 0.1) / 0.05) * 0.05
    samples = replace(with_play, wrench=wrench)
    assert check_recordings([samples], cell) == []
    assert not [note for note in channel_notes(prepare([samples], cell, EFFECTS, 300), cell) if "saturated" in note]


def test_an_unknown_modulus_is_questioned_where_no_tissue_has_it() -> None:
    assert check_recordings([with_forces(100.0)], with_modulus_unknown()) == []
    assert any("the modulus that this gives is" in note for note in check_recordings([with_forces(1e5)], with_modulus_unknown()))


@pytest.mark.parametrize("cell", [nominal(), with_modulus_unknown()], ids=["known", "unknown modulus"])
def test_a_force_with_the_wrong_sign_is_refused(cell: CellFile) -> None:
    with pytest.raises(RecordingError, match="multiply the forces by -1"):
        check_recordings([with_forces(-1.0)], cell)


@pytest.mark.parametrize("zero_m", [0.0, 0.011, 0.02])
def test_a_height_that_is_positive_downwards_is_refused(zero_m: float) -> None:
    assert HEALTHY.z_cmd_m is not None
    mirrored = replace(HEALTHY, z_m=zero_m - HEALTHY.z_m, z_cmd_m=zero_m - HEALTHY.z_cmd_m, vz_m_per_s=-HEALTHY.vz_m_per_s)
    with pytest.raises(RecordingError, match="positive downwards"):
        check_recordings([mirrored], nominal())


def test_an_hour_missing_in_time_is_refused_with_the_place_to_split() -> None:
    t_s = HEALTHY.t_s.copy()
    t_s[700:] += 3600.0
    with pytest.raises(RecordingError, match=r"after row 700.*split the file there"):
        check_recordings([replace(HEALTHY, t_s=t_s)], nominal())


def test_a_recording_split_at_its_hole_is_judged_as_two() -> None:
    assert HEALTHY.z_cmd_m is not None
    at_rest = (np.abs(HEALTHY.z_cmd_m - 0.015) < 1e-9) & (HEALTHY.t_s > 0.5)
    cut = int(np.flatnonzero(at_rest)[-10])
    parts = [
        Samples(HEALTHY.t_s[part], HEALTHY.z_cmd_m[part], HEALTHY.z_m[part], HEALTHY.vz_m_per_s[part], HEALTHY.wrench[part])
        for part in (slice(None, cut), slice(cut, None))
    ]
    assert quick(parts, nominal()).verdict == "none"


def test_a_short_hole_is_noted_with_its_time() -> None:
    keep = np.ones(len(HEALTHY), dtype=bool)
    keep[300:350] = False
    assert HEALTHY.z_cmd_m is not None
    holed = Samples(HEALTHY.t_s[keep], HEALTHY.z_cmd_m[keep], HEALTHY.z_m[keep], HEALTHY.vz_m_per_s[keep], HEALTHY.wrench[keep])
    assert [note for note in recording_notes([holed], nominal()) if "missing at 1 place, the longest time 0.408 s from 2.39" in note]


def test_time_in_milliseconds_is_refused() -> None:
    with pytest.raises(RecordingError, match="t_s like ms"):
        check_recordings([replace(HEALTHY, t_s=1e3 * HEALTHY.t_s)], nominal())


def test_a_touch_far_from_the_stated_surface_is_noted_with_both_heights() -> None:
    cell = cell_from({"tissue": {"surface_z_m": 0.009}}, "high")
    (note,) = [note for note in check_recordings([HEALTHY], cell) if "begins to rise" in note]
    touch_m = float(note.split("z = ")[1].split(" m")[0])
    assert touch_m == pytest.approx(0.0, abs=1e-3)
    assert "0.009 m" in note


def test_a_sensor_that_fails_in_mid_press_is_noted_with_its_time() -> None:
    wrench = HEALTHY.wrench.copy()
    first = int(np.argmin(HEALTHY.z_m)) - 60
    wrench[first : first + 400] = wrench[first]
    notes = check_recordings([replace(HEALTHY, wrench=wrench)], nominal())
    assert any(f"from {HEALTHY.t_s[first]:.4g} s" in note and "sensor or its cable failed" in note for note in notes)


def test_noise_far_from_the_stated_is_noted() -> None:
    quiet = cell_from({"sensor": {"noise_rms_N": 0.005, "resolution_fz_N": 0.01}}, "quiet sensor")
    for cell, expected in ((quiet, 1), (nominal(), 0)):
        notes = channel_notes(prepare([HEALTHY], cell, EFFECTS, 300), cell)
        assert len([note for note in notes if "noise of fz_N at rest" in note]) == expected


def test_a_force_that_never_answers_the_press_is_noted() -> None:
    wrench = HEALTHY.wrench.copy()
    wrench[:, 2] = np.random.default_rng(1).normal(0.0, 0.05, len(HEALTHY))
    assert any("does not feel the press" in note for note in check_recordings([replace(HEALTHY, wrench=wrench)], nominal()))


def test_recordings_of_several_sites_are_refused_and_named() -> None:
    with pytest.raises(RecordingError, match=r"holds 2 sites \(A, B\), expected one; export each with palpd export --site"):
        check_recordings([replace(HEALTHY, sites=("A", "B"))], nominal())


def test_recordings_of_two_sites_are_not_judged_as_one_cell() -> None:
    one, other = (replace(HEALTHY, sites=(name,)) for name in "AB")
    with pytest.raises(RecordingError, match=r"the recordings together hold 2 sites \(A, B\), expected one"):
        check_recordings([one, other], nominal())


def test_a_cell_file_with_sites_says_which_tissue_counts() -> None:
    cell = cell_from({"sites": [{"name": "A"}, {"name": "B", "x_m": 0.03}]}, "sites")
    assert any("has sites (A, B), and the recording names none of them" in note for note in recording_notes([HEALTHY], cell))
