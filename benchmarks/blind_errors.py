"""What the errors of a blind check are made of, counted in its scored batches.

`python -m benchmarks.blind_errors [BATCHES…] [--docs]` reads what `palpd blind --resume` wrote, also compressed by `xz`: by default the
batches of the published tables, which stand beside this file. `--docs` writes the counts into docs/diagnosis.md.
"""

import argparse
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.marked_text import write_marked
from benchmarks.neighbours import BATCHES, batches_in
from palpd.blind.outcome import CaseOutcome

PAGE = Path(__file__).parents[1] / "docs" / "diagnosis.md"
MARK = "blind errors"
OF_THE_TABLES = (BATCHES, BATCHES.with_name("blind_batches_injected.jsonl.xz"))
SHOWN = 4
"""Most effects that a line counts, the commonest first."""
LOW_SNR, PLAIN_SNR = 6.0, 10.0
MOST_EXPLAINED = 0.8
"""Share of an effect's energy above which its nearest neighbour on the list explains it."""


def lines(outcomes: Sequence[CaseOutcome]) -> list[str]:
    """One line of the page for each kind of error."""
    usual = [one for one in outcomes if not one["extra"]]
    healthy = [one for one in usual if one["kind"] == "healthy"]
    coarse = [one for one in outcomes if one["extra"] and one["kind"] == "healthy"]
    two = [one for one in usual if one["kind"] == "two"]
    both = [one for one in two if set(one["planted"]) <= set(one["named"])]
    small = [
        one for one in usual if one["kind"] in ("library", "foreign") and not one["variance"] and LOW_SNR <= (one["snr"] or 0.0) < PLAIN_SNR
    ]
    missed = [one for one in small if not set(one["planted"]) & {name for group in one["groups"][:1] for name in group}]
    removed = [one for one in usual if one["kind"] == "removed" and one["mimic"] and one["mimic"]["snr_left"] >= PLAIN_SNR]
    explained = [one for one in removed if one["verdict"] != "unknown"]
    like_another = [one for one in explained if _explained_by_another(one) > MOST_EXPLAINED]
    more = sum(len(one["named"]) > len(one["planted"]) for one in both)
    return [
        f"- **Healthy cells**: {len(_accused(healthy))} of {len(healthy)} accused: {_answers(_accused(healthy))}. With coarse steps "
        f"{len(_accused(coarse))} of {len(coarse)}: {_answers(_accused(coarse))}.",
        f"- **SNR 6 to 10**: of {len(small)} single effects {len(missed)} are not in the first group: "
        f"{_counts(name for one in missed for name in one['planted'])}. The answer is no gap in "
        f"{sum(one['verdict'] == 'none' for one in missed)}.",
        f"- **Two effects**: in {len(two)} pairs both are named in {len(both)}, with something else in {more} of these. Most often "
        f"missing: {_counts(name for one in two for name in one['planted'] if name not in one['named'])}.",
        f"- **Taken out of the list**: {len(explained)} of {len(removed)} are not called unknown. In {len(like_another)} of these a "
        "neighbour on the list explains more than four fifths.",
    ]


def _accused(healthy: Iterable[CaseOutcome]) -> list[CaseOutcome]:
    return [one for one in healthy if one["verdict"] != "none"]


def _explained_by_another(one: CaseOutcome) -> float:
    assert one["mimic"] is not None
    assert one["snr"] is not None
    return 1.0 - (one["mimic"]["snr_left"] / one["snr"]) ** 2


def _answers(accused: Sequence[CaseOutcome]) -> str:
    return _counts(name for one in accused for name in (one["named"] or [str(one["verdict"])]))


def _counts(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}` {count}" if "." in name else f"{name} {count}" for name, count in Counter(names).most_common(SHOWN))


def main() -> None:
    """Print the lines, or write them into the page."""
    parser = argparse.ArgumentParser(description="What the errors of a blind check are made of.")
    parser.add_argument("batches", type=Path, nargs="*", default=OF_THE_TABLES, help="what palpd blind --resume wrote")
    parser.add_argument("--docs", action="store_true", help="write into docs/diagnosis.md")
    options = parser.parse_args()
    text = "\n".join(lines([outcome for file in options.batches for outcome in batches_in(file)[1]]))
    print(text)
    if options.docs:
        write_marked(PAGE, MARK, text)


if __name__ == "__main__":
    main()
