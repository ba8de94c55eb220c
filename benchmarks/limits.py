"""Is an effect found from the size on that `palpd diagnose --limits` states, and not below?

`python -m benchmarks.limits [--cells 5] [--seed 1] [--jobs 2] --kept FOLDER [--docs]`. A healthy cell of the blind check is drawn for
each effect and number; its recording states the smallest size of that effect. Then the same cell is recorded again with that effect at
half, once and twice that size, with the other parameters as stated, by the simulator and the laws of the blind check, which share none with
the library. An effect counts as found where an answer names it, or has it in the group of a name. Answers that stand in FOLDER are kept.
"""

import argparse
import json
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from palpd.blind.detectability import Detectability
from palpd.blind.drawn_cases import measured
from palpd.blind.drawn_cells import draw_cell, draw_deviations, draw_motion
from palpd.blind.laws import LIBRARY_LAWS, Planted
from palpd.cell.cell_file import CellFile, cell_from
from palpd.cell.effects import EFFECTS
from palpd.gap.diagnosis import diagnose, limits
from palpd.gap.infer.detectable import DetectableSize
from palpd.quantities import wilson
from palpd.workers import pool

FACTORS = (0.5, 1.0, 2.0)
PAGE = Path(__file__).parents[1] / "docs" / "limits.md"
MOST_ROWS = 20_000
INTRODUCTION = """# How small an effect a recording shows

Each answer states the smallest size of every effect that its recordings would have shown (`detectable` in out.json,
`palpd diagnose --limits`). Here that is checked on healthy cells of the [blind check](blind.md). Its simulator and laws share none with
the library. Each effect is planted at half, once and twice the size that the healthy recording states. Its other parameters have typical
values. *Found*: an answer names it, or has it in the group of a name. Wanted: at most 30 % at half the size, 35 to 65 % at the size,
at least 90 % at twice the size.

Again: `{command}`.
"""


class EffectOnCell(NamedTuple):
    """An effect on the cell of a number."""

    effect: str
    number: int


def answers_to(case: EffectOnCell, seed: int, kept: Path) -> dict[str, Any]:
    """What is stated of an effect on one cell, and whether it is found at each factor on the stated size.

    Args:
        seed: Seed of all cells.
        kept: Folder of the answers.
    """
    file = kept / f"{case.effect}-{case.number}.json"
    if file.exists():
        content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return content
    r = np.random.default_rng([seed, sorted(EFFECTS).index(case.effect), case.number])
    cell = draw_cell(r)
    motion = draw_motion(r, cell)
    t_s = np.arange(min(int(motion.duration_s * cell.rate_Hz), MOST_ROWS)) / cell.rate_Hz
    drawn = Detectability(cell, draw_deviations(r, motion), motion, t_s)
    file_of_cell = cell_from(cell.as_yaml(), "the drawn cell")

    def recorded(planted: Sequence[Planted]) -> Any:
        return measured(r, cell, drawn.run(planted), motion, t_s, planted, cell.rate_Hz)

    stated = next(one for one in limits([recorded([])], file_of_cell).sizes if one.effect == case.effect)
    out: dict[str, Any] = {"effect": case.effect, "number": case.number} | {"smallest": stated.smallest, "found": {}, "named": {}}
    law = next((law for law in LIBRARY_LAWS if law.effect == case.effect), None)
    if stated.smallest is not None and law is not None and stated.of_typical is not None:
        for factor in FACTORS:
            shape = {**stated.others, stated.parameter.name: at_factor(stated, factor, file_of_cell)}
            answer = diagnose([recorded([(law, shape)])], file_of_cell, propose=False)
            names = {name for one in answer.effects for name in (one.id, *one.indistinguishable_from)}
            out["found"][str(factor)] = case.effect in names
            out["named"][str(factor)] = sorted(names)
    file.write_text(json.dumps(out), encoding="utf-8")
    return out


def at_factor(stated: DetectableSize, factor: float, cell: CellFile) -> float:
    """A size that is larger by a factor: a ratio to a value other than 0 is raised to that power, a limit is divided by it."""
    absent = cell.sensor.filter_cutoff_Hz if callable(stated.parameter.nominal) else stated.parameter.nominal
    assert stated.smallest is not None
    if not absent:
        return stated.smallest * factor
    return stated.smallest / factor if math.isinf(absent) else float(absent * (stated.smallest / absent) ** factor)


def table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Lines of the page: all effects together, then one row an effect."""
    lines = ["| effect | cells | not at all | found at 0.5 | at 1 | at 2 |", "|---|---|---|---|---|---|"]
    for name in ("all", *sorted({row["effect"] for row in rows})):
        mine = [row for row in rows if name in ("all", row["effect"])]
        shares = []
        for factor in FACTORS:
            each = [row["found"][str(factor)] for row in mine if row["found"]]
            low, high = wilson(sum(each), len(each)) if each else (0.0, 1.0)
            interval = f" ({100 * low:.0f} to {100 * high:.0f} %)" if name == "all" else ""
            shares.append(f"{sum(each)} of {len(each)}{interval}")
        shown = "**all**" if name == "all" else f"`{name}`"
        lines.append(f"| {shown} | {len(mine)} | {sum(row['smallest'] is None for row in mine)} | {' | '.join(shares)} |")
    return lines


def main() -> None:
    """Print the table, or write the page."""
    parser = argparse.ArgumentParser(description="Whether an effect is found from its stated limit on.")
    parser.add_argument("--cells", type=int, default=5, help="cells for each effect")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--kept", type=Path, required=True, help="folder of the answers")
    parser.add_argument("--docs", action="store_true", help="write docs/limits.md")
    options = parser.parse_args()
    options.kept.mkdir(parents=True, exist_ok=True)
    names = [name for name, effect in EFFECTS.items() if effect.scatter is None]
    cases = [EffectOnCell(name, number) for number in range(options.cells) for name in names]
    with pool(options.jobs) as workers:
        rows = list(workers.map(partial(answers_to, seed=options.seed, kept=options.kept), cases, chunksize=1))
    lines = table(rows)
    if options.docs:
        command = f"python -m benchmarks.limits --cells {options.cells} --seed {options.seed} --jobs 2 --kept FOLDER --docs"
        PAGE.write_text("\n".join([INTRODUCTION.format(command=command), *lines, ""]), encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
