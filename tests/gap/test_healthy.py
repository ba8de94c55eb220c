"""What changed since the cell was healthy: its own residual is the nominal, whatever law it follows."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import palpd
from palpd.cell.effects import EFFECTS
from palpd.cell.tip_motion import estimate_tip_motion
from palpd.cli.application import one_file_each
from palpd.errors import BadInput, RecordingError
from palpd.gap.commands import diagnose_files, since_healthy
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.healthy import HealthyCell
from palpd.gap.healthy_reference import HealthyReference
from palpd.gap.plain import plain_answer
from palpd.gap.user_simulator import asked
from palpd.gap.usual import _spread
from palpd.recording.samples import Samples, write_csv
from palpd.tick import Floats
from tests.gap.test_diagnosis import quick
from tests.gap.test_user_simulator import axis, foam_N, moved_axis, own_simulator, record, stated


def rig(tip: Mapping[str, Floats]) -> dict[str, Floats]:
    """The foam, with friction that depends on the height: no cell file has either."""
    rubbing_N = 0.3 * (1.0 + 40.0 * np.maximum(tip["z_m"], 0.0)) * np.tanh(tip["vz_m_per_s"] / 5e-4)
    return own_simulator(tip) | {"fz_N": own_simulator(tip)["fz_N"] - rubbing_N}


def rubbing_more(tip: Mapping[str, Floats]) -> dict[str, Floats]:
    return rig(tip) | {"fz_N": rig(tip)["fz_N"] - 0.2 * np.tanh(tip["vz_m_per_s"] / 5e-4)}


@pytest.fixture(scope="module")
def healthy() -> list[Samples]:
    return [record(rig, seed=seed) for seed in (11, 12, 13)]


@pytest.fixture(scope="module")
def reference(healthy: list[Samples]) -> HealthyReference:
    return HealthyReference.of(healthy, stated(), EFFECTS)


def changed(now: Samples, reference: HealthyReference) -> Diagnosis:
    learned = reference.learned
    return diagnose([now], learned.compared_cell, learned.library, propose=False, simulators=[reference.simulator(now)])


@pytest.mark.timeout(600)
def test_what_no_cell_file_has_is_healthy_if_it_was_there_before(reference: HealthyReference) -> None:
    again = record(rig, seed=21)
    assert quick(again, stated()).verdict != "none"
    answer = changed(again, reference)
    assert answer.verdict == "none"
    assert answer.sentence.startswith("No gap: the cell behaves as it did while it was healthy, within its tolerances")


def test_another_motion_of_the_healthy_cell_is_healthy(reference: HealthyReference) -> None:
    answer = changed(record(rig, seed=22, presses_m=(0.005, 0.002, 0.0045)), reference)
    assert answer.verdict == "none", answer.sentence


def test_more_friction_beside_known_friction_is_named_with_what_it_is_more(reference: HealthyReference) -> None:
    answer = changed(record(rubbing_more, seed=23), reference)
    assert [effect.id for effect in answer.effects] == ["cable.friction"], answer.sentence
    value, low, high = answer.effects[0].parameters["force_N"]
    assert low <= 0.2 <= high, (value, low, high)


def test_friction_that_became_less_is_named(reference: HealthyReference) -> None:
    """Friction of the list is positive; beside a cell that rubs already it may have either sign, also by the curve of its own friction."""

    def rubbing_less(tip: Mapping[str, Floats]) -> dict[str, Floats]:
        smooth_N = own_simulator(tip)["fz_N"]
        return rig(tip) | {"fz_N": smooth_N + 0.5 * (rig(tip)["fz_N"] - smooth_N)}

    answer = changed(record(rubbing_less, seed=27), reference)
    assert [effect.id for effect in answer.effects] == ["cable.friction"], answer.sentence
    value, low, high = answer.effects[0].parameters["force_N"]
    assert low < value < high < 0.0, (value, low, high)
    assert set(answer.effects[0].parameters) == {"force_N"}, "by which curve is no number of the effect"
    assert "own_curve" not in str(answer.to_json())


def test_a_mass_that_no_cell_file_knows_is_named_where_it_changed(healthy: list[Samples]) -> None:
    """The healthy recordings showed it, so neither the stated mass nor its tolerance says how large a change can be."""
    unknown = stated().with_tolerances(mass_kg=1.0)
    unknown = unknown.model_copy(update={"probe": unknown.probe.model_copy(update={"mass_kg": 0.0})})

    def heavier(tip: Mapping[str, Floats]) -> dict[str, Floats]:
        return rig(tip) | {"fz_N": rig(tip)["fz_N"] - 0.15 * tip["az_m_per_s2"]}

    answer = changed(record(heavier, seed=28), HealthyReference.of(healthy, unknown, EFFECTS))
    assert "probe.mass" in {name for one in answer.effects for name in (one.id, *one.indistinguishable_from)}, answer.sentence


def test_a_rig_without_tissue_is_not_judged_for_a_contact() -> None:
    recordings = [moved_axis(axis, seed=seed) for seed in (1, 2, 3)]
    answer = changed(recordings[2][0], HealthyReference.of([samples for samples, _ in recordings[:2]], recordings[0][1], EFFECTS))
    assert {"tissue.modulus", "contact.lateral", "probe.tilt"} <= set(answer.to_json()["simulated"]["not_judged"])


def test_a_tissue_that_became_softer_is_named_by_its_own_contact_force(reference: HealthyReference) -> None:
    def softer(tip: Mapping[str, Floats]) -> dict[str, Floats]:
        return rig(tip) | {"fz_N": rig(tip)["fz_N"] - 0.25 * foam_N(np.maximum(-tip["z_m"], 0.0))}

    answer = changed(record(softer, seed=25), reference)
    assert len(answer.effects) == 1, answer.sentence
    named = {answer.effects[0].id, *answer.effects[0].indistinguishable_from}
    assert {"tissue.modulus", "sensor.gain"} & named, answer.sentence


@pytest.mark.timeout(600)
def test_a_rig_that_is_another_one_every_day_is_healthy_and_a_large_change_is_named() -> None:
    def day(seed: int, more_N: float = 0.0) -> Samples:
        wave_per_m, phase = np.random.default_rng(seed).uniform((400.0, 0.0), (900.0, 2.0 * np.pi))

        def forces(tip: Mapping[str, Floats]) -> dict[str, Floats]:
            moving = np.tanh(tip["vz_m_per_s"] / 5e-4)
            return rig(tip) | {"fz_N": rig(tip)["fz_N"] + 0.1 * np.sin(wave_per_m * tip["z_m"] + phase) - more_N * moving}

        return record(forces, seed=seed)

    days = HealthyReference.of([day(seed) for seed in (31, 32, 33)], stated(), EFFECTS)
    assert days.habits[""] > 0.0, "a wave of another length is in no list"
    quiet = changed(day(41), days)
    assert quiet.verdict == "none", quiet.sentence
    assert [note for note in quiet.notes if "looks like something unknown" in note]
    assert [effect.id for effect in changed(day(42, more_N=1.5), days).effects] == ["cable.friction"]


def test_a_drift_that_no_healthy_recording_has_is_named(reference: HealthyReference) -> None:
    """Their zeros and drifts are free, so they show nothing of a drift; it was as usual as any other size once."""
    assert not np.any(reference.usual.spread["sensor.drift"]), reference.usual.spread["sensor.drift"]
    assert not np.any(reference.usual.spread["sensor.bias"]), reference.usual.spread["sensor.bias"]

    def drifts(tip: Mapping[str, Floats]) -> dict[str, Floats]:
        return rig(tip) | {"fz_N": rig(tip)["fz_N"] + 0.01 * tip["t_s"]}

    answer = changed(record(drifts, seed=26), reference)
    assert "sensor.drift" in {name for one in answer.effects for name in (one.id, *one.indistinguishable_from)}, answer.sentence


def test_where_the_healthy_recordings_never_were_nothing_is_judged(healthy: list[Samples], reference: HealthyReference) -> None:
    deeper = record(rubbing_more, seed=26, presses_m=(0.009, 0.009, 0.009))
    answer = changed(deeper, reference)
    (note,) = [note for note in answer.notes if "beyond the heights and speeds of the healthy cell" in note]
    one = answer.problem.recordings[0]
    assert one.simulated is not None
    assert one.simulated.doubt is not None
    beyond = one.bins.mean((deeper.z_m < min(each.z_m.min() for each in healthy) - 0.002).astype(float)) == 1.0
    assert beyond.any()
    assert not answer.problem.data[:, beyond].any(), note


def test_how_much_a_number_of_healthy_recordings_says_stands_in_the_answer(healthy: list[Samples]) -> None:
    def about(n: int) -> str:
        return " ".join(HealthyCell.of(healthy[:n], stated(), EFFECTS).simulator().about)

    assert "One healthy recording shows only how the cell varies within a run" in about(1)
    assert "Two healthy recordings hardly show" in about(2)
    assert not about(3)


def test_healthy_recordings_that_say_nothing_are_refused(healthy: list[Samples]) -> None:
    def refusal(*recordings: Samples) -> str:
        with pytest.raises(RecordingError) as error:
            since_healthy(recordings, stated(), EFFECTS, [healthy[2]])
        return str(error.value)

    first = healthy[0]
    assert "recordings 1 and 2 hold the same samples" in refusal(healthy[2])
    assert "hold 2 sites (A, B), expected one" in refusal(replace(first, sites=("A",)), replace(healthy[1], sites=("B",)))
    assert "fz_N is 0 throughout" in refusal(replace(first, wrench=np.zeros_like(first.wrench)))
    assert "multiply the forces by -1" in refusal(replace(first, wrench=-first.wrench))
    with pytest.raises(RecordingError, match="no healthy recording was given"):
        HealthyCell.of([], stated(), EFFECTS)


def test_without_a_cell_file_the_healthy_recordings_give_one(healthy: list[Samples], tmp_path: Path) -> None:
    for number, samples in enumerate([*healthy, record(rubbing_more, seed=27)]):
        write_csv(tmp_path / f"{number}.csv", samples)
    before, now = [tmp_path / f"{number}.csv" for number in range(3)], [tmp_path / "3.csv"]
    answer = diagnose_files(now, None, healthy=before, propose=False)
    assert [effect.id for effect in answer.effects] == ["cable.friction"], answer.sentence
    content = answer.to_json()
    assert content["simulated"]["healthy"]
    ((step, command),) = plain_answer(content, EFFECTS)["steps"]
    assert "When it is mended, record the same motion" in step
    assert not command
    assert answer.modulus is None


def test_two_nominals_and_none_are_refused(healthy: list[Samples]) -> None:
    with pytest.raises(BadInput, match="no cell is given; give cell=, or healthy="):
        palpd.diagnose(healthy[0])
    with pytest.raises(BadInput, match="two nominals"):
        palpd.diagnose(healthy[0], healthy=healthy, simulated=own_simulator)


def test_a_pattern_of_the_shell_gives_each_option_all_of_its_files() -> None:
    words = ["diagnose", "--healthy", "a.csv", "b.csv", "--now", "c.csv", "d.csv", "--json", "out.json"]
    spelled = ["--healthy", "a.csv", "--healthy", "b.csv", "--now", "c.csv", "--now", "d.csv", "--json", "out.json"]
    assert one_file_each(words) == ["diagnose", *spelled]
    assert one_file_each(["run", "--now", "a", "b"]) == ["run", "--now", "a", "b"]
    for empty in (["diagnose", "a.csv", "--healthy"], ["diagnose", "--healthy", "--now", "a.csv"]):
        with pytest.raises(BadInput, match="--healthy has no file behind it"):
            one_file_each(empty)


def test_changes_that_look_alike_share_what_is_usual() -> None:
    alike, seen = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), np.array([4.0, 4.0, 1.0])
    spread = _spread(seen, np.array([0.0, 0.0, 2.0]), alike)
    assert spread[0] == pytest.approx(spread[1], rel=1e-9)
    assert spread[0] ** 2 + spread[1] ** 2 == pytest.approx(4.0, rel=1e-6), "together they explain what was seen"
    assert spread[2] == 0.0, "noise explains it"


def test_what_is_usual_is_as_large_in_a_recording_of_small_forces(reference: HealthyReference) -> None:
    """Sizes were multiples of the forces that are compared: a sensor at its limit, in proportion, hid that friction had halved."""
    now = record(rig, seed=43)
    weak = replace(now, wrench=0.3 * now.wrench)
    motion = asked(estimate_tip_motion(reference.learned.cell, now.t_s, now.z_m, now.vz_m_per_s, now.z_cmd_m), now.z_cmd_m)
    learned = reference.learned.simulator()
    errors = [np.square(reference.usual.allowed(learned, one).doubt(motion).errors).sum(axis=0) for one in (now, weak)]  # type: ignore[misc]
    np.testing.assert_allclose(errors[0], errors[1])


@pytest.mark.parametrize(("worse", "name"), [("coarser", "sensor.quantization"), ("noisier", "sensor.noise")])
def test_a_sensor_that_became_worse_is_named_and_one_that_always_was_is_healthy(reference: HealthyReference, worse: str, name: str) -> None:
    """A cell file that states no noise took that of the new recording: three times as noisy was no gap, with a probability of 1."""

    def today(seed: int) -> Samples:
        plain, rng = record(rig, seed=seed), np.random.default_rng(seed + 100)
        wrench = plain.wrench.copy()
        if worse == "coarser":
            wrench[:, 2] = 0.3 * np.rint(wrench[:, 2] / 0.3)
        else:
            wrench += rng.standard_normal(wrench.shape) * 0.14 * np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])
        return replace(plain, wrench=wrench)

    answer = changed(today(41), reference)
    assert [effect.id for effect in answer.effects] == [name], answer.sentence
    assert "than while the cell was healthy" in answer.sentence
    always = changed(today(41), HealthyReference.of([today(seed) for seed in (11, 12, 13)], stated(), EFFECTS))
    assert always.verdict == "none", always.sentence


def test_a_cell_that_only_presses_has_no_friction_of_its_own() -> None:
    """What goes one way cannot tell friction from what depends on the height: its curve then fitted a foam twenty times as hard."""
    both = [record(rig, seed=seed) for seed in (11, 12)]
    assert HealthyCell.of(both, stated(), EFFECTS).simulator().parameters
    down = []
    for one in both:
        n = int(np.argmin(one.z_m))
        assert one.z_cmd_m is not None
        down.append(Samples(one.t_s[:n], one.z_cmd_m[:n], np.minimum.accumulate(one.z_m)[:n], -np.abs(one.vz_m_per_s[:n]), one.wrench[:n]))
    assert not HealthyCell.of(down, stated(), EFFECTS).simulator().parameters
