"""Files for the fuzz of the command line: one sound file of every kind, and many spoilt in a known way (benchmarks/fuzz_commands.py)."""

import copy
import json
import os
import random
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from palpd.cell.cell_file import nominal
from palpd.compensation.train import train
from palpd.config import Config, Plan
from palpd.daemon.motion_job import Job
from palpd.daemon.simulated_run import run
from palpd.recording.mcap_file import RecordingWriter
from palpd.recording.reader import Recording, samples_of
from palpd.recording.samples import write_csv

DIGITS = "9" * 5000
"""A whole number that Python itself refuses to convert."""
SCALARS: dict[str, tuple[str, bool]] = {
    "text for a number": ("tall", True),
    "NaN": (".nan", True),
    "infinity": ("-.inf", True),
    "1e300": ("1e300", False),
    "-1e300": ("-1e300", False),
    "1e-300": ("1e-300", False),
    "5000 digits": (DIGITS, True),
    "true for a number": ("true", True),
    "yes for a number": ("yes", True),
    "list for a number": ("[1, 2]", True),
    "block for a number": ("{a: 1}", True),
    "decimal comma": ("'1,5'", True),
    "hexadecimal": ("0x10", True),
    "sexagesimal": ("1:30", True),
    "python tag": ("!!python/object/apply:os.system [true]", True),
}
"""Values in the place of a number, and whether every number refuses them."""
TEXTS = {
    "no text": '""',
    "root folder": "/",
    "NUL": '"a\\0b"',
    "newline": '"a\\nb"',
    "5000 letters": "x" * 5000,
    "home": "~/x",
    "no value": "null",
    "emoji": "😀",
    "half a surrogate": '"\\ud800"',
}
REFUSED_TEXTS = ("NUL", "half a surrogate")
"""Values in the place of a text, and those that every key refuses."""
CELLS = {
    "NaN": "nan",
    "infinity": "inf",
    "text": "N/A",
    "empty cell": "",
    "hexadecimal": "0x1F",
    "5000 digits": DIGITS,
    "two points": "1.2.3",
    "1e999": "1e999",
    "1e300": "1e300",
    "NUL": "1\x002",
}
"""What stands in a cell of a table and is no number that a force can have."""
PLAN = {
    "sites": [{"name": "A", "x_m": 0.0, "y_m": 0.0}],
    "mode": "dynamic",
    "depths_m": [0.004, 0.006],
    "press_speed_m_per_s": 0.01,
    "repeats": 1,
    "hold_s": 0.5,
    "safe_height_m": 0.01,
    "search": {"speed_m_per_s": 0.02, "max_travel_m": 0.08},
}
CELL = {
    "probe": {"mass_kg": 0.2, "tip_radius_m": 0.005, "tip_length_m": 0.08},
    "tissue": {"surface_z_m": 0.0, "youngs_modulus_Pa": 62500.0, "poisson_ratio": 0.5},
}


class SpoiltFile(NamedTuple):
    """A file with a known fault; `refused` says that accepting it is a wrong answer, `same` that it must be read as the sound one."""

    path: str
    kind: str
    refused: bool = True
    same: bool = False


def sound_files(folder: Path) -> dict[str, Path]:
    """Write one sound file of every kind into a folder; returns them by the name of their kind."""
    folder.mkdir(parents=True)
    config = {
        "robot": {"host": "127.0.0.1", "watchdog_Hz": 20.0},
        "sensor": {"port": str(folder / "no-sensor"), "rate_Hz": 1000.0},
        "safety": {"contact_limit_N": 12.0, "absolute_limit_N": 25.0, "max_speed_m_per_s": 0.05},
        "paths": {"runs": "runs", "state": "state", "write_reports": False},
        "cell": {"probe": CELL["probe"]},
    }
    for name, content in (("config", config), ("plan", PLAN), ("cell", CELL)):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    palpation = run(Job("palpation", Config(), Plan.model_validate(PLAN)), nominal(), seed=1)
    writer = RecordingWriter(folder / "run.mcap", palpation.header)
    for first in range(0, len(palpation.rows), 100):
        writer.write(palpation.rows[first : first + 100])
        writer.flush()
    writer.close({"verdict": "done", "reason": ""})
    content = (folder / "run.mcap").read_bytes()
    (folder / "run.part").write_bytes(content[: 2 * len(content) // 3])
    write_csv(folder / "run.csv", samples_of(Recording.load(folder / "run.mcap"), "A"))
    (folder / "presses.csv").write_text("x_m,y_m,youngs_modulus_Pa\n" + "".join(f"{k / 100},{k / 200},{6e4 + k}\n" for k in range(6)))
    free = run(Job("free_motion", Config(), Plan()), nominal(), seed=1)
    writer = RecordingWriter(folder / "free.mcap", free.header)
    writer.write(free.rows)
    writer.close({"verdict": "done", "reason": ""})
    train([samples_of(Recording.load(folder / "free.mcap"))], folder / "inertial.onnx", probe_mass_kg=0.2)
    (folder / "effect.py").write_text((Path(__file__).parents[1] / "docs" / "examples" / "my_effect.py").read_text())
    names = ("config.yaml", "plan.yaml", "cell.yaml", "run.mcap", "run.part", "run.csv", "presses.csv", "free.mcap", "effect.py")
    kinds = ("config", "plan", "cell", "mcap", "part", "csv", "presses", "free", "effect")
    return dict(zip(kinds, (folder / name for name in names), strict=True)) | {"model": folder / "inertial.onnx"}


def spoilt_files(sound: dict[str, Path], folder: Path, random_state: random.Random) -> dict[str, list[SpoiltFile]]:
    """Write the spoilt files.

    Args:
        sound: What `sound_files` returned.
        folder: Where they are written.
        random_state: Source of the random bytes.

    Returns:
        The spoilt files by the name of the kind that they take the place of.
    """
    spoilt: dict[str, list[SpoiltFile]] = {}
    for kind, path in sound.items():
        here = folder / kind
        here.mkdir(parents=True)
        spoilt[kind] = [*_no_files(here, path.suffix), *_other_bytes(here, path, random_state)]
        if path.suffix == ".yaml":
            spoilt[kind] += _yaml_faults(here, path)
        elif path.suffix == ".csv":
            spoilt[kind] += _table_faults(here, path)
        elif path.suffix in (".mcap", ".part"):
            spoilt[kind] += _flipped(here, path, random_state)
    spoilt["config"] += _forged_cards(folder / "model", sound)
    spoilt["effect"] += _effect_faults(folder / "effect")
    return spoilt


def _no_files(folder: Path, suffix: str) -> list[SpoiltFile]:
    """Names behind which no regular file stands."""
    (folder / f"folder{suffix}").mkdir()
    os.mkfifo(folder / f"pipe{suffix}")
    (folder / f"loop{suffix}").symlink_to(f"loop{suffix}")
    (folder / f"zero{suffix}").symlink_to("/dev/zero")
    (folder / f"tty{suffix}").symlink_to("/dev/ptmx")
    (folder / f"secret{suffix}").write_text("a: 1\n")
    (folder / f"secret{suffix}").chmod(0)
    (folder / "file").write_text("")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(folder / f"socket{suffix}"))
    places = {
        "missing": f"missing{suffix}",
        "folder": f"folder{suffix}",
        "pipe": f"pipe{suffix}",
        "loop of links": f"loop{suffix}",
        "/dev/zero": f"zero{suffix}",
        "terminal": f"tty{suffix}",
        "unreadable": f"secret{suffix}",
        "socket": f"socket{suffix}",
        "under a file": f"file/x{suffix}",
        "name too long": "n" * 300 + suffix,
        "newline in the name": f"a\nb{suffix}",
    }
    return [*(SpoiltFile(str(folder / name), kind) for kind, name in places.items()), SpoiltFile("", "empty name")]


def _writer(folder: Path, suffix: str) -> Callable[[str, bytes], str]:
    def write(kind: str, content: bytes) -> str:
        path = folder / f"{kind.replace(' ', '-').replace('/', '-')}{suffix}"
        path.write_bytes(content)
        return str(path)

    return write


def _other_bytes(folder: Path, sound: Path, random_state: random.Random) -> Iterator[SpoiltFile]:
    """Content that is not what the name says."""
    write, content = _writer(folder, sound.suffix), sound.read_bytes()
    yield SpoiltFile(write("empty", b""), "empty", sound.suffix != ".py")
    yield SpoiltFile(write("binary", b"\x89\xff" + random_state.randbytes(3000)), "binary")
    yield SpoiltFile(write("zeros", bytes(3000)), "zeros")
    yield SpoiltFile(write("half a UTF-8 letter", content[:40] + b"\xc3"), "half a letter")
    for share in (0.03, 0.3, 0.7, 0.99):
        whole = sound.suffix in (".yaml", ".csv", ".part", ".py")  # may happen to end where a line ends
        yield SpoiltFile(write(f"cut at {share}", content[: int(share * len(content))]), "truncated", not whole)
    huge = Path(write("huge", b""))
    os.truncate(huge, 3_000_000_000)
    yield SpoiltFile(str(huge), "huge")
    if sound.suffix in (".yaml", ".csv", ".py"):
        text = content.decode()
        yield SpoiltFile(write("UTF-16", text.encode("utf-16")), "UTF-16")
        yield SpoiltFile(write("UTF-32", text.encode("utf-32-be")), "UTF-32")
        yield SpoiltFile(write("one long line", b"a," * 150_000), "one long line")
        yield SpoiltFile(write("BOM", b"\xef\xbb\xbf" + content), "byte order mark", False, sound.suffix != ".py")
        yield SpoiltFile(write("CRLF", text.replace("\r", "").replace("\n", "\r\n").encode()), "CRLF", False, True)


def _yaml_faults(folder: Path, sound: Path) -> Iterator[SpoiltFile]:
    write, text = _writer(folder, ".yaml"), sound.read_text()
    content = yaml.safe_load(text)
    first, alike = next(iter(content)), list(zip("abcdefg", "bcdefgh", strict=True))
    whole = {
        "deeply nested": "[" * 5000,
        "nested blocks": "".join(" " * level + "a:\n" for level in range(500)),
        "duplicate key": text + f"{first}: {{}}\n",
        "unknown key": text + "colour: red\n",
        "list at the top": "- 1\n- 2\n",
        "number at the top": "5\n",
        "5000 digits at the top": DIGITS,
        "tabs": f"{first}:\n\t- 1\n",
        "semicolons": text.replace(":", ";"),
        "two documents": text + "---\n" + text,
        "aliases": "a: &a [1,1,1,1,1,1,1,1,1]\n" + "".join(f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in alike),
        "alias of itself": "a: &a [*a]\n",
        "unknown alias": "a: *b\n",
        "block as key": "? {a: 1}\n: 2\n",
        "unclosed quote": text + 'x: "abc\n',
        "control letter": text + "x: \x07\n",
        "merge key": text + "<<: 5\n",
        "JSON NaN": '{"a": NaN}',
        "emoji key": "😀: 1\n",
    }
    for kind, spoilt in whole.items():
        yield SpoiltFile(write(kind, spoilt.encode()), kind)
    for place in _places(content, (), str):
        name = ".".join(map(str, place))
        for kind, value in TEXTS.items():
            yield SpoiltFile(write(f"{kind} at {name}", _with(content, place, value).encode()), kind, kind in REFUSED_TEXTS)
    for place in _places(content, (), int | float):
        name, is_switch = ".".join(map(str, place)), isinstance(_value_at(content, place), bool)
        for kind, (value, refused) in SCALARS.items():
            spoilt = write(f"{kind} at {name}", _with(content, place, value).encode())
            yield SpoiltFile(spoilt, kind, refused and not (is_switch and value in ("true", "yes")))
    for key in content:
        for value in ("5", "[]", "'x'", "[[1]]"):
            if not (isinstance(content[key], int | float | str) or (value == "[]" and key == "depths_m")):
                yield SpoiltFile(write(f"{value} for {key}", _with(content, (key,), value).encode()), "wrong type")


def _places(content: Any, at: tuple[str | int, ...], kind: Any) -> Iterator[tuple[str | int, ...]]:
    """Where values of that kind stand."""
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    if isinstance(content, kind):
        yield at
    for key, value in inner:
        yield from _places(value, (*at, key), kind)


def _value_at(content: Any, place: tuple[str | int, ...]) -> Any:
    for key in place:
        content = content[key]
    return content


def _with(content: Any, place: tuple[str | int, ...], value: str) -> str:
    """YAML with this text in a value's place."""
    changed = copy.deepcopy(content)
    inside = changed
    for key in place[:-1]:
        inside = inside[key]
    inside[place[-1]] = "PLACE"
    return yaml.safe_dump(changed, sort_keys=False).replace("PLACE", value)


def _table_faults(folder: Path, sound: Path) -> Iterator[SpoiltFile]:
    write, text = _writer(folder, ".csv"), sound.read_text()
    lines = text.splitlines()
    header, rows = lines[0].split(","), [line.split(",") for line in lines[1:]]

    def table(head: list[str], body: list[list[str]], delimiter: str = ",") -> bytes:
        return ("\n".join(delimiter.join(cells) for cells in [head, *body]) + "\n").encode()

    def cell(value: str) -> bytes:
        middle = len(rows) // 2
        column = next(k for k, name in enumerate(header) if name in ("fz_N", "youngs_modulus_Pa"))
        changed = [*rows[middle][:column], value, *rows[middle][column + 1 :]]
        return table(header, [*rows[:middle], changed, *rows[middle + 1 :]])

    commas = [[value.replace(".", ",") for value in row] for row in rows]
    alike = {
        "semicolons": table(header, rows, ";"),
        "tabs": table(header, rows, "\t"),
        "comments": ("# made by hand, on a Monday\n" + lines[0] + "\n# a note; another\n" + "\n".join(lines[1:]) + "\n").encode(),
        "decimal commas and semicolons": table(header, commas, ";"),
        "decimal commas and tabs": table(header, commas, "\t"),
        "quoted cells": table([f'"{name}"' for name in header], rows),
        "blank lines": text.replace("\n", "\n\n").encode(),
    }
    for kind, content in alike.items():
        yield SpoiltFile(write(kind, content), kind, False, True)
    for kind, value in CELLS.items():
        yield SpoiltFile(write(f"{kind} in a cell", cell(value)), f"{kind} in a cell")
    whole = {
        "header alone": table(header, []),
        "no header": table(rows[0], rows[1:]),
        "missing column": table(header[1:], [row[1:] for row in rows]),
        "column twice": table([header[0], *header], [[row[0], *row] for row in rows]),
        "decimal commas and commas": table(header, commas),
        "short row": table(header, [*rows[:3], rows[3][:2], *rows[4:]]),
        "spaces for commas": table(header, rows, " "),
        "semicolons in one row": table(header, [*rows[:3], [";".join(rows[3])], *rows[4:]]),
        "unclosed quote": b"" if header[0] != "t_s" else (lines[0] + '\n"' + "\n".join(lines[1:])).encode(),
    }
    if header[0] == "t_s":
        whole["time backwards"] = table(header, rows[::-1])
        whole["time stands still"] = table(header, [[rows[0][0], *row[1:]] for row in rows])
        whole["three rows"] = table(header, rows[:3])
    for kind, content in whole.items():
        yield SpoiltFile(write(kind, content), kind)


def _flipped(folder: Path, sound: Path, random_state: random.Random) -> Iterator[SpoiltFile]:
    write, content = _writer(folder, sound.suffix), sound.read_bytes()
    for number in range(40):
        damaged = bytearray(content)
        for _ in range(random_state.choice((1, 1, 4, 30))):
            damaged[random_state.randrange(len(damaged))] ^= 1 << random_state.randrange(8)
        yield SpoiltFile(write(f"flipped {number}", bytes(damaged)), "flipped bits", False, sound.suffix == ".mcap")
    for header in ("5", "[]", '{"sites": 5}', '{"sites": [5]}', '{"body": null}', '{"config": 5}', "[" * 5000, DIGITS, "", "{}"):
        yield SpoiltFile(write(f"header {header[:20]!r} {len(header)}", _with_header(content, header)), "forged header")


def _with_header(content: bytes, header: str) -> bytes:
    """An MCAP file with that text for the recording's header."""
    from io import BytesIO

    from mcap.writer import Writer

    stream = BytesIO()
    writer = Writer(stream)
    writer.start(profile="ros2", library="palpd")
    writer.add_metadata("palpd.header", {"json": header})
    writer.finish()
    head = stream.getvalue()
    end_of_header = 8 + 9 + int.from_bytes(content[9:17], "little")
    begin_of_ours = 8 + 9 + int.from_bytes(head[9:17], "little")
    ours = head[begin_of_ours : begin_of_ours + 9 + int.from_bytes(head[begin_of_ours + 1 : begin_of_ours + 9], "little")]
    theirs = end_of_header + 9 + int.from_bytes(content[end_of_header + 1 : end_of_header + 9], "little")
    return content[:end_of_header] + ours + content[theirs:]


def _forged_cards(folder: Path, sound: dict[str, Path]) -> Iterator[SpoiltFile]:
    """Configurations that name a model whose card was forged, or whose graph is no file."""
    config = yaml.safe_load(sound["config"].read_text())
    card = json.loads(sound["model"].with_suffix(".json").read_text())
    forged: dict[str, Any] = {
        "rmse NaN": {"rmse_N": float("nan")},
        "rmse text": {"rmse_N": "small"},
        "rmse of 5000 digits": {"rmse_N": "DIGITS"},
        "ranges of 1e400": {"input_range": {key: [0, "1E400"] for key in card["input_range"]}},
        "ranges reversed": {"input_range": {key: value[::-1] for key, value in card["input_range"].items()}},
        "ranges as text": {"input_range": "wide"},
        "range in a range": {"input_range": {key: [[0, 1], [2, 3]] for key in card["input_range"]}},
        "mass of another probe": {"probe": {"mass_kg": 5.0}},
        "mass NaN": {"probe": {"mass_kg": float("nan")}},
        "mass of 5000 digits": {"probe": {"mass_kg": "DIGITS"}},
        "mass true": {"probe": {"mass_kg": True}},
        "probe list": {"probe": [1]},
        "hash number": {"model_sha256": 5},
        "hash of another": {"model_sha256": "0" * 64},
        "schema of another": {"schema": "other"},
        "inputs number": {"inputs": 7},
    }
    write = _writer(folder, ".json")
    for kind, change in forged.items():
        text = json.dumps(card | change).replace('"DIGITS"', DIGITS).replace('"1E400"', "1E400")
        path = Path(write(f"card {kind}", text.encode()))
        path.with_suffix(".onnx").write_bytes(sound["model"].read_bytes())
        yield _naming(path.with_suffix(".onnx"), config, f"forged card: {kind}")
    for path in (Path("/"), Path("/.."), Path("/proc/self/mem")):
        yield _naming(path, config, f"model: {path}", folder / f"model {len(str(path))}.yaml")
    for path in (folder / "pipe.onnx", folder / "zero.onnx", folder / "folder.onnx", folder / "binary.onnx", folder / "huge.onnx"):
        path.with_suffix(".json").write_text(json.dumps(card))
        yield _naming(path, config, f"model: {path.stem}")


def _naming(model: Path, config: dict[str, Any], kind: str, path: Path | None = None) -> SpoiltFile:
    path = path or model.with_suffix(".yaml")
    path.write_text(yaml.safe_dump(config | {"model": {"path": str(model)}}))
    return SpoiltFile(str(path), kind)


def _effect_faults(folder: Path) -> Iterator[SpoiltFile]:
    write = _writer(folder, ".py")
    texts = {
        "syntax error": "def (",
        "raises": "raise ValueError('no')",
        "exits": "import sys; sys.exit(0)",
        "no such module": "import no_such_module",
        "divides by zero": "1 / 0",
        "deep": "(" * 5000,
    }
    for kind, text in texts.items():
        yield SpoiltFile(write(kind, text.encode()), f"effect {kind}")
