"""Which effects are taken for their neighbours: an effect is planted alone, and it is counted how often a neighbour is named.

`python -m benchmarks.neighbours --kept FOLDER [--cells 20] [--seed N] [--jobs 1] [--docs]` draws cells of the blind check with one effect:
by the simulator of the drawn cells at an SNR of 10 to 60, half of them with the library's law and half with another, and by MuJoCo at its
SNR of 4 to 60. Neighbours are effects whose laws have parameters that a diagnosis fits and does not report, effects that the blind check
confuses, and causes whose changes are alike in principle. Answers that stand in FOLDER are kept.
"""

import argparse
import json
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import TypedDict, cast

from palpd.blind.plans import effects_of
from palpd.blind.sources import Hosts, draw
from palpd.blind.truth import CannotDraw, CaseKind, CaseSpec, Source
from palpd.cell.cell_file import cell_from
from palpd.file_kinds import PAGE_MARK
from palpd.files import write_text
from palpd.gap.diagnosis import diagnose
from palpd.quantities import wilson
from palpd.workers import pool

PAGE = Path(__file__).parents[1] / "docs" / "neighbours.md"
SOURCES: tuple[Source, ...] = ("drawn", "mujoco")
STRATA = ("10-20", "20-60")
LAWS: tuple[CaseKind, ...] = ("library", "foreign")
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
the diagnosis fits and does not report, so they can follow a neighbour further. Here one effect is planted into a cell, and a neighbour
must not be named. The cells are those of the [blind check](blind.md): drawn ones with an SNR of 10 to 60, half of them with another law
than the library's, and MuJoCo's with an SNR of 4 to 60.

- *Instead*: the neighbour is named, and the planted effect is not.
- *In its group*: the same, and the neighbour's group of indistinguishable effects holds the planted one. The answer says so.
- *Beside*: both are named.

Again: `{command}`.
"""


class NamedEffects(TypedDict):
    """What was planted, and what the answer names: ids with the groups of effects that cannot be distinguished from them."""

    source: Source
    effect: str
    snr: float | None
    named: dict[str, list[str]]


def planned(cells: int) -> list[CaseSpec]:
    """The cells of each effect and simulator, the first of each before the second ones."""
    effects = sorted({effect for pair in PAIRS for effect in pair})
    specs = []
    for number, (place, effect), source in product(range(cells), enumerate(effects), SOURCES):
        kinds: list[CaseKind] = [kind for kind in LAWS if effect in effects_of(source)[kind]]
        specs.append(CaseSpec(source, 1000 * place + number, kinds[number % len(kinds)], (effect,), STRATA[number // 2 % 2], extra=True))
    return specs


def answer_to(spec: CaseSpec, seed: int, kept: Path) -> NamedEffects | None:
    """The answer to one cell; None where no cell shows the effect.

    Args:
        seed: Seed of all cells.
        kept: Folder of the answers.
    """
    file = kept / f"{spec.name}.json"
    if file.exists():
        return cast("NamedEffects", json.loads(file.read_text(encoding="utf-8")))
    try:
        case = draw(spec, seed, Hosts())
    except CannotDraw:
        return None
    answer = diagnose([case.samples], cell_from(case.cell, "the drawn cell"), propose=False)
    named = {each.id: list(each.indistinguishable_from) for each in answer.effects}
    content: NamedEffects = {"source": spec.source, "effect": spec.effects[0], "snr": case.truth["effects"][0]["snr"], "named": named}
    file.write_text(json.dumps(content), encoding="utf-8")
    return content


def ways(answer: NamedEffects, other: str) -> set[str]:
    """In which of WAYS an answer names another effect than the planted one."""
    if other not in answer["named"]:
        return set()
    if answer["effect"] in answer["named"]:
        return {"beside"}
    return {"instead", "in its group"} if answer["effect"] in answer["named"][other] else {"instead"}


def table(answers: Sequence[NamedEffects]) -> list[str]:
    """Lines of the page: a row for each planted effect and neighbour, then the shares of all cells with any of their neighbours."""
    heads = [f"{source}: {word}" for source in SOURCES for word in ("n", "itself", *WAYS)]
    lines = [f"| planted | neighbour | {' | '.join(heads)} |", "|---" * (2 + len(heads)) + "|"]
    for planted, other in PAIRS:
        row = []
        for source in SOURCES:
            mine = [answer for answer in answers if (answer["source"], answer["effect"]) == (source, planted)]
            named = [ways(answer, other) for answer in mine]
            row += [len(mine), sum(planted in answer["named"] for answer in mine), *(sum(way in each for each in named) for way in WAYS)]
        lines.append(f"| `{planted}` | `{other}` | {' | '.join(map(str, row))} |")
    lines += ["", "| cells | n | a neighbour instead, the planted effect not in its group | a neighbour beside |", "|---|---|---|---|"]
    for source in SOURCES:
        cells = [[ways(a, two) for one, two in PAIRS if one == a["effect"]] for a in answers if a["source"] == source]
        counts = [sum(way in each for each in cells) for way in ({"instead"}, {"beside"})]
        shares = [(count / max(len(cells), 1), *wilson(count, len(cells))) for count in counts]
        words = [f"{count} ({at:.1%}, 95 %: {low:.1%} to {high:.1%})" for count, (at, low, high) in zip(counts, shares, strict=True)]
        lines.append(f"| {source} | {len(cells)} | {' | '.join(words)} |")
    return lines


def main() -> None:
    """Print the table, or write the page."""
    parser = argparse.ArgumentParser(description="How often an effect is taken for its neighbour.")
    parser.add_argument("--cells", type=int, default=20, help="cells of each effect and simulator")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--kept", type=Path, required=True, help="folder of the answers")
    parser.add_argument("--docs", action="store_true", help="write docs/neighbours.md")
    options = parser.parse_args()
    options.kept.mkdir(parents=True, exist_ok=True)
    with pool(options.jobs) as workers:
        drawn = workers.map(partial(answer_to, seed=options.seed, kept=options.kept), planned(options.cells), chunksize=1)
        lines = table([answer for answer in drawn if answer is not None])
    print("\n".join(lines))
    if options.docs:
        command = f"python -m benchmarks.neighbours --cells {options.cells} --seed {options.seed} --kept FOLDER --docs"
        write_text(PAGE, "\n".join([PAGE_MARK, INTRODUCTION.format(command=command), *lines, ""]))


if __name__ == "__main__":
    main()
