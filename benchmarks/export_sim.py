"""Every effect of the library in MuJoCo and in an FMU, against palpd's own simulation, on a motion that no export uses.

`python -m benchmarks.export_sim [--only ID,ID] [--to mujoco,fmu] [--docs docs]`. Every effect stands alone in the nominal cell, as large
as it must be to be seen plainly, and in its variants: the other sign, and with its optional parameters. A row holds the worst of them. The
exported folder is used as its README says, the FMU through fmpy. With --docs the table of docs/export-sim.md is written. Ends with 1 if a
target is missed.
"""

import argparse
import runpy
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, nan
from pathlib import Path

import numpy as np

from benchmarks.marked_text import write_marked
from palpd.cell.cell_file import CellFile, Estimated, nominal
from palpd.cell.effects import EFFECTS, Effect, Scale
from palpd.cell.motion_profile import Move, commanded_heights
from palpd.cell.simulation import scale_of, simulate
from palpd.errors import BadInput
from palpd.gap.model.coordinates import stretched
from palpd.interchange.simulators.export import MOST_OFF, Target, agreement_of, export_cell
from palpd.interchange.simulators.exported_cell import COLUMNS
from palpd.tick import Floats

PAGE = "export-sim.md"
TARGETS: tuple[Target, ...] = ("mujoco", "fmu")
SCRIPTS = {"mujoco": "palpd_cell.py", "fmu": "rollout.py"}
MOST_REFUSED = 4
PLAIN = 5.0
"""Rms change in units of the noise from which an effect is large enough to show an export that lacks it."""
DEVIATIONS = {
    "(deviations)": Estimated(
        bias_N=0.02, drift_N_per_min=0.02, gain=0.01, latency_s=0.0013, filter_cutoff=0.1, crosstalk=(0.004, -0.003, 0.002, 0.003),
        mass_kg=0.004, youngs_modulus=-0.05, surface_z_m=5e-5, servo_natural_frequency=0.04,
    ),
    "(a sensor that is ahead)": Estimated(latency_s=-0.0017),
}  # fmt: skip
"""Cells without an effect, with in-tolerance deviations as a diagnosis writes them."""


@dataclass(frozen=True)
class Row:
    """An effect: the worst difference in each target, in rms of the noise, its channel, and how much the smallest variant changes."""

    name: str
    off: dict[str, float]
    channel: dict[str, str]
    size: float
    refusal: str = ""
    scatter: str = ""


def motion() -> tuple[Floats, Floats]:
    """Five presses at four speeds, with holds, a half lift and a second press of the same depth, and fast strokes in the air."""
    strokes = [Move(0.030, 0.4, 0.0, 5.0), Move(0.004, 0.4, 0.0, 5.0)]
    moves = [
        Move(0.004, 0.01, 0.3), Move(-0.0045, 0.006, 0.6), Move(0.002, 0.01, 0.2), Move(-0.0060, 0.012, 0.4), Move(-0.0030, 0.008, 0.2),
        Move(-0.0060, 0.015, 0.1), Move(0.004, 0.02, 0.3), *3 * strokes, Move(0.004, 0.1, 0.3), Move(-0.0035, 0.03, 0.0),
        Move(0.004, 0.03, 0.4),
    ]  # fmt: skip
    heights_m, _ = commanded_heights(0.0035, moves, 0.002)
    return np.arange(len(heights_m) + 1, dtype=np.float64) * 0.002, np.concatenate(([0.0035], heights_m))


def variants(effect: Effect, scale: Scale) -> Iterator[dict[str, float]]:
    """Values of an effect: typical, of the other sign, and with what is optional; each as large as it must be to be seen plainly."""
    usual = {p.name: p.starts(scale)[0] for p in effect.named_parameters if not p.optional}
    yield _plain(effect, usual, scale)
    for parameter in effect.named_parameters:
        others = [start for start in parameter.starts(scale) if start * usual.get(parameter.name, 0.0) < 0.0]
        if others:
            yield _plain(effect, usual | {parameter.name: others[0]}, scale)
    optional = {p.name: p.starts(scale)[-1] for p in effect.named_parameters if p.optional}
    if optional:
        yield _plain(effect, usual | optional, scale)


def _plain(effect: Effect, values: dict[str, float], scale: Scale) -> dict[str, float]:
    """The values, with amplitudes stretched until the effect changes a channel by PLAIN times its noise, where its range allows that."""
    t_s, z_cmd_m = motion()
    healthy = simulate(nominal(), t_s, z_cmd_m=z_cmd_m)
    for factor in (1.0, 3.0, 10.0, 30.0):
        larger = stretched(effect, values, factor, scale)
        changed = simulate(nominal().with_effects({effect.id: larger}), t_s, z_cmd_m=z_cmd_m)
        if agreement_of(nominal(), rows_of(healthy), changed).worst >= PLAIN:
            break
    return larger


def rows_of(columns: dict[str, Floats]) -> Floats:
    """Columns of a simulation as rows (n, 8) of a rollout."""
    return np.column_stack([columns[name] for name in COLUMNS])


def row(name: str, cells: list[CellFile], targets: list[Target]) -> Row:
    """Export cells, roll the motion out, and compare."""
    t_s, z_cmd_m = motion()
    healthy = simulate(nominal(), t_s, z_cmd_m=z_cmd_m)
    off: dict[str, float] = {}
    channel: dict[str, str] = {}
    size, scatter = inf, ""
    for target in targets:
        off[target] = 0.0
        for cell in cells:
            with tempfile.TemporaryDirectory() as folder:
                place = Path(folder) / "export"
                try:
                    export_cell(cell, target, place)
                except BadInput as error:
                    return Row(name, dict.fromkeys(targets, nan), channel, nan, str(error))
                roll_out = runpy.run_path(str(place / SCRIPTS[target]))["rollout"]
                rows = roll_out(t_s, z_cmd_m)
                noisy = roll_out(t_s, z_cmd_m, noise_seed=1) if name in EFFECTS and EFFECTS[name].scatter else None
            expected = simulate(cell, t_s, z_cmd_m=z_cmd_m)
            agreement = agreement_of(cell, rows, expected)
            if agreement.worst >= off[target]:
                off[target], channel[target] = agreement.worst, agreement.channel
            changed = agreement_of(cell, rows_of(healthy), expected)
            size = min(size, changed.worst)
            if noisy is not None:
                scatter = scattered(noisy[:, 4], simulate(cell, t_s, z_cmd_m=z_cmd_m, noise_seed=2)["fz_N"], expected["fz_N"])
    return Row(name, off, channel, size, scatter=scatter)


def scattered(exported_N: Floats, own_N: Floats, mean_N: Floats) -> str:
    """The scatter of fz in an export and in palpd: its rms, and the share of rows that repeat the one before."""
    each = [f"{np.std(fz - mean_N):.3f} N, {np.mean(np.diff(fz) == 0.0):.0%} repeated" for fz in (exported_N, own_N)]
    return " / ".join(each)


def table(rows: list[Row], targets: list[Target]) -> str:
    """The table in Markdown, the sentence below it included."""
    head = ["effect", "what it changes", *targets, "scatter of fz: export / palpd"]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for one in rows:
        figures = [one.refusal or f"{one.off[target]:.1e} ({one.channel[target]})" for target in targets]
        lines.append(f"| `{one.name}` | {one.size:.2g} | {' | '.join(figures)} | {one.scatter} |")
    effects = [one for one in rows if one.name in EFFECTS]
    refused = [one.name for one in effects if one.refusal]
    worst = max((max(one.off.values()) for one in rows if not one.refusal), default=nan)
    sentence = (
        f"{len(effects) - len(refused)} of {len(effects)} effects are exported (target: all but {MOST_REFUSED}), "
        f"{'none is refused' if not refused else 'refused: ' + ', '.join(refused)}. "
        f"The largest difference is {worst:.1e} times the noise (target {MOST_OFF:g})."
    )
    return "\n".join([*lines, "", sentence])


def main() -> None:
    """Compare, print the table, and write it into the page where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", help="effects, separated by commas")
    parser.add_argument("--to", default=",".join(TARGETS), help="targets, separated by commas")
    parser.add_argument("--docs", type=Path, help="folder of the page to write")
    asked = parser.parse_args()
    targets = [target for target in TARGETS if target in asked.to.split(",")]
    t_s, z_cmd_m = motion()
    healthy = simulate(nominal(), t_s, z_cmd_m=z_cmd_m)
    scale = scale_of(nominal(), t_s, healthy["z_m"], healthy["vz_m_per_s"], healthy["fz_N"])
    cells = {name: [nominal().with_estimated(deviation)] for name, deviation in DEVIATIONS.items()}
    cells |= {name: [nominal().with_effects({name: values}) for values in variants(effect, scale)] for name, effect in EFFECTS.items()}
    rows = []
    for name in [name for name in cells if asked.only is None or name in asked.only.split(",")]:
        rows.append(row(name, cells[name], targets))
        print(table(rows[-1:], targets).splitlines()[2], flush=True)
    print(table(rows, targets).splitlines()[-1])
    if asked.docs is not None:
        write_marked(asked.docs / PAGE, "effects", table(rows, targets))
    missed = [one.name for one in rows if not all(value <= MOST_OFF for value in one.off.values())]
    sys.exit(len(missed) > MOST_REFUSED or any(not one.refusal for one in rows if one.name in missed))


if __name__ == "__main__":
    main()
