"""Adopted laws: of unlisted causes accepted in one recording of a drawn cell, how many are named as adopted in another one?

Cells, motions and causes are those of the blind check. The second recording has another motion and other presses.
"""

import argparse
import json
import sys
from dataclasses import asdict

import numpy as np

from palpd.blind.adoption import AdoptionOutcome, adopt_and_name
from palpd.blind.detectability import Detectability, fit_strength, scales_of
from palpd.blind.drawn_cases import measured
from palpd.blind.drawn_cells import CellRealisation, Deviations, DrawnMotion, draw_cell, draw_deviations, draw_motion
from palpd.blind.laws import NOVEL_LAWS, Law, Planted
from palpd.blind.truth import CannotDraw
from palpd.cell.cell_file import CellFile, cell_from
from palpd.recording.samples import Samples
from palpd.tick import Floats

SNR = (20.0, 60.0)
MOST_ROWS = 12_000
MOST_BINS = 1500
"""Longer recordings and more bins only make it slow: a cell takes half a minute."""

ATTEMPTS = 40
EVENTS = ("wander", "slip", "pulses", "jumping zero")
"""Causes that are no law: they happen once, or at random."""

OF_TIME = ("breathing", "hum")
"""Causes that repeat in time: the second recording begins at another moment of them."""


def pair(seed: int, index: int, *, absent: bool = False) -> tuple[Law, Samples, Samples, CellFile]:
    """Two recordings of a drawn cell with one unlisted cause.

    Args:
        seed: Seed of the benchmark.
        index: Number of the cell; the causes take turns.
        absent: Whether the second recording is one without the cause.

    Returns:
        The cause, both recordings, and the cell file.

    Raises:
        CannotDraw: No cell shows the cause at these sizes.
    """
    laws = [law for law in NOVEL_LAWS if law.effect not in EVENTS]
    law = laws[index % len(laws)]
    for attempt in range(ATTEMPTS):
        r = np.random.default_rng([seed, index, attempt])
        cell = draw_cell(r)
        motions = [draw_motion(r, cell) for _ in range(2)]
        if max(motion.duration_s for motion in motions) * cell.rate_Hz > MOST_ROWS:
            continue
        deviations = draw_deviations(r, motions[0])
        detectability = Detectability(cell, deviations, motions[0], _rows(cell, motions[0]))
        fitted = fit_strength(detectability, law, law.draw(r, scales_of(detectability)), float(np.exp(r.uniform(*np.log(SNR)))))
        if fitted is None:
            continue
        other = draw_deviations(r, motions[1])
        first = _recorded(r, cell, deviations, motions[0], [(law, fitted.parameters)])
        later = fitted.parameters | {
            name: r.uniform(-np.pi, np.pi) for name in fitted.parameters if name == "phase_rad" and law.effect in OF_TIME
        }
        second = _recorded(r, cell, Deviations(deviations.of, other.surface, other.stiffness), motions[1], [] if absent else [(law, later)])
        return law, first, second, cell_from(cell.as_yaml(), "the drawn cell")
    raise CannotDraw(law.effect)


def _rows(cell: CellRealisation, motion: DrawnMotion) -> Floats:
    return np.arange(int(motion.duration_s * cell.rate_Hz)) / cell.rate_Hz


def _recorded(
    r: np.random.Generator, cell: CellRealisation, deviations: Deviations, motion: DrawnMotion, planted: list[Planted]
) -> Samples:
    t_s = _rows(cell, motion)
    run = Detectability(cell, deviations, motion, t_s).run(planted)
    return measured(r, cell, run, motion, t_s, planted, cell.rate_Hz)


def main() -> None:
    """Print one line for each cell, and the share that is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--absent", action="store_true", help="the second recording lacks the cause, and must not be given its name")
    asked = parser.parse_args()
    outcomes: list[AdoptionOutcome] = []
    for index in range(asked.first, asked.first + asked.cells):
        try:
            law, first, second, cell = pair(asked.seed, index, absent=asked.absent)
        except CannotDraw as error:
            print(f"{index}: cannot draw {error}")
            continue
        outcomes.append(adopt_and_name(first, second, cell, MOST_BINS))
        print(json.dumps({"case": index, "cause": law.effect} | asdict(outcomes[-1])))
        sys.stdout.flush()
    accepted = [one for one in outcomes if one.law is not None and not one.secondary]
    named, group = sum(one.named for one in accepted), sum(one.in_group for one in accepted)
    print(f"{len(outcomes)} cells; {len(accepted)} laws accepted; {named} named as adopted, {group} in the group")


if __name__ == "__main__":
    main()
