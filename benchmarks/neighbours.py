"""Which effects are taken for their neighbours, counted in answers of the blind check.

`python -m benchmarks.neighbours BATCHES… [--docs]` reads what `palpd blind --resume` wrote, also compressed by `xz`, and looks at the cells
with one listed effect. `blind_batches.jsonl.xz` beside this file holds such batches. Neighbours are effects whose laws have parameters that
a diagnosis fits and does not report, effects that the blind check confuses, and causes whose changes are alike in principle.
"""

import argparse
import lzma
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from palpd.blind.outcome import CaseOutcome
from palpd.documents import parse_json
from palpd.file_kinds import PAGE_MARK
from palpd.files import write_text
from palpd.quantities import wilson

PAGE = Path(__file__).parents[1] / "docs" / "neighbours.md"
BATCHES = Path(__file__).with_name("blind_batches.jsonl.xz")
WAYS = ("instead", "in its group", "beside")
NEIGHBOURS = {
    "tissue.adhesion": ("tissue.viscoelastic", "tissue.preconditioning", "sensor.hysteresis"),
    "contact.lateral": ("probe.tilt",),
    "sensor.saturation": ("sensor.asymmetry",),
    "sensor.filter": ("sensor.latency",),
    "probe.mass": ("cable.spring", "cable.viscous"),
    "sensor.creep": ("sensor.drift", "tissue.viscoelastic", "sensor.hysteresis"),
    "sensor.drift": ("tissue.viscoelastic",),
}
PAIRS = [pair for one, others in NEIGHBOURS.items() for two in others for pair in ((one, two), (two, one))]
"""A planted effect and a neighbour that must not be named; each is a neighbour of the other."""
INTRODUCTION = """# Effects that are taken for their neighbours

Some effects change a recording in a similar way. The laws of adhesion, hysteresis, asymmetry and saturation also have one parameter that
the diagnosis fits and does not report, so they can follow a neighbour further. Here one listed effect is planted into a cell, and no other
effect must be named. The cells are those of a [blind check](blind.md) in which one listed effect acts, by the library's law or by another:
{counts}; seed {seed}.

- *Instead*: the other effect is named, and the planted one is not.
- *In its group*: the same, and the group of indistinguishable effects of the other one holds the planted one. The answer says so.
- *Beside*: both are named.

Again: `python -m benchmarks.neighbours benchmarks/blind_batches.jsonl.xz --docs`. That file is what `palpd blind {options} --resume FILE`
wrote; decompressed and given again, the check goes on from it.
"""


def ways(outcome: CaseOutcome, other: str) -> set[str]:
    """In which of WAYS an answer names another effect than the planted one."""
    (planted,) = outcome["planted"]
    if other not in outcome["named"]:
        return set()
    if planted in outcome["named"]:
        return {"beside"}
    group = outcome["groups"][outcome["named"].index(other)]
    return {"instead", "in its group"} if planted in group else {"instead"}


def table(outcomes: Sequence[CaseOutcome]) -> list[str]:
    """Lines of the page: a row for each planted effect and neighbour, shares by source, and every other effect that was named."""
    lines = [f"| planted | neighbour | n | itself | {' | '.join(WAYS)} |", "|---" * (4 + len(WAYS)) + "|"]
    for planted, other in PAIRS:
        mine = [outcome for outcome in outcomes if outcome["planted"] == [planted]]
        named = [ways(outcome, other) for outcome in mine]
        row = [len(mine), sum(planted in outcome["named"] for outcome in mine), *(sum(way in each for each in named) for way in WAYS)]
        lines.append(f"| `{planted}` | `{other}` | {' | '.join(map(str, row))} |")
    lines += ["", "| cells with one of these effects | n | a neighbour instead, the planted effect not in its group | a neighbour beside |"]
    lines.append("|---|---|---|---|")
    for source in dict.fromkeys(outcome["source"] for outcome in outcomes):
        cells = [[ways(a, two) for one, two in PAIRS if [one] == a["planted"]] for a in outcomes if a["source"] == source]
        cells = [each for each in cells if each]
        counts = [sum(way in each for each in cells) for way in ({"instead"}, {"beside"})]
        shares = [(count / max(len(cells), 1), *wilson(count, len(cells))) for count in counts]
        words = [f"{count} ({at:.1%}, 95 %: {low:.1%} to {high:.1%})" for count, (at, low, high) in zip(counts, shares, strict=True)]
        lines.append(f"| {source} | {len(cells)} | {' | '.join(words)} |")
    others: Counter[tuple[str, str, str]] = Counter()
    for outcome in outcomes:
        (planted,) = outcome["planted"]
        for other in outcome["named"]:
            if other != planted and (planted, other) not in PAIRS:
                named_so = ways(outcome, other)
                others[planted, other, "in its group" if "in its group" in named_so else min(named_so)] += 1
    lines += ["", "Every other effect that was named beside or instead of a planted one:", ""]
    lines += ["| planted | other effect | how | cells |", "|---|---|---|---|"]
    lines += [f"| `{planted}` | `{other}` | {way} | {count} |" for (planted, other, way), count in others.most_common()]
    return lines


def batches_in(file: Path) -> tuple[int, list[CaseOutcome]]:
    """Seed and outcomes of the batches that a check has scored."""
    with lzma.open(file, "rt", encoding="utf-8") if file.suffix == ".xz" else file.open(encoding="utf-8") as lines:
        begun, *batches = [parse_json(line, file.name) for line in lines]
    return int(begun["seed"]), [outcome for batch in batches for outcome in batch["outcomes"]]


def with_one_effect(outcomes: Sequence[CaseOutcome]) -> list[CaseOutcome]:
    """The cells in which one listed effect acts and nothing else."""
    single = [outcome for outcome in outcomes if outcome["kind"] in ("library", "foreign") and len(outcome["planted"]) == 1]
    return [outcome for outcome in single if not outcome["host_causes"]]


def main() -> None:
    """Print the table, or write the page."""
    parser = argparse.ArgumentParser(description="How often an effect is taken for its neighbour.")
    parser.add_argument("batches", type=Path, nargs="+", help="what palpd blind --resume wrote")
    parser.add_argument("--docs", action="store_true", help="write docs/neighbours.md")
    options = parser.parse_args()
    seeds, checks = zip(*map(batches_in, options.batches), strict=True)
    cells = [outcome for check in checks for outcome in with_one_effect(check)]
    lines = table(cells)
    print("\n".join(lines))
    if options.docs:
        counts = Counter(o["source"] for o in cells)
        again = f"--source {','.join(counts)} --seed {seeds[0]}"
        text = INTRODUCTION.format(counts=", ".join(f"{n} of `{source}`" for source, n in counts.items()), seed=seeds[0], options=again)
        write_text(PAGE, "\n".join([PAGE_MARK, text, *lines, ""]))


if __name__ == "__main__":
    main()
