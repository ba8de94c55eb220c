"""What happens to a recording when its run is over: its report is written, and the catalogue takes it up.

It is a process of its own at the lowest priority, `python -m palpd.history.after_run RECORDING FOLDER`. A run, its end and an abort never
wait for it, and a loop that begins meanwhile does not notice it. SIGTERM ends it and leaves no half-written file.
"""

import contextlib
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

from palpd.errors import PalpdError
from palpd.history.catalogue import Catalogue
from palpd.history.report import report_of, site_history, write_report
from palpd.history.stored import name_in, report_path, stored_recordings

NICEST = 19


def yield_to_others() -> None:
    """Take the processor and the disk only where nobody else wants them."""
    os.nice(NICEST)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def look_back(recording: Path, folder: Path) -> list[str]:
    """Take a recording up into the catalogue, and write its report beside it.

    Args:
        folder: The folder of the runs.

    Returns:
        A sentence for each thing that could not be done.
    """
    problems: list[str] = []
    try:
        report = report_of(recording)
        with Catalogue(folder) as catalogue:
            stored = stored_recordings(folder).get(name_in(folder, recording) or "")
            if stored is not None:
                catalogue.keep(stored, report.facts)
            problems += catalogue.notes
    except PalpdError as error:
        return [str(error)]
    try:
        write_report(report_path(recording), replace(report, history=site_history(recording, folder)))
    except PalpdError as error:
        problems.append(str(error))
    return problems


def main() -> None:
    """Look back at the recording that is named."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    for number in (signal.SIGINT, signal.SIGHUP):  # meant for what runs in the terminal
        signal.signal(number, signal.SIG_IGN)
    yield_to_others()
    for sentence in look_back(Path(sys.argv[1]), Path(sys.argv[2])):
        print(f"palpd: {sentence}", file=sys.stderr)


if __name__ == "__main__":
    main()
