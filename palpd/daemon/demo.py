"""`palpd demo`: the whole job with the real daemon on emulated wires, in a folder of its own."""

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from palpd.analysis.young import modulus_peak_Pa
from palpd.cell.cell_file import PHANTOM, CellFile, load_cell, save_cell
from palpd.cell.effects import load_effects
from palpd.cell.effects.learned import LearnedEffect
from palpd.cell.simulation import equilibrium_force_N, scale_of
from palpd.compensation.model_card import ModelCard
from palpd.compensation.train import train
from palpd.config import Config, ModelConfig, PathsConfig, Plan, PlanSite, RobotConfig, SafetyConfig, SensorConfig, Strokes
from palpd.daemon.display import Display
from palpd.daemon.motion_job import Job, Kind
from palpd.daemon.run_result import RunResult, run_result, simulated_result
from palpd.daemon.session import ForegroundHost, calibrate, carry_out, job, kept_in
from palpd.daemon.simulated_run import run as simulate
from palpd.daemon.wiring import devices, emulated
from palpd.errors import BadInput
from palpd.files import write_yaml
from palpd.gap.commands import diagnose_files
from palpd.gap.other_motion import check_on
from palpd.gap.report.page import write as write_report
from palpd.recording.reader import Recording, samples_of
from palpd.recording.samples import Samples, write_csv
from palpd.workers import beside

BIAS_N = 0.19
"""Bias of the emulated sensor: the paper's sensor read 0.1929 N on average in free motion with the probe, after its tare."""
DRIFT_N_PER_S = 0.82 / 5400.0
"""Drift of the emulated sensor: that of a cold HEX-E, the nearest sensor measured, 0.82 N on Fz in 90 min."""
PATIENCE_S = 0.1
"""Patience of watchdog and devices, twice the default: a PC that runs the demo is often busy, and an emulated arm is harmless."""
SITES = tuple(PlanSite(name=name, x_m=0.03 * index) for index, name in enumerate("ABCD"))
SHORT = Plan(sites=SITES, depths_m=(0.004, 0.006, 0.008), hold_s=3.0, repeats=1)
VARIED = Plan(sites=(PlanSite(name="A"),), depths_m=(0.003, 0.005, 0.008), hold_s=4.0, repeats=2, free=Strokes(strokes=4, height_m=0.02))
"""The motion from which a law is learned: besides presses it strokes the air."""
OTHER_MOTION = Plan(
    sites=(PlanSite(name="A"),), depths_m=(0.004, 0.0065), press_speed_m_per_s=0.02, hold_s=2.0, repeats=2, safe_height_m=0.008,
    free=Strokes(strokes=2, height_m=0.015, speed_m_per_s=0.03),
)  # fmt: skip
"""The motion on which it is tried: other depths, speeds, holds and strokes."""
PALPATING = {
    "palpation": "free moves, holds, presses of different depths",
    "another-motion": "other depths, speeds and holds, which the diagnosis will not see",
}
"""What the demo says of each palpation."""
ONE_SITE = Plan(sites=(PlanSite(name="A"),), depths_m=(0.003, 0.005, 0.008), hold_s=4.0, repeats=2)
FULL = Plan(sites=SITES, depths_m=tuple(d / 1000 for d in range(3, 11)), hold_s=10.0, repeats=10)


@dataclass(frozen=True, slots=True)
class Demonstration:
    """What the demo measured, and the card of the inertial model that it learned, where it came so far."""

    result: RunResult
    card: ModelCard | None = None


def palpate(full: bool, folder: Path | None, display: Display, *, wires: bool = True) -> Demonstration:
    """Calibrate, learn the inertia, palpate the paper's phantom, and add the true moduli, which the emulated cell knows.

    Args:
        full: Whether to carry out the paper's whole plan.
        folder: Empty folder for recordings and model; by default a new one in runs/.
        display: Shows the progress.
        wires: As for `gap`.

    Returns:
        The result of the palpation, or of the free motion where that was stopped.
    """
    plan = FULL if full else SHORT
    folder = kept_in(folder or Path("runs"), "demo" if folder is None else None)
    cell = PHANTOM.with_effects({"sensor.bias": {"offset_N": BIAS_N}, "sensor.drift": {"rate_N_per_s": DRIFT_N_PER_S}})
    display.say(f"A UR5 and a HEX-70 are emulated; everything is kept in {folder}.")
    with (_on_wires if wires else _without_wires)(cell, folder, plan, display, None) as record:
        display.say("1/3 free motion, 2 cm up and down ten times, touching nothing")
        result, free = record("free_motion", plan, "free-motion", None)
        if free is None:
            return Demonstration(result)
        display.say("2/3 learning the inertial model from it")
        card = _learn(free, folder / "inertial.onnx", cell.without_effects().probe.mass_kg)
        presses = len(plan.sites) * len(plan.depths_m) * (1 + plan.repeats)
        display.say(f"3/3 palpating {len(plan.sites)} sites, {presses} presses")
        result, _ = record("palpation", plan, "palpation", folder / "inertial.onnx")
    for site in result["sites"]:
        site["true_youngs_modulus_Pa"] = true_modulus_Pa(cell, site["name"], plan)
    return Demonstration(result, card)


def _learn(recording: Recording, model: Path, probe_mass_kg: float) -> ModelCard:
    serial, delay_s = recording.header["about"].get("sensor_serial"), recording.header["body"]["delay_s"]
    return train([samples_of(recording)], model, probe_mass_kg=probe_mass_kg, sensor_serial=serial, sensor_delay_s=delay_s)


def gap(effect: str, folder: Path | None, display: Display, *, wires: bool = True) -> Demonstration:
    """Give one plain elastic site an effect that the nominal cell does not have, palpate it, diagnose it, and close the gap.

    Args:
        effect: An id of the library, taken at its typical size; `none`; a cell file, for its effects and laws; a file of learned laws; or
            a Python file, for its first effect at its typical size. The diagnosis then also knows the effects of that Python file. It
            never knows a law.
        folder: Empty folder for recording and report; by default a new one in runs/.
        display: Shows the progress.
        wires: Whether the daemon palpates on emulated wires; else the cell's physics stands behind its loop, faster than real time.

    Returns:
        The result of the palpation, with the diagnosis where it was not stopped.
    """
    folder = kept_in(folder or Path("runs"), "demo" if folder is None else None)
    nominal = CellFile.model_validate({"sensor": {"rate_Hz": 1000.0}})
    user_effects = Path(effect) if Path(effect).suffix == ".py" else None
    effects, laws = _effects_of(effect, nominal), _laws_of(effect)
    true = "; ".join(filter(None, (", ".join(effects), *(law.what for law in laws)))) or "none"
    display.say(f"One elastic site is emulated, with {true}; the simulator does not know. Everything is kept in {folder}.")
    cell = nominal.with_effects(effects).model_copy(update={"learned": laws})
    plans = {"palpation": VARIED, "another-motion": OTHER_MOTION} if laws else {"palpation": ONE_SITE}
    recorded: dict[str, Samples] = {}
    with (_on_wires if wires else _without_wires)(cell, folder, ONE_SITE, display, user_effects) as record:
        for number, (name, plan) in enumerate(plans.items(), start=1):
            display.say(f"{number}/{len(plans) + 1} palpating: {PALPATING[name]}")
            result, recording = record("palpation", plan, name, None)
            if recording is None:
                return Demonstration(result)
            recorded[name] = samples_of(recording, "A")
    csv, file, page = folder / "site-A.csv", folder / "cell.yaml", folder / "gap.html"
    write_csv(csv, recorded["palpation"])
    save_cell(file, nominal)
    display.say(f"{len(plans) + 1}/{len(plans) + 1} diagnosing the recording against the nominal cell")
    diagnosis = diagnose_files([csv], file, json_out=folder / "diagnosis.json", cell_out=folder / "enriched.yaml", effects=user_effects)
    check = None
    if "another-motion" in recorded:
        write_csv(folder / "another-motion.csv", recorded["another-motion"])
        check = check_on(diagnosis, recorded["another-motion"])
    content = diagnosis.to_json()
    write_report(page, diagnosis, f"site A, with {true}", check)
    display.say(f"Report: {page}")
    named = [effect["id"] for effect in content["effects"]]
    summary = {"true": true, "named": named, "closed": content["shrink"]["closed"]}
    result["diagnosis"] = {**summary, "another_motion": None if check is None else check.to_json(), **content}
    return Demonstration(result)


Record = Callable[[Kind, Plan, str, Path | None], tuple[RunResult, Recording | None]]
"""Carries out a plan under a name, with an inertial model: its result, and the recording where it was done."""


@contextmanager
def _on_wires(cell: CellFile, folder: Path, limiting: Plan, display: Display, effects: Path | None) -> Iterator[Record]:
    """Palpate on emulated wires, with the reference tare taken, within limits that allow the plan `limiting`."""
    with cell_on_wires(cell, folder, limiting, effects=effects) as config:
        display.say("reference tare")
        calibrate(ForegroundHost(config, devices, display))

        def record(kind: Kind, plan: Plan, name: str, model: Path | None) -> tuple[RunResult, Recording | None]:
            corrected = config.model_copy(update={"model": ModelConfig(path=model)})
            report = carry_out(job(kind, corrected, plan), devices, display, name)
            done = report.recording is not None and not report.exit_code
            return run_result(report), Recording.load(report.recording) if done and report.recording else None

        yield record


@contextmanager
def _without_wires(cell: CellFile, folder: Path, limiting: Plan, display: Display, effects: Path | None) -> Iterator[Record]:
    """Palpate with the cell's physics behind the loop."""
    library = load_effects(effects)
    config = Config(safety=_limits(limiting), paths=PathsConfig(runs=folder, state=folder / "state"), cell=cell.without_effects())

    def record(kind: Kind, plan: Plan, name: str, model: Path | None) -> tuple[RunResult, Recording | None]:
        corrected = config.model_copy(update={"model": ModelConfig(path=model)})
        run = simulate(Job(kind, corrected, plan), cell, library=library)
        result = simulated_result(run)
        return result, Recording(folder / name, run.rows, run.header, {}, None) if result["verdict"] == "done" else None

    display.say("no wires: the cell's physics stands behind the loop, faster than real time")
    yield record


def _laws_of(effect: str) -> tuple[LearnedEffect, ...]:
    return load_cell(effect).learned if Path(effect).suffix in (".yaml", ".yml") else ()


def _effects_of(effect: str, nominal: CellFile) -> dict[str, dict[str, float]]:
    if effect == "none":
        return {}
    if Path(effect).suffix in (".yaml", ".yml"):
        return {name: dict(values) for name, values in load_cell(effect).effects.items()}
    known = load_effects()
    if Path(effect).suffix == ".py":
        installed, known = known, load_effects(effect)
        effect = next(name for name, each in known.items() if installed.get(name) is not each)
    if effect not in known:
        raise BadInput(
            f"{effect} is no effect of the library; known: none, {', '.join(known)}, or a cell file, a file of laws or a Python file"
        )
    t_s = np.linspace(0.0, 60.0, 601)
    z_m = 0.01 - 0.018 * np.abs(np.sin(0.3 * t_s))  # the typical size of an effect depends on the motion: take one like the plan's
    scale = scale_of(nominal, t_s, z_m, np.gradient(z_m, t_s))
    return {effect: {parameter.name: parameter.starts(scale)[0] for parameter in known[effect].parameters if not parameter.optional}}


def true_modulus_Pa(cell: CellFile, site: str, plan: Plan) -> float:
    """The true modulus of a site: the paper's equation 1 on the noise-free equilibrium force of the cell, mean over the plan's depths.

    Args:
        cell: The emulated cell.

    Returns:
        Young's modulus in Pa.
    """
    tissue = cell.tissue
    poisson = tissue.poisson_ratio if tissue else 0.5
    moduli = [
        modulus_peak_Pa(equilibrium_force_N(cell, depth_m, site), depth_m, cell.probe.tip_radius_m, poisson) for depth_m in plan.depths_m
    ]
    return sum(moduli) / len(moduli)


@contextmanager
def service_on_wires(folder: Path | None, display: Display) -> Iterator[Path]:
    """Serve the emulated phantom of the paper within the context: calibrated, disarmed, with its own folder.

    Args:
        folder: Empty folder for configuration, recordings and state; by default a new one in runs/.
        display: Shows the progress.

    Yields:
        The config.yaml of the service; a plan.yaml that its limits allow stands beside it.
    """
    folder = kept_in(folder or Path("runs"), "demo" if folder is None else None)
    display.say(f"A UR5 and a HEX-70 are emulated; everything is kept in {folder}.")
    with cell_on_wires(PHANTOM.with_effects({"sensor.bias": {"offset_N": BIAS_N}}), folder) as config:
        stated = config.model_dump(mode="json", exclude_unset=True) | {"paths": {"runs": ".", "state": "state"}}
        for name, values in (("config.yaml", stated), ("plan.yaml", SHORT.model_dump(mode="json", exclude_unset=True))):
            write_yaml(folder / name, yaml.safe_dump(values, sort_keys=False))
        display.say("reference tare")
        calibrate(ForegroundHost(config, devices, display))
        with (folder / "service.log").open("wb") as log:
            service = subprocess.Popen(beside("palpd", "serve", "--config", str(folder / "config.yaml")), stderr=log)
        try:
            yield folder / "config.yaml"
        finally:
            service.terminate()
            service.wait()


@contextmanager
def cell_on_wires(cell: CellFile, folder: Path, plan: Plan = SHORT, effects: Path | None = None) -> Iterator[Config]:
    """Emulate a cell in a process of its own within the context.

    The phantom's hardest site takes 13 N at 8 mm and 20.5 N at 10 mm. The limits are set above that.

    Args:
        folder: Folder for the cell file, the recordings and the stored state.
        plan: The plan that the limits have to allow.
        effects: Python file with effects that the cell names; None: it names no user's effects.

    Yields:
        The configuration of a daemon that is wired to the emulated cell.
    """
    file = folder / "emulated-cell.yaml"
    save_cell(file, cell)
    host = f"127.{os.getpid() >> 16 & 255}.{os.getpid() >> 8 & 255}.{os.getpid() % 253 + 2}"  # an address per process: two can run at once
    with emulated(folder, "ur5", file, host, effects) as wires:
        yield Config(
            robot=RobotConfig.model_validate({"host": host, "model": "ur5", "watchdog_Hz": 1.0 / PATIENCE_S}),
            sensor=SensorConfig(port=wires.sensor),
            safety=_limits(plan),
            paths=PathsConfig(runs=folder, state=folder / "state"),
            cell=cell.without_effects(),
        )


def _limits(plan: Plan) -> SafetyConfig:
    """Limits that allow a plan on the phantom, with PATIENCE_S for the devices."""
    return SafetyConfig(
        contact_limit_N=16.0 if plan is SHORT else 25.0,
        absolute_limit_N=40.0,
        robot_stale_s=PATIENCE_S,
        sensor_stale_s=PATIENCE_S,
        max_stall_s=PATIENCE_S,
    )
