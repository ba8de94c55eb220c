"""What a recording says of its run: how it ended, under which conditions, what it measured. Report, catalogue and `palpd info` show it."""

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypedDict

from palpd.analysis.modulus_notes import modulus_notes
from palpd.analysis.results import DryFigures, LoopFigures, SiteResult, cut_short_notes, dry_figures, loop_figures, sites
from palpd.analysis.stalls import stall_figures
from palpd.config import parse_plan
from palpd.errors import ConfigError, RecordingError
from palpd.history.dates import local_time
from palpd.history.deviations import deviations, place_sentences
from palpd.history.stored import RECORDING
from palpd.recording.header import RecordedTrip, RunAbout
from palpd.recording.reader import Recording


class RunFacts(TypedDict):
    """What a run was and what it measured.

    `started` is ISO 8601 in the time zone of this computer and `started_s` Unix time. The hashes are SHA-256: of the recording's bytes, of
    config and plan as parsed (JSON with sorted keys), and of the inertial model's bytes (None without one). `trips` is empty where nothing
    stopped the run. `cut_short` and `deviations` are sentences.
    """

    name: str
    path: str
    bytes: int
    recording_sha256: str
    kind: str
    dry: bool
    started: str
    started_s: float
    duration_s: float
    verdict: str
    reason: str
    trips: list[RecordedTrip]
    lost_rows: int
    damaged_ticks: int
    about: RunAbout
    versions: dict[str, str]
    config_sha256: str
    plan_sha256: str
    model_sha256: str | None
    model_card: dict[str, Any] | None
    machine_stiffness_N_per_m: float | None
    loop: LoopFigures
    peak_force_N: float
    sites: list[SiteResult]
    dry_figures: DryFigures | None
    cut_short: list[str]
    deviations: list[str]


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what a header with missing or wrong keys leads to into a sentence.

    Args:
        path: The recording.

    Yields:
        Nothing.

    Raises:
        RecordingError: Something was missing or of another kind than a recording of palpd has.
    """
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError, ConfigError) as error:
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise RecordingError(f"{path} does not hold what a run of palpd records ({what[:200]}); give a recording of palpd run") from error


def facts_of(recording: Recording) -> RunFacts:
    """Gather what a recording says of its run.

    Raises:
        RecordingError: Header or footer lack what a recording of palpd has.
    """
    with reading(recording.path):
        header, footer, rows = recording.header, recording.footer, recording.rows
        config, plan = header["config"], header["plan"]
        started_s = float(header["epoch_offset_s"]) + float(rows["now_s"][0])
        kind = "injection" if recording.injected else str(header["kind"])  # for the diagnosis only: it gives no moduli
        palpated = kind == "palpation" and not header["dry"]
        measured = sites(rows, header) if palpated else []
        loop = loop_figures(rows)
        loop["stalls"] = stall_figures(rows, footer.get("stalls", []))
        return RunFacts(
            name=recording.path.name.removesuffix(RECORDING),
            path=str(recording.path),
            bytes=recording.path.stat().st_size,
            recording_sha256=file_sha256(recording.path),
            kind=kind,
            dry=bool(header["dry"]),
            started=local_time(started_s),
            started_s=started_s,
            duration_s=float(rows["now_s"][-1] - rows["now_s"][0]),
            verdict=str(footer["verdict"]),
            reason=str(footer["reason"]),
            trips=list(footer.get("trips", [])),
            lost_rows=int(footer.get("lost_rows", 0)),
            damaged_ticks=int(footer.get("damaged_ticks", 0)),
            about=header["about"],
            versions={str(name): str(version) for name, version in header["versions"].items()},
            config_sha256=content_sha256(config),
            plan_sha256=content_sha256(plan),
            model_sha256=None if recording.model_bytes is None else hashlib.sha256(recording.model_bytes).hexdigest(),
            model_card=header["model_card"],
            machine_stiffness_N_per_m=header["machine_stiffness_N_per_m"],
            loop=loop,
            peak_force_N=float(rows["force_N"].max()),
            sites=measured,
            dry_figures=dry_figures(rows) if header["dry"] else None,
            cut_short=cut_short_notes(measured, config["safety"]["contact_limit_N"]) if palpated else [],
            deviations=[*_deviations(recording, measured), *modulus_notes(rows, header)] if palpated else [],
        )


def _deviations(recording: Recording, measured: list[SiteResult]) -> list[str]:
    """Where the run differs from its plan and from the place of the run before; of a plan of another version, that nobody can tell."""
    places = place_sentences(recording.header.get("place"))
    try:
        plan = parse_plan(recording.header["plan"], "the recording's plan")
    except ConfigError as error:
        return [*places, f"the run cannot be compared with its plan ({error})"]
    return places + deviations(recording.rows, plan, measured)


def load(path: Path) -> tuple[Recording, RunFacts]:
    """Read a recording and gather what it says.

    Raises:
        RecordingError: It cannot be read, is no recording of palpd, or was removed meanwhile.
    """
    recording = Recording.load(path)
    try:
        return recording, facts_of(recording)
    except OSError as error:
        raise RecordingError(f"{path} was removed or cannot be read any more ({error.strerror}); nothing was kept of it") from error


def content_sha256(content: object) -> str:
    """Hash of settings: the same keys and values give the same hash, whatever their order in a file."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def file_sha256(path: Path) -> str:
    """Hash of a file's bytes, as `sha256sum` prints it."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
