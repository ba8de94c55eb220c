"""Run the benchmarks and write docs/benchmarks.md: what each command printed, and under what load. What is not run keeps its section.

`python benchmarks/page.py [--long] [--only NAME,NAME]`. Short: some ten minutes on a quiet machine with two cores; long: three
quarters of an hour. Ten minutes at each rate, soak, presses, slopes, cold starts and mutation run only where they are named.
"""

import argparse
import datetime
import os
import platform
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

PAGE = Path(__file__).parents[1] / "docs" / "benchmarks.md"


class Section(NamedTuple):
    """A title and the commands that fill it, in short and in long; `short` None: only where it is named."""

    title: str
    short: str | None
    long: str


SECTIONS = {
    "daemon": Section("The daemon at 500 Hz", "benchmarks/daemon.py --presses 3", "benchmarks/daemon.py --presses 20"),
    "replay": Section("Replay at 125 Hz", "benchmarks/daemon.py --model ur5 --presses 2", "benchmarks/daemon.py --model ur5 --presses 20"),
    "endurance": Section("Ten runs of ten minutes at 500 Hz", None, "-m benchmarks.endurance"),
    "tick": Section("Parts of a tick, without wires", "benchmarks/tick.py", "benchmarks/tick.py --rounds 9"),
    "rate": Section(
        "Ticks, with cyclictest and common alternatives",
        "benchmarks/rate.py --seconds 8 --stress --alternatives",
        "benchmarks/rate.py --seconds 60 --stress --alternatives",
    ),
    "minutes": Section("Ten minutes of ticks at each rate", None, "benchmarks/rate.py --seconds 600"),
    "reaction": Section(
        "Reaction and overshoot of loop, guard and drivers",
        "benchmarks/reaction.py --pushes 40 --each 1 --speed 0.005,0.02 --stiffness 1000,20000",
        "benchmarks/reaction.py --pushes 220 --each 5",
    ),
    "walls": Section(
        "Force past the limit at an unannounced wall, whole daemon",
        "benchmarks/walls.py --stiffness 1000,20000 --speed 0.002,0.01",
        "benchmarks/walls.py",
    ),
    "parser": Section("Parser", "benchmarks/parser.py", "benchmarks/parser.py"),
    "recorder": Section("Recorder", "benchmarks/recording.py --seconds 10", "benchmarks/recording.py"),
    "stream": Section("The force in another program", "-m benchmarks.stream", "-m benchmarks.stream --records 40000"),
    "alarms": Section("An alarm after kill -9", "-m benchmarks.alarms --kills 5", "-m benchmarks.alarms"),
    "web": Section("The operator's page, and what the loop notices of it", None, "-m benchmarks.web"),
    "page-abort": Section("An abort by the operator's page", None, "-m benchmarks.abort --page --samples 200 --minutes 60"),
    "crowded-page": Section("An abort by a page that others crowd", None, "-m benchmarks.abort --half-open 1500 --samples 200"),
    "presses": Section("Presses with faults, without wires", None, "benchmarks/presses.py"),
    "soak": Section("Soak", None, "benchmarks/soak.py"),
    "slopes": Section("Moduli by a sensor with two slopes of Fz", None, "-m benchmarks.slopes"),
    "cold": Section("Runs from cold", None, "-m benchmarks.cold"),
    "imports": Section("Importing a million rows", None, "-m benchmarks.imports"),
    "diagnosis": Section("The cost of a diagnosis", None, "-m benchmarks.diagnosis_cost"),
    "catalogue": Section("Looking back at runs", None, "-m benchmarks.catalogue"),
    "mutation": Section("Mutation of guard, tare and frame parser", None, "benchmarks/mutation.py"),
}


def processor() -> str:
    """Its name, where Linux tells."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor() or "unknown")


def run(title: str, command: str) -> tuple[str, bool]:
    """The section, and whether the command ended well."""
    print(f"{title}: python {command}", flush=True)
    load = os.getloadavg()[0]
    done = subprocess.run([sys.executable, *command.split()], cwd=PAGE.parents[1], capture_output=True, text=True, check=False)
    printed = done.stdout.strip() or f"It failed: {(done.stderr.strip().splitlines() or ['?'])[-1]}"
    if not printed.startswith("|"):
        printed = f"```\n{printed}\n```"
    print(printed, flush=True)
    missed = "" if done.returncode == 0 else f" It ended with {done.returncode}: a target is missed."
    machine = f"{processor()}, {os.cpu_count()} cores, Linux {platform.release()}, Python {platform.python_version()}"
    stand = f"`python {command}`, {datetime.date.today()}, {machine}, load {load:.1f} before and {os.getloadavg()[0]:.1f} after it.{missed}"
    return f"{stand}\n\n{printed}", done.returncode == 0


def main() -> None:
    """Run what is asked for and write the page; ends with 1 if one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--only", help=f"of {', '.join(SECTIONS)}, separated by commas")
    parser.add_argument("--more", default="", help="arguments for the command of the one section that is named")
    options = parser.parse_args()
    named = options.only.split(",") if options.only else [name for name, section in SECTIONS.items() if section.short is not None]
    kept = dict(re.findall(r"^## (.*?)\n\n(.*?)\n*(?=^## |\Z)", PAGE.read_text(), re.M | re.S)) if PAGE.exists() else {}
    all_well = True
    for name in named:
        title, short, long = SECTIONS[name]
        command = long if options.long or short is None else short
        kept[title], well = run(title, f"{command} {options.more}".strip())
        all_well &= well
        _write(kept)
    sys.exit(not all_well)


def _write(kept: dict[str, str]) -> None:
    head = """# Benchmarks

How fast the daemon ticks and reacts, how far a force runs past its limit, and what the daemon costs. `make bench`, `bench-long`, `minutes`,
`endurance`, `presses`, `soak`, `slopes`, `cold` and `mutation` write this page. Faults have [a page of their own](faults.md). Each section
names its command.

**Limits.** Everything runs on one machine. Daemon, emulated controller and sensor share its cores, so percentiles above p99 belong to the
machine. Figures under load are worse than on a cell's own PC. Each section states the load and the machine. Sections without one were
measured on virtual machines with 2 cores of an AMD EPYC, Linux 6.18 and Python 3.11.
"""
    bodies = (f"\n## {section.title}\n\n{kept[section.title]}\n" for section in SECTIONS.values() if section.title in kept)
    PAGE.write_text(head + "".join(bodies))


if __name__ == "__main__":
    main()
