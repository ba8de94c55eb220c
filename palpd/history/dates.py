"""Days as users write them, in the time zone of this computer."""

from datetime import datetime, timedelta

from palpd.errors import BadInput


def day_begin_s(day: str) -> float:
    """Unix time at which a day begins, such as 2026-11-22. Raises BadInput."""
    return _begin(day).timestamp()


def day_end_s(day: str) -> float:
    """Unix time at which a day ends. Raises BadInput."""
    try:
        return (_begin(day) + timedelta(days=1)).timestamp()
    except (OverflowError, ValueError) as error:
        raise BadInput(f"the day is {day!r}, beyond all days that can be computed; give such as 2026-11-22") from error


def days_s(since: str, until: str) -> tuple[float | None, float | None]:
    """Unix times from the begin of one day to the end of another; None for a day that is empty. Raises BadInput."""
    return day_begin_s(since) if since else None, day_end_s(until) if until else None


def now() -> str:
    """Date and time of now with time zone, ISO 8601."""
    return local_time(datetime.now().timestamp())


def local_time(at_s: float) -> str:
    """Date and time in the time zone of this computer, ISO 8601. Days that are shown are so the days by which runs are filtered.

    Args:
        at_s: Unix time.
    """
    return datetime.fromtimestamp(at_s).astimezone().isoformat(timespec="seconds")


def _begin(day: str) -> datetime:
    try:
        begin = datetime.strptime(day, "%Y-%m-%d")
        begin.timestamp()
    except (ValueError, OverflowError, OSError) as error:
        raise BadInput(f"the day is {day!r}, expected year, month and day, such as 2026-11-22") from error
    return begin
