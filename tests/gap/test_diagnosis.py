"""A diagnosis names what was put into a simulated cell, and keeps silent about a healthy one."""

import json
from collections.abc import Callable
from dataclasses import replace
from math import log
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from palpd.cell.cell_file import CellFile, Estimated, cell_from, nominal
from palpd.cell.effects import EFFECTS
from palpd.cell.report_times import find_reports
from palpd.cell.simulation import simulate
from palpd.cell.stages import WRENCH
from palpd.errors import RecordingError
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import CHANNELS, declared_rms
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.infer.posterior import known_and_unknown
from palpd.gap.infer.residual import ResidualStructure
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import NOMINAL_ETA, make_problem
from palpd.recording.samples import Samples
from palpd.tick import Floats

IN_TOLERANCE = Estimated(
    bias_N=0.02,
    drift_N_per_min=-0.008,
    gain=0.004,
    latency_s=-0.0008,
    filter_cutoff=0.04,
    crosstalk=(0.003, -0.002, 0.001, 0.002),
    mass_kg=0.002,
    youngs_modulus=0.02,
    surface_z_m=-2e-5,
    servo_natural_frequency=0.015,
)


def heights(rate_Hz: float = 125.0) -> tuple[Floats, Floats]:
    """Free strokes and presses, no two alike."""
    pieces, z = [np.full(int(1.0 * rate_Hz), 0.01)], 0.01
    for depth, down, hold, up, top in [
        (0.004, 0.012, 1.2, 0.02, 0.008),
        (-0.003, 0.02, 0.4, 0.02, 0.015),
        (0.0075, 0.02, 0.6, 0.008, 0.007),
        (0.007, 0.01, 3.0, 0.01, 0.01),
    ]:
        for to, speed, rest in ((-depth, down, hold), (top, up, 0.7)):
            pieces += [np.linspace(z, to, int(abs(z - to) / speed * rate_Hz)), np.full(int(rest * rate_Hz), to)]
            z = to
    commanded = np.concatenate(pieces)
    return np.arange(len(commanded)) / rate_Hz, commanded


def recording(cell: CellFile, effects: dict[str, dict[str, float]], seed: int = 3, rate_Hz: float = 125.0) -> Samples:
    t_s, z_cmd_m = heights(rate_Hz)
    columns = simulate(cell.with_effects(effects).with_estimated(IN_TOLERANCE), t_s, z_cmd_m=z_cmd_m, noise_seed=seed)
    return Samples(t_s, z_cmd_m, columns["z_m"], columns["vz_m_per_s"], np.column_stack([columns[name] for name in WRENCH]))


def slow_robot(samples: Samples, each: int = 8) -> Samples:
    """The recording of a sensor `each` times as fast as its robot, whose reports are joined by straight lines between its samples."""
    at = np.arange(0, len(samples), each)
    report_s = samples.t_s[at] + 0.3 / samples.rate_Hz

    def joined(values: Floats) -> Floats:
        return np.interp(samples.t_s, report_s, values[at])

    assert samples.z_cmd_m is not None
    return replace(samples, z_cmd_m=joined(samples.z_cmd_m), z_m=joined(samples.z_m), vz_m_per_s=joined(samples.vz_m_per_s))


def quick(samples: Samples | list[Samples], cell: CellFile) -> Diagnosis:
    return diagnose(samples if isinstance(samples, list) else [samples], cell, max_bins=900, propose=False)


@pytest.mark.parametrize("step_N", [0.37, 0.5])
@pytest.mark.parametrize("cut", [np.floor, np.trunc, np.rint])
def test_readings_that_are_cut_to_a_coarse_step_are_no_other_effect(cut: Callable[[Floats], Floats], step_N: float) -> None:
    samples = recording(nominal(), {})
    wrench = samples.wrench.copy()
    wrench[:, 2] = step_N * cut(wrench[:, 2] / step_N)
    assert [effect.id for effect in quick(replace(samples, wrench=wrench), nominal()).effects] == ["sensor.quantization"]


def test_a_tip_that_leaves_the_reported_heights_in_acceleration_is_no_other_mass() -> None:
    """In free motion, where the tip feels no tissue, the mass is the stated one."""
    cell = nominal()
    assert cell.tissue is not None
    samples = recording(cell, {})
    acceleration_m_per_s2 = np.gradient(samples.vz_m_per_s, samples.t_s)
    stiffness_N_per_m = 2.0 * cell.tissue.youngs_modulus_Pa / 0.75 * np.sqrt(cell.probe.tip_radius_m * np.maximum(-samples.z_m, 0.0))
    wrench = samples.wrench.copy()
    lag_s2 = (2.0 * np.pi * cell.robot.servo_natural_frequency_Hz) ** -2
    wrench[:, 2] -= 1.6 * lag_s2 * stiffness_N_per_m * acceleration_m_per_s2
    assert quick(replace(samples, wrench=wrench), cell).verdict == "none"


def test_a_healthy_cell_within_its_tolerances_is_not_accused() -> None:
    diagnosis = quick(recording(nominal(), {}), nominal()).to_json()
    assert diagnosis["verdict"] == "none"
    assert diagnosis["effects"] == []
    assert diagnosis["where"] is None
    assert diagnosis["shrink"]["closed"] is None


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("tissue.viscoelastic", {"ratio": 0.2, "tau_s": 0.8}),
        ("cable.friction", {"force_N": 0.05}),
        ("robot.lag", {"bandwidth_ratio": 0.7}),
        ("sensor.drift", {"rate_N_per_s": 0.01}),
        ("contact.lateral", {"ratio": 0.08, "azimuth_rad": 2.0}),
    ],
)
def test_an_effect_is_named_alone_with_its_size_and_closes_the_gap(name: str, values: dict[str, float]) -> None:
    diagnosis = quick(recording(nominal(), {name: values}), nominal())
    assert diagnosis.verdict == "effects"
    (effect,) = diagnosis.effects
    assert name in {effect.id, *effect.indistinguishable_from}
    assert effect.id != name or all(effect.parameters[p][0] == pytest.approx(v, rel=0.25) for p, v in values.items())
    assert diagnosis.gap.shrink.closed is not None
    assert diagnosis.gap.shrink.closed > 0.9


def test_a_force_that_noise_does_not_lift_off_its_level_is_no_smaller_mass() -> None:
    """At a third of a step of noise a reading in the middle of a level follows the force by two thirds."""
    cell = nominal().model_copy(update={"sensor": nominal().sensor.model_copy(update={"noise_rms_N": 0.045})})
    quieter = cell.model_copy(update={"sensor": cell.sensor.model_copy(update={"noise_rms_N": 0.038})})
    t_s = np.arange(30_000) / 500.0
    presses = np.clip(10.0 * np.sin(0.1 * np.pi * t_s) - 9.0, 0.0, 1.0)
    z_cmd_m = (1.0 - presses) * (0.02 + 0.015 * np.sin(4.4 * t_s)) - 0.006 * presses
    columns = simulate(quieter, t_s, z_cmd_m=z_cmd_m, noise_seed=4)
    samples = Samples(t_s, z_cmd_m, columns["z_m"], columns["vz_m_per_s"], np.column_stack([columns[name] for name in WRENCH]))
    diagnosis = quick(samples, cell)
    assert diagnosis.verdict == "none", diagnosis.sentence


def test_a_healthy_robot_that_reports_more_slowly_than_the_sensor_is_not_accused() -> None:
    samples = slow_robot(recording(nominal(), {}, rate_Hz=1000.0))
    diagnosis = quick(samples, nominal())
    (prepared,) = diagnosis.problem.recordings
    assert prepared.reports.rows_each == pytest.approx(8.0, rel=0.02)
    assert prepared.noise_rms[0] == pytest.approx(nominal().robot.position_noise_rms_m, rel=0.1)
    assert diagnosis.verdict == "none"


def test_a_robot_as_fast_as_the_sensor_reports_at_every_sample_also_with_uneven_steps() -> None:
    samples = recording(nominal(), {})
    uneven = replace(samples, t_s=samples.t_s + 0.002 * np.random.default_rng(1).random(len(samples)))
    for one in (samples, uneven):
        assert find_reports(one.t_s, one.z_m).rows_each == 1.0


def test_an_effect_is_named_alone_also_where_the_robot_reports_more_slowly_than_the_sensor() -> None:
    true = {"ratio": 0.2, "tau_s": 0.8}
    (effect,) = quick(slow_robot(recording(nominal(), {"tissue.viscoelastic": true}, rate_Hz=1000.0)), nominal()).effects
    assert effect.id == "tissue.viscoelastic"
    assert all(effect.parameters[p][0] == pytest.approx(v, rel=0.1) for p, v in true.items())


def test_a_vibration_keeps_its_phase_where_several_rows_make_one_step() -> None:
    true = {"amplitude_m": 3e-6, "frequency_Hz": 18.67, "phase_rad": 1.795}
    (effect,) = quick(recording(nominal(), {"robot.vibration": true}, rate_Hz=800.0), nominal()).effects
    value, low, high = effect.parameters["phase_rad"]
    assert effect.id == "robot.vibration"
    assert low <= true["phase_rad"] <= high, value


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_another_slope_on_one_side_of_a_reading_is_named_with_its_side(side: float) -> None:
    true = {"ratio": 0.2, "at_N": 0.5, "side": side}
    (effect,) = quick(recording(nominal(), {"sensor.asymmetry": true}, rate_Hz=500.0), nominal()).effects
    assert effect.id == "sensor.asymmetry"
    assert effect.parameters["side"] == (side, side, side)
    assert all(low <= true[name] <= high for name, (_, low, high) in effect.parameters.items()), effect.parameters


def test_two_effects_are_both_named() -> None:
    true = {"sensor.creep": {"ratio": 0.15, "tau_s": 3.0}, "robot.lag": {"bandwidth_ratio": 0.7}}
    assert {e.id for e in quick(recording(nominal(), true), nominal()).effects} == set(true)


@pytest.mark.parametrize(
    ("name", "values"),
    [("sensor.noise", {"ratio": 1.6}), ("sensor.quantization", {"step_N": 0.4}), ("sensor.dropout", {"rate_Hz": 1.0, "length_s": 0.06})],
)
def test_effects_of_the_scatter_are_named(name: str, values: dict[str, float]) -> None:
    diagnosis = quick(recording(nominal(), {name: values}), nominal())
    assert [e.id for e in diagnosis.effects] == [name]
    first = next(iter(values))
    assert diagnosis.effects[0].parameters[first][0] == pytest.approx(values[first], rel=0.5)


def test_noise_that_is_too_large_may_have_any_tails() -> None:
    quiet = recording(nominal(), {})
    sigma = np.array([nominal().sensor.noise_rms_N] * 3 + [nominal().sensor.noise_rms_Nm] * 3)
    more = np.random.default_rng(8).standard_t(4.0, quiet.wrench.shape)
    diagnosis = quick(replace(quiet, wrench=quiet.wrench + sigma * more), nominal())
    assert (diagnosis.verdict, [e.id for e in diagnosis.effects]) == ("effects", ["sensor.noise"])


def test_something_outside_the_list_is_called_unknown() -> None:
    healthy = recording(nominal(), {})
    bump = 0.5 * np.exp(-0.5 * ((healthy.t_s - 5.0) / 0.2) ** 2) - 0.4 * np.exp(-0.5 * ((healthy.t_s - 12.0) / 0.3) ** 2)
    wrench = healthy.wrench.copy()
    wrench[:, 5] += 0.1 * bump
    assert quick(replace(healthy, wrench=wrench), nominal()).verdict == "unknown"


def test_the_answer_is_complete_consistent_and_the_same_every_time() -> None:
    samples = recording(nominal(), {"tissue.viscoelastic": {"ratio": 0.2, "tau_s": 0.8}})
    one, two = (json.dumps(quick(samples, nominal()).to_json(), sort_keys=True) for _ in range(2))
    assert one == two
    diagnosis: dict[str, Any] = json.loads(one)
    for key in ("verdict", "where", "gap", "effects", "candidates", "p_none", "p_unknown", "shrink", "unexplained", "next_experiment"):
        assert key in diagnosis
    assert diagnosis["schema"] == "palpd.diagnosis/1"
    assert 0.0 <= diagnosis["p_none"] + diagnosis["p_unknown"] <= 1.0
    worst = max(diagnosis["gap"], key=lambda row: row["excess"])
    assert diagnosis["where"] == {"channel": worst["channel"], "phase": worst["phase"]}


def test_the_enriched_cell_predicts_another_motion() -> None:
    cell = nominal()
    true = cell.with_effects({"tissue.viscoelastic": {"ratio": 0.3, "tau_s": 0.8}}).with_estimated(IN_TOLERANCE)
    enriched = quick(recording(cell, true.effects), cell).enriched_cell()
    t_s, z_m = heights()
    z_m = -0.5 * z_m[::-1]
    real, before, after = (simulate(c, t_s, z_m=z_m)["fz_N"] for c in (true, enriched.with_effects({}), enriched))
    assert np.mean((after - real) ** 2) < 0.05 * np.mean((before - real) ** 2)


def test_without_a_commanded_height_the_robot_is_not_judged_and_that_is_said() -> None:
    diagnosis = quick(replace(recording(nominal(), {}), z_cmd_m=None), nominal()).to_json()
    assert not [row for row in diagnosis["gap"] if row["channel"] == "z_m"]
    assert any("z_cmd_m" in note for note in diagnosis["notes"])


def test_a_height_in_millimetres_is_noticed() -> None:
    samples = recording(nominal(), {})
    with pytest.raises(RecordingError, match="mm"):
        quick(replace(samples, z_m=1e3 * samples.z_m), nominal())


FREE, CONTACT = {"free_still", "free_moving"}, {"loading", "holding", "unloading"}


def poor(case: str) -> tuple[Samples, CellFile]:
    """A healthy recording that lacks something, and its cell."""
    cell = nominal()
    assert cell.tissue is not None
    if case == "no contact":
        cell = cell.model_copy(update={"tissue": cell.tissue.model_copy(update={"surface_z_m": -0.05})})
    if case == "no tissue":
        cell = cell.model_copy(update={"tissue": None})
    samples = recording(cell, {})
    if case == "no motion":
        still = np.zeros(len(samples))
        wrench = np.random.default_rng(5).standard_normal(samples.wrench.shape) * declared_rms(cell)[1:]
        samples = Samples(samples.t_s, still, still, 0.0 * still, wrench)
    if case == "no free motion":
        below = samples.z_m < -0.0001
        first = int(np.argmax(below))
        press = slice(first, first + int(np.argmin(below[first:])))
        samples = Samples(samples.t_s[press], None, samples.z_m[press], samples.vz_m_per_s[press], samples.wrench[press])
    if case == "dead axis":
        wrench = samples.wrench.copy()
        wrench[:, 0] = 0.0
        samples = replace(samples, wrench=wrench)
    return samples, cell


@pytest.mark.parametrize(
    ("case", "note", "not_judged", "phases"),
    [
        ("no motion", "nothing moves", {"z_m"}, {"free_still"}),
        ("no contact", "never comes below the stated surface", set(), FREE),
        ("no free motion", "no free motion", {"z_m"}, CONTACT),
        ("dead axis", "fx_N (always 0)", {"fx_N"}, FREE | CONTACT),
        ("no tissue", None, set(), FREE),
    ],
)
def test_a_healthy_recording_that_shows_little_is_judged_for_what_it_shows_and_not_accused(
    case: str, note: str | None, not_judged: set[str], phases: set[str]
) -> None:
    diagnosis = quick(*poor(case))
    assert diagnosis.verdict == "none", diagnosis.sentence
    assert {gap.channel for gap in diagnosis.gap.table} == set(CHANNELS) - not_judged
    assert {gap.phase for gap in diagnosis.gap.table} == phases
    assert any(note in each for each in diagnosis.notes) if note else not diagnosis.notes


def scaled(samples: Samples, cell: CellFile, length: float, force: float, time: float) -> tuple[Samples, CellFile]:
    """The same cell in other units of length, force and time: every number of recording and cell file changes accordingly."""
    speed, torque, mass = length / time, force * length, force * time**2 / length
    factors = {
        "_N": force, "_Nm": torque, "_m": length, "_m_per_s": speed, "_kg": mass, "_s": time, "_Hz": 1.0 / time,
        "_Pa": force / length**2, "_N_per_min": force / time, "resolution_fxy_N": force,
    }  # fmt: skip
    content = cell.model_dump()
    for block in ("probe", "sensor", "robot", "tissue", "tolerances", "repeatability"):
        for key in content[block]:
            suffix = max((s for s in factors if key.endswith(s)), key=len, default=None)
            if suffix and content[block][key] is not None:
                content[block][key] *= factors[suffix]
    z_cmd_m = None if samples.z_cmd_m is None else samples.z_cmd_m * length
    wrench = samples.wrench * np.array([force] * 3 + [torque] * 3)
    return Samples(samples.t_s * time, z_cmd_m, samples.z_m * length, samples.vz_m_per_s * speed, wrench), cell_from(content, "scaled")


@pytest.mark.parametrize(("length", "force", "time"), [(1e-3, 1e-6, 0.05), (20.0, 1e3, 4.0)])
def test_the_diagnosis_does_not_know_how_large_the_cell_is(length: float, force: float, time: float) -> None:
    cell = nominal()
    samples = recording(cell, {"tissue.viscoelastic": {"ratio": 0.2, "tau_s": 0.8}})
    (effect,) = quick(*scaled(samples, cell, length, force, time)).effects
    assert effect.id == "tissue.viscoelastic"
    assert effect.parameters["ratio"][0] == pytest.approx(0.2, rel=0.1)
    assert effect.parameters["tau_s"][0] == pytest.approx(0.8 * time, rel=0.15)


def test_several_recordings_are_fitted_jointly() -> None:
    effect = {"sensor.creep": {"ratio": 0.1, "tau_s": 2.0}}
    diagnosis = quick([recording(nominal(), effect, seed=3), recording(nominal(), effect, seed=4)], nominal())
    assert [e.id for e in diagnosis.effects] == ["sensor.creep"]


def test_what_is_ambiguous_gets_a_motion_that_separates_it() -> None:
    samples = recording(nominal(), {"sensor.gain": {"error": 0.2}})
    diagnosis = diagnose([samples], nominal(), max_bins=900)
    pair = {diagnosis.effects[0].id, *diagnosis.effects[0].indistinguishable_from}
    assert {"sensor.gain", "tissue.modulus"} <= pair
    assert diagnosis.proposal is not None
    assert "sensor.gain" in diagnosis.proposal.sentence
    assert "tissue.modulus" in diagnosis.proposal.sentence
    assert diagnosis.proposal.expected_gain >= ASSUMED.advice.worth_nats
    assert diagnosis.proposal.z_cmd_m.min() >= samples.z_m.min() - 1e-4


def test_a_press_that_an_effect_takes_away_takes_its_columns_along() -> None:
    cell = nominal()
    problem = make_problem([recording(cell, {})], cell, EFFECTS, 900)
    plain = linearise(problem, {}, NOMINAL_ETA)
    sunk = linearise(problem, {"tissue.surface": {"offset_m": -0.05}}, NOMINAL_ETA)
    for there in (plain, sunk):
        assert len(there.labels) == len(there.space.columns.dense()) == there.space.size
    assert len(sunk.numbers("press")) < len(plain.numbers("press"))
    assert sunk.numbers("recording") != []


def test_what_has_any_shape_is_worth_no_more_than_the_listed_effect_that_leaves_nothing() -> None:
    surface: Any = SimpleNamespace(names=("tissue.surface",), log_exact=-400.0, log_likelihood=-80.0, discrepancy_energy=50.0)
    left = ResidualStructure(390.0, 1000.0, "fz_N", "loading")
    alone, beside_plasticity = (np.logaddexp(*known_and_unknown(surface, left, 2000.0, most)) for most in (np.inf, -30.0))
    assert alone == pytest.approx(log(ASSUMED.prior.unknown) - 10.0, abs=0.01)
    assert beside_plasticity == pytest.approx(log(ASSUMED.prior.unknown) - 30.0, abs=0.01)
