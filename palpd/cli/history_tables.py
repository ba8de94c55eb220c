"""Tables and lines for the terminal of what the history knows; computes nothing."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from palpd.analysis.hertz_misfit import STAR_MEANS, star_note, starred
from palpd.history.report import fault_sentences, headline, report_conditions, when
from palpd.history.stored import printable, report_path
from palpd.quantities import kilopascals

if TYPE_CHECKING:
    from palpd.analysis.results import SiteResult
    from palpd.history.catalogue import EffectPoint, RunEntry
    from palpd.history.facts import RunFacts
    from palpd.history.remarks import Remarks
    from palpd.history.trend import ModulusPoint, Quantity, Slope
    from palpd.recording.reader import Recording

COLOURS = {"done": "green", "stopped": "red", "unreadable": "red"}
MOST_LETTERS = 60
"""Letters of a reason or a note in a table; palpd info shows all."""


LEFT = {"run", "ended", "static E (kPa)", "tags", "reason, note", "site", "cut short", "effect", "parameter"}
WHOLE = {"run", "began", "static", "dynamic", "corrected", "peak", "value"}
"""Columns that are not broken into lines."""


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", caption_justify="left", header_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in columns:
        table.add_column(name, justify="left" if name in LEFT else "right", overflow="fold", no_wrap=name in WHOLE)
    return table


def _modulus(modulus_Pa: float | None, ci95_Pa: "Sequence[float] | None", misfit: object) -> str:
    if misfit and modulus_Pa is not None and ci95_Pa is not None:
        low, high = (kilopascals(bound_Pa, modulus_Pa) for bound_Pa in ci95_Pa)
        return starred(f"{kilopascals(modulus_Pa)} ({low} to {high})", misfit)
    half = "" if ci95_Pa is None else f" ± {kilopascals((ci95_Pa[1] - ci95_Pa[0]) / 2.0, modulus_Pa)}"
    return kilopascals(modulus_Pa) + half


def _row(table: Table, *cells: str) -> None:
    """Add a row of texts from files: neither markup nor control characters count."""
    table.add_row(*(Text(printable(cell), style=COLOURS.get(cell, "")) for cell in cells))


def runs_table(entries: "Sequence[RunEntry]") -> Table:
    """The runs of a catalogue, a line each."""
    table = _table("Runs", "run", "began", "ended", "static E (kPa)", "tags", "reason, note")
    for entry in entries:
        known = [site for site in entry.sites if site.static_Pa is not None]
        moduli = ", ".join(starred(f"{site.site} {kilopascals(site.static_Pa)}", site.hertz_misfit) for site in known)
        words = "; ".join(filter(None, (entry.reason, entry.note)))
        kind = ("" if entry.kind in ("palpation", "") else f"{entry.kind} ") + ("dry " if entry.dry else "")
        short = words if len(words) <= MOST_LETTERS else f"{words[: MOST_LETTERS - 1]}…"
        _row(table, entry.name, when(entry.started)[:16], kind + entry.verdict, moduli, ", ".join(entry.tags), short)
    table.caption = STAR_MEANS if any(site.hertz_misfit for entry in entries for site in entry.sites) else None
    return table


def moduli_table(sites: "Sequence[SiteResult]") -> Table:
    """Moduli of a run with their intervals."""
    table = _table("Moduli in kPa, ± 95 %", "site", "static", "dynamic", "corrected", "peak", "cut short")
    for site in sites:
        _row(
            table,
            str(site["name"]),
            _modulus(site["static_youngs_modulus_Pa"], site["static_ci95_Pa"], site["hertz_misfit"]),
            kilopascals(site["dynamic_original_Pa"]),
            _modulus(site["dynamic_corrected_Pa"], site["dynamic_corrected_ci95_Pa"], site["hertz_misfit"]),
            "–" if site["peak_force_N"] is None else f"{site['peak_force_N']:.2f} N",
            ", ".join(f"{depth_m * 1e3:g} mm" for depth_m in site["cut_short_depths_m"]) or "none",
        )
    table.caption = printable(star_note({str(site["name"]): site["hertz_misfit"] for site in sites})) or None
    return table


def info_lines(recording: "Recording", facts: "RunFacts", remarks: "Remarks") -> tuple[list[str], list[str]]:
    """What `palpd info` prints before the table of moduli, and behind it.

    Args:
        remarks: Tags and notes.

    Returns:
        The lines before and the lines after.
    """
    loop = facts["loop"]
    before = [
        f"{facts['name']}: {facts['kind']}{', dry' if facts['dry'] else ''}, {when(facts['started'])}, {facts['duration_s']:.1f} s",
        f"{facts['verdict']}: {headline(facts).removeprefix('Done: ')}",
        *(f"  {name:<18}{value}" for name, value in report_conditions(recording, facts)),
    ]
    after = [
        f"Loop: {loop['ticks']} ticks, {loop['missed']} missed, work p50 {loop.get('work_us_p50', 0):.0f} µs, p99 "
        f"{loop.get('work_us_p99', 0):.0f} µs, woke up late by p50 {loop.get('wakeup_us_p50', 0):.0f} µs, p99 "
        f"{loop.get('wakeup_us_p99', 0):.0f} µs"
    ]
    if dry := facts["dry_figures"]:
        after.append(f"Dry: noise of fz {dry['noise_N'] * 1e3:.0f} mN rms")
    after += [f"fault: {sentence}" for sentence in fault_sentences(facts)]
    after += [f"cut short: {sentence}" for sentence in facts["cut_short"]]
    after += [f"deviation: {sentence}" for sentence in facts["deviations"]]
    if remarks.tags:
        after.append(f"tags: {', '.join(remarks.tags)}")
    after += [f"note ({note.date[:10]}): {note.text}" for note in remarks.notes]
    report = report_path(recording.path)
    after.append(f"recording: {facts['path']} ({facts['bytes'] / 1e6:.1f} MB, SHA-256 {facts['recording_sha256'][:16]}…)")
    after.append(f"report: {report}" if report.exists() else f"report: none yet; palpd report {facts['path']} writes it")
    return before, after


def modulus_trend_table(points: "Sequence[ModulusPoint]", site: str) -> Table:
    """The moduli of a site over the days.

    Args:
        points: Oldest first.
    """
    table = _table(f"Site {printable(site)} over the days, kPa ± 95 %", "began", "run", "static", "dynamic", "corrected")
    for run, of in points:
        static = _modulus(of.static_Pa, of.static_ci95_Pa, of.hertz_misfit)
        corrected = _modulus(of.corrected_Pa, of.corrected_ci95_Pa, of.hertz_misfit)
        _row(table, when(run.started)[:16], run.name, static, kilopascals(of.dynamic_Pa), corrected)
    table.caption = STAR_MEANS if any(point.moduli.hertz_misfit for point in points) else None
    return table


def effect_trend_table(effects: "Mapping[tuple[str, str], tuple[list[EffectPoint], Slope | None]]") -> Table:
    """The parameters of effects that diagnoses have named, over the days, as `effect_trend` gives them."""
    table = _table("Named effects over the days", "began", "run", "effect", "parameter", "value", "95 %", "probability")
    for points, _ in effects.values():
        for point in points:
            interval = "–" if point.low is None or point.high is None else f"{point.low:.3g} to {point.high:.3g}"
            figures = f"{point.value:.4g}", interval, f"{point.probability:.2f}"
            _row(table, when(point.started)[:16], point.run, point.effect, point.parameter, *figures)
    return table


def slope_lines(slopes: "Mapping[Quantity, Slope]") -> list[str]:
    """What the slopes of a site's moduli say, a line each."""
    return [
        f"{quantity}: {slope.per_day / 1e3:+.2g} kPa per day (95 %: {slope.ci95_per_day[0] / 1e3:+.2g} to "
        f"{slope.ci95_per_day[1] / 1e3:+.2g}), mean {kilopascals(slope.mean)} kPa over {slope.points} runs in {slope.days:.2g} days"
        for quantity, slope in slopes.items()
    ]
