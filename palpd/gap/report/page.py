"""A diagnosis as one self-contained page: the answer in plain words first, then the evidence for it, folded."""

from collections.abc import Mapping
from contextlib import suppress
from math import log10
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from markupsafe import Markup

from palpd.analysis.figure_style import ENRICHED, GREY, NOMINAL
from palpd.analysis.page import rendered_page
from palpd.cell.effects import Effect
from palpd.files import write_text
from palpd.gap.data.noise import CHANNELS
from palpd.gap.data.phases import PHASES
from palpd.gap.diagnosis import Diagnosis
from palpd.gap.other_motion import MotionCheck
from palpd.gap.plain import channel_words, plain_answer, shown_place, unit_of
from palpd.gap.report.figures import PHASE_WORDS, Curves, figures_of
from palpd.gap.report.sketch import law_sketch, sketch
from palpd.quantities import quantity
from palpd.recording.samples import Samples

MOST_CANDIDATES = 7


def write(path: Path, diagnosis: Diagnosis, title: str, check: MotionCheck | None = None) -> None:
    """Write the report of a diagnosis.

    Args:
        title: Names the recordings.
        check: The enriched cell on another motion; None where no other motion was recorded.

    Raises:
        BadInput: The file cannot be written.
    """
    write_text(path, page(diagnosis.to_json(), curves_of(diagnosis), diagnosis.problem.library, title, check))


def curves_of(diagnosis: Diagnosis) -> Curves:
    """The recording with the largest gap, and what the nominal and the enriched cell predict for its motion."""
    problem = diagnosis.problem
    channel = diagnosis.gap.where["channel"] if diagnosis.gap.where is not None else ""
    gaps = np.zeros(len(problem.recordings))
    for t in diagnosis.gap.trend:
        gaps[int(t["recording"])] += float(t["rms"]) ** 2 if t["channel"] == channel else 0.0
    shown = int(np.argmax(gaps))
    run = problem.recordings[shown]
    samples: Samples = run.samples
    return Curves(
        recording=shown,
        t_s=samples.t_s - samples.t_s[0],
        phase=run.phases.phase,
        cycle=run.phases.cycle,
        measured=np.column_stack([samples.z_m, samples.wrench]),
        nominal=problem.raw_prediction(run, problem.cell),
        enriched=problem.raw_prediction(run, diagnosis.enriched_cell()),
        noise_rms=np.asarray(run.noise_rms),
    )


def page(content: Mapping[str, Any], curves: Curves, library: Mapping[str, Effect], title: str, check: MotionCheck | None = None) -> str:
    """The report as HTML.

    Args:
        content: The content of out.json.
        curves: The recording that is drawn.
        library: Effects by id, for their descriptions and units.
        title: Names the recordings.
        check: The enriched cell on another motion; None where no other motion was recorded.
    """
    channel = (shown_place(content) or content["shrink"])["channel"]
    proposed = content["next_experiment"]
    return rendered_page(
        "palpd.gap.report",
        "report.html.j2",
        title=title,
        nominal=NOMINAL,
        enriched=ENRICHED,
        grey=GREY,
        d=content,
        plain=plain_answer(content, library),
        sketches={each["id"]: _sketch(each, library) for each in content["effects"]} | law_sketch(content),
        channel=channel_words(channel, content),
        phase_words=[PHASE_WORDS[phase] for phase in PHASES],
        candidates=_candidates(content),
        gap_rows=_gap_rows(content),
        excess=max((gap["excess"] for gap in content["gap"]), default=0.0),
        plan=yaml.safe_dump(proposed["plan"], sort_keys=False) if proposed else "",
        check="" if check is None else check.sentence,
        figures=figures_of(content, curves, channel, check),
    )


def _sketch(named: Mapping[str, Any], library: Mapping[str, Effect]) -> Markup:
    """The sketch of a named effect; empty where it cannot be drawn, since a user's effect may fail in any way on another motion."""
    with suppress(Exception):
        return sketch(library[named["id"]], {name: figure["value"] for name, figure in named["parameters"].items()})
    return Markup("")


def _candidates(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What may be the cause with its probability, the most probable first."""
    rows = [(each["id"], each["probability"]) for each in content["candidates"][:MOST_CANDIDATES]]
    rows += [("an effect that is not in the list", content["p_unknown"]), ("no gap", content["p_none"])]
    return [(name, f"{100.0 * p:.0f} %") for name, p in sorted(rows, key=lambda row: -row[1])]


def _gap_rows(content: Mapping[str, Any]) -> list[tuple[str, list[dict[str, Any] | None]]]:
    """The excess over the floor of each channel (row) in each phase (column); None where the phase does not occur."""
    gaps = {(g["channel"], g["phase"]): g for g in content["gap"]}

    def shown(channel: str, phase: str) -> dict[str, Any] | None:
        g = gaps.get((channel, phase))
        if g is None:
            return None
        return {
            "text": f"{g['excess']:.0f}" if g["excess"] >= 10 else f"{g['excess']:.1f}",
            "heat": f"{min(1.0, log10(1.0 + g['excess']) / log10(31.0)):.2f}" if g["excess"] >= 0.3 else "0",
            "tip": f"rms {quantity(g['rms'], unit_of(channel, content))}, floor {quantity(g['noise_floor'], unit_of(channel, content))}",
            "largest": content["where"] == {"channel": channel, "phase": phase},
        }

    judged = [channel for channel in CHANNELS if any(channel == c for c, _ in gaps)]
    return [(channel_words(channel, content), [shown(channel, phase) for phase in PHASES]) for channel in judged]
