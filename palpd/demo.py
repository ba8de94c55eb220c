"""`palpd demo`: the whole job with the real daemon on emulated wires, in a folder of its own."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from palpd.cell import equilibrium_force_N, scale_of
from palpd.cell_file import PHANTOM, CellFile, load_cell, save_cell
from palpd.config import Config, ModelConfig, PathsConfig, Plan, RobotConfig, SafetyConfig, SensorConfig, Site
from palpd.effects import EFFECTS, Effect, load_effects, own_effects
from palpd.errors import BadInput
from palpd.gap.commands import diagnose_files
from palpd.gap.report import write as write_report
from palpd.record import Recording, export, samples_of
from palpd.report import depth_table, diagnosis_lines, site_tables
from palpd.session import calibrate, carry_out, findings, job, kept_in
from palpd.train import train
from palpd.wiring import devices, emulated
from palpd.young import modulus_peak_Pa

BIAS_N = 0.19
"""What the paper's sensor read in free motion after its tare (mean 0.1929 N with the probe)."""
DRIFT_N_PER_S = 0.82 / 5400.0
"""A cold HEX-E, the nearest sensor measured: 0.82 N in 90 min on Fz."""
SITES = tuple(Site(name=name, x_m=0.03 * index) for index, name in enumerate("ABCD"))
SHORT = Plan(sites=SITES, depths_m=(0.004, 0.006, 0.008), hold_s=3.0, repeats=1)
ONE_SITE = Plan(sites=(Site(name="A"),), depths_m=(0.003, 0.005, 0.008), hold_s=4.0, repeats=2)
FULL = Plan(sites=SITES, depths_m=tuple(d / 1000 for d in range(3, 11)), hold_s=10.0, repeats=10)


def palpate(full: bool, folder: Path | None, console: Console) -> dict[str, Any]:
    """Calibrate, learn the inertia, palpate the paper's phantom, and compare with the truth that the emulated cell knows."""
    plan = FULL if full else SHORT
    folder = kept_in(folder or Path("runs"), "demo" if folder is None else None)
    cell = PHANTOM.with_effects({"sensor.bias": {"offset_N": BIAS_N}, "sensor.drift": {"rate_N_per_s": DRIFT_N_PER_S}})
    console.print(f"A UR5 and a HEX-70 are emulated; everything is kept in {folder}.")
    with cell_on_wires(cell, folder, plan) as config:
        console.print("1/4 reference tare")
        calibrate(config, devices, console)
        console.print("2/4 free motion, 2 cm up and down ten times, touching nothing")
        free = carry_out(job("free_motion", config, plan), devices, console, "free-motion")
        if free.exit_code or free.recording is None:
            return {**findings(free), "sites": []}
        console.print("3/4 learning the inertial model from it")
        recording = Recording.load(free.recording)
        model = folder / "inertial.onnx"
        about = recording.header["about"]
        card = train(
            [samples_of(recording)],
            model,
            probe_mass_kg=config.cell.probe.mass_kg,
            sensor_serial=about["sensor_serial"],
            sensor_delay_s=about["delay_s"],
        )
        config = config.model_copy(update={"model": ModelConfig(path=model)})
        presses = len(plan.sites) * len(plan.depths_m) * (1 + plan.repeats)
        console.print(f"4/4 palpating {len(plan.sites)} sites, {presses} presses")
        report = carry_out(job("palpation", config, plan), devices, console, "palpation")
    found = findings(report)
    for site in found["sites"]:
        site["true_youngs_modulus_Pa"] = true_modulus_Pa(cell, site["name"], plan)
    _tell(found, card, console)
    return found


def gap(effect: str, folder: Path | None, console: Console) -> dict[str, Any]:
    """Give one plain elastic site an effect that the nominal cell does not have, palpate it, diagnose it, and close the gap.

    `effect` is an id of the library at its typical size, `none`, a cell file whose effects are taken, or a Python file of which the first
    effect is taken at its typical size; the diagnosis then knows that file's effects too.
    """
    folder = kept_in(folder or Path("runs"), "demo" if folder is None else None)
    nominal = CellFile.model_validate({"sensor": {"rate_Hz": 1000.0}})
    own = Path(effect) if Path(effect).suffix == ".py" else None
    effects = _effects_of(effect, nominal)
    true = ", ".join(effects) or "none"
    console.print(f"One elastic site is emulated, with {true}; the simulator does not know. Everything is kept in {folder}.")
    with cell_on_wires(nominal.with_effects(effects), folder, ONE_SITE, effects=own) as config:
        console.print("1/3 reference tare")
        calibrate(config, devices, console)
        console.print("2/3 palpating: free moves, holds, presses of different depths")
        report = carry_out(job("palpation", config, ONE_SITE), devices, console, "palpation")
    found = findings(report)
    if report.recording is None or report.exit_code:
        return found
    csv, cell = folder / "site-A.csv", folder / "cell.yaml"
    export(Recording.load(report.recording), csv, "A")
    save_cell(cell, nominal)
    console.print("3/3 diagnosing the recording against the nominal cell")
    answer = diagnose_files([csv], cell, json_out=folder / "diagnosis.json", cell_out=folder / "enriched.yaml", effects=own)
    json = answer.to_json()
    write_report(folder / "gap.html", answer, f"site A, with {true}")
    for line in diagnosis_lines(answer.sentence, json):
        console.print(line, highlight=False)
    console.print(f"Report: {folder / 'gap.html'}")
    found["diagnosis"] = {"true": true, "named": [named["id"] for named in json["effects"]], "closed": json["shrink"]["closed"], **json}
    return found


def _effects_of(effect: str, nominal: CellFile) -> dict[str, dict[str, float]]:
    if effect == "none":
        return {}
    if Path(effect).suffix in (".yaml", ".yml"):
        return {name: dict(values) for name, values in load_cell(effect).effects.items()}
    known: Mapping[str, Effect] = EFFECTS
    if Path(effect).suffix == ".py":
        known = load_effects(effect)
        effect = own_effects(known)[0].id
    if effect not in known:
        raise BadInput(f"{effect} is no effect of the library; known: none, {', '.join(EFFECTS)}, or a cell file or Python file")
    t_s = np.linspace(0.0, 60.0, 601)
    z_m = 0.01 - 0.018 * np.abs(np.sin(0.3 * t_s))  # a motion like the plan's says how large an effect typically is
    scale = scale_of(nominal, t_s, z_m, np.gradient(z_m, t_s))
    return {effect: {parameter.name: parameter.starts(scale)[0] for parameter in known[effect].parameters}}


def true_modulus_Pa(cell: CellFile, site: str, plan: Plan) -> float:
    """Mean over the plan's depths of the paper's equation 1 on the emulated cell's own noise-free equilibrium force."""
    tissue = cell.tissue
    poisson = tissue.poisson_ratio if tissue else 0.5
    moduli = [
        modulus_peak_Pa(equilibrium_force_N(cell, depth_m, site), depth_m, cell.probe.tip_radius_m, poisson) for depth_m in plan.depths_m
    ]
    return sum(moduli) / len(moduli)


@contextmanager
def cell_on_wires(
    cell: CellFile, folder: Path, plan: Plan = SHORT, model: str = "ur5", effects: Path | None = None
) -> Iterator[Config]:
    """An emulated cell in a process of its own, and the configuration of a daemon that is wired to it.

    The phantom's hardest site takes 13 N at 8 mm and 20.5 N at 10 mm: the limits are set above that, as the paper's must have been.
    """
    file = folder / "emulated-cell.yaml"
    save_cell(file, cell)
    # 0.1 s for watchdog and devices, twice the default: whoever tries the demo has other things running, and an emulated arm hurts nobody
    patience_s = 0.1
    host = f"127.{os.getpid() >> 16 & 255}.{os.getpid() >> 8 & 255}.{os.getpid() % 253 + 2}"  # its own, so that two can run at once
    with emulated(folder, model, file, host, effects) as wires:
        yield Config(
            robot=RobotConfig.model_validate({"host": host, "model": model, "watchdog_Hz": 1.0 / patience_s}),
            sensor=SensorConfig(port=wires.sensor),
            safety=SafetyConfig(
                contact_limit_N=16.0 if plan is SHORT else 25.0,
                absolute_limit_N=40.0,
                robot_stale_s=patience_s,
                sensor_stale_s=patience_s,
                max_stall_s=patience_s,
            ),
            paths=PathsConfig(runs=folder, state=folder / "state"),
            cell=cell.with_effects({}),
        )


def _tell(found: dict[str, Any], card: Any, console: Console) -> None:
    if found["sites"]:
        console.print(depth_table(found["sites"]))
        console.print(*site_tables(found["sites"], card.bias_N), sep="\n")
    console.print(
        f"Inertial model: b - m a learned from the free motion above, {card.n} points, rmse {card.rmse_N * 1e3:.0f} mN: a bias of "
        f"{card.bias_N:+.3f} N and a mass of {card.mass_kg:.3f} kg, {card.inertial_rms_N * 1e3:.1f} mN rms of inertia. "
        "The bias of each press is followed from there by the running zero."
    )
    for note in found["notes"]:
        console.print(f"note: {note}")
    loop = found["loop"]
    console.print(
        f"Loop: {loop['ticks']} ticks, {loop['missed']} missed, work p50 {loop.get('work_us_p50', 0):.0f} µs, "
        f"p99 {loop.get('work_us_p99', 0):.0f} µs."
    )
    console.print(f"{found['verdict']}: {found['recording']}" + (f" ({found['reason']})" if found["reason"] else ""))
