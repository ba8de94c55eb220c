"""The blind check as a page with figures for the documentation, from its JSON file alone."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
from matplotlib.axes import Axes

from palpd.analysis.figure_style import BLUE, GREY, ORANGE, save_figure, styled_figure
from palpd.blind.check import SCHEMA, CheckResult, together
from palpd.blind.drawn_cases import STRATA
from palpd.blind.outcome import CaseOutcome
from palpd.blind.score import (
    LAWS,
    SOURCE_TITLES,
    ScoreRow,
    alone,
    answer,
    answered,
    by_effect,
    calibration,
    calibration_error,
    first_right,
    table,
    tables_as_markdown,
    wilson,
)
from palpd.blind.truth import SOURCES
from palpd.documents import read_json
from palpd.errors import BadInput
from palpd.file_kinds import PAGE_MARK
from palpd.files import write_text

INTRODUCTION = """\
How often the diagnosis is right on cells whose truth it cannot see. `palpd blind` makes the cells, seals their truth, diagnoses
the recordings in another process, and then scores the answers. Each source of cells has its own table, the worst first.
[diagnosis.md](diagnosis.md#how-far-to-trust-it) compares these figures with recordings of other rigs, and says what this check cannot
show."""
"""What the reader gets; stands at the head of the page."""

PREAMBLE = """\
No source shares physics or laws with the library. The contract is [the contract of a diagnosis](reference/contract.md).

| source | motion and force | laws |
|---|---|---|
| `drawn` | own integrator at 2400 Hz or more, a second-order servo | written anew, with the contract's formula and with others |
| `mujoco` | MuJoCo: a slide or a six-axis arm with one of five controllers | changes of its model, and an own sensor model |
| `injected` | recorded: real cells (`--recordings`), or healthy cells of MuJoCo's | other laws than the contract's, planted |

In every simulated cell all tolerances are off by a normal deviate, every press scatters, and the noise is 0.85 to 1.18 times the stated
noise. No two cycles are alike. MuJoCo's controllers hold their targets (125 or 500 Hz), have a third order, or limit the jerk. In a fifth
of the drawn cells above 190 Hz, and in most of MuJoCo's, the robot reports slower than the sensor.

The SNR of an effect is the norm of its noise-free change over 20 ms means of all channels, in sensor sigmas of such a mean. Changes that
tolerances and press scatter (as Gaussians) can hide do not count. It is 6 to 200 in drawn and injected cells, and 4 to 60 in MuJoCo's.

`--coarse N` adds N cells of each source whose readings have coarse steps, two healthy ones for each one with a listed effect. The steps
of fz, of the lateral forces and of the torques are drawn apart from each other and from what acts. Each is 1 to 8 times the stated noise,
uniform in the logarithm; that of a HEX-70's fz is 4.4 times. The cell file states steps and noise. The SNR counts a step as white noise
of its square over 12. This says too much where a force rests within one step: there the true SNR can be far smaller. A recording of
`injected` is rounded once the effect is in it, to a whole multiple of its own step. It keeps its own step where that is the coarser."""
"""How the cells are made; stands above the tables."""

READING = """\
A target is met if the estimate reaches it. With fewer cases than the line needs there is no verdict. The worst source is the one with the
largest mean shortfall from its targets.

An answer is right if it names the very effect that was planted, whatever the effect is indistinguishable from, unless the line says
otherwise. Bias, drift, warm-up, gain, modulus, thickness, inclusion, tilt and crosstalk have an indistinguishable effect. The lines
on the right cause and on nothing else named leave these out. The best mimic of an effect outside the list is the effect of the
library that, fitted to its noise-free change, leaves the smallest SNR. Where another law was planted, an interval covers if it holds the
parameter of the listed law that is nearest to the planted change. The declared causes of a real host count neither for nor against an
answer.

A law outside the list is right if the first term that the diagnosis learned has one of the true law's names: channel, factor and driver,
a period within 10 %, a time constant within a factor of two. Several names can be right: while one tissue is pressed, depth and force say
the same. A law that is no factor × curve(driver), such as stick-slip, counts in the line on wrong laws alone. `--unlisted N` adds N cells
of each source for these lines. The band is judged on the rows of the recording: the enriched cell is simulated on the noise-free motion
with the law, without it, and with its curve raised by 1.96 standard deviations, and a row is covered if the true change lies inside.
The mean of an added force is free, since the tare decides it. A listed cause is sufficient if its own law was planted, or if it leaves
an SNR below 10 of the planted one."""
"""How the tables are read; stands below them."""

OWN_RECORDINGS = """\
## On your own recordings

`palpd blind --source injected --recordings FOLDER` plants effects into recordings of your cells. It says how well the diagnosis does on
your motions and your noise. FOLDER holds X.csv with X.yaml, and `causes.yaml` (or another file, with `--causes`). That file says what
acts in each:

```yaml
X: {causes: []}                                    # healthy
Y: {causes: [cable.friction, robot.backlash]}      # known causes: never planted again, and naming them is right
Z: {causes: [sensor.saturation], unlisted: true}   # something outside the list acts too: this one is no host
```

The effect's change is computed on the recorded motion and added to the recorded channels. Sensor effects act on the recorded force.
Effects of the robot change the reported height. A channel that a recording does not hold stays as it is. If the step of the readings is
larger than their noise, they are rounded twice. The gap closed on another motion is judged on simulated hosts only."""
"""How to plant effects into recordings; stands below the effects."""

COMPARED = (
    "right cause first",
    "right and nothing",
    "two effects",
    "healthy cell",
    "outside the list",
    "known effect",
    "expected calibration",
)
"""Beginnings of the lines of the table that are compared between ablations."""

ABLATED = {
    "white noise": "*white noise*: the cell file states no press scatter and tolerances 10 000 times smaller, so every residual is noise",
    "no tolerances": "*no tolerances*: the cell file states tolerances 10 000 times smaller and the true press scatter",
    "no press scatter": "*no press scatter*: the cell file states no press scatter",
    "fz only": "*fz only*: the diagnosis sees neither the commanded heights nor the other five channels",
}
"""What each ablation takes away."""
PAGE_FILES = ("blind.md", "blind-confusion.png", "blind-calibration.png")
"""What `write_page` writes into its folder."""


def write_page(check: CheckResult, folder: Path, ablations: Sequence[CheckResult] = (), others: Sequence[CheckResult] = ()) -> Path:
    """Write blind.md and its figures into a folder.

    Args:
        folder: where the page and the figures go; it is created.
        ablations: results of checks with a part of the method taken away, to be compared.
        others: results of checks of other sources with the same seed, for the same page.
    """
    folder.mkdir(parents=True, exist_ok=True)
    result = together([check, *others])
    outcomes = result["outcomes"]
    page, confusion, calibration = (folder / name for name in PAGE_FILES)
    _confusion(outcomes, confusion)
    _calibration_and_size(outcomes, calibration)
    lines = [
        PAGE_MARK,
        "# The blind check",
        "",
        INTRODUCTION,
        "",
        *(f"- {_numbers(one)}" for one in (check, *others)),
        "",
        f"A published table's seed is the first eight hex digits of the measured commit, here {result['seed']:08x}.",
        "",
        PREAMBLE,
        "",
        "## Results",
        "",
        tables_as_markdown(result["tables"]),
        READING,
        "",
        "![what was planted and what was named](blind-confusion.png)",
        "",
        "![probability stated and share right; share right over SNR](blind-calibration.png)",
        "",
        "## By effect",
        "",
        "Numbers of cells: the planted effect was named first, named alone, or in the group named first, or the answer was unknown.",
    ]
    for source in (source for source in SOURCES if source in result["sources"]):
        lines += ["", f"### {SOURCE_TITLES[source]}", "", *_effect_table([o for o in outcomes if o["source"] == source])]
    lines += ["", OWN_RECORDINGS]
    if ablations:
        lines += ["", "## What each part of the method contributes", "", *_ablation_table(result, ablations)]
    write_text(page, "\n".join(lines) + "\n")
    return page


def _numbers(result: CheckResult) -> str:
    each = f"cells of each source ({', '.join(result['sources'])})" if len(result["sources"]) > 1 else f"{result['sources'][0]} cells"
    numbers = f"{result['cases']} {each}"
    if result["large"]:
        numbers += f" and {result['large']} further drawn cells with one effect of SNR > 20"
    if result["coarse"]:
        numbers += f" and {result['coarse']} further cells of each source with coarse steps"
    return f"{numbers}, seed {result['seed']}; SHA-256 over the sealed files: `{result['sealed_sha256']}`. Again: `{_command(result)}`."


def _command(result: CheckResult) -> str:
    source = "all" if len(result["sources"]) == len(SOURCES) else ",".join(result["sources"])
    parts = [f"palpd blind --source {source} --cases {result['cases']} --seed {result['seed']}"]
    parts += [f"--{name} {result[name]}" for name in ("large", "unlisted", "coarse") if result[name]]
    parts += [f"--recordings {result['recordings']}"] if result["recordings"] else []
    return " ".join([*parts, "--json blind.json --docs docs"])


def _effect_table(outcomes: Sequence[CaseOutcome]) -> list[str]:
    lines = [
        "| planted | n | first | alone | in the group | called unknown | named instead |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in by_effect(outcomes):
        instead = ", ".join(f"{name} ({n})" for name, n in row["instead"].items())
        counts = " | ".join(str(row[key]) for key in ("n", "first", "alone", "in_group", "unknown"))
        lines.append(f"| {row['effect']} | {counts} | {instead} |")
    return lines


def _ablation_table(result: CheckResult, ablations: Sequence[CheckResult]) -> list[str]:
    """The table of every ablation, over the cases that all checks have in common."""
    cases = min(each["cases"] for each in [result, *ablations])
    names = [{o["case"] for o in each["outcomes"]} for each in [result, *ablations]]
    common = set.intersection(*names)
    tables = [table([o for o in each["outcomes"] if o["case"] in common]) for each in [result, *ablations]]
    heads = ["everything", *(a["ablation"] or "" for a in ablations)]
    lines = [
        f"The first {cases} cells of each source once more, without one part of the method: "
        f"`palpd blind --cases {cases} --seed {result['seed']} --ablation …`.",
        "",
        *(f"- {ABLATED[a['ablation'] or '']}" for a in ablations),
        "",
        "| what | " + " | ".join(heads) + " |",
        "|---|" + "---|" * len(heads),
    ]
    for k, row in enumerate(tables[0]):
        if row["what"].startswith(COMPARED):
            lines.append(f"| {row['what']} | " + " | ".join(_brief(each[k]) for each in tables) + " |")
    return lines


def _brief(row: ScoreRow) -> str:
    if row["value"] is None:
        return "–"
    return f"{100 * row['value']:.0f} % of {row['n']}" if row["share"] else f"{row['value']:.2g}"


def _confusion(outcomes: Sequence[CaseOutcome], path: Path) -> None:
    """Planted against named first, singles and healthy cells."""
    pairs: Counter[tuple[str, str]] = Counter()
    for o in outcomes:
        if o["kind"] in {"healthy", "library", "foreign", "novel"}:
            true = {"healthy": "healthy", "novel": "not listed"}.get(o["kind"]) or o["planted"][0]
            pairs[true, {"none": "healthy", "unknown": "not listed"}.get(answer(o), answer(o))] += 1
    names = sorted({name for pair in pairs for name in pair}, key=lambda n: (n in {"healthy", "not listed", "failed"}, n))
    counts = np.array([[pairs[a, b] for b in names] for a in names], dtype=float)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
    with styled_figure(11.0, 10.0) as figure:
        axes = figure.subplots()
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
        for i, j in zip(*np.nonzero(counts), strict=True):
            ink = "white" if share[i, j] > 0.6 else "black"
            axes.text(int(j), int(i), f"{counts[i, j]:.0f}", ha="center", va="center", fontsize=7, color=ink)
        axes.grid(visible=False)
        axes.set_xticks(range(len(names)), names, rotation=90)
        axes.set_yticks(range(len(names)), names)
        axes.set(xlabel="named first (an unknown verdict counts as not listed)", ylabel="planted")
    save_figure(figure, path)


def _calibration_and_size(outcomes: Sequence[CaseOutcome], path: Path) -> None:
    """Stated probability against share right; share right and alone against SNR."""
    with styled_figure(11.0, 4.2) as figure:
        left, right = figure.subplots(1, 2)
        _draw_calibration(left, outcomes)
        _draw_share_over_snr(right, outcomes)
    save_figure(figure, path)


def _draw_calibration(axes: Axes, outcomes: Sequence[CaseOutcome]) -> None:
    pairs = [pair for pair in map(answered, outcomes) if pair is not None]
    error, rows = calibration_error(pairs), calibration(pairs)
    axes.plot([0, 1], [0, 1], color=GREY)
    for p, share, n in rows:
        axes.plot([p, p], wilson(round(share * n), n), color=BLUE)
        axes.plot(p, share, "o", color=BLUE, markersize=3 + 2 * np.log10(n + 1))
        axes.annotate(str(n), (p, share), textcoords="offset points", xytext=(7, -4), fontsize=8)
    axes.set(xlabel="stated probability of the answer", ylabel="share right", xlim=(0, 1.05), ylim=(0, 1.05))
    axes.set_title(f"calibration error {error:.3f}")


def _draw_share_over_snr(axes: Axes, outcomes: Sequence[CaseOutcome]) -> None:
    for (kind, name), colour in zip(LAWS, (BLUE, ORANGE), strict=True):
        for is_right, style, label in ((first_right, "-o", "named first"), (alone, ":s", "alone")):
            points = []
            for low, high in STRATA.values():
                mine = [o for o in outcomes if o["kind"] == kind and o["snr"] is not None and low <= o["snr"] < high]
                if mine:
                    points.append(((low * high) ** 0.5, sum(map(is_right, mine)) / len(mine)))
            axes.plot(
                [snr for snr, _ in points], [share for _, share in points], style, color=colour, label=f"{name}, {label}", markersize=5
            )
    axes.set(xscale="log", xlabel="SNR", ylabel="share of single effects", ylim=(0, 1.05))
    axes.set_title("by size, indistinguishable effects included")
    axes.legend()


def load(path: Path) -> CheckResult:
    """A result of the blind check from its JSON file."""
    check = read_json(path)
    if not isinstance(check, dict) or check.get("schema") != SCHEMA:
        raise BadInput(f"{path} holds no result of a blind check of this version ({SCHEMA}); give the JSON of one")
    return cast("CheckResult", check)
