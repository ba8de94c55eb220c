"""Do cells that are drawn from a diagnosis hold the true cell? On blind cells with one listed effect, diagnosed as usual.

`python -m benchmarks.randomise [--cells 10] [--seed 1] [--draws 100] [--kept FILE]`. A cell takes ten seconds. With --kept every cell is
written to the file when it is done, and cells that the file holds are not run again. Two questions are asked of each cell:

- behaviour: on another motion, noise-free, the truth lies between the lowest and the highest draw in 95 % of the rows, in the channel that
  the effect changes most. A fifth of the noise of a row is allowed for, as in an export.
- parameters: the true effect is among the hypotheses, and its parameters lie in the 95 % region that its uncertainty states.

Ends with 1 if the behaviour is held in less than 90 % of the cells.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from palpd.blind.check import make_case
from palpd.blind.laws import LIBRARY_LAWS
from palpd.blind.truth import CannotDraw, CaseSpec, Truth
from palpd.cell.cell_file import CellFile, OpenHypothesis, load_cell
from palpd.cell.draws import drawn_cells, spread
from palpd.documents import read_json
from palpd.files import read_text, write_text
from palpd.gap.commands import diagnose_files, simulate_columns
from palpd.quantities import wilson
from palpd.recording.samples import Samples, read
from palpd.tick import Floats

EFFECTS = tuple(dict.fromkeys(law.effect for law in LIBRARY_LAWS if not law.variance))
"""Listed effects that change the mean of the readings; they take turns."""
STRATA = ("20-60", "10-20")
"""Signal-to-noise ratios of the effects; they take turns."""
ROWS_HELD, ALLOWED, REGION, TARGET = 0.95, 0.2, 0.95, 0.9
"""Share of rows between the draws, allowance in the noise of a row, size of the region of parameters, and share of cells (target)."""
CHANNELS = ("z_m", "fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")
MOST_KEPT_BYTES = 10_000_000


@dataclass(frozen=True)
class Held:
    """One cell: its effect, what was named, and how the draws hold the truth.

    `rows_between` is the share of rows between the lowest and the highest draw. `spread` is the rms standard deviation of the draws over
    the rms change by the effect; None where the effect changes nothing on that motion.
    """

    name: str
    effect: str
    named: list[str]
    channel: str
    rows_between: float
    spread: float | None
    parameters_inside: bool

    @property
    def behaves(self) -> bool:
        """Whether the draws hold the behaviour."""
        return self.rows_between >= ROWS_HELD


def judged(spec: CaseSpec, seed: int, draws: int) -> Held:
    """Draw a cell, diagnose it, draw from the answer, and look where the truth is."""
    with tempfile.TemporaryDirectory() as folder:
        recordings, sealed = Path(folder) / "recordings", Path(folder) / "sealed"
        recordings.mkdir()
        sealed.mkdir()
        make_case(spec, seed, recordings, sealed)
        recording, enriched = recordings / f"{spec.name}.csv", recordings / "enriched.yaml"
        diagnosis = diagnose_files([recording], recording.with_suffix(".yaml"), cell_out=enriched, propose=False)
        truth: Truth = read_json(sealed / f"{spec.name}.json")
        cell, second = load_cell(enriched), read(sealed / f"{spec.name}.csv")
    change = truth["second"]
    assert change is not None
    channel = max(CHANNELS, key=lambda c: change["change"][c] / np.hypot(change["floor"][c], change["sigma"][c]))
    true = _channel(second, channel)
    variants = np.array([_channel(_simulated(one, second, channel), channel) for one in drawn_cells(cell, draws, seed)])
    allowed = ALLOWED * change["sigma"][channel]
    between = (variants.min(axis=0) - allowed <= true) & (true <= variants.max(axis=0) + allowed)
    return Held(
        spec.name,
        spec.effects[0],
        [effect.id for effect in diagnosis.effects],
        channel,
        float(between.mean()),
        float(np.sqrt(np.mean(variants.var(axis=0)))) / change["change"][channel] if change["change"][channel] else None,
        any(_inside(one, spec.effects[0], truth["effects"][0]["parameters"]) for one in cell.uncertainty),
    )


def _simulated(cell: CellFile, motion: Samples, channel: str) -> Samples:
    columns = {"t_s": motion.t_s, "z_m": motion.z_m, "vz_m_per_s": motion.vz_m_per_s}
    if motion.z_cmd_m is not None:
        columns["z_cmd_m"] = motion.z_cmd_m
    return simulate_columns(cell, columns, measured=channel != "z_m")


def _channel(samples: Samples, channel: str) -> Floats:
    return samples.z_m if channel == "z_m" else np.asarray(samples.wrench[:, CHANNELS.index(channel) - 1])


def _inside(hypothesis: OpenHypothesis, effect: str, true: dict[str, float]) -> bool:
    """Whether the true parameters of an effect lie in the region of a hypothesis that has this effect alone."""
    if set(hypothesis.effects) != {effect}:
        return False
    numbers = [k for k, one in enumerate(hypothesis.open) if one.name.rpartition(".")[0] == effect]
    factor = spread(hypothesis)[numbers]
    moves = []
    for k in numbers:
        one = hypothesis.open[k]
        name = one.name.rpartition(".")[2]
        value, centre = true[name], hypothesis.effects[effect][name]
        move = np.log(max(value, 1e-300) / centre) if one.scale == "log" else value - centre
        moves.append((move + np.pi) % (2.0 * np.pi) - np.pi if one.scale == "angle" else move)
    distance = float(np.array(moves) @ np.linalg.pinv(factor @ factor.T) @ np.array(moves))
    return distance <= float(chi2.ppf(REGION, len(numbers)))


def specs(count: int) -> list[CaseSpec]:
    """The cells: effects and strata in turn."""
    return [
        CaseSpec("drawn", k, "library", (EFFECTS[k % len(EFFECTS)],), STRATA[(k // len(EFFECTS) + k) % len(STRATA)]) for k in range(count)
    ]


def main() -> None:
    """Judge the cells that are not judged yet, and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--kept", type=Path, help="file of judged cells (JSON lines), to go on with")
    asked = parser.parse_args()
    begun = {"seed": asked.seed, "draws": asked.draws}
    lines = read_text(asked.kept, most_bytes=MOST_KEPT_BYTES).splitlines() if asked.kept is not None and asked.kept.exists() else []
    if lines and json.loads(lines[0]) != begun:
        sys.exit(f"{asked.kept} holds cells of {lines[0]}, and this is {json.dumps(begun)}; name another file")
    known = {held.name: held for held in (Held(**json.loads(line)) for line in lines[1:])}
    head = ("cell", "effect", "named", "channel", "rows between the draws", "spread / change", "parameters in their region")
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for spec in specs(asked.cells):
        if spec.name not in known:
            try:
                known[spec.name] = judged(spec, asked.seed, asked.draws)
            except CannotDraw:
                continue
            if asked.kept is not None:
                write_text(asked.kept, "\n".join(json.dumps(one) for one in (begun, *map(asdict, known.values()))) + "\n")
        held = known[spec.name]
        named = ", ".join(held.named) or "none"
        inside = "yes" if held.parameters_inside else "no"
        wide = "changes nothing here" if held.spread is None else f"{held.spread:.2f}"
        print(
            f"| {held.name} | {held.effect} | {named} | {held.channel} | {held.rows_between:.3f} | {wide} | {inside} |",
            flush=True,
        )
    answers = list(known.values())
    for what, right in (("behaviour", [one.behaves for one in answers]), ("parameters", [one.parameters_inside for one in answers])):
        low, high = wilson(sum(right), len(right))
        print(f"\n{what}: held in {sum(right)} of {len(right)} cells ({low:.0%} to {high:.0%}).")
    sys.exit(sum(one.behaves for one in answers) < TARGET * len(answers))


if __name__ == "__main__":
    main()
