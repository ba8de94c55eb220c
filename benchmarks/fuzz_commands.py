"""Thousands of bad command lines: does every command refuse them in one sentence, at once, and leave no half-written file?

`python -m benchmarks.fuzz_commands [--lines N] [--seconds S] [--seed N] [--real N] [--only COMMAND]`. In sound command lines one
word is spoilt: an input with a known fault (benchmarks/fuzz_inputs.py), an output that cannot be written, an
option out of range, unknown, missing or contradicting another. Each line runs in a forked process with its own folder and 10 s; `--real`
of them run as processes of their own besides. Prints a table; ends with 1 if a line is not clean.

Clean is exit 2 (or 3) with exactly one sentence on stderr and no new file, or exit 0 with whole files where the line is sound; and every
input is what it was, by its hash. As root the
fuzz gives up the right to read and write everything, and mounts a full disk in a name space of its own; where it may not,
no full disk is tried.
"""

import argparse
import contextlib
import hashlib
import json
import math
import os
import random
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import types
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

LIMIT_S = 10.0
"""Longest time for one line; a refusal takes 0.1 s, and the machine may be busy."""
REAL_LIMIT_S = 40.0
"""The same for a process of its own, whose imports take 1 s, and 12 s on a machine with five times too much to do."""
MEMORY_BYTES = 6_000_000_000
"""Address space of one line; a line that needs more than this for a bad file has read too much of it."""
RIGHTS = "-dac_override,-dac_read_search,-fowner"
"""What root gives up, so that unreadable files are unreadable."""
LINES = """
run --config {config} --plan {plan} --json {out.json}
setup {folder} --robot 127.0.0.1 --skip weight
commission --config {config} --report --cell-out {out.yaml} --json {out.json}
calibrate --config {config}
free-motion --out {new.mcap} --config {config}
stiffness --config {config} --json {out.json}
level-test --config {config}
check --config {config} --temperature-C 21
inject --config {config} --plan {plan} --cell {cell} --times 2 --json {out.json}
inject --config {config} --open {mcap} --cell {cell} --json {out.json}
retract --config {config}
demo --json {out.json} --out {folder}
sim --plan {plan} --config {config} --cell {cell} --json {out.json}
emulate --cell {cell} --effects {effect} --sensor-link link
serve --config {config}
web --config {config} --port 8700 --plan {plan} --listen 127.0.0.1 --name localhost
status --config {config} --json {out.json}
arm --config {config}
start {plan} --config {config}
pause --config {config}
resume --config {config}
abort --config {config}
clear --config {config}
recover-robot --config {config} --json {out.json}
jobs --config {config} --json {out.json}
plans --config {config} --json {out.json}
job 20260714-101502-map --config {config} --json {out.json}
controls --config {config}
stream --config {config} --metrics 9464
alarms --config {config} --test --json {out.json}
init {folder} --depths-mm 2,3
install --prefix {folder}
doctor --config {config} --watch-s 1 --json {out.json}
migrate {config} --dry-run
migrate {plan} --old {new.yaml} --dry-run
migrate {cell} --kind cell --old {new.yaml} --dry-run
check-config {config} --plan {plan} --json {out.json}
runs --config {config} --json {out.json}
info {mcap} --config {config} --json {out.json}
report {mcap} --out {out.html} --pdf {out.pdf} --config {config}
replay {csv} --config {config} --json {out.json}
replay {mcap} --json {out.json}
export {mcap} --csv {new.csv} --site A
export {mcap} --parquet {new.parquet} --site A
recover {part}
import {csv} --csv {new.csv} --force-column fz_N --height-column z_m --time-column t_s
cell-from {csv} --out {new.yaml} --tip-radius-m 0.005
cell-from {mcap} --out {new.yaml} --site A
analyse {csv} --force-column fz_N --height-column z_m --tip-radius-m 0.005 --json {out.json}
analyse {mcap} --site A --json {out.json}
analyse {csv} --cell {cell} --json {out.json}
train {free} --out {new.onnx} --config {config}
map --presses {presses} --out {out.png} --json {out.json}
diagnose {mcap} --cell {cell} --site A --json {out.json}
diagnose {csv} --cell {cell} --json {out.json} --cell-out {out.yaml} --report {out.html} --effects {effect}
resolve --config {config} --recording {csv} --cell {cell} --rounds 1 --yes --effects {effect} --out {folder} --json {out.json}
resolve --config {config} --plan {plan} --rounds 1 --yes --out {folder}
simulate {csv} --cell {cell} --csv {new.csv} --effects {effect}
export-sim {cell} --to mujoco --out {folder}
tolerances {csv} --cell {cell} --json {out.json}
effects --effects {effect} --cell {cell} --json {out.json}
blind --cases 1 --jobs 1 --json {out.json} --docs {folder} --keep {folder}
study --out {folder} --free {mcap} --palpation {mcap} --json {out.json}
arena plant --cases {plan} --to {folder} --number 1
"""
"""Sound lines; a word in braces is an input of that kind, or an output: out.* may be replaced, new.* must not exist, folder is made."""
CONTRADICTIONS = """
map --presses {presses} --emulated
map --presses {presses} --config {config}
map --out /
map --out {csv}/x.png
map --emulated --config {config}
analyse {csv} --depth-column z_m --height-column z_m --force-column fz_N --tip-radius-m 0.005
analyse {csv} --depth-column z_m --height-down-positive --force-column fz_N --tip-radius-m 0.005
analyse {csv} --force-column fz_N --height-column z_m
analyse {csv} --force-column no_such --height-column z_m --tip-radius-m 0.005
inject --config {config} --report --times 3
inject --config {config} --report --open {mcap}
inject --config {config} --open {mcap} --plan {plan}
inject --config {config} --plan {plan} --here --return
inject --config {config} --plan {plan} --times 0
analyse {mcap} --site Z
analyse {mcap} --tip-radius-m 0.005
analyse {csv} --cell {cell} --force-column fz_N
import {csv} --force-column fz_N
job x --agree --cancel
runs {mcap} --tag good --since 2026-01-01
export {mcap} --csv out.csv --site Z
export {mcap}
export {mcap} --parquet out.csv
export {mcap} --csv out.parquet
migrate {csv}
migrate {plan} --kind cell
migrate {mcap}
runs --tag good
runs --folder {config}
runs --since yesterday
runs {mcap}
runs {mcap} --tag two,words
runs no-such-run --tag good
runs --most 0
info no-such-run
info {csv}
report {mcap} --beside no-such-run
report {mcap} --out x.html --pdf x.png
report {mcap} --out {csv}/x.html
study --published --free {mcap}
study --free {mcap}
study --cell A
study --palpation {mcap}
diagnose {csv}
diagnose {csv} --cell {cell} --effects {cell}
effects no.such.effect
effects --adopt {cell} --name learned.mine
effects --remove learned.nothing
effects tissue.inclusion tissue.no
blind --ablation everything
blind --source everything
blind --source drawn --recordings {folder}
blind --source injected --causes {plan}
blind --source injected --recordings {folder} --causes {plan}
blind --compare {plan}
train {free} --out model.txt
train {free} --out model.onnx --method magic
recover {mcap}
recover {csv}
replay {part}
export {part} --csv out.csv
export {csv} --csv out.csv
demo --effect no.such.effect
demo --effect {plan}
import {csv} --csv {csv}
simulate {csv} --cell {cell} --csv {csv}
export-sim {cell} --to mujoco --out {csv}
export-sim {cell} --to mujoco --out new --seed 1
export-sim {cell} --to fmu --out new --randomise 0
export-sim {cell} --to fmu --out new --randomise 3
export-sim {cell} --to fmu --out new --site Z
export-sim {csv} --to fmu --out new
emulate --host 300.300.300.300
emulate --host 192.0.2.1
emulate --cell {plan}
sim --config {plan} --plan {plan}
sim --config {config} --plan {config}
check-config {csv}
check-config {config} {plan}
import {csv} --csv out.csv --force-column fz_N --height-column z_m --time-column z_m
diagnose {csv} --cell {cell} --site A
diagnose {mcap} --cell {cell} --site Z
cell-from {csv} --out {csv}
cell-from {csv} --out out.yaml --tip-radius-m 5
import {csv} --csv out.csv --column fx=fx_N
import {csv} --csv out.csv --axis z --force-column fz_N --height-column z_m --time-column t_s
import {csv} {csv} --csv out.csv --force-column fz_N --height-column z_m --time-column t_s
import {csv} --csv out.csv --tare-s -1
import {cell} --csv out.csv
import {presses} --csv out.csv --force-column youngs_modulus_Pa --height-column x_m
abort --config {config} --socket {csv}
abort now
init {config}
init {folder} --depths-mm deep
init {folder} --depths-mm 2,,-3
init {folder} --depths-mm nan
init {folder} --depths-mm 1e300
init {folder} --depths-mm 900
init {folder} --limit-N 1 --depths-mm 8
retract {config}
retract --socket {csv}
status --json
status --socket
stream --config {config}
stream --force {csv} --config {config}
web --port 70000 --config {config}
"""
SLOW = ("diagnose", "resolve", "serve", "blind", "study", "demo", "emulate", "stream", "web")
"""Commands that work for long, or for ever, on what they accept: they are given only what they must refuse."""
NO_DEVICE = (
    "run", "check", "inject", "calibrate", "free-motion", "stiffness", "level-test", "retract", "status", "arm", "start", "pause", "resume",
    "abort", "clear", "recover-robot", "jobs", "job", "plans", "controls", "alarms",
)  # fmt: skip
"""Commands that need a daemon, devices or addresses of alarms, which are not there: they refuse every line."""
FINE = {("map", "header alone"), ("import", "unclosed quote"), ("analyse", "unclosed quote"), ("simulate", "three rows")}
FINE |= {("import", "spaces for commas"), ("import", "UTF-16"), ("recover", "forged header")}
FINE |= {("migrate", "hexadecimal"), ("migrate", "sexagesimal")}
"""Faults that a command need not refuse: no press yet; rows before the numbers, which it counts and names; a short motion; tables of other
separators and encodings, which an import reads; ticks that are whole behind a header with odd values, which every command refuses that
reads them; numbers of YAML 1.1, which a migration writes anew."""
NUMBERS = ("nan", "inf", "-inf", "-1", "0", "1e300", "1e-300", "9" * 5000, "10000000000000000000", "0x10", "1,5", "", "one", " ", "1_000")
SURE = ("nan", "inf", "-inf", "1e300", "9" * 5000, "0x10", "1,5", "", "one", " ")
"""Numbers that no option accepts."""
PRECIOUS = {"itself": "", "link": "link to:", "hard": "hard link to:"}
"""How an output is an input: its path, or the mark of a link that is made to it."""
COMPARED = ("youngs_modulus_Pa", "peak_force_N", "verdict", "next_m")
"""Figures that must not depend on how a file is spelled."""


class Line(NamedTuple):
    """One command line; `refused` says that exit 0 is a wrong answer, `same` that the figures must be those of `sound`."""

    words: tuple[str, ...]
    kind: str
    refused: bool
    sound: tuple[str, ...] = ()
    same: bool = False


class LineOutcome(NamedTuple):
    """How a line ended: `verdict` is one of CLEAN or UNCLEAN, `detail` the last line on stderr or what is wrong."""

    verdict: str
    detail: str
    took_s: float


CLEAN = ("refused", "stopped", "done")
UNCLEAN = ("traceback", "hang", "half-written", "wrong answer", "no sentence", "input changed")
MOST_HASHED_BYTES = 50_000_000
"""Largest input that is hashed after each line; a sparse one of 2 GB stands for a file that is too large."""


# --- the lines ----------------------------------------------------------------------------------------------------------------


def lines(sound: dict[str, Path], spoilt: dict[str, Any], outputs: list[tuple[str, str]]) -> Iterator[Line]:
    """Every bad command line."""
    for template in LINES.strip().splitlines():
        words = template.split()
        good = tuple(_filled(word, sound) for word in words)
        for at, word in enumerate(words):
            if not word.startswith("{"):
                continue
            kind = word[1:-1]
            for file in spoilt.get(kind, ()):
                if (file.refused and not (words[0] in SLOW and "model" in file.path)) or words[0] not in SLOW:
                    unread = "model" in file.path and words[0] not in ("doctor", "replay")
                    unread = unread or (words[0] == "simulate" and file.kind.endswith(" in a cell"))  # a force, which it does not read
                    refused = (file.refused and not unread and (words[0], file.kind) not in FINE) or words[0] in NO_DEVICE
                    yield Line((*good[:at], file.path, *good[at + 1 :]), f"{kind}: {file.kind}", refused, good, file.same)
            if kind not in spoilt:
                yield from _bad_outputs(good, at, kind, outputs)
                yield from _precious_outputs(good, at, [str(path) for path in sound.values() if path.is_file()])
    for template in CONTRADICTIONS.strip().splitlines():
        yield Line(tuple(_filled(word, sound) for word in template.split()), "contradiction", refused=True)
    yield from _bad_options(sound)


def _linked(words: tuple[str, ...], here: Path) -> tuple[str, ...]:
    """The same line, with the links that it asks for made in its folder."""
    spelled_out = list[str]()
    for word in words:
        link = next((link for link, mark in PRECIOUS.items() if mark and word.startswith(mark)), None)
        target = word.removeprefix(PRECIOUS[link]) if link else word
        if link is not None:
            word = f"{link}{Path(target).suffix}"
            (here / word).symlink_to(target) if link == "link" else os.link(target, here / word)
        spelled_out.append(word)
    return tuple(spelled_out)


def _filled(word: str, sound: dict[str, Path]) -> str:
    kind = word.strip("{}")
    return str(sound[kind]) if word.startswith("{") and kind in sound else kind


def _bad_outputs(good: tuple[str, ...], at: int, kind: str, outputs: list[tuple[str, str]]) -> Iterator[Line]:
    suffix = Path(kind).suffix
    for place, fault in outputs:
        if kind == "folder" and fault in ("missing folder", "folder", "empty name", "root folder"):  # sound places for a folder
            continue
        path = place.replace("SUFFIX", suffix)
        yield Line((*good[:at], path, *good[at + 1 :]), f"output: {fault}", refused=True)
    if kind.startswith("new"):
        yield Line((*good[:at], "there" + suffix, *good[at + 1 :]), "output: exists", refused=True)


def _precious_outputs(good: tuple[str, ...], at: int, read: list[str]) -> Iterator[Line]:
    """The output at a place is an input of the line, a link to one, a recording, or another output; with and without force."""
    inputs = [word for word in good if word in read]
    recording = next(path for path in read if path.endswith(".mcap"))
    others = [word for k, word in enumerate(good) if k != at and word.startswith(("out.", "new."))]
    places = [*(f"{PRECIOUS[link]}{path}" for path in inputs for link in PRECIOUS), recording, *others]
    for place in places:
        for force in ((),) if good[0] in ("stream", "recover") else ((), ("--force",)):
            yield Line((*good[:at], place, *good[at + 1 :], *force), "output: precious", refused=True)


def _bad_options(sound: dict[str, Path]) -> Iterator[Line]:
    """Unknown options, options without a value, numbers out of range and unknown words, for every option of every command."""
    goods: dict[str, tuple[str, ...]] = {}
    for template in LINES.strip().splitlines():
        goods.setdefault(template.split()[0], tuple(_filled(word, sound) for word in template.split()))
    for words in (("no-such-command",), ("diagnos",), ("--colour",)):
        yield Line(words, "unknown command", refused=True)
    for name, options in _options().items():
        good = goods[name]
        yield Line((*good, "--colour"), "unknown option", refused=True)
        yield Line((*good, "--colour=red"), "unknown option", refused=True)
        yield Line((*good, "one too many", "two"), "too many words", refused=True)
        for option, kind in options.items():
            if kind is bool:
                yield Line((*good, f"{option}=maybe"), "flag with value", refused=True)
                continue
            yield Line((*good, option), "option without value", refused=True)
            if kind in (int, float):
                for number in SURE if name in SLOW else NUMBERS:
                    yield Line((*good, f"{option}={number}"), f"number {number[:9]!r}", number in SURE)
            elif get_origin(kind) is Literal:
                for word in ("", "no-such-word", "N N"):
                    yield Line((*good, f"{option}={word}"), "unknown word", refused=True)


def spelled(info: Any) -> str:
    """How a parameter of typer is spelled on a command line; empty for an argument."""
    names = (info.default, *(info.param_decls or ()))
    return next((name.partition("/")[0] for name in names if isinstance(name, str) and name.startswith("--")), "")


def _options() -> dict[str, dict[str, Any]]:
    """Type of each option of each command."""
    import typer

    from palpd.cli.application import app

    known: dict[str, dict[str, Any]] = {}
    for command in app.registered_commands:
        callback: Any = command.callback
        options = known.setdefault(command.name or callback.__name__.replace("_", "-"), {})
        for hint in get_type_hints(callback, include_extras=True).values():
            kind, *about = get_args(hint) if get_origin(hint) is Annotated else (hint,)
            for info in about:
                if isinstance(info, typer.models.OptionInfo):
                    inner = [each for each in get_args(kind) if each is not type(None)]
                    options[spelled(info)] = inner[0] if isinstance(kind, types.UnionType) else kind
    return known


def bad_outputs(folder: Path, full: Path | None) -> list[tuple[str, str]]:
    """Places that cannot be written, made in a folder; SUFFIX stands for the ending of the file."""
    (folder / "read-only").mkdir(parents=True)
    (folder / "read-only").chmod(0o555)
    for suffix in ("", ".json", ".csv", ".parquet", ".mcap", ".onnx", ".png", ".pdf", ".yaml", ".html"):
        (folder / f"folder{suffix}").mkdir()
        (folder / f"folder{suffix}" / "inside").write_text("")
        (folder / f"locked{suffix}").write_text("kept")
        (folder / f"locked{suffix}").chmod(0o444)
        (folder / f"loop{suffix}").symlink_to(f"loop{suffix}")
    return [
        ("missing/xSUFFIX", "missing folder"),
        *([] if full is None else [(f"{full}/xSUFFIX", "full disk")]),
        (f"{folder}/read-only/xSUFFIX", "read-only folder"),
        (f"{folder}/folderSUFFIX", "folder"),
        (f"{folder}/folderSUFFIX/inside/xSUFFIX", "under a file"),
        (f"{folder}/lockedSUFFIX", "read-only file"),
        (f"{folder}/loopSUFFIX", "loop of links"),
        ("/proc/xSUFFIX", "/proc"),
        ("", "empty name"),
        ("/", "root folder"),
        ("n" * 300 + "SUFFIX", "name too long"),
    ]


# --- running them -------------------------------------------------------------------------------------------------------------


def ran(line: Line, folder: Path, stamps: dict[str, bytes], real: bool = False) -> LineOutcome:
    """Run a line in a folder of its own and judge it; `stamps` are the hashes of all inputs by their paths."""
    figures = None
    if line.same:
        _run(line.sound, folder / "compared", real)
        figures = _figures(folder / "compared")
        shutil.rmtree(folder / "compared")
    began_s = time.monotonic()
    here = folder / "line"
    code, errors = _run(line.words, here, real)
    took_s = time.monotonic() - began_s
    verdict, detail = _judged(line, here, code, errors)
    if changed := [path for path, stamp in stamps.items() if _stamp(Path(path)) != stamp]:
        return LineOutcome("input changed", f"exit {code}: {', '.join(changed)}; {detail}", took_s)
    if verdict == "done" and line.same and figures != (now := _figures(here)):
        verdict, detail = "wrong answer", f"{now} where the sound file gives {figures}"
    shutil.rmtree(here)
    return LineOutcome(verdict, detail, took_s)


def _run(words: tuple[str, ...], here: Path, real: bool) -> tuple[int | None, str]:
    """Exit code, None for a hang, and what stood on stderr."""
    here.mkdir()
    for suffix in (".csv", ".parquet", ".mcap", ".onnx", ".yaml"):
        (here / f"there{suffix}").write_text("kept")
    words = _linked(words if words[0] != "recover" else _recovering(words, here), here)
    errors = here.with_name("stderr")
    if real:
        with errors.open("wb") as stderr:
            process = subprocess.Popen(
                [sys.executable, "-m", "palpd", *words],
                cwd=here, env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1]), "PALPD_EFFECTS_DIR": str(here / "effects")},
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr, start_new_session=True,
            )  # fmt: skip
        pid = process.pid
    else:
        pid = os.fork()
        if pid == 0:
            _child(words, here, errors)
    watch = os.pidfd_open(pid)
    ended = bool(select.select([watch], [], [], REAL_LIMIT_S if real else LIMIT_S)[0])
    os.close(watch)
    for end in (os.killpg, os.kill):  # what a line leaves behind ends with it
        with contextlib.suppress(ProcessLookupError):
            end(pid, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    return (code if ended else None), errors.read_text(errors="replace")


def _recovering(words: tuple[str, ...], here: Path) -> tuple[str, ...]:
    """The same line with links in its folder, since `recover` writes beside what it reads."""
    linked = [words[0]]
    for number, word in enumerate(words[1:]):
        if word.startswith("/") and len(Path(word).name) < 200:
            (here / f"{number}{Path(word).suffix}").symlink_to(word)
            word = f"{number}{Path(word).suffix}"
        linked.append(word)
    return tuple(linked)


def _child(words: tuple[str, ...], here: Path, errors: Path) -> None:
    """Be `palpd` with these words; never returns."""
    code: Any = 1
    try:
        os.setsid()
        for number, path in ((0, "/dev/null"), (1, "/dev/null"), (2, str(errors))):
            os.dup2(os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600), number)
        os.chdir(here)
        os.environ["PALPD_EFFECTS_DIR"] = str(here / "effects")
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.argv = ["palpd", *words]
        from palpd.cli import main

        try:
            main()
            code = 0
        except SystemExit as left:
            code = left.code or 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code if isinstance(code, int) else 1)


def _judged(line: Line, here: Path, code: int | None, errors: str) -> tuple[str, str]:
    printed = [each for each in errors.strip().splitlines() if each.strip()]
    last = printed[-1][:300] if printed else ""
    if code is None:
        return "hang", last
    if "Traceback" in errors or code not in (0, 2, 3):
        return "traceback", f"exit {code}: {last}"
    left = [path for path in here.rglob("*") if _is_new(path)]
    if code and (line.words[0] in ("doctor", "recover-robot", "check") or code == 3):  # these say in their JSON why
        left = [path for path in left if not (path.suffix == ".json" and _is_whole(path))]
    if any(path.name.startswith(".palpd-") or path.suffix in (".recovering", ".part") for path in left):
        return "half-written", f"left {', '.join(path.name for path in left)}"
    if code == 0:
        broken = [path.name for path in left if not _is_whole(path)]
        if broken:
            return "half-written", f"exit 0 with {', '.join(broken)}"
        return ("wrong answer", "exit 0, expected a refusal") if line.refused else ("done", "")
    if left:
        return "half-written", f"exit {code} left {', '.join(path.name for path in left)}"
    if len(printed) != 1 or not last.startswith("palpd: ") or len(last) < 20:
        return "no sentence", f"exit {code} with {len(printed)} lines: {' / '.join(printed)[:300]}"
    return ("refused" if code == 2 else "stopped"), last


def _stamp(path: Path) -> bytes:
    """What tells whether an input was changed: its bytes where it can be read, else its size; empty where it is gone."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").digest() if path.stat().st_size < MOST_HASHED_BYTES else b"large"
    except OSError:
        return b"unreadable" if os.path.lexists(path) else b""


def _is_new(path: Path) -> bool:
    return (
        path.is_file()
        and not path.is_symlink()
        and path.stem != "hard"
        and not (path.name.startswith("there.") and path.read_bytes() == b"kept")
    )


def _is_whole(path: Path) -> bool:
    from palpd.recording.reader import Recording

    try:
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".mcap":
            Recording.load(path)
        elif path.suffix in (".csv", ".html", ".yaml"):
            return path.read_bytes().endswith((b"\n", b">"))
    except Exception:
        return False
    return path.stat().st_size > 0


def _figures(here: Path) -> dict[str, Any]:
    """What must be the same for the same data: figures of the JSON, and tables to the last byte."""
    figures: dict[str, Any] = {path.name: path.read_text() for path in here.glob("new.csv")}
    for path in here.glob("out.json"):
        content = json.loads(path.read_text())
        figures |= {key: content[key] for key in COMPARED if key in content}
    return figures


# --- the whole ----------------------------------------------------------------------------------------------------------------


def _without_rights() -> None:
    """As root: go on in a mount name space of its own, without the right to read and write everything."""
    tools = ["unshare", "--mount", "setpriv", "--bounding-set", RIGHTS]
    root = os.geteuid() == 0 and "PALPDFUZZ" not in os.environ and all(map(shutil.which, ("unshare", "setpriv")))
    if root and subprocess.run([*tools, "true"], capture_output=True, check=False).returncode == 0:
        os.environ["PALPDFUZZ"] = "prepared"
        os.execvp(tools[0], [*tools, sys.executable, "-m", "benchmarks.fuzz_commands", *sys.argv[1:]])
    os.environ.pop("PALPDFUZZ", None)


def _full_disk(folder: Path) -> Path | None:
    """A file system of 16 kB that is full; None where none may be mounted."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(folder)]
    if os.geteuid() or subprocess.run(mount, capture_output=True, check=False).returncode:
        return None
    with (folder / "filler").open("wb", buffering=0) as filler:
        try:
            while True:
                filler.write(bytes(4096))
        except OSError:
            return folder


def _preload() -> None:
    """Import what the commands import, so that a forked process begins at once."""
    import importlib
    import pkgutil

    import palpd

    for module in pkgutil.walk_packages(palpd.__path__, "palpd."):
        if "__main__" not in module.name and "mujoco" not in module.name:
            importlib.import_module(module.name)
    importlib.import_module("onnx")
    importlib.import_module("sklearn.linear_model")


def _in_child(make: Any) -> None:
    """Carry out something in a process of its own, which keeps this one without threads."""
    pid = os.fork()
    if pid == 0:
        try:
            make()
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
    if os.waitpid(pid, 0)[1]:
        sys.exit("the sound files could not be made")


def main() -> int:
    """Print a table; 1 if a line is not clean."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lines", type=int, default=1500, help="how many lines are drawn; 0 for all")
    parser.add_argument("--real", type=int, default=20, help="how many of them run as processes of their own besides")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=math.inf, help="begin no further line after this time")
    parser.add_argument("--only", help="lines of this command")
    parser.add_argument("--kind", help="lines whose kind contains this")
    parser.add_argument("--verbose", action="store_true", help="print every line")
    options = parser.parse_args()
    _without_rights()
    _preload()
    folder = Path(tempfile.mkdtemp(prefix="palpd-fuzz-"))
    try:
        return _fuzz(options, folder)
    finally:
        for path in [folder, *folder.rglob("*")]:
            if path.is_dir() and not path.is_symlink():
                path.chmod(0o700)
        subprocess.run(["umount", str(folder / "full")], capture_output=True, check=False)
        shutil.rmtree(folder, ignore_errors=True)


def _fuzz(options: argparse.Namespace, folder: Path) -> int:
    from benchmarks.fuzz_inputs import sound_files, spoilt_files

    listed = folder / "files.json"

    def make() -> None:
        sound = sound_files(folder / "sound")
        spoilt = spoilt_files(sound, folder / "spoilt", random.Random(options.seed))
        listed.write_text(json.dumps([{kind: str(path) for kind, path in sound.items()}, spoilt]))

    _in_child(make)
    from benchmarks.fuzz_inputs import SpoiltFile

    sound, spoilt = json.loads(listed.read_text())
    sound = {kind: Path(path) for kind, path in sound.items()}
    spoilt = {kind: [SpoiltFile(*file) for file in files] for kind, files in spoilt.items()}
    full = _full_disk(folder / "full")
    every = list(lines(sound, spoilt, bad_outputs(folder / "places", full)))
    chosen = [line for line in every if options.only in (None, line.words[0]) and (options.kind or "") in line.kind]
    random.Random(options.seed).shuffle(chosen)
    chosen = chosen[: options.lines or None]
    stamps = {str(path): _stamp(path) for place in ("sound", "spoilt") for path in (folder / place).rglob("*") if path.is_file()}
    counts: dict[str, Counter[str]] = {}
    slowest = LineOutcome("", "", 0.0)
    chosen = [*chosen[: options.real], *chosen]
    end_s = time.monotonic() + options.seconds
    for number, line in enumerate(chosen):
        if time.monotonic() > end_s:
            break
        outcome = ran(line, folder, stamps, real=number < options.real)
        counts.setdefault(line.words[0], Counter())[outcome.verdict] += 1
        slowest = max(slowest, outcome, key=lambda each: each.took_s)
        if outcome.verdict in UNCLEAN or options.verbose:
            print(f"{outcome.verdict} ({line.kind}, {outcome.took_s:.1f} s): palpd {' '.join(word[-90:] for word in line.words)}")
            print(f"    {outcome.detail}", flush=True)
    print(f"\n{'command':<16}" + "".join(f"{verdict:>14}" for verdict in (*CLEAN, *UNCLEAN)))
    total = sum(counts.values(), Counter())
    for name, counter in [*sorted(counts.items()), ("all", total)]:
        print(f"{name[:15]:<16}" + "".join(f"{counter[verdict]:>14}" for verdict in (*CLEAN, *UNCLEAN)))
    unclean = sum(total[verdict] for verdict in UNCLEAN)
    print(f"{total.total()} lines of {len(every)} (seed {options.seed}), {unclean} not clean; the slowest took {slowest.took_s:.1f} s.")
    return 1 if unclean else 0


if __name__ == "__main__":
    sys.exit(main())
