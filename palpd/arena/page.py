"""The page of scores: tools against rigs, and every miss."""

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from itertools import cycle
from pathlib import Path

from palpd.analysis.figure_style import BLUE, GREY, ORANGE, RED, YELLOW, save_figure, styled_figure
from palpd.arena.cases import ArenaRig
from palpd.arena.score import RigScore, ScoredAnswer, Share, by_rig, over_rigs
from palpd.file_kinds import PAGE_MARK
from palpd.files import check_writable, write_text

INTRODUCTION = """# The arena: {title}

What tools say of recordings whose cause is known. [The arena](arena.md) explains rigs, answers and score, and how to ask another tool.
*Bits*: what the truth costs under the stated probabilities, 0 at best. Intervals are 95 % intervals of Wilson. The worst rig of each tool
is bold. {asked} Scored on {date}; answers of {made_by}.

Again: `{command}`."""


def table(rows: Sequence[ScoredAnswer]) -> str:
    """The figures of one tool, as a table in Markdown: all rigs, then each; the worst one is bold."""
    scores = by_rig(rows)
    worst = max(scores, key=lambda each: each.bits).name
    lines = [
        "| rig | healthy silent | cause first | nothing else | outside the list | bits | processor time | no answer |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for each in [RigScore.of("all", rows), *scores]:
        name = f"**{each.name}**" if each.name == worst and len(scores) > 1 else each.name
        seconds = "–" if each.cpu_s is None else f"{each.cpu_s:.1f} s"
        lines.append(
            f"| {name} | {each.silent} | {each.first} | {each.alone} | {each.outside} | {each.bits:.2f} | {seconds} | {each.failed} |"
        )
    return "\n".join(lines)


def headline(rows: Sequence[ScoredAnswer]) -> str:
    """Means over rigs weighed alike."""
    parts = {
        "cause first": over_rigs(rows, lambda row: row.first, lambda row: not row.truth.healthy),
        "healthy silent": over_rigs(rows, lambda row: not row.alarm, lambda row: row.truth.healthy),
    }
    words = [f"{name} {100 * share:.0f} %" for name, share in parts.items() if share is not None]
    bits = over_rigs(rows, lambda row: row.bits)
    return ", ".join([*words, *([] if bits is None else [f"{bits:.2f} bits"])]) or "no rig has five questions"


def by_knowledge(rows: Sequence[ScoredAnswer]) -> str:
    """Right answers by how the truth is known, as a table in Markdown."""
    lines = ["| truth | healthy silent | cause first |", "|---|---|---|"]
    for known in sorted({row.truth.known for row in rows}):
        of = [row for row in rows if row.truth.known == known]
        silent = Share.of([row for row in of if row.truth.healthy], lambda row: not row.alarm)
        lines.append(f"| {known} | {silent} | {Share.of([row for row in of if not row.truth.healthy], lambda row: row.first)} |")
    return "\n".join(lines)


def misses(rows: Iterable[ScoredAnswer]) -> str:
    """Every wrong answer, as a table in Markdown."""
    lines = ["| rig | question | truth | answer |", "|---|---|---|---|"]
    for row in rows:
        if row.right and (row.truth.healthy or row.truth.outside or row.alone):
            continue
        truth = ", ".join(" or ".join(f"`{name}`" for name in sorted(names)) for names in row.truth.causes) or "healthy"
        named = ", ".join(" or ".join(f"`{name}`" for name in sorted(group)) for group in row.answer.named)
        message = row.answer.failed or row.answer.verdict + (f": {named}" if named else "")
        lines.append(f"| {row.question.rig} | {row.question.name} | {truth} | {message} |")
    return "\n".join(lines)


def write_page(folder: Path, cases: Path, rigs: Sequence[ArenaRig], tools: Mapping[str, Sequence[ScoredAnswer]]) -> Path:
    """Write a page of scores and its picture: arena-scores.md for the shipped rigs, else arena-NAME.md by the name of their folder.

    Args:
        folder: Where they are written.
        tools: Rows of each tool, the one whose misses are listed first.
    """
    stem, title = ("arena-scores", "scores") if cases.name == "arena" else (f"arena-{cases.name}", f"scores, {cases.name}")
    page, picture = (folder / f"{stem}.{ending}" for ending in ("md", "png"))
    check_writable(picture)
    questions = len(next(iter(tools.values())))
    head = INTRODUCTION.format(
        title=title,
        asked=f"{questions} questions to {len(rigs)} rigs.",
        date=datetime.now(tz=UTC).date(),
        made_by="; ".join(sorted({row.answer.made_by for rows in tools.values() for row in rows} - {""})) or "unknown versions",
        command=f"palpd arena score --cases {cases.name if cases.name != 'arena' else 'benchmarks/arena'} "
        + " ".join(f"--answers answers/{name}" for name in tools),
    )
    names = list(tools)
    lines = [PAGE_MARK, head, "", f"![Bits of each tool on each rig]({picture.name})", "", "## Tools", ""]
    lines += ["| tool | means over rigs weighed alike | best of all tools on |", "|---|---|---|"]
    bits = {name: {each.name: each.bits for each in by_rig(rows)} for name, rows in tools.items()}
    for name in names:
        best = [rig for rig, value in bits[name].items() if value <= min(other.get(rig, value) for other in bits.values())]
        lines.append(f"| {name} | {headline(tools[name])} | {len(best)} of {len(bits[name])} rigs |")
    for name in names:
        lines += ["", f"### {name}", "", table(tools[name])]
    lines += ["", "## By how the truth is known", "", f"{names[0]}:", "", by_knowledge(tools[names[0]])]
    lines += ["", f"## Every miss of {names[0]}", "", misses(tools[names[0]])]
    lines += [
        "",
        "## Rigs",
        "",
        *(f"- *{rig.name}*: {rig.title}" + (" (used to mend palpd)" if rig.used_to_mend else "") for rig in rigs),
        "",
    ]
    write_text(page, "\n".join(lines))
    _picture(picture, bits)
    return page


def _picture(path: Path, bits: Mapping[str, Mapping[str, float]]) -> None:
    """Bits of each tool on each rig, a line of dots a rig."""
    order = sorted({rig for of in bits.values() for rig in of}, key=lambda rig: -next(iter(bits.values())).get(rig, 0.0))
    with styled_figure(8.0, 1.0 + 0.28 * len(order)) as figure:
        axes = figure.subplots()
        for (tool, of), colour, mark in zip(bits.items(), cycle((BLUE, ORANGE, RED, YELLOW, GREY)), cycle("osD^v"), strict=False):
            known = [k for k, rig in enumerate(order) if rig in of]
            axes.plot(
                [of[order[k]] for k in known], known, mark, color=colour, label=tool, markersize=6 if tool == next(iter(bits)) else 4.5
            )
        axes.set_yticks(range(len(order)), order)
        axes.set_xlabel("bits that the truth costs (0: certain and right)")
        axes.set_xlim(left=0.0)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        save_figure(figure, path)
