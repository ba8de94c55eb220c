"""Diagnose recordings of other rigs and write docs/real.md: the answer to each beside what is known to act in it.

`python benchmarks/real_recordings.py FOLDER [--causes FILE] [--docs docs]`. FOLDER holds X.csv with X.yaml; the file of causes says
what acts in each (default: benchmarks/real_causes.yaml).
"""

import argparse
import time
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpd.blind.injected_cells import DeclaredCauses, declared_recordings
from palpd.errors import PalpdError
from palpd.file_kinds import PAGE_MARK
from palpd.files import write_text
from palpd.gap.commands import diagnose_files
from palpd.quantities import wilson

CAUSES = Path(__file__).with_name("real_causes.yaml")
TARGET = 0.8
"""Least share of recordings with the right cause and nothing wrong beside it."""

HEAD = """\
# Recordings of other rigs

What the diagnosis answers on public recordings that nobody here made, beside what their makers say or show about them. The recordings
are not in the repository, since their licences differ. `python benchmarks/real_recordings.py FOLDER --docs docs` writes this page.

An answer is *right* if it names a known cause, alone or with its group, and nothing else. Where something outside the list acts, the
right answer is `unknown`; what is named beside it is a cause or the nearest mimic. An answer is *partly right* if it names a known cause
and something else, or calls it unknown. *Beyond the list* is what the [search for laws](outside-the-list.md) says of what the named
effects leave; nobody knows the true law of these recordings, so it counts neither for nor against an answer.
"""


@dataclass(frozen=True)
class RealAnswer:
    """The answer to one recording."""

    name: str
    declared: DeclaredCauses
    verdict: str
    named: list[tuple[str, float, list[str]]]
    p_unknown: float
    closed: float | None
    seconds: float
    warned: list[str]
    law: str = ""

    @property
    def right_names(self) -> list[str]:
        """Named effects that are known causes, themselves or by their group."""
        return [name for name, _, group in self.named if {name, *group} & set(self.declared.causes)]

    @property
    def judgement(self) -> str:
        """`right`, `partly right` or `wrong`."""
        all_right = len(self.right_names) == len(self.named)
        if self.declared.unlisted:
            return "right" if self.verdict == "unknown" else "partly right" if self.right_names else "wrong"
        if not self.right_names:
            return "wrong"
        return "right" if all_right and self.verdict != "unknown" else "partly right"

    @property
    def missing(self) -> list[str]:
        """Known causes that nothing named stands for."""
        return [cause for cause in self.declared.causes if not any(cause in {name, *group} for name, _, group in self.named)]


def diagnosed(path: Path, declared: DeclaredCauses) -> RealAnswer:
    """Diagnose one recording.

    Args:
        path: The recording.
        declared: What acts in it.

    Returns:
        The answer; its verdict is the error where there is none.
    """
    began = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            answer = diagnose_files([path], path.with_suffix(".yaml")).to_json()
        except PalpdError as error:
            answer = {
                "verdict": f"refused: {error}",
                "effects": [],
                "p_unknown": 0.0,
                "shrink": {"closed": None},
                "learned": None,
                "events": None,
            }
    seconds = time.process_time() - began
    named = [(e["id"], e["probability"], e["indistinguishable_from"]) for e in answer["effects"]]
    closed = (answer["shrink"] or {"closed": None})["closed"]
    warned = [f"{w.category.__name__}: {w.message}" for w in caught]
    return RealAnswer(path.stem, declared, answer["verdict"], named, answer["p_unknown"], closed, seconds, warned, law_words(answer))


def law_words(answer: dict[str, Any]) -> str:
    """What the search for laws says of a recording, in a few words.

    Args:
        answer: The content of out.json.

    Returns:
        The learned law with its formula and the laws that fit as well, or the number of events by kind and channel, or `nothing`.
    """
    learned, events = answer["learned"], answer["events"]
    if learned is not None:
        formulas = [f"`{term['formula']}`" if term["formula"] else "a curve" for term in (learned, *learned["further_terms"])]
        alike = f"; {len(learned['alike'])} others fit as well" if learned["alike"] else ""
        beside = "replaces what is named" if learned["replaces_listed"] else "beside what is named" if answer["effects"] else "alone"
        return f"{learned['what']}: {', '.join(formulas)} ({beside}{alike})"
    if events:
        kinds = Counter(f"{event['kind']} in {event['channel'].split('_')[0]}" for event in events)
        return "events: " + ", ".join(f"{n} {kind}" for kind, n in kinds.items())
    return "nothing"


def page(answers: list[RealAnswer]) -> str:
    """The page of the answers."""
    right, n = sum(a.judgement == "right" for a in answers), len(answers)
    low, high = wilson(right, n)
    warned = sum(len(a.warned) for a in answers)
    lines = [
        HEAD,
        f"Right: {right} of {n} ({right / n:.0%}, 95 % interval {low:.0%} to {high:.0%}; target {TARGET:.0%}). "
        f"Python warnings: {warned} (target 0).",
        "",
        "| recording | known to act | verdict | named | not named | answer | beyond the list | gap closed | CPU seconds |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for a in answers:
        known = ", ".join([f"`{cause}`" for cause in a.declared.causes] + (["something outside the list"] if a.declared.unlisted else []))
        named = ", ".join(f"`{name}` {p:.2f}" + (f" (or {', '.join(group)})" if group else "") for name, p, group in a.named) or "nothing"
        missing = ", ".join(f"`{cause}`" for cause in a.missing)
        closed = "–" if a.closed is None else f"{a.closed:.2f}"
        lines.append(f"| {a.name} | {known} | {a.verdict} | {named} | {missing} | {a.judgement} | {a.law} | {closed} | {a.seconds:.1f} |")
    if warned:
        lines += ["", "Warnings:", "", *(f"- {a.name}: {text}" for a in answers for text in a.warned)]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Diagnose the recordings of a folder and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="X.csv with X.yaml, also in folders inside")
    parser.add_argument("--causes", type=Path, default=CAUSES, help="what acts in each recording (.yaml)")
    parser.add_argument("--docs", type=Path, help="write real.md into this folder")
    options = parser.parse_args()
    text = page([diagnosed(path, declared) for path, declared in declared_recordings(options.folder, options.causes)])
    print(text)
    if options.docs is not None:
        write_text(options.docs / "real.md", f"{PAGE_MARK}\n{text}")


if __name__ == "__main__":
    main()
