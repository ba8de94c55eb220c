"""Parameters that may be null: presliding of friction, and the damping of a lagging servo."""

import numpy as np
import pytest
import yaml

from palpd.cell.cell_file import cell_from, load_cell, nominal, save_cell
from palpd.cell.dynamics import slack_dahl
from palpd.cell.simulation import simulate
from palpd.errors import ConfigError


def free_strokes() -> tuple[np.ndarray, np.ndarray]:
    t_s = np.arange(4000) / 500.0
    return t_s, 0.01 + 0.002 * np.sin(2.0 * np.pi * 0.5 * t_s)


def test_a_null_parameter_is_an_absent_one() -> None:
    given = yaml.safe_load("effects: {cable.friction: {force_N: 1.0, presliding_m: null}, robot.lag: {bandwidth_ratio: 0.5}}")
    cell = cell_from(given, "cell")
    assert cell.effects == {"cable.friction": {"force_N": 1.0}, "robot.lag": {"bandwidth_ratio": 0.5}}
    with pytest.raises(ConfigError, match="force_N not given"):
        cell_from({"effects": {"cable.friction": {"force_N": None}}}, "cell")


def test_a_cell_with_presliding_is_read_back_equal(tmp_path) -> None:
    cell = nominal().with_effects({"cable.friction": {"force_N": 1.0, "presliding_m": 1e-4}})
    save_cell(tmp_path / "cell.yaml", cell)
    assert load_cell(tmp_path / "cell.yaml").effects == cell.effects


def test_friction_with_presliding_follows_the_law_of_dahl() -> None:
    t_s, z_m = free_strokes()
    without = simulate(nominal(), t_s, z_m=z_m)["fz_N"]
    cell = nominal().with_effects({"cable.friction": {"force_N": 1.0, "presliding_m": 2e-4}})
    cell = cell.model_copy(update={"sensor": cell.sensor.model_copy(update={"filter_cutoff_Hz": None})})
    bare = nominal().model_copy(update={"sensor": cell.sensor})
    friction_N = simulate(cell, t_s, z_m=z_m)["fz_N"] - simulate(bare, t_s, z_m=z_m)["fz_N"]
    expected_N, share = [], 0.0
    for change_m in np.diff(z_m, prepend=z_m[0]):
        for _ in range(20):
            share += change_m / 20 / 2e-4 * (1.0 - share * np.sign(change_m))
        expected_N.append(-share)
    assert friction_N == pytest.approx(np.array(expected_N), abs=0.03)
    assert np.abs(without).max() < 1.0


def test_friction_acts_only_while_backlash_lets_the_tip_move() -> None:
    t_s, z_m = free_strokes()
    play = {"robot.backlash": {"width_m": 1e-3}}
    both = simulate(nominal().with_effects(play | {"cable.friction": {"force_N": 1.0}}), t_s, z_m=z_m)["fz_N"]
    alone = simulate(nominal().with_effects(play), t_s, z_m=z_m)["fz_N"]
    friction_N = both - alone
    falling = (t_s > 0.55) & (t_s < 0.65)  # just past the first reversal: the robot moves through the dead band
    assert np.abs(friction_N[falling]).max() < 0.05
    assert np.abs(friction_N).max() == pytest.approx(1.0, abs=0.05)


def slack_link(tip_m: np.ndarray, width_m: float, length_m: float) -> np.ndarray:
    """Share of the friction on a robot's probe behind a play, in small steps: the friction's spring moves the probe within the play."""
    probe_m, share, out = tip_m[0], 0.0, []
    steps_m = np.repeat(np.diff(tip_m, prepend=tip_m[0]) / 50, 50)
    for step, at_m in enumerate(tip_m[0] + np.cumsum(steps_m)):
        ahead_m, way = at_m - probe_m, float(np.sign(steps_m[step]))
        # The spring of the friction pushes the probe along with the robot, else the robot's side of the play pushes it.
        moved_m = steps_m[step] if share * way < 0.0 else way * max(way * ahead_m - 0.5 * width_m, 0.0)
        probe_m += moved_m
        share += moved_m / length_m * (1.0 - share * np.sign(moved_m))
        if step % 50 == 49:
            out.append(share)
    return np.array(out)


def test_a_slack_link_carries_no_force_before_the_friction_builds_up_again() -> None:
    t_s, z_m = free_strokes()
    friction = {"cable.friction": {"force_N": 1.0, "presliding_m": 2e-4}, "robot.backlash": {"width_m": 1e-3}}
    cell = nominal().with_effects(friction)
    bare = nominal().model_copy(update={"sensor": nominal().sensor.model_copy(update={"filter_cutoff_Hz": None})})
    cell = cell.model_copy(update={"sensor": bare.sensor})
    friction_N = simulate(cell, t_s, z_m=z_m)["fz_N"] - simulate(bare, t_s, z_m=z_m)["fz_N"]
    assert friction_N == pytest.approx(-slack_link(z_m, 1e-3, 2e-4), abs=0.03)
    assert np.mean(np.abs(friction_N[500:]) < 1e-3) > 0.2  # the play


def test_a_slack_link_is_the_same_in_blocks_and_at_once() -> None:
    _, z_m = free_strokes()
    memory: dict[str, object] = {}
    blocks = [slack_dahl(block, 2e-4, 1e-3, memory) for block in np.split(z_m, [1, 2, 500, 1337, 3000])]
    assert np.concatenate(blocks) == pytest.approx(slack_dahl(z_m, 2e-4, 1e-3, {}), abs=1e-9)


def test_a_servo_may_be_damped_otherwise_than_stated() -> None:
    t_s = np.arange(1000) / 500.0
    step_m = np.where(t_s > 0.2, 0.001, 0.0)
    stated = simulate(nominal(), t_s, z_cmd_m=step_m)["z_m"]
    ringing = simulate(nominal().with_effects({"robot.lag": {"bandwidth_ratio": 1.0, "damping_ratio": 0.2}}), t_s, z_cmd_m=step_m)["z_m"]
    assert stated.max() < 1.001e-3
    assert ringing.max() > 1.3e-3
