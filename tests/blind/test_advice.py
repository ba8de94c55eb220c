"""Advice against random: the motions are what they are said to be, and the figures what the outcomes say."""

import numpy as np
import pytest

from palpd.blind.advice import _of_legs, _random, table
from palpd.blind.drawn_cells import draw_cell
from palpd.gap.advise.motions import MotionLimits, motions


@pytest.mark.parametrize("seed", range(3))
def test_both_motions_are_equally_long_within_the_limits_and_continuous(seed: int) -> None:
    r = np.random.default_rng(seed)
    cell = draw_cell(r)
    depth_m = 0.8 * cell.tip_radius_m
    limits = MotionLimits(depth_m, 10.0, depth_m, 2.0 * depth_m, 2.0 * depth_m, 4.0 * depth_m, 40.0 * depth_m)
    for motion in motions(limits):
        advised = _of_legs(motion, cell, limits)
        t_s, z_m = motion.heights(0.0005, cell.surface_z_m, cell.surface_z_m + limits.home_m, limits.acceleration_m_per_s2)
        assert np.abs(advised.at(t_s) - z_m).max() < 0.1 * depth_m, "the same motion in other terms"
        other = _random(r, cell, advised.duration_s, limits)
        assert other.duration_s == advised.duration_s
        t_s = np.arange(0.0, other.duration_s, 0.005)
        z_m = other.at(t_s)
        assert z_m.min() >= cell.surface_z_m - depth_m - 1e-9
        assert np.abs(np.diff(z_m)).max() < 0.5 * depth_m, "no jumps"


def outcome(first: bool, advised: tuple[bool, bool], random: tuple[bool, bool]) -> dict[str, dict[str, object]]:
    return {
        "first": {"among": first, "p": 0.5},
        "advised": {"resolved": advised[0], "among": advised[1], "p": 0.9},
        "random": {"resolved": random[0], "among": random[1], "p": 0.7},
    }


def test_the_table_counts_what_is_resolved_and_what_is_wrongly_excluded() -> None:
    outcomes = [outcome(True, (True, True), (False, True))] * 6 + [outcome(True, (False, True), (True, True))]
    outcomes += [outcome(True, (False, False), (False, True)), outcome(False, (False, False), (False, False))]
    summary = table(outcomes)
    assert summary["n"] == 9
    assert summary["resolved_advised"] == pytest.approx(6 / 9)
    assert summary["difference"] == pytest.approx(5 / 9)
    assert (summary["only_advised"], summary["only_random"]) == (6, 1)
    assert summary["difference_ci95"][0] > 0.0
    assert (summary["reversals_advised"], summary["reversals_random"]) == (1, 0), "what was never among the open cannot be reversed"
