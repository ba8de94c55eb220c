"""What moves if a number that the diagnosis assumes is 30 % larger: verdicts, names and scores, one number at a time.

`python -m benchmarks.sensitivity --cells 60 --kept FOLDER` draws sealed cells (`palpd.blind`, seed SEED): a listed effect with its own
law, a healthy cell, something outside the list, two effects, coarse steps, a listed effect with another law, and so on in this order. It
diagnoses each once as it is, and once for each number of `palpd.gap.assumptions`. FOLDER keeps the answers, so an interrupted command
goes on where it was; keep one folder for one state of the code. Cells come one after the other, so every number has been measured on
all cells that are finished. `--docs` writes the table into docs/assumptions.md, from the kept answers alone. With several folders it
takes what each number changed on a cell from the first folder that holds it; a change is always between two answers of one state.

| unit | 30 % larger |
|---|---|
| probability, cosine | its odds times 1.3; the other parts of a sum of 1 shrink in proportion |
| count | times 1.3, rounded, and at least 1 more |
| any other | times 1.3; numbers in one tuple together |

A process is as it would be with the varied number from its start, at a part of the cost: ASSUMED is replaced before any other module of
`palpd.gap` is imported, by an object that knows who reads it. Where a number is read for the first time, the process forks. The child
goes on with the varied number and writes its answer, then the parent goes on. A number that a diagnosis does not read changes nothing.

The score of a cell is the logarithm of the probability that the answer states of the truth, at least log(LEAST_P).
"""

import argparse
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from math import log
from pathlib import Path
from typing import Any

from palpd.blind.laws import INDISTINGUISHABLE
from palpd.blind.plans import plan, plan_coarse
from palpd.blind.sources import Hosts, draw
from palpd.blind.truth import CaseSpec, SealedCase
from palpd.cell.cell_file import cell_from
from palpd.cell.effects import EFFECTS
from palpd.gap import assumptions
from palpd.gap.assumptions import ASSUMED, Assumptions
from palpd.workers import end_with, pool

SEED, PLANNED = 250_000_030, 400
"""Seed of the cells, and number of them for each source that is planned; the order of the effects depends on both."""
KINDS = ("library", "healthy", "novel", "two", "coarse", "foreign")
"""Kinds of the cells, in turn."""
LARGER = 1.3
SUMS_OF_ONE = (("prior.none", "prior.one", "prior.two", "prior.three"), ("law_error.p_exact", "law_error.p_sizes"))
"""Probabilities that add up to 1: if one is larger, the others are smaller."""
LEAST_P = 1e-3
"""Least probability whose logarithm enters a score."""
ADVICE = "advice."
"""Numbers that only the next experiment reads. They are varied in a diagnosis of their own, which looks for it."""
PAGE = Path(__file__).parents[1] / "docs" / "assumptions.md"

BINS = 1500
"""Largest number of bins of a diagnosis. `palpd diagnose` has 4500, at a third more time."""

Answer = dict[str, Any]


def paths() -> list[str]:
    """All numbers as `stage.field`, in the order of the class."""
    return [f"{stage.name}.{field.name}" for stage in fields(Assumptions) for field in fields(getattr(ASSUMED, stage.name))]


def described(path: str) -> Mapping[str, str]:
    """Unit, meaning and source of a number."""
    stage, name = path.split(".")
    return next(field.metadata for field in fields(getattr(ASSUMED, stage)) if field.name == name)


def value_of(path: str, of: Assumptions = ASSUMED) -> Any:
    """A number, or a tuple of numbers."""
    stage, name = path.split(".")
    return getattr(getattr(of, stage), name)


def with_value(of: Assumptions, path: str, value: Any) -> Assumptions:
    """The assumptions with another value of one number."""
    stage, name = path.split(".")
    changed: Assumptions = replace(of, **{stage: replace(getattr(of, stage), **{name: value})})  # type: ignore[arg-type]
    return changed


def larger(value: Any, unit: str) -> Any:
    """A value, or each number of a tuple, made larger as the table above says; words stay."""
    if isinstance(value, tuple):
        return tuple(larger(part, unit) for part in value)
    if isinstance(value, str):
        return value
    if unit == "count":
        return max(value + 1, round(LARGER * value))
    if unit in ("probability", "cosine"):
        return LARGER * value / (1.0 - value + LARGER * value)
    return LARGER * value


def varied(path: str) -> Assumptions:
    """The assumptions with one number larger; what adds up to 1 with it becomes smaller."""
    out = with_value(ASSUMED, path, larger(value_of(path), described(path)["unit"]))
    for sum_of_one in SUMS_OF_ONE:
        if path in sum_of_one:
            others = [other for other in sum_of_one if other != path]
            was = sum(total(value_of(other)) for other in others)
            now = was + total(value_of(path)) - total(value_of(path, out))
            for other in others:
                out = with_value(out, other, _scaled(value_of(other), now / was))
    return out


def total(value: Any) -> float:
    """A number, or the sum of a tuple."""
    return float(sum(value) if isinstance(value, tuple) else value)


def _scaled(value: Any, factor: float) -> Any:
    return tuple(factor * part for part in value) if isinstance(value, tuple) else factor * value


def read_with(path: str) -> set[str]:
    """The numbers that differ where one is varied."""
    return next((set(group) for group in SUMS_OF_ONE if path in group), {path})


class WatchedAssumptions:
    """Stands for ASSUMED: gives the values of `now`, and calls `before_read` with `stage.field` before each reading."""

    def __init__(self, before_read: Callable[[str], None]) -> None:
        """Begin with the values of the program."""
        self.now, self.before_read = ASSUMED, before_read

    def __getattr__(self, stage: str) -> "_Stage":
        """One stage; it takes the place of its instance."""
        return _Stage(self, stage)


class _Stage:
    def __init__(self, watched: WatchedAssumptions, stage: str) -> None:
        self._watched, self._stage = watched, stage

    def __getattr__(self, name: str) -> Any:
        self._watched.before_read(f"{self._stage}.{name}")
        return getattr(getattr(self._watched.now, self._stage), name)


def cells(count: int) -> list[CaseSpec]:
    """The first cells; a smaller number is a fair sample of a larger one."""
    planned: dict[str, list[CaseSpec]] = {kind: [] for kind in KINDS}
    for spec in (spec for pair in zip(plan("drawn", PLANNED, SEED), plan("mujoco", PLANNED, SEED), strict=True) for spec in pair):
        if spec.kind in planned:
            planned[spec.kind].append(spec)
    planned["coarse"] = plan_coarse("drawn", PLANNED, SEED)[2::3]
    rounds = -(-count // len(KINDS))
    return [planned[kind][number] for number in range(rounds) for kind in KINDS][:count]


def answer_of(case: SealedCase, propose: bool, max_bins: int) -> Answer:
    """The verdict of a case, as it is kept."""
    from palpd.gap.diagnosis import diagnose  # imported here: ASSUMED is replaced before

    known = {name: effect for name, effect in EFFECTS.items() if name not in case.without}
    diagnosis = diagnose([case.samples], cell_from(case.cell, "cell"), known, propose=propose, max_bins=max_bins)
    verdict = diagnosis.decision
    return {
        "verdict": verdict.kind,
        "names": sorted(effect.id for effect in verdict.effects),
        "groups": sorted([effect.id, *sorted(effect.indistinguishable_from)] for effect in verdict.effects),
        "law": verdict.law is not None,
        "next": diagnosis.proposal.motion.what if diagnosis.proposal is not None and diagnosis.proposal.motion is not None else None,
        "p_none": verdict.p_none,
        "p_unknown": verdict.p_unknown,
        "score": _score(case, verdict.p_none, verdict.p_unknown, verdict.candidates),
    }


def _score(case: SealedCase, p_none: float, p_unknown: float, candidates: Mapping[str, float]) -> float:
    """Log of the stated probability of the truth; of two effects the mean. An effect that nothing distinguishes counts as the true one."""
    kind, planted = case.truth["kind"], [effect["id"] for effect in case.truth["effects"]]
    if kind in ("removed", "novel"):
        stated = [p_unknown]
    elif not planted:
        stated = [p_none]
    else:
        stated = [max(candidates.get(name, 0.0) for name in (id_, *INDISTINGUISHABLE.get(id_, ()))) for id_ in planted]
    return sum(log(max(p, LEAST_P)) for p in stated) / len(stated)


def measure(spec: CaseSpec, kept: Path, only: str, max_bins: int) -> str:
    """Diagnose one cell with every number varied that begins with `only`, and append the answers to the kept ones.

    Returns:
        The name of the cell.
    """
    known = answers(kept)
    targets = {path for path in paths() if path.startswith(only)} - known.get(spec.name, {}).keys()
    if not targets and "" in known.get(spec.name, {}):
        return spec.name
    case = draw(spec, SEED, Hosts())
    usual = {path for path in targets if not path.startswith(ADVICE)}
    for base, numbers in (("", usual), (ADVICE, targets - usual)):
        if base not in known.get(spec.name, {}) and (numbers or not base):
            _in_child(partial(_varying, case, spec.name, kept, set(), base, max_bins))
        if numbers:
            _in_child(partial(_varying, case, spec.name, kept, numbers, base, max_bins))
    return spec.name


def _varying(case: SealedCase, name: str, kept: Path, targets: set[str], base: str, max_bins: int) -> None:
    """Diagnose a case as it is, forking where a targets number is read first. Numbers that nobody read get the answer of the base."""
    propose, pending = base == ADVICE, set(targets)

    def keep(path: str, answer: Answer) -> None:
        line = json.dumps({"cell": name, "path": path, "answer": answer}) + "\n"
        with (kept / "answers.jsonl").open("ab", buffering=0) as file:
            file.write(line.encode())

    def before_read(path: str) -> None:
        for one in sorted(one for one in pending if path in read_with(one)):
            pending.discard(one)
            if not _is_child():
                continue
            pending.clear()
            watched.now, became[0] = varied(one), one
            return

    became = [base]
    watched = WatchedAssumptions(before_read)
    assumptions.ASSUMED = watched  # type: ignore[assignment]
    try:
        answer = answer_of(case, propose, max_bins)
    except Exception as error:
        if became[0] == base:
            raise
        # a number without which there is no answer is a finding, too
        answer = {"verdict": f"{type(error).__name__}: {error}"[:200], "names": [], "score": log(LEAST_P)}
    keep(became[0], answer)
    if became[0] == base:
        for path in sorted(pending):
            keep(path, answer | {"unread": True})


def _is_child() -> bool:
    """Fork: True in the child, which ends with the parent; False in the parent, once the child has ended."""
    parent = os.getpid()
    if child := os.fork():
        _, status = os.waitpid(child, 0)
        if status:
            raise RuntimeError(f"a diagnosis ended with the status {status}")
        return False
    end_with(parent)
    return True


def _in_child(work: Callable[[], None]) -> None:
    """Do something in a process of its own: what it imports is not imported here."""
    if not _is_child():
        return
    status = 1
    try:
        work()
        status = 0
    finally:
        os._exit(status)


def answers(kept: Path) -> dict[str, dict[str, Answer]]:
    """The kept answers by cell and by number; "" and ADVICE are those of the program as it is."""
    out: dict[str, dict[str, Answer]] = {}
    file = kept / "answers.jsonl"
    for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
        try:
            entry = json.loads(line)
        except ValueError:  # an interrupted command left half a line
            continue
        out.setdefault(entry["cell"], {})[entry["path"]] = entry["answer"]
    return out


def pooled(folders: Sequence[Path]) -> dict[str, dict[str, Answer]]:
    """The kept answers of several states of the code, as `answers`; each number of a cell from the first folder that holds it."""
    out: dict[str, dict[str, Answer]] = {}
    for number, folder in enumerate(folders):
        for cell, mine in answers(folder).items():
            taken = {path for before in range(number) for path in out.get(f"{cell}, state {before}", {})} - {"", ADVICE}
            out[f"{cell}, state {number}"] = {path: answer for path, answer in mine.items() if path not in taken}
    return out


@dataclass(frozen=True)
class Moved:
    """What a number moves: cells measured, cells that read it, changes in words, and the sum of the scores after less before."""

    cells: int
    read: int
    changes: list[str]
    score: float


def moved(path: str, known: Mapping[str, Mapping[str, Answer]]) -> Moved:
    """What a larger value of a number moves in the kept answers."""
    base = ADVICE if path.startswith(ADVICE) else ""
    pairs = {cell: (mine[base], mine[path]) for cell, mine in known.items() if base in mine and path in mine}
    changes = [f"{cell}: {words}" for cell, (before, after) in sorted(pairs.items()) if (words := change(before, after))]
    read = sum(not after.get("unread") for _, after in pairs.values())
    return Moved(len(pairs), read, changes, sum(after["score"] - before["score"] for before, after in pairs.values()))


def change(before: Answer, after: Answer) -> str:
    """What differs between two answers, in words; empty where nothing does."""
    out = []
    for key in ("verdict", "names", "groups", "law", "next"):
        if before.get(key) != after.get(key) and not (key == "groups" and before.get("names") != after.get("names")):
            out.append(f"{key} {_shown(before.get(key))} → {_shown(after.get(key))}")
    return ", ".join(out)


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return " + ".join(" / ".join(part) if isinstance(part, list) else str(part) for part in value) or "nothing"
    return "nothing" if value is None else str(value)


HEAD = """<!-- written by python -m benchmarks.sensitivity --docs: change palpd/gap/assumptions.py, not this page -->
# What a diagnosis assumes

What a diagnosis assumes stands in `palpd/gap/assumptions.py`, as `ASSUMED.prior.none` for example. [The model](explanation/inference.md)
says where each number enters. A *source* of "chosen" means that no measurement set the number. Other numbers were not varied:

- prices and thresholds of a comparison with [healthy recordings](healthy.md), in `usual.py` (`PRICE_NATS`), `healthy_reference.py`
  (`HABIT`), `onset.py` (`CLEAR_NATS`) and `healthy.py`,
- the map from probabilities to stated ones, which was fitted to sealed cells (`calibration.json`),
- guards, steps, grids, memory, and what an input may be. They stand beside their use, for example in `plausibility.py` and `fit.py`.

The last column says what changed on sealed cells where that number alone was 30 % larger: the odds of a probability, the other numbers
themselves, a count by at least 1. The score is the sum over these cells of the logarithm of the probability that is stated of the truth.
*Not read* means that no diagnosis of these cells used the number. A number that changes nothing on a few cells may
still matter on others.

`python -m benchmarks.sensitivity --kept FOLDER --docs` writes this page; it measures on {bins} bins for each recording.
"""
COLUMNS = ("number", "value", "unit", "what it is", "source", "what changes if it is 30 % larger")
NOT_MEASURED = "not measured"


def page(known: Mapping[str, Mapping[str, Answer]], written: str = "", bins: int = BINS) -> str:
    """The page of all numbers.

    Args:
        known: Kept answers.
        written: The page so far. What it says of a number that `known` does not hold stays, unless the value is another one.
        bins: Number of bins of the kept diagnoses.
    """
    before = {cells[0]: cells for line in written.splitlines() if len(cells := _cells(line)) == len(COLUMNS)}
    out = [HEAD.format(bins=bins)]
    for stage in fields(Assumptions):
        stage_class = type(getattr(ASSUMED, stage.name))
        out.append(f"\n## {stage.name}\n\n{stage_class.__doc__}\n\n| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
        for path in (path for path in paths() if path.startswith(f"{stage.name}.")):
            about, old = described(path), before.get(f"`{path}`")
            value = shown_value(value_of(path))
            result = moved(path, known)
            measured = in_words(result) if result.cells else old[-1] if old and old[1] == value else NOT_MEASURED
            out.append(f"| `{path}` | {value} | {about['unit']} | {about['what']} | {about['source']} | {measured} |")
    return "\n".join(out) + "\n"


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split(" | ")] if line.startswith("| `") else []


def shown_value(value: Any) -> str:
    """A number, or the numbers of a tuple with commas between them."""
    if isinstance(value, tuple):
        return ", ".join(" ".join(map(shown_value, part)) if isinstance(part, tuple) else shown_value(part) for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def in_words(result: Moved) -> str:
    """What a number moves, as a cell of the table."""
    cells_measured = f"{result.cells} cell" + ("s" if result.cells > 1 else "")
    if not result.read:
        return f"not read, {cells_measured}"
    score = f", score {result.score:+.2f}" if abs(result.score) >= 0.005 else ""
    if not result.changes:
        return f"nothing, {cells_measured}{score}"
    return f"{len(result.changes)} of {cells_measured}{score}: " + "; ".join(line.split(": ", 1)[1] for line in result.changes)


def main() -> None:
    """Measure, and print what changes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=60)
    parser.add_argument("--only", default="", metavar="PREFIX", help="numbers whose path begins so, such as prior.")
    parser.add_argument("--kept", type=Path, nargs="+", default=[Path("sensitivity")], help="folder of the answers; with --docs, several")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--bins", type=int, default=BINS, help="largest number of bins of a diagnosis; palpd diagnose has 4500")
    parser.add_argument("--docs", action="store_true", help="write docs/assumptions.md from the kept answers, and measure nothing")
    options = parser.parse_args()
    if options.docs:
        written = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
        PAGE.write_text(page(pooled(options.kept), written, options.bins), encoding="utf-8")
        return
    if len(options.kept) > 1:
        parser.error("several folders are for --docs: measure into the folder of this state of the code")
    kept = options.kept[0]
    kept.mkdir(parents=True, exist_ok=True)
    todo = cells(options.cells)
    with pool(options.jobs) as workers:
        for number, name in enumerate(workers.map(partial(measure, kept=kept, only=options.only, max_bins=options.bins), todo), 1):
            print(f"{number} of {len(todo)}: {name}", flush=True)
    known = answers(kept)
    for path in (path for path in paths() if path.startswith(options.only)):
        result = moved(path, known)
        print(f"{path}: {len(result.changes)} of {result.cells} answers change, {result.read} read it, score {result.score:+.2f}")
        print("".join(f"    {line}\n" for line in result.changes), end="")


if __name__ == "__main__":
    main()
