"""What looking back costs: the report of a run of five minutes, and questions to a catalogue of 10 000 runs.

`python -m benchmarks.catalogue [--runs N] [--minutes M] [--repeats K]`. Targets: a report within 3 s of processor time, process start
included; a question within 200 ms of it, without process start. The recording is a simulated palpation of four sites. The files of the
10 000 runs are empty, and the catalogue takes each for that palpation at another time. Ends with 1 where a target is missed.
"""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from palpd.cell.cell_file import PHANTOM
from palpd.config import Config, Plan
from palpd.history.catalogue import Catalogue, RunFilter
from palpd.history.facts import RunFacts, load
from palpd.history.stored import stored_recordings
from palpd.history.trend import modulus_trend
from palpd.testing.processes import timed
from palpd.testing.simulated_recording import BEGAN_S, write_simulated

REPORT_TARGET_S, QUESTION_TARGET_S = 3.0, 0.2
SITES = ("A", "B", "C", "D")


def five_minutes(path: Path, minutes: float) -> Path:
    """A palpation of four sites; the duration of its holds makes it as long as is asked for."""
    plan = Plan.model_validate(
        {"sites": [{"name": name, "x_m": 0.03 * k} for k, name in enumerate(SITES)], "depths_m": [0.004, 0.006, 0.008], "repeats": 3,
         "hold_s": max(0.5, (60.0 * minutes - 262.0) / 12.0)}
    )  # fmt: skip
    return write_simulated(path, plan, PHANTOM, Config.model_validate({"safety": {"contact_limit_N": 16.0}}))


def fill(folder: Path, count: int, facts: RunFacts) -> None:
    """Empty recordings, and a catalogue that takes each for a palpation: one of ten was stopped, one of seven has a tag."""
    for number in range(count):
        (folder / f"{number:05d}.mcap").write_bytes(b"")
        if number % 7 == 0:
            (folder / f"{number:05d}.remarks.json").write_text('{"tags": ["wet"]}')
    with Catalogue(folder) as catalogue:
        for number, recording in enumerate(stored_recordings(folder).values()):
            like: RunFacts = {**facts, "started_s": BEGAN_S + 600.0 * number}
            if number % 10 == 0:
                like = {**like, "verdict": "stopped", "reason": "a reason"}
            catalogue.keep(recording, like)


def median_s(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median processor and wall time of something, in s."""
    times = []
    for _ in range(repeats):
        began_s = time.process_time(), time.perf_counter()
        work()
        times.append((time.process_time() - began_s[0], time.perf_counter() - began_s[1]))
    cpu_s, wall_s = (statistics.median(each) for each in zip(*times, strict=True))
    return cpu_s, wall_s


def words(cpu_s: float, wall_s: float) -> str:
    """Both times in milliseconds."""
    return f"{cpu_s * 1e3:.0f} ms of processor, {wall_s * 1e3:.0f} ms of wall time"


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    lines, kept = ["| what | measured | target |", "|---|---|---|"], True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = five_minutes(folder / "run.mcap", options.minutes)
        _, facts = load(path)
        command = [sys.executable, "-m", "palpd", "report", str(path), "--folder", name]
        cpu_s, wall_s = (statistics.median(each) for each in zip(*(timed(command) for _ in range(options.repeats)), strict=True))
        kept &= cpu_s <= REPORT_TARGET_S
        what = f"report of a run of {facts['duration_s'] / 60:.1f} min ({facts['bytes'] / 1e6:.0f} MB), process start included"
        lines.append(f"| {what} | {words(cpu_s, wall_s)} | {REPORT_TARGET_S * 1e3:g} ms |")
        lines.append(f"| reading that recording for the catalogue | {words(*median_s(lambda: load(path), 3))} | |")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fill(folder, options.runs, facts)
        questions: dict[str, Callable[[Catalogue], object]] = {
            "the newest 30": lambda catalogue: catalogue.runs(RunFilter(most=30)),
            "all": lambda catalogue: catalogue.runs(),
            "stopped, with a tag": lambda catalogue: catalogue.runs(RunFilter(verdict="stopped", tags=("wet",))),
            "a word anywhere": lambda catalogue: catalogue.runs(RunFilter(text="a reason", most=30)),
            "trend of a site": lambda catalogue: modulus_trend(catalogue, "A", RunFilter(most=1000)),
        }
        for what, question in questions.items():

            def asked(question: Callable[[Catalogue], object] = question) -> None:
                with Catalogue(folder) as catalogue:
                    question(catalogue)

            cpu_s, wall_s = median_s(asked, options.repeats)
            kept &= cpu_s <= QUESTION_TARGET_S
            lines.append(f"| {options.runs} runs, {what} | {words(cpu_s, wall_s)} | {QUESTION_TARGET_S * 1e3:g} ms |")
        with Catalogue(folder) as catalogue:
            looked_s = median_s(lambda: catalogue.refresh(), options.repeats)
        assert len(stored_recordings(folder)) == options.runs
        lines.append(f"| {options.runs} runs, looking for what is new | {words(*looked_s)} | |")
    print("\n".join(lines))
    sys.exit(not kept)


if __name__ == "__main__":
    main()
