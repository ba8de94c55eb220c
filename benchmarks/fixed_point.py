"""Whether an answer is stable under itself: each recording is diagnosed again with the cell that its own diagnosis writes.

`python -m benchmarks.fixed_point FOLDER [--most N] [--jobs 2]` takes each X.csv with X.yaml in the folder, such as one of
`benchmarks.foreign`. Nobody needs to know what acts: a cell that holds all that was found has no gap. It prints the share of the answers
with named effects whose second diagnosis says "none", and the second answer of the others.
"""

import argparse
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from palpd.cell.cell_file import CellFile, load_cell
from palpd.gap.commands import read_recording
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.model.problem import MAX_BINS
from palpd.quantities import wilson
from palpd.workers import pool


@dataclass(frozen=True)
class TwoAnswers:
    """The verdicts on a recording, and what was named.

    Attributes:
        second: Verdict with the cell of the first answer; None where that named no effects.
    """

    stem: str
    first: str
    second: str | None
    named: tuple[str, ...] = ()
    named_again: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """What is said of an answer that is not stable."""
        return f"{self.stem}: {', '.join(self.named)}; then {self.second}: {', '.join(self.named_again) or 'nothing'}"


def asked_twice(recording: Path, bins: int) -> TwoAnswers:
    """Diagnose a recording with its cell file, then with the cell that the answer writes."""
    samples = read_recording(recording)

    def answer(cell: CellFile) -> Diagnosis:
        return diagnose([samples], cell, max_bins=bins, propose=False)

    first = answer(load_cell(recording.with_suffix(".yaml")))
    if first.verdict != "effects":
        return TwoAnswers(recording.stem, first.verdict, None)
    second = answer(first.enriched_cell())
    named, again = (tuple(effect.id for effect in one.effects) for one in (first, second))
    return TwoAnswers(recording.stem, first.verdict, second.verdict, named, again)


def main() -> None:
    """Ask about all recordings of a folder, and print the share of stable answers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--most", type=int, default=10**6, help="number of recordings, at most")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--bins", type=int, default=MAX_BINS)
    options = parser.parse_args()
    recordings = [path for path in sorted(options.folder.glob("*.csv")) if path.with_suffix(".yaml").exists()][: options.most]
    named = stable = 0
    with pool(options.jobs) as workers:
        for one in workers.map(partial(asked_twice, bins=options.bins), recordings):
            named, stable = named + (one.second is not None), stable + (one.second == "none")
            if one.second not in (None, "none"):
                print(one.line, flush=True)
    low, high = wilson(stable, named)
    print(f"stable: {stable} of {named} answers with named effects ({low:.0%} to {high:.0%}), of {len(recordings)} recordings")


if __name__ == "__main__":
    main()
