"""The diagnosis of sealed cases, in a process of its own: it is given a folder of recordings and cell files and nothing else.

`python -m palpd.blind.diagnose_case FOLDER JOBS [--engine]` writes X.json and X.enriched.yaml beside every X.csv. X.without holds the
ids of effects that the diagnosis is not given. A case that fails leaves X.failed with the reason. `--engine` states the engine's own
probabilities, to which the map to the stated ones is fitted.
"""

import json
import os
import resource
import sys
from functools import partial
from pathlib import Path

from palpd.gap.commands import diagnose_files
from palpd.workers import pool

ENGINE = "--engine"
"""Option that states the engine's own probabilities."""


def diagnose_case(recording: Path, *, calibrated: bool = True) -> str | None:
    """Diagnose one case.

    Args:
        calibrated: Whether probabilities are stated by the fitted map; the engine's own otherwise.

    Returns:
        The sentence of what went wrong, or None.
    """
    beside = recording.with_suffix(".without")
    without = beside.read_text(encoding="utf-8").split() if beside.exists() else []
    out = recording.with_suffix(".json")
    began = os.times()
    try:
        diagnose_files(
            [recording],
            recording.with_suffix(".yaml"),
            json_out=out,
            cell_out=recording.with_suffix(".enriched.yaml"),
            without=without,
            propose=False,
            calibrated=calibrated,
        )
    except Exception as error:  # whatever it is, it is this case's score and not the end of the check
        sentence = f"{type(error).__name__}: {error}"
        recording.with_suffix(".failed").write_text(sentence, encoding="utf-8")
        return sentence
    ended = os.times()
    cost = {
        "cpu_s": ended.user + ended.system - began.user - began.system,
        "wall_s": ended.elapsed - began.elapsed,
        "peak_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }
    content = json.loads(out.read_text(encoding="utf-8"))
    out.write_text(json.dumps(content | {"cost": cost}, ensure_ascii=False), encoding="utf-8")
    return None


def main(folder: Path, jobs: int, *, calibrated: bool = True) -> int:
    """Diagnose every recording of a folder.

    Args:
        folder: Folder of recordings and cell files.
        jobs: Number of processes.
        calibrated: Whether probabilities are stated by the fitted map; the engine's own otherwise.

    Returns:
        Number of recordings that failed.
    """
    recordings = sorted(folder.glob("*.csv"))
    with pool(jobs) as workers:
        return sum(sentence is not None for sentence in workers.map(partial(diagnose_case, calibrated=calibrated), recordings))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), calibrated=ENGINE not in sys.argv[3:])
