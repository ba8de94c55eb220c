"""Tables for the terminal from what other modules computed; computes nothing."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from palpd.quantities import kilopascals, number, quantity

if TYPE_CHECKING:
    from palpd.analysis.results import SiteResult
    from palpd.cell.effects import Effect
    from palpd.cell.effects.learned import LearnedEffect
    from palpd.daemon.finding import Finding
    from palpd.daemon.overshoot import OvershootForecast
    from palpd.gap.fleet import CellRow, FleetRow
    from palpd.gap.infer.detectable import DetectableSize
    from palpd.gap.similar_effects import Similarity


def site_tables(sites: "list[SiteResult]", bias_N: float | None) -> tuple[Table, Table]:
    """Draw how stiff each site is, static against dynamic, and the forces with the share of the correction.

    Args:
        sites: Results of a run.
        bias_N: Bias of the inertial model's card; None without a model. The running zero is bias too.

    Returns:
        The table of moduli and the table of forces.
    """
    from palpd.analysis.hertz_misfit import star_note, starred

    stiff = _table("How stiff each site is (E in kPa)", "site", "true", "static", "off", "dynamic", "corrected", "YMBT", "corrected")
    forces = _table("Forces", "site", "peak", "cut short", "correction", "= bias", "+ inertial")
    for site in sites:
        true, static, correction_N = site.get("true_youngs_modulus_Pa"), site["static_youngs_modulus_Pa"], site["correction_N"]
        stiff.add_row(
            site["name"],
            kilopascals(true),
            starred(kilopascals(static), site["hertz_misfit"]),
            f"{static / true - 1:+.1%}" if static and true else "–",
            kilopascals(site["dynamic_original_Pa"]),
            starred(kilopascals(site["dynamic_corrected_Pa"]), site["hertz_misfit"]),
            _percent(site["ymbt_original"]),
            _percent(site["ymbt_corrected"]),
        )
        parts = bias_N is not None and correction_N is not None
        site_bias_N = (bias_N or 0.0) + (site["running_zero_N"] or 0.0)
        forces.add_row(
            site["name"],
            f"{site['peak_force_N']:.2f} N" if site["peak_force_N"] is not None else "–",
            ", ".join(f"{d * 1e3:g} mm" for d in site["cut_short_depths_m"]) or "none",
            f"{correction_N:+.3f} N" if parts else "none",
            f"{site_bias_N:+.3f} N" if parts else "–",
            f"{correction_N - site_bias_N:+.3f} N" if parts and correction_N is not None else "–",
        )
    stiff.caption = star_note({site["name"]: site["hertz_misfit"] for site in sites}) or None
    return stiff, forces


def depth_table(sites: "list[SiteResult]") -> Table:
    """Every hold: depth commanded and reached, force, modulus."""
    table = _table("Static palpation", "site", "commanded", "reached", "force", "E (kPa)")
    for site in sites:
        for depth in site["depths"]:
            table.add_row(
                site["name"],
                f"{depth['commanded_m'] * 1e3:.1f} mm",
                f"{depth['achieved_m'] * 1e3:.3f} mm" if depth["achieved_m"] is not None else "–",
                f"{depth['force_N']:.2f} N" if depth["force_N"] is not None else "cut short",
                kilopascals(depth["E_Pa"]),
            )
    return table


def diagnosis_lines(content: dict[str, Any]) -> list[str]:
    """Write a diagnosis in a few lines: doubts, answer, each cause with its parameters, what to do next.

    Args:
        content: The diagnosis as its JSON has it.
    """
    decisive, plain = content["decisive"], content["plain"]
    lines = [*(f"Doubtful: {note}" for note in decisive), plain["answer"]]
    lines += filter(None, (" ".join(filter(None, (plain["sure"], plain["where"], plain["closed"]))), content["basis"]))
    for cause in plain["causes"]:
        lines.append(f"  {cause['id']}: {cause['sentence']} {cause['sure']} {cause['mistaken_for']}")
        lines += [f"    {name}: {label} {value}" for name, label, value in cause["parameters"]]
    lines += [f"  {event}" for event in plain["events"]]
    lines += [f"Next: {sentence} {command}".rstrip() for sentence, command in plain["steps"]]
    return lines + [f"Note: {note}" for note in content["notes"] if note not in decisive]


def effect_table(library: "Mapping[str, Effect]") -> Table:
    """The effects of a library: what each does, and its parameters."""
    table = _table("Effects", "effect", "parameters", "what it does")
    for effect in library.values():
        table.add_row(effect.id, ", ".join(parameter.name for parameter in effect.named_parameters), effect.what)
    return table


def adopted_table(laws: "Mapping[str, LearnedEffect]", folder: Path) -> Table:
    """The adopted effects of a user: what each does, over which range it was learned, and what imitates it.

    Args:
        folder: The folder that they stand in.
    """
    from palpd.cell.effects.drivers import UNITS

    table = _table(f"Adopted effects ({folder})", "effect", "what it does", "learned in", "imitated by")
    for law in laws.values():
        ranges = "; ".join(f"{number(t.range[0], 4)} to {number(t.range[1], 4)} {UNITS[t.driver.quantity]}" for t in law.terms)
        imitated = ", ".join(f"{name} ({cosine:.2f})" for name, cosine in (law.confounds or {}).items())
        table.add_row(law.id, law.what, ranges, imitated or "nothing in the list")
    return table


def similarity_table(similar: "Sequence[Similarity]") -> Table:
    """What effects could be mistaken for, and from which size on not."""
    table = _table("What it could be mistaken for (free strokes, holds and presses)", "effect", "similar", "cosine", "what")
    for pair in similar:
        table.add_row(pair.effect, pair.other, f"{pair.cosine:.3f}", pair.words)
    return table


def recordings_table(rows: "Sequence[FleetRow]") -> Table:
    """Recording by recording: which effect, how sure, how far the gap closes."""
    table = _table("Recordings", "recording", "verdict", "effects", "probability", "closed", "what")
    for row in sorted(rows, key=lambda row: (str(row.cell), str(row.name))):
        table.add_row(
            row.name if row.cell == row.name else f"{row.cell}: {row.name}",
            row.verdict or "failed",
            ", ".join(row.effects) or "–",
            f"{row.probability:.2f}" if row.probability is not None else "–",
            f"{row.closed:.0%}" if row.closed is not None else "–",
            row.sentence if row.verdict is None else "",
        )
    return table


def fleet_table(cells: "Sequence[CellRow]") -> Table:
    """Cell by cell: what it has now, since when, and the trend."""
    table = _table("Cells", "cell", "recordings", "verdict", "effects", "since", "trend")
    for cell in cells:
        failed = f" ({cell.failed} failed)" if cell.failed else ""
        verdict, effects = cell.verdict or "failed", ", ".join(cell.effects) or "–"
        table.add_row(cell.cell, f"{cell.recordings}{failed}", verdict, effects, cell.since or "–", cell.trend)
    return table


def published_table(figures: dict[str, Any]) -> Table:
    """The paper's gap between dynamic and static modulus by setup, and what each would need to have it explained."""
    table = _table("Corrected dynamic over static modulus at the same depth, and what would make it so", "setup", "gap (95 %)")
    of = {e["what"]: e["needs"] for e in figures["explanations"] if e["needs"]}
    for name in ("a force", "a share of the contact", "a press deeper by"):
        table.add_column(name, justify="right")
    for setup, (value, low, high) in figures["gap"].items():
        force, share = (needs[setup] for needs in of.values())
        interval = f"{value:.0%} ({low:.0%} to {high:.0%})"
        table.add_row(setup, interval, f"{force:.2f} N", f"{share:.0%}", f"{figures['deeper_m'][setup] * 1e3:.2f} mm")
    return table


def overshoot_table(predicted: "OvershootForecast") -> tuple[Table, Table]:
    """Delays between a force and the arm's answer, and what they cost in newtons."""
    delays = _table("From a force to the arm at rest", "delay", "ms", "from")
    for term in predicted["delays"]:
        delays.add_row(term["name"], f"{term['duration_s'] * 1e3:.1f}", term["source"])
    delays.add_row("together", f"{sum(term['duration_s'] for term in predicted['delays']) * 1e3:.1f}", "")
    speeds = sorted({row["speed_m_per_s"] for row in predicted["overshoot"]})
    forces = _table("Predicted force beyond a limit", "against", *(f"at {speed * 1e3:g} mm/s" for speed in speeds))
    for stiffness in sorted({row["stiffness_N_per_m"] for row in predicted["overshoot"]}):
        of = {row["speed_m_per_s"]: row["overshoot_N"] for row in predicted["overshoot"] if row["stiffness_N_per_m"] == stiffness}
        forces.add_row(f"{stiffness / 1e3:g} N/mm", *(f"{of[speed]:.2f} N" for speed in speeds))
    return delays, forces


def finding_table(findings: "Sequence[Finding]") -> Table:
    """One line a finding of `palpd doctor`."""
    table = Table("check", "", "measured", "what to do")
    colours = {"ok": "green", "warn": "yellow", "fail": "red"}
    for finding in findings:
        table.add_row(finding.name, Text(finding.verdict, colours[finding.verdict]), finding.measured, finding.advice)
    return table


def check_table(points: Sequence[Mapping[str, Any]]) -> Table:
    """Draw what a morning check measured, how far that is from what healthy days let expect, and how far it may be.

    Args:
        points: The `figures` of its `--json`.
    """
    table = _table("What the check measured", "figure", "today", "change", "tolerance", "changed since")
    for point in points:
        sizes = (point["value"], point["value"] - point["expected"], point["tolerance"])
        cells = [f"{size:.2g} %" if point["unit"] == "%" else quantity(size, point["unit"]) for size in sizes]
        table.add_row(point["words"], *cells, point["since"] or "")
    return table


def _percent(share: float | None) -> str:
    return f"{share * 100:.1f} %" if share is not None else "–"


LEFT = {
    "learned in", "imitated by", "from", "parameter", "parameters", "what it does", "what", "effects", "since", "trend", "similar",
    "or what is needed",
}  # fmt: skip


def limits_table(sizes: "Sequence[DetectableSize]") -> Table:
    """Draw the smallest size of each effect that recordings would show, or what they need to show it."""
    table = _table("What these recordings would show", "effect", "parameter", "from", "or what is needed")
    for one in sizes:
        others = ", ".join(f"{name} {number(value)}" for name, value in one.others.items())
        smallest = "not at all" if one.smallest is None else quantity(one.smallest, one.parameter.unit)
        table.add_row(one.effect, one.parameter.label, smallest, one.needs or (others and f"with {others}"))
    return table


def _table(title: str, first: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", caption_justify="left", header_style="bold")
    table.add_column(first)
    for name in columns:
        table.add_column(name, justify="left" if name in LEFT else "right")
    return table
