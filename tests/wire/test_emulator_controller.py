"""What the emulated controller decides, cycle by cycle, told the time: no socket, no clock."""

from collections.abc import Callable

import numpy as np
import pytest

from hw.emulators.controller import Controller
from hw.emulators.controller_state import MODELS, Power, Runtime, Safety
from hw.emulators.dashboard import UNLOCK_AFTER_S
from hw.emulators.pose import composed, inverse, rotation, rotation_vector
from hw.emulators.ur import status_bits

START = np.array([0.0, 0.0, 0.03, np.pi, 0.0, 0.0])
TCP = np.array([0.0, 0.0, 0.115, 0.0, 0.0, 0.0])
DOWN = (0.0, 0.0, -0.01, 0.0, 0.0, 0.0)


class Bench:
    """A controller, its clock, and the client's side of the registers."""

    def __init__(self, model: str = "ur5", offset: int = 0) -> None:
        self.model, self.offset, self.t_s = MODELS[model], offset, 100.0
        self.robot = Controller(self.model, START, TCP)
        script = (
            f"def rtde_control():\n    global f = # float register offset\n{offset}    global i = # int register offset\n{offset}\nend\n"
        )
        self.upload = lambda: self.robot.upload(script, self.t_s)
        self.upload()
        self.run(0.2)

    def cycle(self) -> None:
        self.t_s += self.model.cycle_s
        self.robot.cycle(self.t_s)

    def run(self, duration_s: float, while_: Callable[[], bool] = lambda: True) -> float:
        """Cycles until the time is over or the condition fails; how long it took."""
        begin_s = self.t_s
        while self.t_s < begin_s + duration_s - 1e-9 and while_():
            self.cycle()
        return self.t_s - begin_s

    def write(self, *ints: int, doubles: tuple[float, ...] = ()) -> None:
        values = {f"input_int_register_{self.offset + i}": (value,) for i, value in enumerate(ints)}
        values |= {f"input_double_register_{self.offset + i}": (value,) for i, value in enumerate(doubles)}
        self.robot.write(values, self.t_s)

    def do(self, *ints: int, doubles: tuple[float, ...] = ()) -> bool:
        """A regular command with its handshake, as the client does it; whether it was reported done."""
        self.write(*ints, doubles=doubles)
        self.run(10.0, lambda: self.answer(0) != 2 and self.robot.state.runtime is Runtime.PLAYING)
        done = self.answer(0) == 2
        self.write(0)
        self.cycle()
        return done

    def answer(self, register: int) -> int:
        return int(self.robot.state.outputs[f"output_int_register_{self.offset + register}"][0])

    def speed_l(self, speed: tuple[float, ...] = DOWN, acceleration: float = 0.5) -> None:
        self.write(10, doubles=(*speed, acceleration, 0.1))

    @property
    def vz(self) -> float:
        return float(self.robot.state.speed[2])

    @property
    def z(self) -> float:
        return float(self.robot.state.pose[2])


@pytest.fixture(params=["ur5", "ur5e"])
def bench(request: pytest.FixtureRequest) -> Bench:
    return Bench(request.param)


def test_speed_ramps_with_the_commanded_acceleration_and_height_is_its_integral(bench: Bench) -> None:
    bench.speed_l(acceleration=0.25)
    bench.run(0.024)
    assert bench.vz == pytest.approx(-0.25 * 0.024)
    assert bench.z == pytest.approx(0.03 - 0.5 * 0.25 * 0.024**2)
    bench.run(1.0)
    assert bench.vz == pytest.approx(-0.01)
    assert bench.z == pytest.approx(0.03 - 0.01 * 1.024 + 0.5 * 0.01 * 0.04)


def test_a_commanded_speed_goes_on_after_its_time_and_after_the_register_is_cleared(bench: Bench) -> None:
    bench.speed_l()
    bench.run(0.2)
    bench.write(0)
    bench.run(0.5)
    assert bench.vz == pytest.approx(-0.01)


@pytest.mark.parametrize("rate_Hz", [10.0, 50.0])
def test_a_starved_watchdog_stops_the_program_and_the_motion_within_two_cycles_of_its_time(bench: Bench, rate_Hz: float) -> None:
    assert bench.do(35, doubles=(rate_Hz,))
    for _ in range(20):
        bench.speed_l()
        bench.cycle()
    assert bench.vz == pytest.approx(-0.01)
    took_s = bench.run(1.0, lambda: bool(bench.robot.state.speed.any()))
    assert 1 / rate_Hz - bench.model.cycle_s <= took_s <= 1 / rate_Hz + 2 * bench.model.cycle_s + 0.002
    bench.cycle()
    assert bench.robot.state.runtime is Runtime.STOPPED
    assert bench.robot.state.stops[-1][1] == "watchdog"


def test_inputs_that_were_read_late_feed_the_watchdog_before_it_is_judged(bench: Bench) -> None:
    assert bench.do(35, doubles=(50.0,))
    bench.speed_l()
    bench.cycle()
    late_s = bench.t_s + 0.1  # the emulator's process stood still; now it reads what came, then makes up its cycles
    bench.robot.write({"input_int_register_0": (10,)}, late_s)
    bench.run(0.1)
    assert bench.robot.state.runtime is Runtime.PLAYING


def test_a_package_without_the_command_register_does_not_feed_the_watchdog(bench: Bench) -> None:
    assert bench.do(35, doubles=(50.0,))
    for _ in range(40):
        bench.robot.write({"input_double_register_0": (0.0,)}, bench.t_s)
        bench.cycle()
        if bench.robot.state.runtime is not Runtime.PLAYING:
            break
    else:
        pytest.fail("the watchdog did not stop the program")


def test_a_new_program_has_no_watchdog(bench: Bench) -> None:
    assert bench.do(35, doubles=(10.0,))
    bench.write(0)
    bench.upload()
    bench.run(1.0)
    assert bench.robot.state.runtime is Runtime.PLAYING


def test_a_straight_move_ends_exactly_at_its_goal_after_the_time_of_its_trapezoid(bench: Bench) -> None:
    goal = (0.004, 0.0, 0.027, np.pi, 0.0, 0.0)
    begin_s = bench.t_s
    assert bench.do(3, 0, doubles=(*goal, 0.05, 1.25))
    assert bench.robot.state.pose == pytest.approx(np.array(goal), abs=1e-12)
    assert bench.t_s - begin_s == pytest.approx(0.005 / 0.05 + 0.05 / 1.25, abs=5 * bench.model.cycle_s)


def test_a_move_that_turns_ends_in_the_asked_orientation(bench: Bench) -> None:
    goal = composed(START, np.array([0.0, 0.0, 0.0, 0.02, -0.01, 0.03]))
    assert bench.do(3, 0, doubles=(*goal, 0.1, 0.5))
    assert rotation(bench.robot.state.pose[3:]) == pytest.approx(rotation(goal[3:]), abs=1e-9)


def test_an_asynchronous_move_reports_progress_and_then_its_end(bench: Bench) -> None:
    assert bench.do(3, 1, doubles=(0.0, 0.0, 0.035, np.pi, 0.0, 0.0, 0.05, 1.0))
    running = bench.answer(2)
    assert running >> 15 & 1
    bench.run(1.0)
    over = bench.answer(2)
    assert not over >> 15 & 1
    assert over >> 24 == running >> 24
    assert over >> 16 & 0x7F == (running >> 16 & 0x7F) + 1
    assert bench.z == pytest.approx(0.035)


def test_a_second_asynchronous_move_takes_over_from_rest(bench: Bench) -> None:
    assert bench.do(3, 1, doubles=(0.0, 0.0, 0.05, np.pi, 0.0, 0.0, 0.05, 0.5))
    bench.run(0.1)
    assert bench.do(3, 1, doubles=(0.0, 0.0, 0.03, np.pi, 0.0, 0.0, 0.05, 0.5))
    speeds = []
    for _ in range(round(2.0 / bench.model.cycle_s)):
        bench.cycle()
        speeds.append(bench.vz)
    assert np.abs(np.diff(speeds)).max() <= 0.5 * bench.model.cycle_s + 1e-9
    assert bench.z == pytest.approx(0.03)


def test_an_asynchronous_stop_ends_an_asynchronous_move_and_the_program_stays(bench: Bench) -> None:
    assert bench.do(3, 1, doubles=(0.0, 0.0, 0.08, np.pi, 0.0, 0.0, 0.05, 1.0))
    bench.run(0.2)
    assert bench.do(33, 1, doubles=(2.0,))
    bench.run(0.1)
    assert not bench.robot.state.speed.any()
    assert bench.z < 0.05
    assert bench.robot.state.runtime is Runtime.PLAYING


@pytest.mark.parametrize("command", [1, 3, 33, 34])
def test_a_move_or_stop_while_a_commanded_speed_lives_ends_the_program(bench: Bench, command: int) -> None:
    bench.speed_l()
    bench.run(0.1)
    assert not bench.do(command, 0, doubles=(*START, 0.05, 1.0))
    bench.run(0.1)
    assert bench.robot.state.runtime is Runtime.STOPPED
    assert not bench.robot.state.speed.any()


def test_a_speed_stop_comes_to_rest_before_it_is_done_and_lets_moves_pass_again(bench: Bench) -> None:
    bench.speed_l()
    bench.run(0.1)
    assert bench.do(15, doubles=(0.5,))
    assert not bench.robot.state.speed.any()
    assert bench.do(3, 0, doubles=(*START, 0.05, 1.0))


def test_a_move_that_is_not_emulated_ends_the_program_instead_of_pretending(bench: Bench) -> None:
    bench.write(45, 0)
    bench.run(0.1)
    assert bench.robot.state.runtime is Runtime.STOPPED
    assert "movePath" in bench.robot.state.stops[-1][1]


def test_a_protective_stop_halts_pauses_and_is_not_unlocked_before_its_time(bench: Bench) -> None:
    bench.speed_l()
    bench.run(0.1)
    bench.robot.state.pausing_stop(bench.t_s, Safety.PROTECTIVE_STOP, "protective stop")
    bench.run(0.05)
    assert (bench.robot.state.safety, bench.robot.state.runtime) == (Safety.PROTECTIVE_STOP, Runtime.PAUSED)
    assert not bench.robot.state.speed.any()
    assert not bench.robot.dashboard.unlock(bench.t_s)
    assert not bench.robot.dashboard.play()
    bench.run(UNLOCK_AFTER_S)
    assert bench.robot.dashboard.unlock(bench.t_s)
    bench.write(0)
    bench.upload()
    bench.run(0.2)
    assert bench.robot.state.runtime is Runtime.PLAYING


def test_an_emergency_stop_ends_the_program_and_no_script_starts_until_the_brakes_are_released(bench: Bench) -> None:
    bench.robot.state.cutting_stop(bench.t_s, Safety.ROBOT_EMERGENCY_STOP, "emergency stop")
    bench.upload()
    bench.run(0.3)
    assert bench.robot.state.runtime is Runtime.STOPPED
    bench.robot.dashboard.release_brakes()
    assert (bench.robot.state.safety, bench.robot.state.power) == (Safety.ROBOT_EMERGENCY_STOP, Power.POWER_OFF), "no power clears a stop"
    bench.robot.state.safety = Safety.NORMAL  # the button is turned
    bench.robot.dashboard.power_on()
    assert bench.robot.state.power is Power.IDLE
    bench.robot.dashboard.release_brakes()
    bench.upload()
    bench.run(0.3)
    assert bench.robot.state.runtime is Runtime.PLAYING


@pytest.mark.parametrize(
    ("safety", "bits"),
    [
        (Safety.NORMAL, 0x001), (Safety.REDUCED, 0x002), (Safety.PROTECTIVE_STOP, 0x404), (Safety.RECOVERY, 0x008),
        (Safety.SAFEGUARD_STOP, 0x410), (Safety.SYSTEM_EMERGENCY_STOP, 0x4A0), (Safety.ROBOT_EMERGENCY_STOP, 0x4C0),
        (Safety.VIOLATION, 0x500), (Safety.FAULT, 0x600),
    ],
)  # fmt: skip
def test_each_safety_mode_has_its_bits(bench: Bench, safety: Safety, bits: int) -> None:
    bench.robot.state.safety = safety
    assert status_bits(bench.robot.state)[1] == bits


def test_a_safety_fault_is_left_over_a_restart_of_the_safety_system_and_then_the_power(bench: Bench) -> None:
    state, dashboard = bench.robot.state, bench.robot.dashboard
    state.cutting_stop(bench.t_s, Safety.FAULT, "safety fault")
    dashboard.release_brakes()
    assert (state.safety, state.power) == (Safety.FAULT, Power.POWER_OFF)
    dashboard.restart_safety()
    assert (state.safety, state.power) == (Safety.NORMAL, Power.POWER_OFF)
    dashboard.release_brakes()
    assert state.power is Power.RUNNING


def test_stop_script_ends_the_program_and_inputs_keep_their_values(bench: Bench) -> None:
    bench.write(255)
    bench.run(0.1)
    assert bench.robot.state.runtime is Runtime.STOPPED
    assert bench.robot.state.inputs["input_int_register_0"] == (255,)


def test_a_script_for_the_upper_registers_uses_the_upper_registers() -> None:
    bench = Bench(offset=24)
    assert bench.do(40)
    assert bench.robot.state.outputs["output_double_register_26"] == (pytest.approx(0.115),)


def test_another_tcp_shows_the_same_tip_elsewhere_and_moves_take_it_into_account(bench: Bench) -> None:
    assert bench.do(29, doubles=(0.0, 0.0, 0.2, 0.0, 0.0, 0.0))
    assert bench.robot.state.tcp_pose(bench.robot.state.pose)[2] == pytest.approx(0.03 - 0.085)
    assert bench.do(3, 0, doubles=(0.0, 0.0, -0.045, np.pi, 0.0, 0.0, 0.05, 1.0))
    assert bench.z == pytest.approx(0.04)


def test_joints_follow_poses_there_and_back(bench: Bench) -> None:
    arm, pose = bench.robot.state.arm, composed(START, np.array([0.01, -0.02, 0.005, 0.02, 0.0, -0.01]))
    assert arm.pose(arm.joints(pose))[:3] == pytest.approx(pose[:3], abs=1e-12)
    assert rotation(arm.pose(arm.joints(pose))[3:]) == pytest.approx(rotation(pose[3:]), abs=1e-9)
    speed = np.array([0.01, 0.02, -0.03, 0.1, 0.0, 0.0])
    assert arm.tip_speed(arm.joint_speed(speed)) == pytest.approx(speed)


def test_a_pose_and_its_inverse_cancel() -> None:
    pose = np.array([0.1, -0.2, 0.3, 0.5, -1.0, 2.0])
    assert composed(pose, inverse(pose)) == pytest.approx(np.zeros(6), abs=1e-12)
    for vector in ([0.0, 0.0, 0.0], [np.pi, 0.0, 0.0], [0.0, -np.pi, 0.0], [1e-9, 0.0, 0.0], [1.0, 2.0, -1.0]):
        assert rotation(rotation_vector(rotation(vector))) == pytest.approx(rotation(vector), abs=1e-9)
