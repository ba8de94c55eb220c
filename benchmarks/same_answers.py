"""Shows that a change of the code changed no decision and no diagnosis.

`python -m benchmarks.same_answers FOLDER --before CHECKOUT` replays every `*.mcap` of FOLDER with this code, and diagnoses every `*.csv`
that has a `*.yaml` beside it with this code and with the code of CHECKOUT (whose environment stands in CHECKOUT/.venv). It prints one line
for each file and ends with 1 if any decision or any `out.json` differs. Both codes run as separate processes through the command line.
Timing does not count; `--any-words` also leaves out sentences, notes and names of families, for a change that rewords them.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
TIMING_KEYS = {"seconds", "realtime_factor", "cost"}
"""Keys that measure the machine and not the code."""
WORDING_KEYS = {"sentence", "plain", "basis", "what", "notes", "family"}
"""Keys that hold words for people."""


def without(content: Any, keys: set[str]) -> Any:
    """A JSON value without some keys, at any depth.

    Args:
        content: The value.
        keys: Keys to leave out.

    Returns:
        The rest.
    """
    if isinstance(content, dict):
        return {key: without(value, keys) for key, value in content.items() if key not in keys}
    return [without(value, keys) for value in content] if isinstance(content, list) else content


def answer(checkout: Path, *arguments: str) -> dict[str, Any]:
    """Run one `palpd` command of a checkout.

    Args:
        checkout: Folder with the code and its `.venv`.
        arguments: Command and arguments, without `--json`.

    Returns:
        The content of its JSON file without timing, or its error sentence under `error`.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.json"
        command = [str(checkout / ".venv" / "bin" / "python"), "-m", "palpd", *arguments, "--json", str(out)]
        environment = os.environ | {"PALPD_EFFECTS_DIR": folder}  # an answer does not depend on who asks
        done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False, env=environment)
        if not out.exists():
            return {"error": done.stderr.strip()}
        content: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
        return {key: value for key, value in content.items() if key not in TIMING_KEYS}


def differing_keys(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Top-level keys whose values differ, or that only one of the two has.

    Args:
        before: One answer.
        after: The other answer.

    Returns:
        The keys in alphabetical order.
    """
    return sorted(key for key in before.keys() | after.keys() if before.get(key) != after.get(key))


def main() -> int:
    """Compare all files of a folder; 0 if nothing differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--before", type=Path, required=True)
    parser.add_argument("--any-words", action="store_true")
    options = parser.parse_args()
    left_out = WORDING_KEYS if options.any_words else set()
    failures = 0
    for recording in sorted(options.folder.rglob("*.mcap")):
        replayed = answer(ROOT, "replay", str(recording.resolve()))
        identical = replayed.get("decisions_identical") is True
        failures += not identical
        print(f"{recording.name}: {replayed.get('ticks', 0)} ticks, " + ("decisions identical" if identical else f"DIFFERS {replayed}"))
    pairs = [(csv, csv.with_suffix(".yaml")) for csv in sorted(options.folder.rglob("*.csv")) if csv.with_suffix(".yaml").exists()]
    for recording, cell in pairs:
        arguments = ("diagnose", str(recording.resolve()), "--cell", str(cell.resolve()))
        before, after = answer(options.before.resolve(), *arguments), answer(ROOT, *arguments)
        keys = differing_keys(without(before, left_out), without(after, left_out))
        failures += bool(keys)
        print(f"{recording.name}: {after.get('verdict')}, " + ("out.json equal" if not keys else f"DIFFERS in {', '.join(keys)}"))
    print(f"{failures} of the files differ")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
