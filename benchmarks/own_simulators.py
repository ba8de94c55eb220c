"""Ten rigs with simulators of their own: is a hidden effect named against the user's simulator, and a healthy rig silent?

`python -m benchmarks.own_simulators [--seed 1] [--jobs 2] --kept FOLDER [--docs]`. The rigs, their simulators and the effects stand in
`benchmarks.own_models`, which was written from docs/reference/contract.md and docs/my-simulator.md alone. Each rig has 5 healthy
recordings and 8 with one effect. Then 30 of the recordings are diagnosed again with a tenth and ten times the modulus in the cell file,
which must not change an answer. Answers that stand in FOLDER are kept.
"""

import argparse
import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import palpd
from benchmarks.own_models import MODELS
from palpd.quantities import wilson
from palpd.workers import pool

HEALTHY = 5
FACTORS = (0.1, 1.0, 10.0)
AGAIN = 30
"""Recordings that are diagnosed with each factor on the modulus of the cell file."""
APART_P, APART_SHARE = 0.02, 0.1
"""Largest difference of probabilities, and of parameters in widths of their interval, of answers that count as identical."""
PAGE = Path(__file__).parents[1] / "docs" / "own-simulators.md"
INTRODUCTION = """# Ten simulators that palpd has never seen

Ten rigs, each with a simulator of its own: `benchmarks/own_models.py`, written from [the contract](reference/contract.md) of the effects
and [the page on your own simulator](my-simulator.md) alone. Contacts, servos and damping are none of palpd's. Of each rig there are
{healthy} healthy recordings and {effects} with one effect that its simulator does not have. *First*: the effect, or one that the answer
calls indistinguishable from it, comes first. *Nothing else*: only it is named. Wanted: first in 90 %, nothing else in 85 %, healthy
silent in 95 %. Recordings of the same rigs with other seeds served to mend the diagnosis (seed 2000, before the last mends: first 66 of 80,
nothing else 56 of 80, silent 39 of 50); those of this table are new.

Again: `{command}`.
"""


class RecordingOf(NamedTuple):
    """A recording of a rig; no effect: a healthy one."""

    model: str
    effect: str | None
    number: int


def recordings() -> list[RecordingOf]:
    """All recordings, model by model."""
    return [
        RecordingOf(name, effect, number)
        for name, model in MODELS.items()
        for number, effect in enumerate([*[None] * HEALTHY, *model.effects])
    ]


def again() -> list[RecordingOf]:
    """The recordings that are diagnosed with other moduli, as many of each rig with tissue."""
    of_model = [[one for one in recordings() if one.model == name] for name, model in MODELS.items() if model.cell["tissue"] is not None]
    order = [each[number] for number in (5, 6, 0, 7, 8, 9) for each in of_model]
    return order[:AGAIN]


def answer_to(case: RecordingOf, seed: int, kept: Path, factor: float = 1.0) -> dict[str, Any]:
    """What a diagnosis says of a recording against the rig's own simulator, with the truth and its processor time.

    Args:
        seed: Seed of all recordings.
        kept: Folder of the answers.
        factor: On the modulus in the cell file.
    """
    file = kept / f"{case.model.replace(' ', '_')}-{case.number}-x{factor:g}.json"
    if file.exists():
        content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return content
    model = MODELS[case.model]
    recording, blocks = model.record(case.effect, seed + case.number), json.loads(json.dumps(model.cell))
    if factor != 1.0:
        blocks["tissue"]["youngs_modulus_Pa"] *= factor
    began = time.process_time()
    try:
        answer = palpd.diagnose(recording.columns, blocks, simulated=model.simulate).to_json()
    except palpd.errors.PalpdError as error:
        answer = {"error": str(error), "verdict": "refused", "effects": []}
    out = case._asdict() | {"truth": recording.truth, "snr": recording.snr, "factor": factor, "cpu_s": time.process_time() - began}
    out |= {key: answer.get(key) for key in ("verdict", "sentence", "effects", "p_none", "p_unknown", "simulated", "error", "notes")}
    file.write_text(json.dumps(out), encoding="utf-8")
    return out


def named(row: Mapping[str, Any]) -> list[set[str]]:
    """The named effects of an answer, each with those that look the same."""
    return [{effect["id"], *effect["indistinguishable_from"]} for effect in row["effects"]]


def first(row: Mapping[str, Any]) -> bool:
    """Whether the truth comes first."""
    groups = named(row)
    return row["verdict"] in ("effects", "ambiguous") and bool(groups) and row["effect"] in groups[0]


def alone(row: Mapping[str, Any]) -> bool:
    """Whether the truth is named and nothing else."""
    return first(row) and len(row["effects"]) == 1


def silent(row: Mapping[str, Any]) -> bool:
    """Whether nothing is named."""
    return bool(row["verdict"] == "none")


def identical(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two answers are the same within APART_P and APART_SHARE."""
    if one["verdict"] != other["verdict"] or [e["id"] for e in one["effects"]] != [e["id"] for e in other["effects"]]:
        return False
    for mine, theirs in zip(one["effects"], other["effects"], strict=True):
        if abs(mine["probability"] - theirs["probability"]) > APART_P:
            return False
        for name, value in mine["parameters"].items():
            low, high = value["ci95"]
            if abs(value["value"] - theirs["parameters"][name]["value"]) > APART_SHARE * (high - low):
                return False
    return True


def count(rows: Sequence[Mapping[str, Any]], of: Callable[[Mapping[str, Any]], bool], *, interval: bool = False) -> str:
    """For how many of the rows something holds."""
    right = sum(of(row) for row in rows)
    low, high = wilson(right, len(rows))
    return f"{right} of {len(rows)}" + (f" ({100 * low:.0f} to {100 * high:.0f} %)" if interval else "")


def tables(rows: Sequence[Mapping[str, Any]], moduli: Sequence[Sequence[Mapping[str, Any]]]) -> list[str]:
    """Lines of the page: rigs, misses, and moduli."""
    lines = ["| rig | first | nothing else | healthy silent | processor time, median |", "|---|---|---|---|---|"]
    for name in ("all", *MODELS):
        mine = [row for row in rows if name in ("all", row["model"])]
        planted, healthy = [row for row in mine if row["effect"]], [row for row in mine if not row["effect"]]
        cells = [count(planted, first, interval=name == "all"), count(planted, alone, interval=name == "all")]
        cells.append(count(healthy, silent, interval=name == "all"))
        seconds = sorted(row["cpu_s"] for row in mine)[len(mine) // 2]
        lines.append(f"| {'**all**' if name == 'all' else name} | {' | '.join(cells)} | {seconds:.1f} s |")
    lines += ["", *(f"- *{name}*: {model.about}" for name, model in MODELS.items())]
    lines += ["", "## Every miss", "", "| rig | truth | SNR | answer |", "|---|---|---|---|"]
    for row in rows:
        if not (alone(row) if row["effect"] else silent(row)):
            groups = ", ".join(" or ".join(f"`{name}`" for name in sorted(group)) for group in named(row)) or "nothing"
            truth = f"`{row['effect']}`" if row["effect"] else "healthy"
            lines.append(f"| {row['model']} | {truth} | {row['snr']:.0f} | {row['verdict']}: {groups} |")
    same = sum(all(identical(each[1], one) for one in each) for each in moduli)
    low, high = wilson(same, len(moduli))
    lines += ["", "## The modulus of the cell file", ""]
    factors = ", ".join(f"{factor:g}" for factor in FACTORS)
    lines.append(
        f"{len(moduli)} of the recordings were diagnosed with {factors} times the modulus in the cell file. Answers were identical "
        f"(probabilities within {APART_P:g}, parameters within a tenth of their interval) in {same} of {len(moduli)} "
        f"({100 * low:.0f} to {100 * high:.0f} %)."
    )
    return lines


def main() -> None:
    """Print the tables, or write the page."""
    parser = argparse.ArgumentParser(description="Hidden effects of rigs with simulators of their own.")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--kept", type=Path, required=True, help="folder of the answers")
    parser.add_argument("--docs", action="store_true", help="write docs/own-simulators.md")
    options = parser.parse_args()
    options.kept.mkdir(parents=True, exist_ok=True)
    answer = partial(answer_to, seed=options.seed, kept=options.kept)
    with pool(options.jobs) as workers:
        rows = list(workers.map(answer, recordings(), chunksize=1))
        moduli = list(zip(*(workers.map(partial(answer, factor=factor), again(), chunksize=1) for factor in FACTORS), strict=True))
    lines = tables(rows, moduli)
    if options.docs:
        command = f"python -m benchmarks.own_simulators --seed {options.seed} --jobs 2 --kept FOLDER --docs"
        text = INTRODUCTION.format(command=command, healthy=HEALTHY, effects=len(next(iter(MODELS.values())).effects))
        # The section of benchmarks.own_sysid stays as it is.
        _, heading, beside = PAGE.read_text(encoding="utf-8").partition("\n## Beside mujoco.sysid\n")
        PAGE.write_text("\n".join([text, *lines, ""]) + heading + beside, encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
