"""Where the morning checks are kept: one file NAME.check.json beside the recording of each, and what it takes to judge the next."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from palpd.analysis.young import modulus_hertz_Pa
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
        note: How the configuration computes the puck's modulus otherwise than at the check before, and that checks are gone; or empty.
        number: Its place in the order of the checks, whatever the clock said; 0 in those of older versions, whose dates order them.
    """

    day: CheckedDay
    verdict: DayVerdict
    plate: str | None = None
    baseline: Baseline | None = None
    diagnosis: dict[str, Any] | None = None
    note: str = ""
    number: int = 0

    @property
    def named(self) -> tuple[str, ...]:
        """Effects that the diagnosis names."""
        return tuple(str(effect["id"]) for effect in (self.diagnosis or {}).get("effects", ()))


_FILE = TypeAdapter(MorningCheck)


def kept_checks(folder: Path) -> list[tuple[Path, MorningCheck]]:
    """All checks in a folder of runs with their recordings, oldest first; of copies that one with a baseline, or nearest to the top.

    Raises:
        BadInput: A file is damaged, or the folder cannot be read.
    """
    checks = [(path.with_name(path.name.removesuffix(CHECK) + RECORDING), check_of(path)) for path in stored_beside(folder, CHECK)]

    def order(kept: tuple[Path, MorningCheck]) -> tuple[int, float, bool, int]:
        path, check = kept
        return check.number, datetime.fromisoformat(check.day.date).timestamp(), check.baseline is not None, -len(path.parts)

    return list({(check.number, check.day.date): (path, check) for path, check in sorted(checks, key=order)}.values())


def check_of(path: Path) -> MorningCheck:
    """Read one file of a check. Raises BadInput."""
    try:
        check = _FILE.validate_python(read_json(path, most_bytes=MOST_BYTES))
        datetime.fromisoformat(check.day.date)
        return check
    except ValidationError as error:
        raise BadInput(f"{path} holds no check ({error.error_count()} faults); move it away, and repeat palpd check") from error
    except ValueError as error:
        raise BadInput(f"{path} holds no check ({error}); move it away, and repeat palpd check") from error


def keep_check(recording: Path, check: MorningCheck) -> Path:
    """Write a check beside its recording. Raises BadInput where it cannot be written."""
    path = beside(recording, CHECK)
    write_json(path, asdict(check), own=True)
    return path


def since_baseline(checks: Sequence[tuple[Path, MorningCheck]]) -> list[tuple[Path, MorningCheck]]:
    """The checks that count: from the last baseline on, oldest first."""
    begins = [number for number, (_, check) in enumerate(checks) if check.baseline is not None]
    return list(checks[begins[-1] if begins else 0 :])


def gone(first: MorningCheck, folder: Path) -> str:
    """Say that the commissioning is no longer in the folder, so that charts begin at a day that nobody chose; empty where it is there.

    Args:
        first: As `since_baseline` gives it.
        folder: The folder of the runs.
    """
    if first.number <= 1 or first.baseline is not None:
        return ""
    return (
        f"Checks before number {first.number} of {first.day.date[:10]} are no longer in {folder}, so the charts begin with it and show "
        "nothing that had changed before; move their files NAME.check.json back, or begin a new baseline."
    )


def by_numbers_of(day: CheckedDay, today: CheckedDay) -> CheckedDay:
    """A day whose puck's modulus is computed by the tip radius and Poisson's ratio of today, so that both can be compared.

    A number that was corrected leaves the stiffness of the puck as it was, and a tip that was exchanged its modulus. The configuration does
    not say which it was, so the modulus nearer to today's counts.
    """
    one, other = day.features, today.features
    if one.tip_radius_m is None or one.poisson_ratio is None or other.tip_radius_m is None or other.poisson_ratio is None:
        return day
    stiffness = one.puck_modulus_Pa / modulus_hertz_Pa(1.0, 1.0, one.tip_radius_m, one.poisson_ratio)
    as_today_Pa = modulus_hertz_Pa(stiffness, 1.0, other.tip_radius_m, other.poisson_ratio)
    nearer_Pa = min(one.puck_modulus_Pa, as_today_Pa, key=lambda modulus_Pa: abs(modulus_Pa - other.puck_modulus_Pa))
    return replace(day, features=replace(one, puck_modulus_Pa=nearer_Pa))


def change_of_numbers(before: CheckedDay, today: CheckedDay) -> str:
    """Say which numbers of the configuration compute the puck's modulus otherwise than a day before; empty where none does."""
    changes = [
        f"{key} from {old:g} to {new:g}"
        for key, name in (("cell.probe.tip_radius_m", "tip_radius_m"), ("cell.tissue.poisson_ratio", "poisson_ratio"))
        if None not in (old := getattr(before.features, name), new := getattr(today.features, name)) and old != new
    ]
    if not changes:
        return ""
    return (
        f"The configuration has changed since the check of {before.date[:10]} ({', '.join(changes)}), and with it the modulus of an "
        "unchanged puck; the checks before are compared by the numbers of today."
    )


def judge_today(
    kept: Sequence[tuple[Path, MorningCheck]], today: CheckedDay, tolerances: CheckTolerances
) -> tuple[DayVerdict, list[Path], str]:
    """Judge a day by the checks before it.

    Args:
        kept: As `kept_checks` gives them.
        today: What was measured.

    Returns:
        The verdict, the recordings of healthy days that a diagnosis compares with, and the note of `MorningCheck`.
    """
    known = since_baseline(kept)
    verdicts = judged([*(by_numbers_of(check.day, today) for _, check in known), today], tolerances)
    healthy = [path for (path, _), verdict in zip(known, verdicts, strict=False) if verdict.level == "ok" and path.exists()]
    return verdicts[-1], healthy[:HEALTHY_COMPARED], change_of_numbers(known[-1][1].day, today) if known else ""


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
            "sentence": f"{check.verdict.sentence} {check.note}".strip(),
            "named": check.named,
            "baseline": check.baseline.note if check.baseline is not None else None,
        }
        for check in known
    ]
    return {"checks": checks, "figures": figures}
