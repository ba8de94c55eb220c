"""The moduli of a run as they come: whenever a site is over, the recording so far is analysed beside the server.

They are those of `palpd run`, from the same functions. The recorder writes all 0.15 s, so the unfinished file holds all but the last rows.
"""

import asyncio
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict

from palpd.errors import PalpdError
from palpd.web.aside import Aside

REST = 5.0
"""Pause between two analyses, as a multiple of what the last one took: a long run is not read again all the time."""
LEAST_REST_S = 2.0
PALPATE = ("run", "map", "resolve")
"""Programs whose moduli are shown; the others leave those of the job before on the page."""
MOST_SITES = 1000
"""Sites that are kept of a job; a plan has no more, and a map 200."""


class LiveSite(TypedDict):
    """A site of the run or job under way: moduli in Pa with their 95 % intervals, and its place in the base's axes.

    `hertz_misfit` says how the moduli change with depth, where they do.
    """

    name: str
    x_m: float | None
    y_m: float | None
    static_Pa: float | None
    static_ci95_Pa: list[float] | None
    dynamic_Pa: float | None
    dynamic_ci95_Pa: list[float] | None
    peak_N: float | None
    cut_short: bool
    hertz_misfit: str | None


class LiveModuli:
    """Keeps the moduli of the job under way, or of the last one. `publish` receives an event where they have changed."""

    def __init__(self, aside: Aside, publish: Callable[[dict[str, Any]], None]) -> None:
        self._aside, self._publish = aside, publish
        self._job: str | None = None
        self._site = -1
        self._recording: Path | None = None
        self._sites: dict[str, list[LiveSite]] = {}
        self._error = ""
        self._due: Path | None = None
        self._task: asyncio.Task[None] | None = None

    def event(self) -> dict[str, Any]:
        """All sites so far, for the pages."""
        sites = [site for each in self._sites.values() for site in each]
        return {"event": "sites", "job": self._job, "sites": sites[:MOST_SITES], "error": self._error}

    def hear(self, status: dict[str, Any]) -> None:
        """Take a status of the service: has a job begun, is a site over, has a run ended?"""
        active = status.get("active")
        if active is not None and active["id"] != self._job and active["program"] in PALPATE:
            self._job, self._sites, self._error, self._site, self._recording = active["id"], {}, "", -1, None
            self._publish(self.event())
        if status.get("recording") and status.get("job") == "palpation":
            self._recording = Path(status["recording"])
            site = int(status.get("site", -1))
            if site > self._site >= 0:
                self._begin(self._recording)
            self._site = site
        elif self._recording is not None and "job" not in status:  # the run is over, and its file has got its name
            last = (status.get("last") or {}).get("recording")
            if last is not None and Path(last).stem == self._recording.stem:
                self._begin(Path(last))
            self._recording, self._site = None, -1

    def _begin(self, recording: Path) -> None:
        self._due = recording
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._analyse())

    async def _analyse(self) -> None:
        loop = asyncio.get_running_loop()
        while self._due is not None:
            recording, job, began_s, self._due = self._due, self._job, loop.time(), None
            try:
                sites, error = await self._aside.compute(moduli_of, str(recording)), ""
            except PalpdError as refused:
                sites, error = None, str(refused)
            if job == self._job:
                self._error = error
                if sites is not None:
                    self._sites[recording.stem] = sites
                self._publish(self.event())
            await asyncio.sleep(max(LEAST_REST_S, REST * (loop.time() - began_s)) if self._due is not None else 0.0)


def moduli_of(recording: str) -> list[LiveSite]:
    """Analyse a recording, also one that is still written; runs beside the server.

    Args:
        recording: Path of FILE.mcap or FILE.part.

    Returns:
        The sites that have a surface, in the order of the plan.

    Raises:
        RecordingError: The file cannot be read.
    """
    import numpy as np

    from palpd.analysis.results import sites
    from palpd.errors import RecordingError
    from palpd.recording import cdr
    from palpd.recording.mcap_file import Contents
    from palpd.tick import Phase

    path = Path(recording)
    if not path.exists():
        path = path.with_suffix(".mcap" if path.suffix == ".part" else ".part")
    contents = Contents()
    messages = [message for batch in contents.batches(path) for message in batch]
    if contents.header is None or not messages:
        raise RecordingError(f"{path} holds no tick yet; the moduli come with the first site")
    rows = cdr.unpack_ticks(messages, contents.absent)
    live: list[LiveSite] = []
    for number, site in enumerate(sites(rows, contents.header)):
        pressed = rows[(rows["site"] == number) & (rows["phase"] == Phase.PRESS)]
        if site["surface_z_m"] is None or not len(pressed):
            continue
        x_m, y_m = (float(np.median(pressed["tcp_pose"][:, axis])) for axis in (0, 1))
        live.append({
            "name": site["name"],
            "x_m": _finite(x_m),
            "y_m": _finite(y_m),
            "static_Pa": _finite(site["static_youngs_modulus_Pa"]),
            "static_ci95_Pa": site["static_ci95_Pa"],
            "dynamic_Pa": _finite(site["dynamic_corrected_Pa"]),
            "dynamic_ci95_Pa": site["dynamic_corrected_ci95_Pa"],
            "peak_N": _finite(site["peak_force_N"]),
            "cut_short": site["cut_short"],
            "hertz_misfit": None if site["hertz_misfit"] is None else site["hertz_misfit"]["sentence"],
        })  # fmt: skip
    return live


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
