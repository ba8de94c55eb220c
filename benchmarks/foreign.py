"""How often the diagnosis is right on cells that are written from the contract alone; writes docs/foreign.md.

`python -m benchmarks.foreign --cells 200 --seed N --kept FOLDER [--jobs 2] [--palpd PATH] [--docs docs]` draws the cells of
`benchmarks.foreign_cells` into the folder, lets `palpd diagnose` answer each, and prints the page. A second call goes on: it draws and asks
only what the folder does not hold. It ends with 1 where a cell has no answer.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import Pool
from pathlib import Path
from typing import Any

from benchmarks.foreign_cells import ForeignCase, plan_cases, write_case
from palpd.files import write_text
from palpd.quantities import wilson

TIMEOUT_S = 1800
"""Longest time for one answer: a hundred times the longest that was measured."""
HEAD = """\
# Cells written from the contract alone

How often the diagnosis is right on cells whose author never read it. The generator, `benchmarks/foreign_cells.py`, was written from
[the contract of a diagnosis](reference/contract.md) alone, without reading the diagnosis. It shares no code with it, and none with the
[blind check](blind.md).

Again: `{command}`. A second call goes on. On two cores, a cell is
drawn in a second and diagnosed in up to 20 s.

| cells | share | what acts |
|---|---|---|
| healthy | 30 % | nothing: all tolerances are off by a normal deviate, presses scatter, the noise is 0.9 to 1.1 times the stated |
| single | 40 % | one effect of the library; half of them by another law than the contract's |
| pair | 15 % | two such effects, whose changes have a cosine of at most 0.85 |
| outside | 15 % | one of 13 laws that are in no list. No listed effect explains more than 60 % of its energy |

Each cell has its own probe, sensor, robot, tissue and motion: 5 to 11 presses and free strokes in 30 to 90 s, at 125 to 1000 Hz. In half of
the cells the step of fz is coarse, 1 to 8 times the noise. Half of the robots are no system of second order: they hold the targets of a
slower cycle, have a third order, or limit the jerk. Their cell file states the second-order system that fits free strokes best. A sixth of
the recordings have no `z_cmd_m`. The SNR is that of the contract, uniform in the logarithm from 5 to 60.

## Limits of the cells

- **Controllers.** What the second-order system cannot follow is a real gap in `z_m`, also in a cell that counts as healthy. The column
  *misfit* below is the SNR of that gap.
- **Held targets without a filter.** Their acceleration has ripples that the sampling aliases. They read as a force in proportion to the
  speed, of up to 2 N s/m, like `cable.viscous`.
- **Conditional effects.** `robot.lag` and `robot.vibration` act only with `z_cmd_m`, `sensor.filter` only with a stated cutoff, and
  `tissue.modulus` only where the modulus is known.
- **SNR of scatter.** For `sensor.noise` and `sensor.quantization` it counts the variance in blocks of 20 ms. It does not
  compare with the other SNR.
- **Rounding.** The lattice of readings lies anywhere. So a force at rest is off by up to half a step, for the whole recording.
"""
RIGHT = {"healthy": "silent", "single": "only", "pair": "only", "outside": "unknown"}
"""The key of `judged` that makes an answer right, by kind of cell."""
EVERY_SNR, CLEAR, FAINT = (0.0, 1e9), (10.0, 1e9), (5.0, 10.0)
"""Ranges of the SNR of every effect that acts, in standard deviations."""


@dataclass(frozen=True)
class ForeignAnswer:
    """A cell with its truth, its answer, and what is right about it."""

    name: str
    truth: dict[str, Any]
    answer: dict[str, Any]
    right: dict[str, bool]

    def is_within(self, kind: str, snr_range: tuple[float, float]) -> bool:
        """Whether the cell is of this kind, and the SNR of all that acts is in the range (standard deviations)."""
        return self.truth["kind"] == kind and all(snr_range[0] <= snr < snr_range[1] for snr in self.truth["snr"].values())


def judged(truth: dict[str, Any], answer: dict[str, Any]) -> dict[str, bool]:
    """What is right about an answer: content of .truth.json, content of out.json."""
    named, acting = [e["id"] for e in answer["effects"]], set(truth["effects"])
    groups = [{e["id"], *e["indistinguishable_from"]} for e in answer["effects"]]
    return {
        "silent": answer["verdict"] == "none",
        "unknown": answer["verdict"] == "unknown",
        "first": bool(named) and named[0] in acting,
        "only": answer["verdict"] in ("effects", "ambiguous") and sorted(named) == sorted(acting),
        "group": bool(groups) and bool(groups[0] & acting),
        "all": acting <= set(named),
        "all groups": acting <= set().union(*groups),
    }


def diagnose(palpd: Path, folder: Path, name: str) -> str:
    """Let `palpd diagnose` answer a cell of the folder; the answer is kept beside it.

    Returns:
        Why there is no answer; "" where there is one.
    """
    kept = folder / f"{name}.answer.json"
    if kept.exists():
        return ""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "out.json"
        command = [palpd, "diagnose", folder / f"{name}.csv", "--cell", folder / f"{name}.yaml", "--json", out]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        try:
            run = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, env=environment, check=False)
        except subprocess.TimeoutExpired:
            return f"no answer after {TIMEOUT_S} s"
        if run.returncode or not out.exists():
            return f"exit {run.returncode}: {run.stderr.strip()[-300:]}"
        write_text(kept, out.read_text(encoding="utf-8"))
    print(name, file=sys.stderr, flush=True)
    return ""


def share(k: int, n: int) -> str:
    """Share of k in n in per cent with Wilson's 95 % interval."""
    low, high = wilson(k, n)
    return f"{k / n:.0%} | {low:.0%} to {high:.0%}" if n else "– |"


def main_table(answers: list[ForeignAnswer]) -> list[str]:
    """The shares that are right, and the frequent errors."""
    rows = ["| cells | what | share | 95 % interval | n |", "|---|---|---|---|---|"]

    def row(cells: str, chosen: Iterable[ForeignAnswer], what: str, key: str) -> None:
        right = [a.right[key] for a in chosen]
        rows.append(f"| {cells} | {what} | {share(sum(right), len(right))} | {len(right)} |")

    def split(cells: str, chosen: list[ForeignAnswer], what: str, key: str) -> None:
        row(cells, chosen, what, key)
        for coarse, step in ((False, "fine"), (True, "coarse")):
            row(f"{cells}, {step} step of fz", [a for a in chosen if a.truth["coarse"] is coarse], what, key)
        for of_second_order, controller in ((True, "controller of second order"), (False, "other controller")):
            part = [a for a in chosen if (a.truth["controller"] == "second order") is of_second_order]
            row(f"{cells}, {controller}", part, what, key)

    split("healthy", [a for a in answers if a.is_within("healthy", EVERY_SNR)], "verdict `none`", "silent")
    for words, snr_range in (("SNR from 10", CLEAR), ("SNR 5 to 10", FAINT)):
        single = [a for a in answers if a.is_within("single", snr_range)]
        (split if snr_range == CLEAR else row)(f"single, {words}", single, "right effect and nothing else", "only")
        row(f"single, {words}", single, "right effect first", "first")
        row(f"single, {words}", single, "right effect in the first group", "group")
        row(f"single, {words}", single, "verdict `unknown`", "unknown")
        row(f"single, {words}", single, "verdict `none`", "silent")
    for words, snr_range in (("both SNR from 10", CLEAR), ("any SNR", EVERY_SNR)):
        pair = [a for a in answers if a.is_within("pair", snr_range)]
        row(f"pair, {words}", pair, "both and nothing else", "only")
        row(f"pair, {words}", pair, "both named", "all")
        row(f"pair, {words}", pair, "both named or in a group", "all groups")
        row(f"pair, {words}", pair, "verdict `unknown`", "unknown")
    for words, snr_range in (("any SNR", EVERY_SNR), ("SNR from 10", CLEAR), ("SNR 5 to 10", FAINT)):
        outside = [a for a in answers if a.is_within("outside", snr_range)]
        row(f"outside, {words}", outside, "verdict `unknown`", "unknown")
        row(f"outside, {words}", outside, "verdict `none`", "silent")
    return rows


def table_by_effect(answers: list[ForeignAnswer]) -> list[str]:
    """The single effects and the laws outside the list, one line each."""
    rows = ["| what acts alone | n | SNR | right | right effect first | `unknown` | `none` |", "|---|---|---|---|---|---|---|"]
    alone = [a for a in answers if a.truth["kind"] in ("single", "outside")]
    for effect in sorted({effect for a in alone for effect in a.truth["effects"]}):
        cells = [a for a in alone if effect in a.truth["effects"]]
        counts = [
            sum(a.right[RIGHT[a.truth["kind"]] if key == "right" else key] for a in cells)
            for key in ("right", "first", "unknown", "silent")
        ]
        snr = ", ".join(f"{a.truth['snr'][effect]:.0f}" for a in cells)
        rows.append(f"| `{effect}` | {len(cells)} | {snr} | {' | '.join(map(str, counts))} |")
    return rows


def table_of_wrong_answers(answers: list[ForeignAnswer]) -> list[str]:
    """Every wrong answer, one line each."""
    rows = ["| cell | what acts (SNR) | step of fz | misfit | verdict | named (probability) | laws |", "|---|---|---|---|---|---|---|"]
    for a in answers:
        truth, kind = a.truth, a.truth["kind"]
        if a.right[RIGHT[kind]]:
            continue
        acting = ", ".join(f"`{effect}` ({snr:.0f})" for effect, snr in truth["snr"].items()) or "nothing"
        named = ", ".join(
            f"`{e['id']}` ({e['probability']:.2f}{'; or ' if e['indistinguishable_from'] else ''}{', '.join(e['indistinguishable_from'])})"
            for e in a.answer["effects"]
        )
        step = "coarse" if truth["coarse"] else "fine"
        misfit = f"{truth['controller_misfit']['snr']:.0f}" if truth["z_cmd"] else "no `z_cmd_m`"
        rows.append(f"| {a.name} | {acting} | {step} | {misfit} | {a.answer['verdict']} | {named or 'nothing'} | {truth['note']} |")
    return rows


def page(answers: list[ForeignAnswer], unanswered: dict[str, str], command: str) -> str:
    """The page of the answers; `unanswered` says why a cell has none."""
    wrong = "Right is: nothing in a healthy cell; exactly what acts, and not `unknown`, with listed effects; `unknown` outside the list."
    lines = [HEAD.format(command=command), "## Results", ""]
    lines += [
        f"{len(answers)} cells. *First group* is the first named effect with its `indistinguishable_from`.",
        "",
        *main_table(answers),
        "",
        "## By effect",
        "",
        *table_by_effect(answers),
        "",
    ]
    lines += ["## Wrong answers", "", wrong, "", *table_of_wrong_answers(answers)]
    if unanswered:
        lines += ["", "## Without an answer", "", *(f"- {name}: {reason}" for name, reason in unanswered.items())]
    return "\n".join(lines) + "\n"


def draw_cells(cases: list[ForeignCase], folder: Path, jobs: int) -> None:
    """Draw the cells that the folder does not hold."""
    missing = [(case, folder) for case in cases if not (folder / f"{case.name}.truth.json").exists()]
    with Pool(jobs) as pool:
        pool.starmap(write_case, missing, chunksize=1)


def main() -> None:
    """Draw, ask, and print the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=200)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--kept", type=Path, required=True, help="folder of the cells and answers, to go on with")
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time")
    parser.add_argument("--palpd", type=Path, default=Path(sys.executable).with_name("palpd"), help="command that diagnoses")
    parser.add_argument("--docs", type=Path, help="write foreign.md into this folder")
    options = parser.parse_args()
    options.kept.mkdir(parents=True, exist_ok=True)
    drawn, mark = {"cells": options.cells, "seed": options.seed}, options.kept / "drawn.json"
    if mark.exists() and json.loads(mark.read_text(encoding="utf-8")) != drawn:
        sys.exit(f"{options.kept} holds cells of {mark.read_text(encoding='utf-8')}, and this is {json.dumps(drawn)}; name another folder")
    mark.write_text(json.dumps(drawn), encoding="utf-8")
    cases = plan_cases(options.cells, options.seed)
    draw_cells(cases, options.kept, options.jobs)
    with ThreadPoolExecutor(options.jobs) as pool:
        reasons = dict(zip(cases, pool.map(lambda case: diagnose(options.palpd, options.kept, case.name), cases), strict=True))
    answers = []
    for case in (case for case, reason in reasons.items() if not reason):
        truth, answer = (json.loads((options.kept / f"{case.name}.{kind}.json").read_text("utf-8")) for kind in ("truth", "answer"))
        answers.append(ForeignAnswer(case.name, truth, answer, judged(truth, answer)))
    command = f"python -m benchmarks.foreign --cells {options.cells} --seed {options.seed} --kept FOLDER --jobs 2 --docs docs"
    text = page(answers, {case.name: reason for case, reason in reasons.items() if reason}, command)
    print(text)
    if options.docs is not None:
        write_text(options.docs / "foreign.md", text, own=True)
    sys.exit(len(answers) < len(cases))


if __name__ == "__main__":
    main()
