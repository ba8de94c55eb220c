"""Where the time of a tick goes: each of the six sentences of the loop, and the replay of the same run, without wires.

`python benchmarks/tick.py` prints a markdown table. A palpation on a simulated cell is recorded at 125 and at 500 Hz with
the network on every sample. Then the loop makes its decisions again. `observe` is the drivers' own code before bytes and a UR receiver in
memory. Everything is processor time of the thread, on one processor, medians over the run, without the benchmark's own clock.

"cold" walks through 4 MB between two ticks, as the other processes of a machine do while the loop sleeps. The daemon's ticks are cold ones.
"""

import argparse
import gc
import os
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

PARTS = ("observe", "explain", "decide", "guard", "act", "record", "go on")
RATES_Hz = {125: "ur5", 500: "ur5e"}
COLD_BYTES = 4_000_000
COLD_TICKS = 1500
"""Length of a run of cold ticks: each walk takes a millisecond."""
REPLAYS = 3
PLAN = {"depths_m": [0.006], "mode": "dynamic", "repeats": 1}
FOOTER = {"verdict": "done", "reason": "", "trips": [], "ticks": 0, "missed": 0}


# --- the run ------------------------------------------------------------------------------------------------------------------


def record(folder: Path, rate_Hz: int) -> Path:
    """Learn a model from free motion, palpate with it on a simulated cell, and write the recording."""
    from palpd.cell.cell_file import CellFile
    from palpd.compensation.train import train
    from palpd.config import Config, Plan, filter_delay_s
    from palpd.daemon.motion_job import Job
    from palpd.daemon.simulated_run import FZ_OFFSET_N, run
    from palpd.recording.mcap_file import RecordingWriter
    from palpd.recording.reader import Recording, samples_of
    from palpd.study.laboratory import free_cell, setup
    from palpd.tick import Phase

    model = folder / "inertial.onnx"
    if not model.exists():
        config = Config()
        free = run(Job("free_motion", config, Plan()), free_cell(setup("A"), {}), seed=1)
        moving = Recording(model, free.rows[free.rows["phase"] == Phase.FREE_MOTION], free.header, {}, None)
        delay_s = filter_delay_s(config.sensor.filter_cutoff_Hz)
        train([samples_of(moving)], model, probe_mass_kg=config.cell.probe.mass_kg, sensor_delay_s=delay_s)
    config = Config.model_validate({"robot": {"model": RATES_Hz[rate_Hz]}, "model": {"path": model}})
    job = Job("palpation", config, Plan.model_validate(PLAN))
    done = run(job, CellFile(), seed=2, home_above_m=0.012)
    assert done.outcome.verdict == "done", done.outcome.reason
    header: Any = {
        **done.header,
        "kind": job.kind,
        "dry": False,
        "plan": job.plan.model_dump(mode="json"),
        "reference": [0.0, 0.0, FZ_OFFSET_N, 0.0, 0.0, 0.0],
        "machine_stiffness_N_per_m": None,
        "returns_to_start": True,
    }
    writer = RecordingWriter(folder / f"{rate_Hz}.mcap", header, model.read_bytes())
    for begin in range(0, len(done.rows), 500):
        writer.write(done.rows[begin : begin + 500])
    footer: Any = FOOTER
    return writer.close(footer)


# --- the stand-ins, which also take the time ----------------------------------------------------------------------------------


class Marks:
    """Times at which the sentences of one tick begin and end, by name; `every` holds those of all ticks."""

    def __init__(self) -> None:
        self.now: dict[str, int] = {}
        self.every: list[dict[str, int]] = []

    def __call__(self, name: str) -> None:
        """Take the time."""
        self.now[name] = time.thread_time_ns()

    def next(self) -> None:
        """Begin another tick."""
        if self.now:
            self.every.append(self.now)
        self.now = {}

    def medians_us(self) -> dict[str, float]:
        """Each part's median, µs, over the ticks in which the sequence decided; `whole` is that of their sums."""
        begins = ("begin", "observed", "deciding", "decided", "acting", "recording", "recorded")
        ends = ("observed", "deciding", "decided", "acting", "acted", "recorded", "end")
        whole = [marks for marks in self.every if "decided" in marks and "end" in marks and "acted" in marks]
        spent = np.array([[marks[end] - marks[begin] for begin, end in zip(begins, ends, strict=True)] for marks in whole]) / 1e3
        spent -= clock_us()
        return dict(zip(PARTS, np.median(spent, axis=0).tolist(), strict=True)) | {"whole": float(np.median(spent.sum(axis=1)))}


def clock_us() -> float:
    """What one reading of the clock costs."""
    times = [time.thread_time_ns() for _ in range(2001)]
    return float(np.median(np.diff(times))) / 1e3


class Receiver:
    """A UR receiver in memory: the getters that the driver calls, over lists of numbers, as ur_rtde hands them out."""

    def __init__(self, states: Iterable[Any]) -> None:
        self._states = iter(states)
        self.advance()

    def advance(self) -> None:
        """Let the next state arrive."""
        s = next(self._states)
        self._vectors = [
            [*s.tcp_pose], [*s.tcp_speed], [*s.target_pose], [*s.target_speed], [*s.tool_acceleration_m_per_s2],
        ]  # fmt: skip
        self.getTimestamp = s.timestamp_s.__float__
        pose, speed, target_pose, target_speed, acceleration = self._vectors
        self.getActualTCPPose, self.getActualTCPSpeed = pose.copy, speed.copy
        self.getTargetTCPPose, self.getTargetTCPSpeed = target_pose.copy, target_speed.copy
        self.getActualToolAccelerometer = acceleration.copy
        self.getRobotMode, self.getSafetyMode = int(s.robot_mode).__int__, int(s.safety_mode).__int__
        self.getRuntimeState, self.getSafetyStatusBits = int(s.runtime_state).__int__, int(s.safety_status_bits).__int__
        self.isConnected = True.__bool__


def drivers(states: list[Any], frames: list[Any]) -> tuple[Any, Any, Receiver]:
    """The daemon's own drivers before a receiver and bytes in memory."""
    from hw.hex_frames import FrameParser
    from hw.hex_sensor import HexSensor, SampleClock
    from hw.host_time import MinimumDelayClock
    from hw.rtde import UrReader

    receiver = Receiver(states)

    class Robot(UrReader):
        def __init__(self) -> None:
            self.host, self._receive, self._lost, self._timestamp_s = "memory", receiver, False, 0.0
            self._clock = MinimumDelayClock(1e-4, 1.0)
            self._clock.see(states[0].timestamp_s, states[0].t_s)

    class Sensor(HexSensor):
        def __init__(self) -> None:
            self.counts_per_unit = np.array([41.7, 41.7, 7.6, 1000.0, 1000.0, 1000.0])
            self._parser, self._clock, self._rejected = FrameParser(1, 150.0), SampleClock(), 0
            self._chunks = iter([b"".join(map(packet, each.counter.tolist(), self._counts(each))) for each in frames])

        def _counts(self, each: Any) -> list[list[int]]:
            counts: list[list[int]] = np.rint(each.wrench * self.counts_per_unit).astype(int).tolist()
            return counts

        def _read_bytes(self) -> bytes:
            return next(self._chunks)

    return Robot(), Sensor(), receiver


def packet(counter: int, counts: list[int]) -> bytes:
    """A frame as the DAQ sends it."""
    words = (counter, 0, *(max(-32768, min(32767, count)) & 0xFFFF for count in counts))
    body = b"\xaa\x07\x08\x10" + b"".join(word.to_bytes(2, "big") for word in words)
    return body + (sum(body) & 0xFFFF).to_bytes(2, "big")


def measure(recording: Any, cold: bool) -> dict[str, float]:
    """Medians of a run of the loop over this recording, in µs."""
    from palpd.config import parse_config, parse_plan
    from palpd.control.inertial import InertialModel
    from palpd.control.loop import Loop
    from palpd.control.sequence import Sequence
    from palpd.daemon.motion_job import Job, explainer_with, job_limits, sequence_of
    from palpd.daemon.motion_process import RingWriter
    from palpd.recording.reader import RecordedRobot, RecordedSensor
    from palpd.recording.ring import Ring
    from palpd.tick import Timing

    rows, header = recording.rows[: COLD_TICKS if cold else None], recording.header
    robot, sensor = RecordedRobot(rows), RecordedSensor(rows)
    states, frames, timings = [], [], []
    for at in range(len(rows)):
        robot.advance(at)
        sensor.advance(at)
        states.append(robot.read())
        frames.append(sensor.read())
        timings.append(Timing(*(rows[name][at].item() for name in ("index", "planned_s", "now_s", "missed"))))
    job = Job(
        header["kind"], parse_config(header["config"], "it"), parse_plan(header["plan"], "it"), reference=tuple(header["reference"]),
    )  # fmt: skip
    assert recording.model_bytes is not None
    model = InertialModel.from_bytes(recording.model_bytes, header["model_card"])
    explainer = explainer_with(model, job, header["body"]["delay_s"])
    marks, at = Marks(), [-1]
    real_robot, real_sensor, receiver = drivers(states, frames)
    walked = np.zeros(COLD_BYTES // 8)

    class Devices:
        def wait(self) -> Timing:
            marks.next()
            at[0] += 1
            if at[0]:
                receiver.advance()
            if cold:
                walked[:] += 1.0
            marks("begin")
            return timings[at[0]]

        def elapsed_us(self) -> float:
            marks("end")
            return 0.0

    class Robot:
        def read(self) -> Any:
            real_robot.read()
            return states[at[0]]

        def move(self, _: Any) -> None:
            marks("acting")
            marks("acted")

        stop = end = Any

    class Sensor:
        def read(self) -> Any:
            real_sensor.read()
            marks("observed")
            return frames[at[0]]

    class Timed(Sequence):
        def __init__(self, wrapped: Sequence) -> None:
            vars(self).update(vars(wrapped))

        def step(self, observation: Any) -> Any:
            marks("deciding")
            proposal = super().step(observation)
            marks("decided")
            return proposal

    ring = Ring.create(job.config.robot.rate_Hz)
    write = RingWriter(ring)

    def keep(record: Any) -> None:
        marks("recording")
        write(record)
        marks("recorded")

    devices: Any = Devices()
    keeps: Any = keep
    anything: Callable[..., Any] = Loop
    loop = anything(
        Robot(), Sensor(), devices, Timed(sequence_of(job, header["body"]["delay_s"])), explainer, job_limits(job), keeps,
    )  # fmt: skip
    gc.collect()
    gc.freeze()
    gc.disable()
    while at[0] + 1 < len(rows) and loop.tick():
        pass
    gc.enable()
    ring.close()
    return marks.medians_us()


def figures_of(path: Path) -> dict[str, float]:
    """The medians with hot and with cold caches, and the best processor time of a replay in multiples of real time."""
    from palpd.daemon.replay import replay
    from palpd.recording.reader import Recording

    recording = Recording.load(path)
    figures = {}
    for caches in ("hot", "cold"):
        figures |= {f"{part} | {caches}": us for part, us in measure(recording, caches == "cold").items()}
    took_s = []
    for _ in range(REPLAYS):
        began_s = time.thread_time()
        again = replay(recording)
        took_s.append(time.thread_time() - began_s)
        assert again["decisions_identical"], again["first_difference"]
    figures["replay | hot"] = float(recording.rows["now_s"][-1] - recording.rows["now_s"][0]) / min(took_s)
    return figures


def table(paths: dict[int, Path], rounds: int) -> str:
    """Markdown: µs for each part."""
    lines = ["| loop | part | caches | µs |", "|---|---|---|---|"]
    for rate_Hz, path in paths.items():
        measured = [figures_of(path) for _ in range(rounds)]
        for part in measured[0]:
            median = float(np.median([figures[part] for figures in measured]))
            shown = f"{median:.0f} × real time" if part.startswith("replay") else f"{median:.1f}"
            lines.append(f"| {rate_Hz} Hz | {part} | {shown} |")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3, help="runs of each; the median counts")
    parser.add_argument("--folder", type=Path, help="keeps the recordings there, and takes them from there")
    options = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    with tempfile.TemporaryDirectory() as name:
        folder = options.folder or Path(name)
        folder.mkdir(exist_ok=True)
        paths = {rate: path if (path := folder / f"{rate}.mcap").exists() else record(folder, rate) for rate in RATES_Hz}
        print(table(paths, options.rounds))


if __name__ == "__main__":
    main()
