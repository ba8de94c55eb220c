"""A zero that follows the sensor and never the contact: by itself, in the loop, and when a recording is replayed."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpd.config import Config, Plan
from palpd.control.inertial import InertialModel
from palpd.control.loop import Explainer, Loop
from palpd.control.running_zero import FREE_N, LEAST_S, ZERO_S, FreeAir, RunningZero
from palpd.daemon.motion_job import Job, zero_of
from palpd.daemon.replay import replay
from palpd.daemon.simulated_run import SimulatedRecording, run
from palpd.recording.reader import Recording
from palpd.tick import Mode, Phase
from tests.control.test_inertial import BIAS_N, written
from tests.scenes import frames, robot
from tests.simulated import cell_file

STEP_S = 0.001
LIMIT_N = 0.5


class Half(InertialModel):
    """Says that half a newton less `away_N` is bias, whatever moves."""

    def __init__(self, says_N: float = 0.0) -> None:
        super().__init__({}, (-1.0, -1.0), (1.0, 1.0), lambda rows: [])
        self.says_N = says_N

    def predict(self, features: Sequence[Sequence[float]]) -> list[float]:
        return [self.says_N] * len(features)


def fed(zero: RunningZero, values: list[float], start_s: float = 0.0) -> list[float]:
    return [zero.step(start_s + k * STEP_S, value) for k, value in enumerate(values)]


def test_free_air_ends_with_a_force_and_begins_again_some_time_after_it() -> None:
    free = FreeAir()
    assert all(free(k * STEP_S, 0.1) for k in range(100))
    assert not [free(0.1 + k * STEP_S, 1.0) for k in range(20)][-1]
    assert free.touched is False  # said once, where it is first seen
    assert not free(0.15, 0.0)
    assert [free(0.15 + k * STEP_S, 0.0) for k in range(300)][-1]


def test_a_bias_of_a_tare_is_found_within_a_second_and_then_averaged() -> None:
    noise = np.random.default_rng(0).normal(0.19, 0.065, 4000).tolist()
    zeros_N = fed(RunningZero(), noise)
    assert zeros_N[1000] == pytest.approx(0.19, abs=0.03)
    assert np.std(zeros_N[2000:]) < 0.004


def test_after_a_second_of_free_air_it_moves_by_less_than_a_press_of_that_slowness_would_show() -> None:
    zero = RunningZero()
    before = fed(zero, [0.0] * 1000)[-1]
    for seconds in (1, 2, 3):
        after = fed(zero, [before + 0.99 * FREE_N] * 1000, seconds)[-1]
        assert after - before <= FREE_N / ZERO_S
        before = after


def test_a_warm_up_is_followed() -> None:
    drift = [0.005 * k * STEP_S for k in range(20_000)]
    assert fed(RunningZero(), drift)[-1] == pytest.approx(0.1 - 0.005 * ZERO_S, abs=1e-3)


def test_a_touch_at_a_height_that_was_vouched_for_is_seen_and_forgotten() -> None:
    zero = RunningZero()
    fed(zero, [0.1] * 2000)
    fed(zero, [0.1 + 1.0 * k * STEP_S for k in range(1000)], 2.0)
    assert zero.zero_N == pytest.approx(0.1, abs=0.02)
    fed(zero, [1.1] * 60_000, 3.0)  # a minute of it changes nothing
    assert zero.zero_N == pytest.approx(0.1, abs=0.02)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.floats(allow_nan=True, allow_infinity=True), st.floats(0.0, 10.0) | st.just(math.nan)), min_size=1, max_size=200),
    st.floats(0.0, 5.0),
)
def test_whatever_comes_the_zero_stays_within_its_limit_and_its_rate(samples: list[tuple[float, float]], limit_N: float) -> None:
    zero, t_s, lows = RunningZero(limit_N=limit_N), 0.0, [0.0]
    for value_N, wait_s in samples:
        before_N = zero.zero_N
        t_s += wait_s if math.isfinite(wait_s) else 0.0
        after_N = zero.step(math.nan if math.isnan(wait_s) else t_s, value_N)
        assert abs(after_N) <= limit_N
        rolled_back = after_N in lows
        assert rolled_back or abs(after_N - before_N) <= FREE_N * 0.02 / LEAST_S + 1e-12
        lows.append(after_N)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-30.0, 30.0), min_size=1, max_size=60), st.floats(-2.0, 2.0), st.floats(0.0, 0.9))
def test_model_and_zero_together_hide_at_most_the_limit_and_nothing_of_the_absolute_force(
    forces_N: list[float], says_N: float, limit_N: float
) -> None:
    explainer = Explainer(np.zeros(6), model=Half(says_N), zero=RunningZero(limit_N=limit_N), correction_limit_N=limit_N, tare=np.zeros(6))
    for k, force_N in enumerate(forces_N):
        wrench = np.zeros((8, 6))
        wrench[:, 2] = -force_N  # the sensor points down
        seen = explainer.contact(robot(k * 0.008), frames(k * 0.008, wrench=wrench), clear_z_m=-math.inf)
        assert abs(seen.force_N - force_N) <= limit_N + 1e-9
        assert seen.absolute_N == pytest.approx(abs(force_N))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-30.0, 30.0), min_size=1, max_size=60), st.floats(0.0001, 0.02))
def test_below_the_height_that_is_clear_nothing_is_learned_however_slowly_a_force_grows(forces_N: list[float], clear_z_m: float) -> None:
    explainer = Explainer(np.zeros(6), model=Half(), zero=RunningZero(limit_N=LIMIT_N), correction_limit_N=LIMIT_N, tare=np.zeros(6))
    for k, force_N in enumerate(sorted(forces_N)):
        wrench = np.zeros((8, 6))
        wrench[:, 2] = -force_N
        seen = explainer.contact(robot(k * 0.008, z_m=clear_z_m - 1e-6), frames(k * 0.008, wrench=wrench), clear_z_m)
        assert seen.force_N == pytest.approx(force_N)
        assert seen.zero_N == 0.0


def test_nothing_is_clear_until_somebody_says_so() -> None:
    explainer = Explainer(np.zeros(6), model=Half(), zero=RunningZero(), correction_limit_N=LIMIT_N, tare=np.zeros(6))
    for k in range(1000):
        assert explainer.contact(robot(k * 0.008, z_m=1.0), frames(k * 0.008, wrench=np.full((8, 6), 0.1))).zero_N == 0.0


def test_a_zero_is_chosen_and_is_the_default() -> None:
    config = Config()
    assert config.model.zero == "running"
    assert zero_of(config.model) is not None
    assert zero_of(config.model.model_copy(update={"zero": "learned"})) is None


PLAN = Plan.model_validate({"depths_m": [0.004], "repeats": 2, "hold_s": 0.5})
EFFECTS = {"sensor.bias": {"offset_N": 0.25}, "sensor.drift": {"rate_N_per_s": 0.002}}


@pytest.fixture(scope="module")
def palpated(tmp_path_factory: pytest.TempPathFactory) -> dict[str, SimulatedRecording]:
    """A plan on a sensor with another bias than the model learned, which drifts; by either zero."""
    model = written(tmp_path_factory.mktemp("model"))
    results_by_zero = {}
    for zero in ("running", "learned"):
        config = Config.model_validate({"model": {"path": model, "zero": zero}})
        results_by_zero[zero] = run(Job("palpation", config, PLAN), cell_file(effects=EFFECTS))
        results_by_zero[zero].header["model_bytes"] = model.read_bytes()
        results_by_zero[zero].header["config"], results_by_zero[zero].header["plan"] = (
            config.model_dump(mode="json"),
            PLAN.model_dump(mode="json"),
        )
    return results_by_zero


def test_the_loop_follows_the_bias_of_the_day_and_stands_still_in_contact(palpated: dict[str, SimulatedRecording]) -> None:
    rows = palpated["running"].rows
    touching = np.isin(rows["phase"], (Phase.PRESS, Phase.HOLD)) & (rows["force_N"] > 1.0)
    bias_N = 0.25 + 0.002 * (rows["now_s"] - rows["now_s"][rows["phase"] != Phase.TARE][0])
    left_N = bias_N - BIAS_N - rows["zero_N"]
    dynamic = touching & (rows["mode"] == Mode.DYNAMIC)
    assert np.abs(left_N[dynamic]).max() < 0.03
    for span in np.split(rows["zero_N"][touching], np.flatnonzero(np.diff(np.flatnonzero(touching)) > 1) + 1):
        assert np.ptp(span) == 0.0
    assert not rows["zero_N"][rows["phase"] == Phase.SEARCH].any() or np.ptp(rows["zero_N"][rows["phase"] == Phase.SEARCH]) == 0.0
    assert not palpated["learned"].rows["zero_N"].any()


def test_dynamic_moduli_are_nearer_the_truth_than_by_the_learned_bias(palpated: dict[str, SimulatedRecording]) -> None:
    from palpd.analysis.results import sites

    results_by_zero = {name: sites(each.rows, each.header)[0] for name, each in palpated.items()}
    off = {name: abs(site["dynamic_corrected_Pa"] / site["static_youngs_modulus_Pa"] - 1.0) for name, site in results_by_zero.items()}
    assert off["running"] < off["learned"]
    site = results_by_zero["running"]
    assert site["running_zero_N"] == pytest.approx(0.25 - BIAS_N, abs=0.06)
    assert abs(site["correction_N"] - BIAS_N - site["running_zero_N"]) < 0.02  # the rest of the correction is inertia


def test_a_replay_builds_the_same_zero_bit_for_bit(palpated: dict[str, SimulatedRecording], tmp_path: Path) -> None:
    for zero, other in (("running", "learned"), ("learned", "running")):
        done = palpated[zero]
        header = {
            **done.header,
            "kind": "palpation",
            "dry": False,
            "reference": [0.0, 0.0, -50.0, 0.0, 0.0, 0.0],
            "machine_stiffness_N_per_m": None,
            "returns_to_start": True,
        }
        recording = Recording(tmp_path / "r.mcap", done.rows, header, {"verdict": "done"}, done.header["model_bytes"])
        if zero == "running":
            assert replay(recording)["decisions_identical"]
        changed = Config.model_validate(header["config"] | {"model": header["config"]["model"] | {"zero": other}})
        assert "zero_N" in replay(recording, changed)["first_difference"]


def test_a_rehearsal_leaves_the_zero_as_it_was(palpated: dict[str, SimulatedRecording], tmp_path: Path) -> None:
    from palpd.daemon.clock import SimClock
    from palpd.daemon.motion_job import explainer_of, limits_of, sequence_of
    from palpd.daemon.sim_cell import SimCell
    from palpd.daemon.simulated_run import RowList

    config = Config.model_validate({"model": {"path": written(tmp_path)}})
    job = Job("palpation", config, PLAN, reference=(0.0, 0.0, -50.0, 0.0, 0.0, 0.0))
    sim = SimCell(cell_file(effects=EFFECTS), 125.0)
    loop = Loop(sim.robot, sim.sensor, SimClock(125.0), sequence_of(job, 0.0), explainer_of(job, {}, 0.0), limits_of(config), RowList())
    loop.rehearse(50)
    assert loop.explainer.zero is not None
    assert loop.explainer.zero.zero_N == 0.0
    assert vars(loop.explainer.zero)["_past"] == vars(RunningZero())["_past"]
