"""Where the morning checks are kept: one file NAME.check.json beside the recording of each, and what it takes to judge the next."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from palpd.config import CheckTolerances
from palpd.documents import read_json
from palpd.errors import BadInput
from palpd.files import write_json
from palpd.history.control_charts import WATCHED, CheckedDay, DayVerdict, judged
from palpd.history.stored import CHECK, RECORDING, beside, stored_beside
from palpd.quantities import scaled

MOST_BYTES = 200_000
"""Largest file of a check: a dozen figures with their charts take 5 kB, a diagnosis 20 kB."""
HEALTHY_COMPARED = 5
"""Healthy recordings that a diagnosis compares with, the oldest of the baseline: three show how a cell varies, more take longer."""


@dataclass(frozen=True, slots=True)
class Baseline:
    """A user's word that a change was on purpose: charts begin anew at this check."""

    date: str
    note: str


@dataclass(frozen=True, slots=True)
class MorningCheck:
    """One check as it is kept.

    Attributes:
        day: What was measured.
        verdict: What the charts said of it.
        plate: File name of the recording of the plate; None where there is none.
        baseline: Where this check is the first of a new baseline, who wants it so.
        diagnosis: What `palpd diagnose --healthy` said of the puck's recording, as its out.json; None where nothing had changed.
    """

    day: CheckedDay
    verdict: DayVerdict
    plate: str | None = None
    baseline: Baseline | None = None
    diagnosis: dict[str, Any] | None = None

    @property
    def named(self) -> tuple[str, ...]:
        """Effects that the diagnosis names."""
        return tuple(str(effect["id"]) for effect in (self.diagnosis or {}).get("effects", ()))


_FILE = TypeAdapter(MorningCheck)


def kept_checks(folder: Path) -> list[tuple[Path, MorningCheck]]:
    """All checks in a folder of runs with their recordings, oldest first.

    Raises:
        BadInput: A file is damaged, or the folder cannot be read.
    """
    checks = [(path.with_name(path.name.removesuffix(CHECK) + RECORDING), check_of(path)) for path in stored_beside(folder, CHECK)]
    return sorted(checks, key=lambda each: datetime.fromisoformat(each[1].day.date).timestamp())


def check_of(path: Path) -> MorningCheck:
    """Read one file of a check. Raises BadInput."""
    try:
        check = _FILE.validate_python(read_json(path, most_bytes=MOST_BYTES))
        datetime.fromisoformat(check.day.date)
        return check
    except ValidationError as error:
        raise BadInput(f"{path} holds no check ({error.error_count()} faults); move it away, or repeat palpd check") from error
    except ValueError as error:
        raise BadInput(f"{path} holds no check ({error}); move it away, or repeat palpd check") from error


def keep_check(recording: Path, check: MorningCheck) -> Path:
    """Write a check beside its recording. Raises BadInput where it cannot be written."""
    path = beside(recording, CHECK)
    write_json(path, asdict(check), own=True)
    return path


def since_baseline(checks: Sequence[tuple[Path, MorningCheck]]) -> list[tuple[Path, MorningCheck]]:
    """The checks that count: from the last baseline on, oldest first."""
    begins = [number for number, (_, check) in enumerate(checks) if check.baseline is not None]
    return list(checks[begins[-1] if begins else 0 :])


def judge_today(folder: Path, today: CheckedDay, tolerances: CheckTolerances) -> tuple[DayVerdict, list[Path]]:
    """Judge a day by the checks that are kept.

    Args:
        folder: The folder of the runs.
        today: What was measured.

    Returns:
        The verdict, and the recordings of healthy days that a diagnosis compares with.
    """
    known = since_baseline(kept_checks(folder))
    verdicts = judged([*(check.day for _, check in known), today], tolerances)
    healthy = [path for (path, _), verdict in zip(known, verdicts, strict=False) if verdict.level == "ok" and path.exists()]
    return verdicts[-1], healthy[:HEALTHY_COMPARED]


def charts(folder: Path) -> dict[str, Any]:
    """The checks since the last baseline, and a chart of each figure, for a page.

    Args:
        folder: The folder of the runs.

    Returns:
        `checks` with date, level, sentence, baseline and what the diagnosis names; `figures` with words, unit, and columns over the checks:
        `values`, `low` and `high` in that unit, and `changed`.

    Raises:
        BadInput: A file is damaged, or the folder cannot be read.
    """
    known = [check for _, check in since_baseline(kept_checks(folder))]
    figures = []
    for name, watched in WATCHED.items():
        points = [next((point for point in check.verdict.points if point.figure == name), None) for check in known]
        there = [point for point in points if point is not None]
        if not there:
            continue
        scale, unit = (1.0, "%") if watched.unit == "%" else scaled(max(max(map(abs, point.limits)) for point in there), watched.unit)
        columns = [(None, None, None) if point is None else (point.value, *point.limits) for point in points]
        values, low, high = ([None if x is None else x / scale for x in column] for column in zip(*columns, strict=True))
        changed = [point is not None and point.changed for point in points]
        figures.append({"words": watched.words, "unit": unit, "values": values, "low": low, "high": high, "changed": changed})
    checks = [
        {
            "date": check.day.date,
            "temperature_C": check.day.temperature_C,
            "level": check.verdict.level,
            "sentence": check.verdict.sentence,
            "named": check.named,
            "baseline": check.baseline.note if check.baseline is not None else None,
        }
        for check in known
    ]
    return {"checks": checks, "figures": figures}
