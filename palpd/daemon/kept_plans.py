"""Plans that the service keeps under a name: one YAML file each, which `palpd sim --plan` reads too.

The first line of a file is a comment with who kept the plan, and with the figures of its rehearsal.
"""

import hashlib
import json
import re
from contextlib import suppress
from pathlib import Path
from typing import Literal

from pydantic import Field, StrictFloat, StrictInt, ValidationError

from palpd.cell.effects.drivers import StrictBlock
from palpd.config import Config, Plan
from palpd.daemon.socket_client import ControlAnswer, ControlRequest, KeptPlan
from palpd.daemon.stored_state import MOST_BYTES, now
from palpd.errors import BadInput, PalpdError, Refused
from palpd.files import opened, read_text, write_text

MOST_PLANS = 200
"""Largest number of plans: more than people find by name, and a list is still read in some milliseconds."""
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
"""A name that is a file name everywhere, and never a path or a hidden file."""
HEAD = "# kept by palpd: "
"""Begins the first line of a file."""


class RehearsalFigures(StrictBlock):
    """What a rehearsal on the simulated cell gave, when, and the hash of the configuration that it is true for."""

    verdict: Literal["done", "stopped"]
    duration_s: StrictFloat = Field(ge=0)
    peak_force_N: StrictFloat
    presses: StrictInt = Field(ge=0)
    cut_short: StrictInt = Field(ge=0)
    config_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    date: str = Field(default_factory=now, max_length=40)


class _Head(StrictBlock):
    by: str = ""
    kept: str = ""
    rehearsal: RehearsalFigures | None = None


def rehearsed_config_sha256(config: Config) -> str:
    """Hash of all that a rehearsal depends on: the configuration without folders and alarms, and the bytes of the inertial model."""
    settings = config.model_dump(mode="json", exclude={"paths": True, "alarms": True, "model": {"path"}})
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    if config.model.path is not None:
        with opened(config.model.path) as stream:
            digest.update(stream.read())
    return digest.hexdigest()


class KeptPlans:
    """The plans of a folder, which is made when the first one is kept."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def all(self) -> list[KeptPlan]:
        """What is known of each plan, by name; a file that cannot be read is left out."""
        plans = []
        for path in sorted(self._folder.glob("*.yaml")):
            with suppress(PalpdError):
                plans.append(self._read(path.stem)[0])
        return plans

    def answer(self, request: ControlRequest) -> ControlAnswer:
        """All plans; with a name that one, and its text. Raises BadInput where there is none of that name."""
        if request.get("name") is None:
            return {"plans": self.all()}
        plan, text = self._read(request.get("name"))
        return {"plans": [plan], "yaml": text}

    def keep(self, request: ControlRequest, plan: Plan, by: str) -> ControlAnswer:
        """Keep a plan. One that somebody has changed meanwhile stays as it is; the same plan again gets another rehearsal only.

        Args:
            request: The request `keep-plan`.
            plan: Its plan, which a start would take.
            by: Who keeps it, for people.

        Returns:
            What is known of the plan now.

        Raises:
            BadInput: The name or the rehearsal is none, the plan is too large, or the file cannot be written.
            Refused: Another plan of that name is kept, or there are too many.
        """
        path, text, head = self._path(request.get("name")), _yaml(plan), _Head(by=by, kept=now())
        if len(text) > MOST_BYTES:
            raise BadInput(f"the plan takes {len(text)} bytes, expected at most {MOST_BYTES}; give it fewer sites")
        if path.exists():
            there, before = self._read(path.stem)
            if before == text:
                head = _Head(by=there["by"], kept=there["kept"], rehearsal=there["rehearsal"])
            else:
                _refuse_changed(there, request)
        elif len(list(self._folder.glob("*.yaml"))) >= MOST_PLANS:
            raise Refused(f"{MOST_PLANS} plans are kept already, expected fewer; forget one of them")
        try:
            if request.get("rehearsal") is not None:
                head = head.model_copy(update={"rehearsal": RehearsalFigures.model_validate(request.get("rehearsal"))})
            self._folder.mkdir(parents=True, exist_ok=True)
        except ValidationError as error:
            raise BadInput("the rehearsal has not the keys and values that docs/jobs.md lists; rehearse the plan again") from error
        except OSError as error:
            raise BadInput(f"{self._folder} cannot be made ({error.strerror}); make room, or run as the service's user") from error
        write_text(path, f"{HEAD}{head.model_dump_json()}\n{text}", own=True)
        return {"plans": [self._read(path.stem)[0]]}

    def forget(self, request: ControlRequest) -> ControlAnswer:
        """Remove a plan. Raises BadInput or Refused where it is absent, was changed meanwhile, or cannot be removed."""
        plan, _ = self._read(request.get("name"))
        _refuse_changed(plan, request)
        try:
            self._path(plan["name"]).unlink()
        except OSError as error:
            raise BadInput(f"{plan['name']} cannot be removed ({error.strerror}); run as the service's user") from error
        return {"plans": self.all()}

    def _path(self, name: object) -> Path:
        if not isinstance(name, str) or NAME.fullmatch(name) is None:
            allowed = "1 to 64 letters, digits, _, - and ., and no . at the beginning"
            raise BadInput(f"{str(name)[:40]!r} is no name of a plan, expected {allowed}; give another one")
        return self._folder / f"{name}.yaml"

    def _read(self, name: object) -> tuple[KeptPlan, str]:
        path = self._path(name)
        if not path.exists():
            raise BadInput(f"no plan {path.stem} is kept; palpd plans lists them")
        text = read_text(path, most_bytes=2 * MOST_BYTES)
        line, _, plan = text.partition("\n") if text.startswith(HEAD) else ("", "", text)
        head = _Head()
        with suppress(ValidationError):  # whoever edits a file by hand may spoil the comment
            head = _Head.model_validate_json(line.removeprefix(HEAD))
        figures = None if head.rehearsal is None else head.rehearsal.model_dump()
        sha256 = hashlib.sha256(plan.encode()).hexdigest()
        return KeptPlan(name=path.stem, sha256=sha256, by=head.by, kept=head.kept, rehearsal=figures), plan


def _yaml(plan: Plan) -> str:
    """A plan as YAML with a line for each key and each site. Its values are JSON, which YAML takes, and which is written at once."""
    values = plan.model_dump(mode="json", exclude_none=True)
    sites = "".join(f"\n  - {json.dumps(site)}" for site in values["sites"])
    return "".join(f"{key}:{sites if key == 'sites' else f' {json.dumps(value)}'}\n" for key, value in values.items())


def _refuse_changed(there: KeptPlan, request: ControlRequest) -> None:
    """Refuse to change a plan that is another one than who asks has seen."""
    if request.get("was") != there["sha256"]:
        what = "is kept already" if request.get("was") is None else "was changed meanwhile"
        by = f"by {there['by'] or 'hand'}, {there['kept'] or 'without a date'}"
        raise Refused(f"the plan {there['name']} {what} ({by}); choose it first, or take another name")
