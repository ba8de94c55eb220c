"""The steps that move the arm: level test, watchdog, free motion, rigid plate, first press. Each is a run under the guard."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from palpd.compensation.train import train
from palpd.compensation.training_data import load_training_data
from palpd.config import Plan, Search
from palpd.control.sequence import LIFT_N, LIFT_WINDOW_S
from palpd.daemon.finding import Finding
from palpd.daemon.machine_stiffness import measured_stiffness
from palpd.daemon.setup.cell import SetupCell
from palpd.daemon.setup.commission import seen
from palpd.daemon.setup.watchdog import silent_devices, stopped_after_s
from palpd.daemon.stored_state import SOFTEST_N_PER_M
from palpd.daemon.supervisor import Report
from palpd.errors import Refused, Stopped
from palpd.recording.reader import Recording
from palpd.recording.ring import Rows
from palpd.tick import Phase, Trip

FIRST_PRESS_N = 2.0
"""Contact limit of the first press: twice the force at which the search takes the surface as found."""
FIRST_PRESS = Plan(
    mode="dynamic", depths_m=(0.001,), repeats=1, press_speed_m_per_s=0.002, search=Search(speed_m_per_s=0.002, max_travel_m=0.05)
)
"""Slow: 2 mm/s on 5 N/mm run past a limit by less than 1 N."""
LATE_CYCLES = 3
"""Controller cycles that a watchdog may take beyond its time: it looks once a cycle, and its state is one cycle old."""
LAG_SHARE = 0.25
"""Relative difference of the servo's frequency from `cell.robot` that counts as another one."""
AT_SPEED_S = 0.3
"""Time at full speed after which the lag of a servo of 8 Hz is steady."""


def level_test(cell: SetupCell) -> Sequence[Finding]:
    """Go up in free air; the force must stay."""
    report, rows = _run(cell.host.carry_out("level_test", Plan()))
    changed_N = _changed_N(rows)
    advice = (
        f"{report.reason}. If nothing touches the probe, the cable pulls: give it a loop that hangs loose, fix it at the arm, and redo "
        "reference and level"
    )
    measured = f"the force changed by {changed_N:.2f} N over 5 mm of free air"
    return [seen("free air", measured, f"at most {LIFT_N:g} N", advice, fails=report.exit_code > 0, changed_N=changed_N)]


def measure_watchdog(cell: SetupCell) -> Sequence[Finding]:
    """Fall silent on the way up, and see when the controller stops; then show that the probe is free, since that run was stopped."""
    robot = cell.config.robot
    report, rows = _run(replace(cell, build=silent_devices).host.carry_out("level_test", Plan()))
    stopped_s, allowed_s = stopped_after_s(rows, robot.rate_Hz), 1.0 / robot.watchdog_Hz
    expected = f"{allowed_s * 1e3:.0f} ms, and at most {LATE_CYCLES} cycles more"
    if stopped_s is None:
        if report.exit_code:
            raise Stopped(f"the watchdog was not measured: {report.reason}")
        advice = "the controller goes on without this PC: press no tissue with it, and look whether another program drives it"
        return [seen("watchdog", "the arm was not stopped within half a second of silence", expected, advice, fails=True)]
    if {trip["trip"] for trip in report.trips} == {Trip.PROGRAM_STOPPED.name}:
        cell.state.clear_latch()  # of the stop that this step brought about
    late = stopped_s > allowed_s + LATE_CYCLES / robot.rate_Hz
    advice = "count with this time where the arm may run on (docs/safety.md), or raise robot.watchdog_Hz and redo this step"
    measured = f"the controller stopped the program {stopped_s * 1e3:.0f} ms after the last command"
    return [seen("watchdog", measured, expected, advice, warns=late, stopped_after_ms=stopped_s * 1e3), *level_test(cell)]


def learn_inertia(cell: SetupCell) -> Sequence[Finding]:
    """Move in free air, measure the servo's lag, train the inertial model."""
    config, robot, mass_kg = cell.config, cell.config.cell.robot, cell.config.cell.probe.mass_kg
    report, rows = _run(cell.host.carry_out("free_motion", Plan()), may_stop=False)
    lag_s = _lag_s(rows)
    measured_Hz, stated_Hz = robot.servo_damping_ratio / (np.pi * lag_s), robot.servo_natural_frequency_Hz
    lag = seen(
        "servo lag",
        f"the tip is {lag_s * 1e3:.0f} ms behind its target, as with a servo of {measured_Hz:.1f} Hz",
        f"{stated_Hz:g} Hz within {LAG_SHARE:.0%}",
        f"set cell.robot.servo_natural_frequency_Hz to {measured_Hz:.1f}: the placeholder is another",
        warns=abs(measured_Hz / stated_Hz - 1.0) > LAG_SHARE,
        servo_lag_ms=lag_s * 1e3,
        servo_natural_frequency_Hz=float(measured_Hz),
    )
    data = load_training_data([report.recording or Path()], config)
    model = cell.folder / "inertial.onnx"
    card = train(data.recordings, model, probe_mass_kg=mass_kg, sensor_serial=data.sensor_serial, sensor_delay_s=data.sensor_delay_s)
    cell.change({("model", "path"): model.name})
    measured, expected = (
        f"a moving mass of {card.mass_kg:.3f} kg, {card.rmse_N * 1e3:.0f} mN rmse",
        f"{mass_kg:g} kg, as cell.probe.mass_kg says",
    )
    return [lag, seen("inertial model", measured, expected, mass_kg=card.mass_kg, rmse_N=card.rmse_N, bias_N=card.bias_N)]


def press_plate(cell: SetupCell) -> Sequence[Finding]:
    """Press a rigid plate, as `palpd stiffness` does."""
    _place(cell, "Put a rigid plate on firm ground, 2 to 10 mm below the tip.")
    report, machine = measured_stiffness(cell.host)
    if machine is None:
        raise Stopped(report.reason or "the run was not recorded; redo the step")
    value, (low, high) = machine.stiffness_N_per_m, machine.ci95_N_per_m
    measured = f"1 mm per {value / 1e3:.1f} N (95 %: {low / 1e3:.1f} to {high / 1e3:.1f})"
    expected = f"more than {SOFTEST_N_PER_M / 1e3:g} N for 1 mm"
    return [seen("machine stiffness", measured, expected, stiffness_N_per_m=value, ci95_N_per_m=[low, high])]


def first_press(cell: SetupCell) -> Sequence[Finding]:
    """Find the surface, and press once with a low limit."""
    _place(cell, "Put the tissue below the tip, at most 40 mm away, and nothing hard.")
    config = cell.config
    safety = config.safety.model_copy(update={"contact_limit_N": min(FIRST_PRESS_N, config.safety.contact_limit_N)})
    host = replace(cell.host, config=config.model_copy(update={"safety": safety}))
    _, rows = _run(host.carry_out("palpation", FIRST_PRESS), may_stop=False)
    surface_z_m, peak_N = float(np.nanmax(rows["surface_z_m"])), float(rows["force_N"].max())
    measured = f"surface at z = {surface_z_m * 1e3:.1f} mm, {peak_N:.2f} N at most"
    return [
        seen("first press", measured, f"about 1 N, and never more than {FIRST_PRESS_N:g} N", surface_z_m=surface_z_m, peak_force_N=peak_N)
    ]


def _place(cell: SetupCell, what: str) -> None:
    """Let the operator put something below the tip; then the arm moves. Raises Refused where they stop here."""
    if cell.operator.choose(f"{what} The arm will move then. What now?", ("stop", "go"), "go") == "stop":
        raise Refused("nothing was put below the tip, and nothing was moved; go again when it is there")


def _run(report: Report, may_stop: bool = True) -> tuple[Report, Rows]:
    """A run with its ticks. Raises Stopped where there are none, or where it was stopped and may not be."""
    if report.recording is None or (report.exit_code and not may_stop):
        raise Stopped(report.reason or "the run was not recorded; redo the step")
    return report, Recording.load(report.recording).rows


def _changed_N(rows: Rows) -> float:
    """Change of the mean force from the rest below to the end of the way up."""
    below, above = rows["phase"] == Phase.BASELINE, rows["phase"] == Phase.LIFT
    if not above.any():
        return float("nan")
    last = above & (rows["now_s"] > rows["now_s"][above][-1] - LIFT_WINDOW_S)
    means = [np.concatenate([row["tared"][: row["frames"], :3] for row in rows[which]]).mean(axis=0) for which in (below, last)]
    return float(np.linalg.norm(means[1] - means[0]))


def _lag_s(rows: Rows) -> float:
    """How long after its target the tip passes a height at full speed. Raises Stopped where the motion has no such part."""
    speed = rows["target_speed"][:, 2]
    fast = np.abs(speed) > 0.98 * np.abs(speed).max()
    began_s = np.maximum.accumulate(np.where(fast, -np.inf, rows["now_s"]))  # when it was not fast for the last time
    steady = fast & (rows["now_s"] - began_s > AT_SPEED_S)
    if not steady.any():
        raise Stopped("the free motion has no part at full speed that shows the servo's lag; redo the step on a quiet PC")
    return float(np.median((rows["target_pose"][steady, 2] - rows["tcp_pose"][steady, 2]) / speed[steady]))
