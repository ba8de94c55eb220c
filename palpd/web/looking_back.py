"""What the page asks of the history. The functions compute in the process beside the server: what they import is too large for it.

A run is addressed by its key: its name as the listing shows it, with the bytes escaped that an address cannot hold. A name is looked up
among the recordings of the folder and never joined to a path.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, unquote

from palpd.errors import BadInput, RecordingError
from palpd.history.stored import RECORDING, recording_named, stored_recordings, unfinished_recordings

if TYPE_CHECKING:
    from palpd.history.catalogue import RunFilter

LISTED = 100
"""Runs that a list shows at first."""
MOST_LISTED = 5000
"""Most runs of a list."""
KNOWN = 500
"""Newest runs whose sites, tags and verdicts are offered for filtering."""


def key_of(name: str) -> str:
    """The key of a run: its name, with what an address cannot hold escaped."""
    return quote(name.encode("utf-8", "surrogateescape"))


def recording_of(folder: Path, key: str) -> Path:
    """The recording that a key means.

    Args:
        folder: The folder of the runs.
        key: Key of a run, as the list gives it.

    Raises:
        RecordingError: No recording of the folder is called so.
    """
    name = unquote(key, errors="surrogateescape")
    stored = stored_recordings(folder).get(name)
    if stored is not None:
        return stored.path
    if name in ("", "last") or name.endswith(RECORDING):
        return recording_named(name, folder)
    raise RecordingError(f"no recording in {folder} is called {name!r}; palpd runs lists them")


def listed(folder: Path, query: Mapping[str, str]) -> dict[str, Any]:
    """The runs that fit, newest first, as `palpd runs` lists them.

    Args:
        query: What to look for: `since`, `until`, `site`, `verdict`, `kind`, `tag`, `text`, and `most`.

    Returns:
        The runs with their keys, how many fit, the sites, tags and verdicts that there are, notes for the user, and the names of
        the recordings that were cut off, whatever the filter.

    Raises:
        BadInput: A day is none, or the folder cannot be read.
        Refused: Another process keeps the catalogue busy.
    """
    from dataclasses import replace

    from palpd.history.catalogue import Catalogue, RunFilter, as_json

    text = query.get("most", "")
    most = min(int(text), MOST_LISTED) if text.isdecimal() and len(text) < 10 else LISTED
    only = _filter(query)
    with Catalogue(folder) as catalogue:
        catalogue.refresh()
        entries, count = catalogue.runs(replace(only, most=max(1, most))), catalogue.count(only)
        known = catalogue.runs(RunFilter(most=KNOWN))
        return {
            "folder": str(folder),
            "count": count,
            "runs": [{**as_json(entry), "key": key_of(entry.name)} for entry in entries],
            "sites": sorted({site.site for entry in known for site in entry.sites}),
            "tags": sorted({tag for entry in known for tag in entry.tags}),
            "verdicts": sorted({entry.verdict for entry in known}),
            "kinds": sorted({entry.kind for entry in known} - {""}),
            "notes": list(catalogue.notes),
            "unfinished": sorted(unfinished_recordings(folder), reverse=True),
        }


def trend(folder: Path, query: Mapping[str, str]) -> dict[str, Any]:
    """Moduli and named effects of a site over the days, as `palpd runs --trend` gives them.

    Args:
        query: `site`, and which runs count, as for `listed`.

    Returns:
        Points and slopes, and notes for the user.

    Raises:
        BadInput: No run has a modulus of that site.
        Refused: Another process keeps the catalogue busy.
    """
    from dataclasses import replace

    from palpd.history.catalogue import Catalogue
    from palpd.history.trend import site_trend, trend_as_json

    site = query.get("site", "")
    with Catalogue(folder) as catalogue:
        catalogue.refresh()
        content = trend_as_json(site, *site_trend(catalogue, site, replace(_filter(query), site="")))
        return content | {"notes": [*catalogue.notes, *content["notes"]]}


def checks(folder: Path) -> dict[str, Any]:
    """The morning checks since the last baseline with their charts, and what injections say; a damaged file of these hides no check.

    Raises:
        BadInput: A file of a check is damaged.
    """
    from palpd.history.check_days import charts
    from palpd.history.injections import injection_report

    answer = charts(folder)
    try:
        return answer | {"injections": injection_report(folder)}
    except BadInput as error:
        return answer | {"injections": {"refusal": str(error)}}


def _filter(query: Mapping[str, str]) -> "RunFilter":
    from palpd.history.catalogue import RunFilter
    from palpd.history.dates import days_s

    texts: dict[str, Any] = {name: query.get(name, "") for name in ("site", "verdict", "kind", "text")}
    tag = query.get("tag", "")
    return RunFilter(*days_s(query.get("since", ""), query.get("until", "")), tags=(tag,) if tag else (), **texts)


def course_window(file: Path, begin_s: float, end_s: float) -> dict[str, Any]:
    """Force, height and depth of a run between two times.

    Args:
        file: The course, as `palpd info --course` wrote it.
        begin_s: First time since the first tick.
        end_s: Last time.

    Returns:
        The columns, with at most some 1500 points, and the duration of the whole run.

    Raises:
        BadInput: The file is no course.
    """
    from palpd.history.course import as_columns, read_course, window

    course = read_course(file)
    return {"columns": as_columns(window(course, begin_s, end_s)), "duration_s": float(course["t_s"][-1])}


def remarked(recording: Path, tags: list[str], untag: list[str], note: str) -> dict[str, Any]:
    """Add tags and a note to a run, or take tags away.

    Args:
        note: A note to add; empty for none.

    Returns:
        Tags and notes as they are then.

    Raises:
        BadInput: A tag is no word, a note is too long, or the file beside the recording cannot be written.
    """
    from palpd.history.dates import now
    from palpd.history.remarks import remark

    return {"remarks": remark(recording, now(), tags, untag, note).model_dump(mode="json")}
