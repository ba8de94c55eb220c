"""`palpd inject`: a palpation whose second channel has a sealed effect, the diagnosis of that channel, and the opened seal.

The answer is drawn and its seal shown before anything moves. The recorder alone is told of it; guard, search, tare and running zero work on
what the sensor says. The answer waits in the state folder, in a file for this user only, until the diagnosis is made.
"""

import contextlib
import secrets
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import TypeAdapter, ValidationError

from palpd.cell.cell_file import CellFile
from palpd.config import Config, Plan
from palpd.daemon.devices import Build
from palpd.daemon.display import Display
from palpd.daemon.session import carry_out, job
from palpd.daemon.stored_state import now
from palpd.daemon.supervisor import Report
from palpd.documents import read_json
from palpd.errors import BadInput, PalpdError, RecordingError, Refused
from palpd.files import write_text
from palpd.history.injections import Injection, injection_sentence, keep_injection
from palpd.history.stored import RECORDING
from palpd.recording.reader import Recording, read_header, samples_of
from palpd.recording.second_channel import PlantedEffect

if TYPE_CHECKING:
    from palpd.cell.effects import Effect

FOLDER = "injections"
"""Folder in the state folder with the sealed answers."""
HEALTHY_SHARE = 0.25
"""Share of runs without an effect: they show how often something is named that is not there."""
_ANSWER = TypeAdapter(PlantedEffect)


def drawn_effect(limit_N: float, rng: np.random.Generator) -> PlantedEffect:
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
        return PlantedEffect(salt=salt)
    effect = str(rng.choice(list(largest)))
    name, low, high = largest[effect]
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    signed = size * float(rng.choice([-1.0, 1.0])) if effect in ("sensor.gain", "sensor.bias", "sensor.drift") else size
    width = {"width_N": limit_N * float(rng.uniform(0.02, 0.2))} if effect == "sensor.hysteresis" else {}
    return PlantedEffect(effect, {name: signed, **width}, salt)


def inject(config: Config, plan: Plan, cell: CellFile | None, library: "Mapping[str, Effect]", build: Build, display: Display) -> Report:
    """Carry out a plan with a sealed effect in its second channel, diagnose that channel, and open the seal.

    Args:
        plan: A palpation of one site.
        cell: The cell as the simulator knows it; None: that of the configuration.
        library: Effects that the diagnosis knows.
        build: Opens robot and sensor.
        display: Shows the progress, and takes the sentences.

    Returns:
        The report of the run. A run that was stopped is opened without a diagnosis.

    Raises:
        BadInput: The plan has several sites.
        Refused: Nothing was moved.
    """
    if len(plan.sites) != 1:
        raise BadInput(f"the plan has {len(plan.sites)} sites, expected one: a diagnosis judges one site; give a plan with one")
    work = job("palpation", config, plan)
    planted = drawn_effect(config.safety.contact_limit_N, np.random.default_rng(secrets.randbits(128)))
    sealed = _sealed_file(config, planted.seal)
    sealed.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    write_text(sealed, planted.text, own=True)
    display.say(f"Sealed before the run: {planted.seal}")
    report: Report | None = None
    try:
        report = carry_out(replace(work, planted=planted), build, display)
    finally:
        if report is None or report.recording is None:  # nothing holds this seal
            sealed.unlink(missing_ok=True)
    if report.recording is not None:
        with display.waiting("diagnosing the second channel"):
            injection = open_injection(config, report.recording, cell, library)
        display.say(injection_sentence(injection))
    return report


def open_injection(config: Config, recording: Path, cell: CellFile | None, library: "Mapping[str, Effect]") -> Injection:
    """Diagnose the second channel of a recording, then open its seal and keep both beside the recording.

    A run that was stopped, or was recovered without its second channel, is opened without a diagnosis.

    Args:
        cell: The cell as the simulator knows it; None: that of the configuration.
        library: Effects that the diagnosis knows.

    Raises:
        BadInput: The recording is no injection, or the sealed file is damaged or altered.
        Refused: It was opened before, or its answer is not kept here.
    """
    run = Recording.load(recording)
    seal = run.header.get("injection")
    if not seal:
        raise BadInput(f"{recording} is no run of palpd inject; give one")
    sealed = _sealed_file(config, seal)
    if not sealed.exists():
        raise Refused(f"{sealed} does not hold the answer of {recording.name}; it was opened before, or the run belongs to another cell")
    injection = Injection(now(), seal, PlantedEffect())
    try:
        injection = _diagnosed(run, injection, cell or config.cell.assumed_at_site(run.header["sites"][0]["name"]), library)
    except PalpdError as error:
        injection = replace(injection, reason=str(error))
    injection = replace(injection, planted=_answer(sealed, seal))
    keep_injection(recording, injection)
    sealed.unlink()
    return injection


def unopened(config: Config) -> list[Path]:
    """Recordings whose seal was never opened, since this computer ended before: `palpd inject --open` does it."""
    seals = {path.stem for path in (config.paths.state / FOLDER).glob("*.json")}
    found = []
    for path in sorted(config.paths.runs.glob(f"*{RECORDING}")) if seals else ():
        with contextlib.suppress(PalpdError):
            if read_header(path).get("injection") in seals:
                found.append(path)
    return found


def _sealed_file(config: Config, seal: str) -> Path:
    return config.paths.state / FOLDER / f"{seal}.json"


def _answer(sealed: Path, seal: str) -> PlantedEffect:
    """The sealed answer. Raises BadInput where it is not what was sealed."""
    try:
        planted = _ANSWER.validate_python(read_json(sealed))
    except ValidationError as error:
        raise BadInput(f"{sealed} holds no sealed answer ({error.error_count()} faults); delete it and inject again") from error
    if planted.seal != seal:
        raise BadInput(f"{sealed} does not hold what was sealed: its SHA-256 is {planted.seal}; delete it and inject again")
    return planted


def _diagnosed(run: Recording, injection: Injection, cell: CellFile, library: "Mapping[str, Effect]") -> Injection:
    """What the diagnosis says of the second channel. It sees neither the seal nor the answer."""
    from palpd.gap.diagnosis import diagnose

    if (verdict := run.footer.get("verdict")) != "done":
        raise RecordingError(f"the run was {verdict}: {run.footer.get('reason')}")
    samples = samples_of(run.with_second_channel(), run.header["sites"][0]["name"], at_reports=True)
    answer = diagnose([samples], cell, library, propose=False)
    named = tuple(effect.id for effect in answer.effects)
    stated = {"none": answer.decision.p_none, "unknown": answer.decision.p_unknown}
    probability = stated.get(answer.verdict, min((effect.probability for effect in answer.effects), default=0.0))
    return replace(injection, verdict=answer.verdict, named=named, probability=float(probability))
