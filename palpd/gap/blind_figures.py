"""The blind check as a page with figures for the documentation, made from its JSON file alone."""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpd.gap.blind_cells import STRATA
from palpd.gap.blind_score import LAWS, Outcome, alone, answer, as_markdown, by_effect, calibration, first_right, table, wilson

matplotlib.use("Agg")
BLUE, ORANGE, GREY = "#0b7fab", "#e07b00", "#8a94a3"

PREAMBLE = """\
Recordings come from `palpd/gap/blind_cells.py` and `blind_laws.py`, which share no physics with the library: another integrator at
2400 Hz or more, every law written anew, and other laws for the same effects. In every cell all tolerances are off by a normal
deviate, every press scatters, noise is 0.85 to 1.18 times the stated, no two cycles are alike; in a fifth of those above 190 Hz the
robot reports at 125 Hz and is interpolated. SNR is the norm of the noise-free change over 20 ms means of all channels, in sensor
sigmas of such a mean, where tolerances and press scatter (as Gaussians) cannot hide it."""

READING = """\
Right means the very id that was planted, whatever group it stands in, where the line does not say otherwise. *Without a twin* are all
effects but bias, drift, warm-up, gain, modulus, thickness, inclusion, tilt and crosstalk; the lines on the right cause and on nothing
else named are about these. The best mimic of an effect that was not given is the listed effect that, fitted to its noise-free change,
leaves the smallest SNR."""

COMPARED = (
    "right cause first",
    "right and nothing",
    "two effects",
    "healthy cell",
    "never given",
    "known effect",
    "expected calibration",
)

ABLATED = {
    "white noise": "*white noise*: the cell file states tolerances 10 000 times smaller and no press scatter: every residual is noise",
    "no tolerances": "*no tolerances*: the cell file states them 10 000 times smaller, the scatter of presses as it is",
    "no press scatter": "*no press scatter*: the cell file says that presses do not scatter",
    "fz only": "*fz only*: neither the commanded heights nor the other five channels are shown",
}


def write_page(result: dict[str, Any], folder: Path, ablations: Sequence[dict[str, Any]] = ()) -> Path:
    """Write blind.md and its figures into a folder: table, confusion, calibration, size; ablations beside where given."""
    folder.mkdir(parents=True, exist_ok=True)
    outcomes: list[Outcome] = result["outcomes"]
    _confusion(outcomes, folder / "blind-confusion.png")
    _calibration_and_size(outcomes, folder / "blind-calibration.png")
    lines = [
        "# The blind check",
        "",
        f"{result['cases']} cells drawn with seed {result['seed']}; SHA-256 over the sealed files: `{result['sealed_sha256']}`.",
        f"Again: `palpd blind --cases {result['cases']} --seed {result['seed']} --json blind.json --docs docs`.",
        "",
        PREAMBLE,
        "",
        as_markdown(result["table"]),
        READING,
        "",
        "![what was planted and what was named](blind-confusion.png)",
        "",
        "![probability stated and share right; share right over SNR](blind-calibration.png)",
        "",
        "## By effect",
        "",
        "| planted | n | first | alone | in the group | called unknown | named instead |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in by_effect(outcomes):
        instead = ", ".join(f"{name} ({n})" for name, n in row["instead"].items())
        counts = " | ".join(str(row[key]) for key in ("n", "first", "alone", "in_group", "unknown"))
        lines.append(f"| {row['effect']} | {counts} | {instead} |")
    if ablations:
        lines += ["", "## What each part buys", "", *_ablation_table(result, ablations)]
    page = folder / "blind.md"
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return page


def _ablation_table(result: dict[str, Any], ablations: Sequence[dict[str, Any]]) -> list[str]:
    """Lines of the table with a part of the method's footing taken away, all of them of the cases that every check has drawn."""
    cases = min(each["cases"] for each in [result, *ablations])
    tables = [table(each["outcomes"][:cases]) for each in [result, *ablations]]
    heads = ["everything", *(a["ablation"] for a in ablations)]
    lines = [
        f"The first {cases} cells once more, with a part taken away: `palpd blind --cases {cases} --seed {result['seed']} --ablation …`.",
        "",
        *(f"- {ABLATED[a['ablation']]}" for a in ablations),
        "",
        "| what | " + " | ".join(heads) + " |",
        "|---|" + "---|" * len(heads),
    ]
    for k, row in enumerate(tables[0]):
        if row["what"].startswith(COMPARED):
            lines.append(f"| {row['what']} | " + " | ".join(_brief(each[k]) for each in tables) + " |")
    return lines


def _brief(row: dict[str, Any]) -> str:
    if row["value"] is None:
        return "–"
    return f"{100 * row['value']:.0f} % of {row['n']}" if row["share"] else f"{row['value']:.2g}"


def _confusion(outcomes: Sequence[Outcome], path: Path) -> None:
    """Planted against named first, singles and healthy cells."""
    pairs: Counter[tuple[str, str]] = Counter()
    for o in outcomes:
        if o["kind"] in {"healthy", "library", "foreign", "novel"}:
            true = {"healthy": "healthy", "novel": "not listed"}.get(o["kind"]) or o["planted"][0]
            pairs[true, {"none": "healthy", "unknown": "not listed"}.get(answer(o), answer(o))] += 1
    names = sorted({name for pair in pairs for name in pair}, key=lambda n: (n in {"healthy", "not listed", "failed"}, n))
    counts = np.array([[pairs[a, b] for b in names] for a in names], dtype=float)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
    figure = Figure(figsize=(11, 10), layout="constrained")
    axes: Axes = figure.subplots()
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for i, j in zip(*np.nonzero(counts), strict=True):
        ink = "white" if share[i, j] > 0.6 else "black"
        axes.text(int(j), int(i), f"{counts[i, j]:.0f}", ha="center", va="center", fontsize=7, color=ink)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_xlabel("named first (an unknown verdict counts as not listed)")
    axes.set_ylabel("planted")
    figure.savefig(path, dpi=110)


def _calibration_and_size(outcomes: Sequence[Outcome], path: Path) -> None:
    """Stated probability against share right; share right and alone against SNR."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    error, rows = calibration(outcomes)
    left.plot([0, 1], [0, 1], color=GREY, lw=1)
    for p, share, n in rows:
        low, high = wilson(round(share * n), n)
        left.plot([p, p], [low, high], color=BLUE, lw=1)
        left.plot(p, share, "o", color=BLUE, ms=3 + 2 * np.log10(n + 1))
        left.annotate(str(n), (p, share), textcoords="offset points", xytext=(7, -4), fontsize=8)
    left.set(xlabel="stated probability of the answer", ylabel="share right", xlim=(0, 1.05), ylim=(0, 1.05))
    left.set_title(f"calibration error {error:.3f}")
    for (kind, name), colour in zip(LAWS, (BLUE, ORANGE), strict=True):
        for right_of, style, label in ((first_right, "-o", "named first"), (alone, ":s", "alone")):
            x, y = [], []
            for low_snr, high_snr in STRATA.values():
                mine = [o for o in outcomes if o["kind"] == kind and o["snr"] is not None and low_snr <= o["snr"] < high_snr]
                if mine:
                    x.append((low_snr * high_snr) ** 0.5)
                    y.append(sum(map(right_of, mine)) / len(mine))
            right.plot(x, y, style, color=colour, label=f"{name}, {label}", ms=5)
    right.set(xscale="log", xlabel="SNR", ylabel="share of single effects", ylim=(0, 1.05), title="by size, twins included")
    right.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def load(path: Path) -> dict[str, Any]:
    """A result of the blind check from its JSON file."""
    return dict(json.loads(path.read_text(encoding="utf-8")))
