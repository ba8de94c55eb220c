"""The verbs of the control channel: faults of the emulated cell, and questions to it; docs/emulators.md is the reference.

A request is one JSON object on a line, `{"do": VERB, …}`; the answer is one too, `{"ok": true, …}` or `{"ok": false, "error": …}`.
"""

import itertools
import time
from collections.abc import Callable, Sequence
from types import FunctionType
from typing import Any

import numpy as np

from hw.emulators.controller_state import EMERGENCY, Safety
from hw.emulators.hex_pty import Daq, Faults
from hw.emulators.net_ft import BoxFaults
from hw.emulators.rig import SAMPLE_S, Rig

VerbAnswer = dict[str, Any]
FZ_OVERLOAD = 1 << 7
MOST_ROWS = 1000
"""Most rows in one answer of the log: writing more makes the wires late."""


def obey(rig: Rig, request: dict[str, Any], now_s: float, lateness_s: Sequence[float]) -> VerbAnswer:
    """Carry out one request.

    Args:
        rig: the emulated cell.
        request: `do` names the verb, other keys are its arguments.
        now_s: host time.
        lateness_s: lateness of the latest ticks, for `stats`.

    Raises:
        ValueError: the verb is unknown.
        KeyError: `do` is missing.
        TypeError: an argument is wrong.
    """
    arguments = dict(request)
    verb = arguments.pop("do")
    if verb == "stats":
        return {"ok": True, **_stats(lateness_s, now_s, **arguments)}
    if verb not in VERBS:
        raise ValueError(f"there is no verb {verb!r}; there are {', '.join(sorted((*VERBS, 'stats')))}")
    return {"ok": True, "t_s": now_s, **(VERBS[verb](rig, now_s, **arguments) or {})}


def _stats(lateness_s: Sequence[float], now_s: float, s: float = 60.0, ago_s: float = 0.0) -> VerbAnswer:
    newest, number = round(ago_s / SAMPLE_S), max(1, round(s / SAMPLE_S))
    window = list(itertools.islice(reversed(lateness_s), newest, newest + number)) or [0.0]
    p50, p99, top = np.percentile(np.array(window) * 1e6, [50, 99, 100])
    return {"late_us_p50": p50, "late_us_p99": p99, "late_us_max": top, "cpu_s": time.process_time(), "now_s": now_s}


def _silent(rig: Rig, now_s: float, s: float) -> None:
    rig.daq.faults.silent_until_s = now_s + s
    if rig.box is not None:
        rig.box.faults.silent_until_s = now_s + s


def _slow(rig: Rig, now_s: float, every: int, s: float) -> None:
    rig.daq.faults.slow_every, rig.daq.faults.slow_until_s = int(every), now_s + s


def _stuck(rig: Rig, now_s: float, s: float) -> None:
    rig.daq.faults.stuck_until_s = now_s + s


def _garbage(rig: Rig, _now_s: float, bytes: int) -> None:
    rig.daq.faults.garbage += rig.daq.random.randbytes(bytes)


def _lose(rig: Rig, _now_s: float, bytes: int) -> None:
    rig.daq.faults.lose_bytes += bytes


def _flip(rig: Rig, _now_s: float, frames: int = 1) -> None:
    rig.daq.faults.flips += frames


def _swap(rig: Rig, _now_s: float, frames: int = 1) -> None:
    rig.daq.faults.swaps += frames


def _false_header(rig: Rig, _now_s: float, frames: int = 1) -> None:
    rig.daq.faults.false_headers += frames


def _counter_jump(rig: Rig, _now_s: float, by: int) -> None:
    rig.daq.counter = (rig.daq.counter + by) % 65536


def _status(rig: Rig, now_s: float, word: int, s: float) -> None:
    rig.daq.faults.status, rig.daq.faults.status_until_s = int(word) & 0xFFFF, now_s + s
    if rig.box is not None:
        rig.box.faults.status, rig.box.faults.status_until_s = int(word), now_s + s


def _records(rig: Rig, _now_s: float, lost: int = 0, swapped: int = 0, cut: int = 0) -> None:
    if rig.box is None:
        raise ValueError("there is no Net F/T, whose records could be lost; emulate one with --net-ft-port")
    rig.box.faults.lost, rig.box.faults.swapped, rig.box.faults.cut = lost, swapped, cut


def _overload(rig: Rig, now_s: float, s: float) -> None:
    _status(rig, now_s, FZ_OVERLOAD, s)


def _drift(rig: Rig, _now_s: float, N_per_s: float) -> None:
    rig.daq.faults.drift_N_per_s = N_per_s
    if N_per_s == 0:
        rig.daq.faults.drift_N = 0.0


def _keep_filter(rig: Rig, _now_s: float) -> None:
    rig.daq.faults.keeps_filter = True


def _registers(rig: Rig, _now_s: float, scale: float) -> None:
    rig.daq.faults.register_scale = scale


def _mounting(rig: Rig, _now_s: float, axes: Sequence[int] = (0, 1, 2), signs: Sequence[float] = (1.0, 1.0, 1.0)) -> None:
    rig.axes, rig.signs = (axes[0], axes[1], axes[2]), np.array(signs, dtype=float)


def _usb_latency(rig: Rig, _now_s: float, ms: int) -> None:
    rig.latency_ms = int(ms)


def _unplug(rig: Rig, _now_s: float) -> None:
    rig.line.unplug()


def _replug(rig: Rig, _now_s: float) -> None:
    rig.daq = Daq(fz_parts_at=rig.daq.fz_parts_at)
    rig.line.plug_in()


def _freeze(rig: Rig, now_s: float, s: float) -> None:
    rig.frozen_until_s = now_s + s


def _deaf(rig: Rig, now_s: float, s: float) -> None:
    rig.deaf_until_s = now_s + s


def _drop(rig: Rig, _now_s: float) -> None:
    rig.wires.rtde.drop()


def _slow_packets(rig: Rig, now_s: float, every: int, s: float) -> None:
    rig.keep_every, rig.slow_until_s = int(every), now_s + s


def _protective_stop(rig: Rig, now_s: float) -> None:
    rig.controller.state.pausing_stop(now_s, Safety.PROTECTIVE_STOP, "protective stop")


def _emergency_stop(rig: Rig, now_s: float, on: bool = True, system: bool = False) -> None:
    state = rig.controller.state
    if on:
        state.cutting_stop(now_s, Safety.SYSTEM_EMERGENCY_STOP if system else Safety.ROBOT_EMERGENCY_STOP, "emergency stop")
    elif state.safety in EMERGENCY:
        state.safety = Safety.NORMAL


def _safeguard_stop(rig: Rig, now_s: float, on: bool = True, resume: bool = False) -> None:
    state = rig.controller.state
    if on:
        state.pausing_stop(now_s, Safety.SAFEGUARD_STOP, "safeguard stop")
    elif state.safety is Safety.SAFEGUARD_STOP:
        state.safety = Safety.NORMAL
        if resume:
            rig.controller.dashboard.play()


def _safety_fault(rig: Rig, now_s: float, violation: bool = False) -> None:
    rig.controller.state.cutting_stop(now_s, Safety.VIOLATION if violation else Safety.FAULT, "safety fault")


def _pendant(rig: Rig, now_s: float, press: str) -> None:
    answer = rig.controller.dashboard.obey(press, now_s)
    if answer is None or answer.startswith(("Cannot", "Failed")):
        raise ValueError(answer or f"the pendant has no button {press!r}")


def _power_off(rig: Rig, now_s: float) -> None:
    rig.controller.dashboard.power_off(now_s)


def _program_stop(rig: Rig, now_s: float) -> None:
    rig.controller.state.stop_program(now_s, "stopped at the pendant")


def _other_program(rig: Rig, now_s: float, s: float) -> None:
    rig.controller.upload(f"def other():\n  sleep({s})\nend\n", now_s)


def _local_control(rig: Rig, _now_s: float, on: bool = True) -> None:
    rig.controller.state.remote_control = not on


def _on_arming(rig: Rig, _now_s: float, then: dict[str, Any], delay_s: float = 0.0) -> None:
    if then.get("do") not in VERBS:
        raise ValueError(f"there is no verb {then.get('do')!r}")
    rig.on_arming(delay_s, lambda at_s: obey(rig, then, at_s, ()))


def _restart(rig: Rig, now_s: float, s: float = 2.0) -> None:
    rig.restart(now_s + s)


def _refuse_version(rig: Rig, _now_s: float, on: bool = True) -> None:
    rig.wires.refuse_version = on


def _installation(rig: Rig, _now_s: float, tcp: Sequence[float] | None = None, payload_kg: float | None = None) -> None:
    state = rig.controller.state
    rig.install(state.tcp if tcp is None else np.array(tcp, dtype=float), state.payload_kg if payload_kg is None else payload_kg)


def _hang(rig: Rig, _now_s: float, weight_N: float) -> None:
    rig.hung_N = weight_N


def _wall(rig: Rig, _now_s: float, z_m: float, stiffness_N_per_m: float) -> None:
    rig.place_wall(z_m, stiffness_N_per_m)


def _truth(rig: Rig, _now_s: float, reset: bool = False) -> VerbAnswer:
    tip_z_m, contact_N = rig.tip
    x_m, y_m, target_z_m = (float(value) for value in rig.controller.state.pose[:3])
    answer = {
        "tip_z_m": tip_z_m,
        "target_z_m": target_z_m,
        "contact_N": contact_N,
        "peak_contact_N": rig.peak_contact_N,
        "surface_z_m": rig.surface_m(x_m, y_m),
    }
    if reset:
        rig.peak_contact_N = contact_N
    return answer


def _log(rig: Rig, _now_s: float, since_s: float) -> VerbAnswer:
    """Rows after a time; the deque is in order of time, so the search begins at its end."""
    fresh = list(itertools.takewhile(lambda sample: sample.t_s > since_s, reversed(rig.samples)))
    stops = [stop for stop in rig.controller.state.stops if stop[0] > since_s]
    armings = [at_s for at_s in rig.controller.state.armings if at_s > since_s]
    return {"samples": fresh[::-1][:MOST_ROWS], "more": len(fresh) > MOST_ROWS, "stops": stops, "armings": armings}


def _wire(rig: Rig, _now_s: float, since_s: float) -> VerbAnswer:
    """Sensor samples sent and robot commands received after a time, the first MOST_ROWS of each."""
    sent = list(itertools.takewhile(lambda entry: entry[0] > since_s, reversed(rig.sent)))
    heard = list(itertools.takewhile(lambda entry: entry[0] > since_s, reversed(rig.controller.commands)))
    return {"sent": sent[::-1][:MOST_ROWS], "heard": heard[::-1][:MOST_ROWS]}


def _heal(rig: Rig, _now_s: float) -> None:
    rig.daq.faults = Faults()
    if rig.box is not None:
        rig.box.faults = BoxFaults()


VERBS: dict[str, Callable[..., VerbAnswer | None]] = {
    name.removeprefix("_"): verb
    for name, verb in dict(globals()).items()
    if isinstance(verb, FunctionType) and name.startswith("_") and name != "_stats"
}
"""Every function of this module whose name begins with an underscore is the verb of that name."""
