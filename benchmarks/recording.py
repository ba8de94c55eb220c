"""What recording costs: megabytes a minute and share of a core, with the real recorder process behind a real ring.

`python benchmarks/recording.py [--seconds 20]`. Budget: 15 MB a minute and 5 % of a core at 1000 frames a second.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpd.recording.reader import Recording, same_rows
from palpd.recording.recorder import Recorder
from palpd.recording.ring import Ring
from palpd.testing.processes import processor_s
from palpd.tick import ROW, Mode, Phase

FRAME_HZ = 1000
COUNTS_PER_N = np.array([41.7, 41.7, 7.6, 1000.0, 1000.0, 1000.0])


def palpation(rate_Hz: int, seconds: float, start_s: float) -> NDArray[np.void]:
    """Rows as a run makes them: presses at 10 mm/s and holds, noisy encoders, a wrench of whole counts, turned into base axes."""
    rng = np.random.default_rng(1)
    rows = np.zeros(round(rate_Hz * seconds), ROW)
    n = len(rows)
    rows["index"] = np.arange(n)
    rows["planned_s"] = start_s + np.arange(n) / rate_Hz
    rows["now_s"] = rows["planned_s"] + rng.exponential(60e-6, n)
    rows["work_us"] = 120 + 20 * rng.standard_normal(n)
    rows["robot_t_s"] = rows["now_s"] - 0.001 - rng.exponential(1e-4, n)
    rows["robot_timestamp_s"] = 4000 + np.arange(n) / rate_Hz
    z_m = -0.004 * np.clip(2 * np.sin(rows["planned_s"]), 0, 1)
    rows["target_pose"] = [0.3, -0.2, 0.1, 2.2, -2.2, 0.01]
    rows["target_pose"][:, 2] += z_m
    rows["tcp_pose"] = rows["target_pose"] + rng.normal(0, 5e-6, (n, 6))
    rows["target_speed"][:, 2] = np.gradient(z_m) * rate_Hz
    rows["tcp_speed"] = rows["target_speed"] + rng.normal(0, 2e-4, (n, 6))
    rows["tool_acceleration_m_per_s2"] = rng.normal(0, 0.05, (n, 3))
    rows["robot_mode"], rows["safety_mode"], rows["runtime_state"], rows["connected"] = 7, 1, 2, 1
    per_tick = FRAME_HZ // rate_Hz
    rows["frames"] = per_tick
    frame_t_s = rows["now_s"][:, None] + (np.arange(per_tick) - per_tick) / FRAME_HZ + rng.normal(0, 1e-6, (n, per_tick))
    counter = np.arange(n * per_tick).reshape(n, per_tick)
    force = np.zeros((n, per_tick, 6))
    force[..., 2] = 1e4 * z_m[:, None]
    counts = np.rint((force + rng.normal(0, 1, force.shape) * [0.05, 0.05, 0.05, 0.001, 0.001, 0.001] + 3.0) * COUNTS_PER_N)
    rows["frame_t_s"][:, :per_tick] = frame_t_s
    rows["counter"][:, :per_tick] = counter
    rows["wrench"][:, :per_tick] = counts / COUNTS_PER_N
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rows["tared"][:, :per_tick] = np.dstack([part @ turn for part in np.dsplit(counts / COUNTS_PER_N - 3.0123, 2)])
    rows["inertial_N"][:, :per_tick] = rng.normal(0, 0.01, (n, per_tick))
    rows["force_N"] = rows["tared"][:, :per_tick, 2].max(axis=1)
    rows["absolute_N"] = np.abs(rows["force_N"])
    rows["phase"], rows["mode"], rows["depth_m"], rows["surface_z_m"] = Phase.PRESS, Mode.DYNAMIC, 0.004, 0.0
    rows["proposed_m_per_s"][:, 2] = rows["command_m_per_s"][:, 2] = -0.01
    return rows


def peak_MB(pid: int) -> float:
    """The most memory a process has had resident."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def measure(rate_Hz: int, seconds: float, folder: Path) -> str:
    """One line: what a run at that rate costs."""
    rows = palpation(rate_Hz, seconds, time.monotonic() + 0.5)
    ring = Ring.create(rate_Hz)
    recorder = Recorder.begin(ring, folder / f"{rate_Hz}.mcap", {"benchmark": "recording"})
    recorder.confirm(20.0)
    started_s = processor_s(recorder.pid)
    writing_s = np.empty(len(rows))
    for number, planned_s in enumerate(rows["planned_s"].tolist()):
        time.sleep(max(0.0, planned_s - time.monotonic()))
        begin_s = time.perf_counter()
        ring.write(rows[number])
        writing_s[number] = time.perf_counter() - begin_s
    used_s, memory_MB, lag = processor_s(recorder.pid) - started_s, peak_MB(recorder.pid), ring.recorder_lag
    path = recorder.close({"verdict": "done"})
    lost = ring.recorder_lost
    ring.close()
    begin_s = time.perf_counter()
    recording = Recording.load(path)
    load_s = time.perf_counter() - begin_s
    same = len(recording.rows) == len(rows) and bool(same_rows(recording.rows, rows).all())
    p50_us, p99_us = np.percentile(writing_s, [50, 99]) * 1e6
    return (
        f"{rate_Hz:4d} Hz, {FRAME_HZ} frames/s: {path.stat().st_size / 1e6 / seconds * 60:5.2f} MB/min, "
        f"{100 * used_s / seconds:4.2f} % of a core, {memory_MB:.0f} MB resident, "
        f"write to ring p50 {p50_us:.1f} µs p99 {p99_us:.1f} µs, lag at end {lag} rows, lost {lost}, "
        f"read back at {seconds / load_s:.0f} x real time, identical: {same}"
    )


def main() -> None:
    """Measure at the two rates of the controllers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    seconds = parser.parse_args().seconds
    with tempfile.TemporaryDirectory() as folder:
        for rate_Hz in (125, 500):
            print(measure(rate_Hz, seconds, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
