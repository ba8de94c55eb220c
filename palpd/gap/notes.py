"""Sentences for the reader about a verdict: what is larger than working parts have, far out of tolerance, or outside a law's range."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from palpd.cell.effects import Effect
from palpd.cell.effects.adopted import load_adopted
from palpd.cell.effects.learned import held_sentence
from palpd.cell.simulation import share_outside
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import CHANNELS, FZ
from palpd.gap.decide import DiagnosisVerdict
from palpd.gap.laws.evidence import FitBeside
from palpd.gap.model.problem import Problem, tolerance_key
from palpd.gap.model.servo_error import largest_miss_N_s_per_m
from palpd.quantities import quantity

MOST_HELD_UNSAID = 0.01
"""Share of the rows outside the range of a law up to which no note is made: the range itself leaves out 0.4 % of the data of the law."""


CREEP_NOTE = (
    "Force that decays while the height is held comes from relaxing tissue or from a creeping machine (frame, grip, load cell). "
    "This recording alone cannot distinguish them. Press something rigid and hold: the decay is then the machine's creep."
)


def verdict_notes(problem: Problem, verdict: DiagnosisVerdict) -> Iterator[str]:
    """All sentences about a verdict."""
    yield from unnatural_notes(problem, verdict)
    yield from deviation_notes(problem, verdict.answer)
    if verdict.beyond.note:
        yield verdict.beyond.note
    if (axis := verdict.lone_axis) is not None:
        shown, expected = (quantity(rms, "N" if axis.channel <= FZ else "N m") for rms in axis.noise)
        yield (
            f"{CHANNELS[axis.channel]} alone has a noise of {shown} rms at rest, expected at most {expected} as of the other axes; "
            "check its gauge and its cable."
        )
    yield from held_notes(problem, verdict)
    involved = {name for e in verdict.effects for name in (e.id, *e.indistinguishable_from)}
    yield from cycle_notes(problem, verdict)
    if any(problem.library[name].shows_at_rest for name in involved):
        yield CREEP_NOTE


def unnatural_notes(problem: Problem, verdict: DiagnosisVerdict) -> list[str]:
    """A sentence for every parameter of a named effect that is larger than working parts have (`Parameter.natural`)."""
    return [
        f"{effect.id} has {parameter.name} {quantity(effect.parameters[parameter.name][0], parameter.unit)}, expected at most "
        f"{quantity(parameter.natural, parameter.unit)} of parts that work; check the times in the recording, and whether rows are missing."
        for effect in verdict.effects
        for parameter in problem.library[effect.id].parameters
        if parameter.natural is not None and abs(effect.parameters[parameter.name][0]) >= parameter.natural
    ]


def deviation_notes(problem: Problem, answer: FitBeside) -> list[str]:
    """A sentence for every deviation that the answer leaves far out of tolerance."""
    deviation_sd, notes = answer.deviation_sd, []
    for k, label in enumerate(answer.fit.linearisation.labels):
        judged = label.scope == "cell" or (label.scope == "recording" and label.channel == FZ and label.name != "rounding")
        unknown = label.name == "youngs_modulus" and not problem.cell.tolerances.modulus_known
        if judged and not unknown and abs(deviation_sd[k]) > ASSUMED.noise.credible_sd:
            key = tolerance_key(label.name)
            notes.append(
                f"{label.name} is {deviation_sd[k]:+.1f} standard deviations off, expected at most {ASSUMED.noise.credible_sd:g}; "
                f"check tolerances.{key} ({getattr(problem.cell.tolerances, key):.3g}) and the cell itself."
            )
    return notes


def held_notes(problem: Problem, verdict: DiagnosisVerdict) -> list[str]:
    """A sentence for every learned law, of the library or of the cell, that these recordings drive outside its range."""
    cell = problem.cell_at(verdict.fit.values, verdict.fit.eta)
    samples = [one.samples for one in problem.recordings]
    shares: dict[str, list[float]] = {}
    for one in samples:
        for name, share in share_outside(cell, one.t_s, z_cmd_m=one.z_cmd_m, z_m=one.z_m, library=problem.library).items():
            shares.setdefault(name, []).append(share)
    rows = [len(one.t_s) for one in samples]
    means = {name: float(np.average(each, weights=rows)) for name, each in shares.items() if len(each) == len(rows)}
    return [held_sentence(name, share) for name, share in means.items() if share > MOST_HELD_UNSAID]


def cycle_notes(problem: Problem, verdict: DiagnosisVerdict) -> Iterator[str]:
    """A sentence for a drag that samples between held targets may feign, where no recording shows a cycle of the controller."""
    drag = next((effect for effect in verdict.effects if effect.id == "cable.viscous"), None)
    if drag is None or any(recording.cycle_s is not None for recording in problem.recordings):
        return
    largest = max(largest_miss_N_s_per_m(recording, problem.cell) for recording in problem.recordings)
    if drag.parameters["coefficient_N_s_per_m"][0] < largest:
        yield (
            f"A controller that holds each target for one sample, and smooths nothing, can look like up to {quantity(largest, 'N s/m')} of "
            "cable.viscous in samples at one phase of its cycle; record at twice the rate to exclude it."
        )


def adopted_sentence(folder: Path, known: Mapping[str, Effect]) -> str:
    """Which adopted effects took part, and the folder in which they stand; empty if none did."""
    names = [name for name in load_adopted(folder) if name in known]
    return f"Adopted effects were weighed with the others: {', '.join(names)} ({folder})." if names else ""
