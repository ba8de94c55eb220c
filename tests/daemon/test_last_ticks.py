"""A stopped run shows its last ticks: from the ring, so that they are there after a crash and without a recording too."""

from contextlib import closing

import numpy as np
import pytest

from palpd.cell.cell_file import PHANTOM
from palpd.cli.last_ticks import last_ticks_lines
from palpd.daemon.run_result import run_result, simulated_result
from palpd.daemon.simulated_run import SimulatedRecording
from palpd.daemon.supervisor import LAST_TICKS, Closing, JobRun, Report, last_ticks_of
from palpd.recording.ring import Ring
from palpd.tick import ROW, Phase
from tests.simulated import ran


@pytest.fixture(scope="module")
def stopped() -> SimulatedRecording:
    """A run that the guard stops: the workspace ends above the tissue."""
    return ran(PHANTOM, safety={"workspace_m": [[-0.1, 0.1], [-0.1, 0.1], [0.02, 0.1]]})


def pressing(count: int) -> np.ndarray:
    rows = np.zeros(count, ROW)
    rows["now_s"] = 100.0 + 0.008 * np.arange(count)
    rows["phase"] = Phase.PRESS
    rows["force_N"] = np.arange(count)
    rows["tcp_pose"][:, 2] = -1e-4 * np.arange(count)
    rows["tcp_speed"][:, 2] = -0.0125
    rows["command_m_per_s"][:, 2] = -0.01
    rows["command_stop"][-1] = True
    return rows


def test_each_tick_has_its_force_height_speed_and_command() -> None:
    first, *_, last = last_ticks_of(pressing(3))
    assert first["before_end_s"] == pytest.approx(0.016)
    assert (first["phase"], first["force_N"], first["z_m"]) == ("press", 0.0, 0.0)
    assert first["vz_m_per_s"] == -0.0125
    assert first["command_m_per_s"] == pytest.approx([0.0, 0.0, -0.01])
    assert not first["command_stop"]
    assert (last["before_end_s"], last["force_N"], last["command_stop"]) == (0.0, 2.0, True)


def over(ring: Ring, first_tick: int, exit_code: int) -> Report:
    """The report of a run that published its first row at `first_tick`, and that nothing recorded."""
    run = object.__new__(JobRun)
    run._ring, run._first_tick = ring, first_tick
    return run._over(Closing(Report("stopped", "the motion process ended by signal 11", exit_code), 0.0))


def test_a_crash_without_a_recording_still_shows_the_last_ticks_of_this_run_only() -> None:
    with closing(Ring.create(125.0)) as ring:
        for row in pressing(20):
            ring.write(row)
        assert [tick["force_N"] for tick in over(ring, 0, 3).last_ticks] == list(range(10, 20))
        assert [tick["force_N"] for tick in over(ring, 16, 3).last_ticks] == [16.0, 17.0, 18.0, 19.0]
        assert over(ring, 20, 3).last_ticks == ()
        assert over(ring, 0, 0).last_ticks == ()


def test_the_json_of_a_stopped_run_holds_them(stopped: SimulatedRecording) -> None:
    result = simulated_result(stopped)
    assert result["verdict"] == "stopped"
    assert result["trips"][0]["reason"] in result["reason"]
    assert len(result["last_ticks"]) == LAST_TICKS
    assert result["last_ticks"][-1]["command_stop"]
    assert run_result(Report("stopped", last_ticks=tuple(result["last_ticks"])))["last_ticks"] == result["last_ticks"]


def test_the_table_has_a_line_a_tick() -> None:
    assert last_ticks_lines([]) == []
    lines = [line for line in last_ticks_lines(last_ticks_of(pressing(3))) if " ms " in line]
    assert len(lines) == 3
    assert "-16 ms" in lines[0]
    assert "-10.0 mm/s" in lines[0]
    assert "2.00 N" in lines[2]
    assert "stop" in lines[2]


def test_a_run_that_came_to_its_end_has_none() -> None:
    assert run_result(Report("done"))["last_ticks"] == []
