"""`palpd inject`: a palpation whose second channel has a sealed effect, the diagnosis of that channel, and the opened seal.

The answer is drawn and its seal shown before anything moves. Only the recorder gets the answer; guard, search, tare and running zero
work on what the sensor says. The answer waits in the state folder, in a file for this user only, until the diagnosis is made. Where this
computer ends before, it stays there, and `open_injection` opens it later.
"""

import contextlib
import hashlib
import secrets
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import TypeAdapter

from palpd.cell.cell_file import CellFile
from palpd.config import Config, Plan
from palpd.control.plan_place import Choice
from palpd.daemon.devices import Build
from palpd.daemon.display import Display
from palpd.daemon.job_client import service_at
from palpd.daemon.session import carry_out, job
from palpd.daemon.stored_state import now
from palpd.daemon.supervisor import Report, recording_name
from palpd.errors import BadInput, PalpdError, RecordingError, Refused
from palpd.files import check_folder, read_text, write_text
from palpd.history.injections import Injection, injection_sentence, keep_injection
from palpd.history.stored import INJECTION, RECORDING, beside, unfinished_recordings
from palpd.recording.mcap_file import part_of
from palpd.recording.reader import Recording, read_header, samples_of
from palpd.recording.second_channel import SealedAnswer

if TYPE_CHECKING:
    from palpd.cell.effects import Effect

KIND = "injection"
"""Ends the name of each recording."""
FOLDER = "injections"
"""Folder in the state folder with the sealed answers, each called by its seal."""
HEALTHY_SHARE = 0.25
"""Share of runs without an effect: they show how often something is named that is not there."""


def drawn_effect(limit_N: float, rng: np.random.Generator) -> SealedAnswer:
    """Draw an effect, or none, with a size from hardly visible to plain.

    Args:
        limit_N: Contact force at which the guard stops: forces scale with it.
    """
    largest: Mapping[str, tuple[str, float, float]] = {
        "sensor.gain": ("error", 0.005, 0.5),
        "sensor.bias": ("offset_N", 5e-4 * limit_N, 0.05 * limit_N),
        "sensor.drift": ("rate_N_per_s", 2e-5 * limit_N, 2e-3 * limit_N),
        "sensor.latency": ("delay_s", 0.002, 0.2),
        "sensor.filter": ("cutoff_Hz", 0.5, 50.0),
        "sensor.hysteresis": ("amplitude_N", 1e-3 * limit_N, 0.1 * limit_N),
    }
    salt = secrets.token_hex(16)
    if rng.random() < HEALTHY_SHARE:
        return SealedAnswer(salt=salt)
    effect = str(rng.choice(list(largest)))
    name, low, high = largest[effect]
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    signed = size * float(rng.choice([-1.0, 1.0])) if effect in ("sensor.gain", "sensor.bias", "sensor.drift") else size
    width = {"width_N": limit_N * float(rng.uniform(0.02, 0.2))} if effect == "sensor.hysteresis" else {}
    return SealedAnswer(effect, {name: signed, **width}, salt)


def inject(
    config: Config,
    plan: Plan,
    cell: CellFile | None,
    library: "Mapping[str, Effect]",
    build: Build,
    display: Display,
    choice: Choice | None = None,
) -> Report:
    """Carry out a plan with a sealed effect in its second channel, diagnose that channel, and open the seal.

    Args:
        plan: A palpation of one site.
        cell: The cell as the simulator knows it; None: that of the configuration.
        library: Effects that the diagnosis knows.
        build: Opens robot and sensor.
        display: Shows the progress, and takes the sentences.
        choice: Where sites count from, where the palpation before was not finished.

    Returns:
        The report of the run. A run that was stopped is opened without a diagnosis.

    Raises:
        BadInput: The plan has several sites.
        Refused: A service serves this cell, or the run was refused.
    """
    if service_at(config.paths.control_socket):  # anyone on its page could begin a run in between
        raise Refused("the service of this cell may begin a run at any time; stop it (systemctl stop palpd), and inject again")
    if len(plan.sites) != 1:
        raise BadInput(f"the plan has {len(plan.sites)} sites, expected one: a diagnosis judges one site; give a plan with one")
    work = job("palpation", config, plan, choice=choice)
    recording = config.paths.runs / f"{recording_name(KIND)}{RECORDING}"
    planted = drawn_effect(config.safety.contact_limit_N, np.random.default_rng(secrets.randbits(128)))
    sealed = _sealed_file(config, planted.seal)
    check_folder(sealed.parent)
    sealed.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    write_text(sealed, planted.text, own=True)
    display.say(f"Sealed before the run: {planted.seal}")
    try:
        report = carry_out(replace(work, planted=planted), build, display, recording.stem)
    except Refused:
        if recording.exists():  # the loop had begun, and refused
            open_injection(config, recording, cell, library)
        raise
    finally:
        if not (recording.exists() or part_of(recording).exists()):  # nothing holds this seal
            sealed.unlink(missing_ok=True)
    if report.recording is not None:
        with display.waiting("diagnosing the second channel"):
            injection = open_injection(config, recording, cell, library)
        display.say(f"{recording.name}: {injection_sentence(injection)}")
    return report


def open_injection(config: Config, recording: Path, cell: CellFile | None, library: "Mapping[str, Effect]") -> Injection:
    """Diagnose the second channel of a recording, then open its seal and keep both beside the recording.

    A run that was stopped, or was recovered without its second channel, is opened without a diagnosis.

    Args:
        cell: The cell as the simulator knows it; None: that of the configuration.
        library: Effects that the diagnosis knows.

    Raises:
        BadInput: The recording is no injection, its sealed answer was altered, or nothing can be written beside it.
        Refused: It was opened before, or its answer is not kept here.
    """
    run = Recording.load(recording)
    seal = run.header.get("injection")
    if not seal:
        raise BadInput(f"{recording} is no run of palpd inject; give one")
    sealed = _sealed_file(config, seal)
    if (kept := beside(recording, INJECTION)).exists():
        sealed.unlink(missing_ok=True)  # this computer may have ended between the two
        raise Refused(
            f"{recording.name} was opened before; {kept.name} beside it says what was planted, and palpd inject --report counts it"
        )
    if not sealed.exists():
        raise Refused(
            f"{sealed} does not exist: {recording.name} is a run of another cell, or was opened under another name; give another run"
        )
    text = read_text(sealed)
    if (altered := hashlib.sha256(text.encode()).hexdigest()) != seal:
        raise BadInput(f"{sealed} is not what was sealed: its SHA-256 is {altered}; delete it, this run shows nothing any more")
    check_folder(recording.parent)
    injection = Injection(now(), seal, SealedAnswer())
    try:
        injection = _diagnosed(run, injection, cell or config.cell.assumed_at_site(run.header["sites"][0]["name"]), library)
    except PalpdError as error:
        injection = replace(injection, reason=str(error))
    injection = replace(injection, planted=TypeAdapter(SealedAnswer).validate_json(text))
    keep_injection(recording, injection)
    sealed.unlink()
    return injection


def unopened(config: Config) -> list[Path]:
    """Runs whose seal was never opened, by the names that they were given; a FILE.part must be recovered first."""
    seals = {path.stem for path in (config.paths.state / FOLDER).glob("*.json")}
    runs = (*config.paths.runs.glob(f"*-{KIND}{RECORDING}"), *unfinished_recordings(config.paths.runs).values()) if seals else ()
    return sorted(path for path in runs if _seal_of(path) in seals)


def _seal_of(path: Path) -> str | None:
    with contextlib.suppress(PalpdError):  # what cannot be read is named elsewhere
        return read_header(path).get("injection")
    return None


def _sealed_file(config: Config, seal: str) -> Path:
    return config.paths.state / FOLDER / f"{seal}.json"


def _diagnosed(run: Recording, injection: Injection, cell: CellFile, library: "Mapping[str, Effect]") -> Injection:
    """What the diagnosis says of the second channel. It does not see the answer."""
    if (verdict := run.footer.get("verdict")) != "done":
        raise RecordingError(f"the run ended {verdict}: {run.footer.get('reason')}")
    from palpd.gap.diagnosis import diagnose

    samples = samples_of(run.with_second_channel(), run.header["sites"][0]["name"], at_reports=True)
    answer = diagnose([samples], cell, library, propose=False)
    named = tuple(effect.id for effect in answer.effects)
    stated = {"none": answer.decision.p_none, "unknown": answer.decision.p_unknown}
    probability = stated.get(answer.verdict, min((effect.probability for effect in answer.effects), default=0.0))
    return replace(injection, verdict=answer.verdict, named=named, probability=float(probability))
