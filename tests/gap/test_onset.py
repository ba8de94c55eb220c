"""When a change began: stated where it begins within the recording, and only there."""

from collections.abc import Mapping

import numpy as np
import pytest

from palpd.cell.effects import EFFECTS
from palpd.gap.healthy import HealthyCell
from palpd.gap.healthy_reference import HealthyReference
from palpd.gap.onset import since_onset
from palpd.tick import Floats
from tests.gap.test_healthy import changed, rig, rubbing_more
from tests.gap.test_user_simulator import foam_N, record, stated


@pytest.fixture(scope="module")
def reference() -> HealthyReference:
    return HealthyReference.of([record(rig, seed=seed) for seed in (11, 12, 13)], stated(), EFFECTS)


@pytest.fixture(scope="module")
def cell(reference: HealthyReference) -> HealthyCell:
    return reference.learned


def softer_from_14_s(tip: Mapping[str, Floats]) -> dict[str, Floats]:
    return rig(tip) | {"fz_N": rig(tip)["fz_N"] - 0.25 * foam_N(np.maximum(-tip["z_m"], 0.0)) * (tip["t_s"] >= 14.0)}


def drifting(tip: Mapping[str, Floats]) -> dict[str, Floats]:
    return rig(tip) | {"fz_N": rig(tip)["fz_N"] + 0.02 * tip["t_s"]}


def test_a_change_within_the_recording_has_its_onset_and_is_named(cell: HealthyCell, reference: HealthyReference) -> None:
    now = record(softer_from_14_s, seed=31)
    onset_s = since_onset(cell.simulator(), cell, now).onset_s
    # The probe rests in the air from 11.6 s to 14.4 s: what softened then shows when it presses.
    assert onset_s is not None
    assert 11.6 < onset_s < 15.5
    answer = changed(now, reference)
    assert "tissue.modulus" in {answer.effects[0].id, *answer.effects[0].indistinguishable_from}, answer.sentence
    assert answer.to_json()["simulated"]["onset_s"] == [onset_s]
    assert any(note.startswith(f"The change in recording 1 begins at {onset_s:.2f} s") for note in answer.notes)


@pytest.mark.parametrize("what", [rig, rubbing_more, drifting], ids=["healthy", "changed throughout", "drifting"])
def test_what_is_there_throughout_has_no_onset(cell: HealthyCell, what: object) -> None:
    now = record(what, seed=32)  # type: ignore[arg-type]
    assert since_onset(cell.simulator(), cell, now).onset_s is None
