"""The blind check as a page with figures for the documentation, from its JSON file alone."""

from collections import Counter
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import cast

import jinja2
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
)
from palpd.blind.truth import SOURCES
from palpd.documents import read_json
from palpd.errors import BadInput
from palpd.file_kinds import PAGE_MARK
from palpd.files import write_text
from palpd.quantities import wilson

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
TEMPLATE = "page.md.j2"
"""Text of the page, beside this file."""
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
    environment = jinja2.Environment(trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined, keep_trailing_newline=True)
    template = environment.from_string(files("palpd.blind").joinpath(TEMPLATE).read_text(encoding="utf-8"))
    cases, compared = _compared([result, *ablations]) if ablations else (0, [])
    text = template.render(
        mark=PAGE_MARK,
        checks=[_numbers(one) for one in (check, *others)],
        seed=result["seed"],
        tables=tables_as_markdown(result["tables"]),
        by_source={
            SOURCE_TITLES[source]: list(by_effect([o for o in outcomes if o["source"] == source]))
            for source in SOURCES
            if source in result["sources"]
        },
        ablations=[one["ablation"] or "" for one in ablations],
        ablated=ABLATED,
        cases=cases,
        compared=compared,
    )
    write_text(page, text)
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


def _compared(checks: Sequence[CheckResult]) -> tuple[int, list[tuple[str, list[str]]]]:
    """Least number of cells of each source, and the compared lines of every check over the cases that all have in common."""
    common = set.intersection(*({o["case"] for o in each["outcomes"]} for each in checks))
    tables = [table([o for o in each["outcomes"] if o["case"] in common]) for each in checks]
    lines = [(rows[0]["what"], [_brief(row) for row in rows]) for rows in zip(*tables, strict=True) if rows[0]["what"].startswith(COMPARED)]
    return min(each["cases"] for each in checks), lines


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
