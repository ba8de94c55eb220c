"""Run the benchmarks and write docs/benchmarks.md: what each command printed, and what it was measured on.

`python benchmarks/page.py [--long]`. Short: ten minutes on a quiet machine with two cores; long: every wall, more repeats, 125 and 500 Hz.
"""

import argparse
import datetime
import os
import platform
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "benchmarks.md"
SHORT = {
    "The daemon at 500 Hz": "benchmarks/daemon.py --presses 3",
    "Replay at 125 Hz": "benchmarks/daemon.py --model ur5 --presses 2",
    "Force past the limit at an unannounced wall": "benchmarks/walls.py --stiffness 1000,20000 --speed 0.002,0.01",
    "Reaction": "benchmarks/reaction.py --repeats 3",
    "Parser": "benchmarks/parser.py",
    "Recorder": "benchmarks/recording.py --seconds 10",
}
LONG = {
    "The daemon at 500 Hz": "benchmarks/daemon.py --presses 20",
    "Replay at 125 Hz": "benchmarks/daemon.py --model ur5 --presses 20",
    "Force past the limit at an unannounced wall": "benchmarks/walls.py",
    "Reaction": "benchmarks/reaction.py --repeats 30",
    "Parser": "benchmarks/parser.py",
    "Recorder": "benchmarks/recording.py",
}


def processor() -> str:
    """Its name, where Linux tells."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor() or "unknown")


def main() -> None:
    """Run all and write the page; ends with 1 if one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true")
    commands = LONG if parser.parse_args().long else SHORT
    sections, failed = [], False
    for title, command in commands.items():
        print(f"{title}: python {command}", flush=True)
        load = os.getloadavg()[0]
        done = subprocess.run([sys.executable, *command.split()], cwd=PAGE.parents[1], capture_output=True, text=True, check=False)
        failed |= done.returncode != 0
        said = done.stdout.strip() if done.returncode == 0 else f"It failed: {(done.stderr.strip().splitlines() or ['?'])[-1]}"
        if not said.startswith("|"):
            said = f"```\n{said}\n```"
        print(said, flush=True)
        sections.append(f"## {title}\n\n`python {command}`, load {load:.1f} before it began.\n\n{said}\n")
    head = (
        "# Benchmarks\n\nWritten by `make bench`. Everything runs on one machine: daemon, emulated controller and sensor share its cores,\n"
        "so percentiles above p99 belong to the machine, and\nfigures under load are worse than on a cell's own PC.\n\n"
        f"Measured on {datetime.date.today()}: {processor()}, {os.cpu_count()} cores, Linux {platform.release()}, "
        f"Python {platform.python_version()}.\n\n"
    )
    PAGE.write_text(head + "\n".join(sections))
    sys.exit(failed)


if __name__ == "__main__":
    main()
