"""Shows that a change of the code changed no diagnosis, and what it did to the cost of one.

`python -m benchmarks.same_answers --before COMMIT` diagnoses 200 recordings (`benchmarks.fixed_cases`) with the code of COMMIT and with
this work tree. It prints what differs and ends with 1 if any answer does. The folder of `--kept` holds recordings and answers, so an
interrupted command goes on where it was. Processor time is compared over the answers that one run made of both codes:
`--cases 60 --anew`. Decisions of recorded runs are compared by `palpd replay RUN.mcap`.

| in the answer | has to be |
|---|---|
| verdict, place, names, groups, parameters at their bound, notes | identical |
| probabilities | within 0.01 |
| parameters and the ends of their intervals | within 5 % of the interval |
| any other number | within 1 % of the largest of its kind |
"""

import argparse
import hashlib
import json
import re
import resource
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.fixed_cases import Case, arguments_of, fixed_cases
from palpd.workers import pool

ROOT = Path(__file__).parents[1]
P_ALLOWED, INTERVAL_SHARE, NUMBER_SHARE = 0.01, 0.05, 0.01
IDENTICAL = ("error", "verdict", "where", "notes", "decisive")
WORDS = {"notes", "decisive", "what", "family", "alike"}
REPEATED = {"sentence", "plain", "basis", "motion_csv", "alike_laws"}
"""Keys that say in words, names or rows what other keys say."""
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
Judged = dict[str, tuple[list[Any], float]]
"""Values by what they are of, and how far each of them may differ; words must be identical."""
DIAGNOSE = """
import json, sys
from pathlib import Path
import palpd
from palpd.blind.diagnose_case import diagnose_files  # wherever this code has it
from palpd.errors import PalpdError
out, asked = Path(sys.argv[1]), json.loads(sys.argv[2])
files = {key: [Path(path) for path in asked.pop(key)] for key in ("recordings", "simulated")}
try:
    diagnose_files(cell=Path(asked.pop("cell")), json_out=out, **files, **asked)
except PalpdError as error:
    out.write_text(json.dumps({"error": str(error)}), encoding="utf-8")
print(palpd.__path__[0])
"""


def answer(asked: Mapping[str, Any], code: Path, out: Path, anew: bool) -> tuple[dict[str, Any], float | None]:
    """The answer of a code, and the processor seconds that it took; None of one that was kept."""
    cpu_s = None
    if anew or not out.exists():
        out.parent.mkdir(parents=True, exist_ok=True)
        unfinished, began = out.with_suffix(".part"), resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-c", DIAGNOSE, str(unfinished), json.dumps(asked)]
        done = subprocess.run(command, cwd=code, capture_output=True, text=True, check=False)
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu_s = ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime
        if done.returncode:
            unfinished.write_text(json.dumps({"error": (done.stderr.strip().splitlines() or [f"exit {done.returncode}"])[-1]}))
        elif Path(done.stdout.strip()) != code / "palpd":
            raise RuntimeError(f"the answer of {code} came from {done.stdout.strip()}; nothing was compared")
        unfinished.rename(out)
    content: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    return content, cpu_s


def compared(case: Case, kept: Path, codes: Mapping[str, Path], anew: bool, left_out: set[str]) -> tuple[str, list[str], float | None]:
    """The verdict of a case, what differs, and the processor time of the second code as a share of that of the first."""
    asked = arguments_of(case, kept / "recordings")
    outs = {name: kept / "answers" / name / f"{case.name}.json" for name in codes}
    (before, cpu_before_s), (after, cpu_after_s) = (answer(asked, code, outs[name], anew) for name, code in codes.items())
    ratio = cpu_after_s / cpu_before_s if cpu_before_s and cpu_after_s else None
    return before.get("verdict", "refused"), list(differences(judged(before, left_out), judged(after, left_out))), ratio


def judged(content: Mapping[str, Any], left_out: set[str]) -> Judged:
    """The content of an answer by what it is compared as."""
    rest = {key: value for key, value in content.items() if key not in left_out}
    out: Judged = {key: ([json.dumps(rest.pop(key, None))], 0.0) for key in IDENTICAL}
    shares = {entry["id"]: entry["probability"] for entry in rest.pop("candidates", ())}
    shares |= {key: rest.pop(key, 0.0) for key in ("p_none", "p_unknown")}
    out |= {f"P({name})": ([p], P_ALLOWED) for name, p in shares.items()}
    for effect in rest.pop("effects", ()):
        out[f"named {effect['id']}"] = ([json.dumps([sorted(effect["indistinguishable_from"]), effect["at_bound"]])], 0.0)
        for name, p in effect["parameters"].items():
            low, high = p["ci95"]
            out[f"{effect['id']} {name}"] = ([p["value"], low, high], INTERVAL_SHARE * (high - low))
    for kind, values in gathered(rest, left_out).items():
        out[kind] = (values, NUMBER_SHARE * max((abs(value) for value in values if not isinstance(value, str)), default=0.0))
    return out


def gathered(value: Any, left_out: set[str], kind: str = "") -> dict[str, list[Any]]:
    """Numbers by their keys, places in lists left out and channels added; words without the numbers in them."""
    out: dict[str, list[Any]] = {}
    if isinstance(value, dict):
        kind += f"[{value['channel']}]" if isinstance(value.get("channel"), str) else ""
        parts = [gathered(content, left_out, f"{kind}.{key}") for key, content in value.items() if key not in left_out]
    elif isinstance(value, list):
        parts = [gathered(content, left_out, kind) for content in value]
    else:
        return {kind: [value if type(value) in (int, float) else NUMBER.sub("#", str(value))]}
    for part in parts:
        for key, values in part.items():
            out.setdefault(key, []).extend(values)
    return out


def differences(before: Judged, after: Judged) -> Iterator[str]:
    """What differs between two answers, a phrase each."""
    for kind in sorted(before.keys() | after.keys()):
        absent: tuple[list[Any], float] = ([0.0] if kind.startswith("P(") else [], P_ALLOWED)
        (was, allowed), (now, _) = before.get(kind, absent), after.get(kind, absent)
        if len(was) != len(now) or any(apart(x, y, allowed) for x, y in zip(was, now, strict=True)):
            yield f"{kind} {was} → {now}" if len(was) + len(now) < 8 else f"{kind} ({len(was)} values before, {len(now)} now)"


def apart(before: Any, after: Any, allowed: float) -> bool:
    """Whether two words differ, or two numbers by more than is allowed."""
    return before != after if isinstance(before, str) or isinstance(after, str) else abs(before - after) > allowed


def code_at(commit: str, kept: Path) -> dict[str, Path]:
    """The code of a commit by its hash, laid out once."""
    name = subprocess.run(["git", "rev-parse", commit], cwd=ROOT, capture_output=True, text=True, check=True).stdout[:12]
    folder = kept / "code" / name
    if not folder.exists():
        folder.mkdir(parents=True)
        packed = subprocess.run(["git", "archive", name, "palpd"], cwd=ROOT, capture_output=True, check=True).stdout
        subprocess.run(["tar", "-x", "-C", str(folder)], input=packed, check=True)
    return {name: folder}


def this_code() -> dict[str, Path]:
    """This work tree by a hash of all that a diagnosis is made of."""
    digest = hashlib.sha256()
    for path in sorted(path for path in (ROOT / "palpd").rglob("*") if path.suffix in (".py", ".json", ".yaml")):
        digest.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return {f"tree-{digest.hexdigest()[:12]}": ROOT}


def main() -> int:
    """Compare all cases; 0 if nothing differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", default="HEAD", help="commit to compare with")
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of X.csv with X.yaml")
    parser.add_argument("--kept", type=Path, default=ROOT / "same-answers", help="folder of recordings and answers")
    parser.add_argument("--anew", action="store_true", help="make every answer again, both codes side by side")
    parser.add_argument("--any-words", action="store_true", help="words may differ")
    parser.add_argument("--without", action="append", default=[], metavar="KEY", help="a key of the answer that only one code writes")
    options = parser.parse_args()
    kept = options.kept.resolve()
    (kept / "recordings").mkdir(parents=True, exist_ok=True)
    codes, cases = code_at(options.before, kept) | this_code(), fixed_cases(options.data.resolve(), options.cases)
    left_out = REPEATED | (WORDS if options.any_words else set()) | set(options.without)
    compare = partial(compared, kept=kept, codes=codes, anew=options.anew, left_out=left_out)
    ratios, differing = [], 0
    with pool(options.jobs) as workers:
        for case, (verdict, phrases, ratio) in zip(cases, workers.map(compare, cases), strict=True):
            differing += bool(phrases)
            ratios += [ratio] if ratio is not None else []
            print(f"{case.name}: {verdict}, " + ("\n    ".join(["DIFFERS in", *phrases]) if phrases else "the same"), flush=True)
    print(f"{differing} of {len(cases)} answers differ ({' and '.join(codes)})")
    if ratios:
        print(f"processor time: {median(ratios):.3f} of that before (median of {len(ratios)})")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
