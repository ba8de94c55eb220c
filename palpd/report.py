"""Tables for the terminal from what other modules computed; computes nothing."""

from collections.abc import Mapping
from typing import Any

from rich.table import Table


def site_tables(sites: list[dict[str, Any]], bias_N: float | None) -> tuple[Table, Table]:
    """How stiff each site is, static against dynamic; and what the correction did. `bias_N` is the model card's; the running zero is
    bias too.
    """
    stiff = _table("How stiff each site is (E in kPa)", "site", "true", "static", "off", "dynamic", "corrected", "YMBT", "corrected")
    forces = _table("Forces", "site", "peak", "cut short", "correction", "= bias", "+ inertial")
    for site in sites:
        true, static, correction_N = site.get("true_youngs_modulus_Pa"), site["static_youngs_modulus_Pa"], site["correction_N"]
        stiff.add_row(
            site["name"],
            _kPa(true),
            _kPa(static),
            f"{static / true - 1:+.1%}" if static and true else "–",
            _kPa(site["dynamic_original_Pa"]),
            _kPa(site["dynamic_corrected_Pa"]),
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
            f"{correction_N - site_bias_N:+.3f} N" if parts else "–",
        )
    return stiff, forces


def depth_table(sites: list[dict[str, Any]]) -> Table:
    """Every hold: depth commanded and reached, force, modulus."""
    table = _table("Static palpation", "site", "commanded", "reached", "force", "E (kPa)")
    for site in sites:
        for depth in site["depths"]:
            table.add_row(
                site["name"],
                f"{depth['commanded_m'] * 1e3:.1f} mm",
                f"{depth['achieved_m'] * 1e3:.3f} mm" if depth["achieved_m"] is not None else "–",
                f"{depth['force_N']:.2f} N" if depth["force_N"] is not None else "cut short",
                _kPa(depth["E_Pa"]),
            )
    return table


def diagnosis_lines(sentence: str, content: dict[str, Any]) -> list[str]:
    """A diagnosis in a few lines: the verdict, each effect with its parameters, before and after, what to record next."""
    lines = [sentence]
    for named in content["effects"]:
        values = ", ".join(
            f"{name} = {value['value']:.4g} (95 %: {value['ci95'][0]:.4g} to {value['ci95'][1]:.4g})"
            for name, value in named["parameters"].items()
        )
        group = f"; cannot be told from {', '.join(named['indistinguishable_from'])}" if named["indistinguishable_from"] else ""
        lines.append(f"  {named['id']}, probability {named['probability']:.2f}: {values}{group}")
    shrink = content["shrink"]
    if shrink and shrink["closed"] is not None:
        lines.append(
            f"Gap in {shrink['channel']}: {shrink['before_rms']:.4g} before, {shrink['after_rms']:.4g} after, floor "
            f"{shrink['noise_floor']:.4g}: {shrink['closed']:.0%} closed on {shrink['on']}."
        )
    if content["next_experiment"]:
        lines.append(f"Next: {content['next_experiment']['sentence']}")
    return lines + [f"Note: {note}" for note in content["notes"]]


def effect_table(library: Mapping[str, Any]) -> Table:
    """The effects of a library: what each does, and its parameters."""
    table = _table("Effects", "effect", "parameters", "what it does")
    for effect in library.values():
        table.add_row(effect.id, ", ".join(parameter.name for parameter in effect.parameters), effect.what)
    return table


def confound_table(likes: list[Any]) -> Table:
    """What effects could be mistaken for, and from which size on not."""
    table = _table("What it could be mistaken for (free strokes, holds and presses)", "effect", "like", "cosine", "what")
    for like in likes:
        table.add_row(like.effect, like.other, f"{like.cosine:.3f}", like.words)
    return table


def recordings_table(rows: list[Any]) -> Table:
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


def fleet_table(cells: list[Any]) -> Table:
    """Cell by cell: what it has now, since when, and the trend."""
    table = _table("Cells", "cell", "recordings", "verdict", "effects", "since", "trend")
    for cell in cells:
        failed = f" ({cell.failed} failed)" if cell.failed else ""
        verdict, effects = cell.verdict or "failed", ", ".join(cell.effects) or "–"
        table.add_row(cell.cell, f"{cell.recordings}{failed}", verdict, effects, cell.since or "–", cell.trend)
    return table


def published_table(found: dict[str, Any]) -> Table:
    """The paper's gap between dynamic and static modulus by setup, and what each would need to have it explained."""
    table = _table("Corrected dynamic over static modulus at the same depth, and what would make it so", "setup", "gap (95 %)")
    of = {e["what"]: e["needs"] for e in found["explanations"] if e["needs"]}
    for name in ("a force", "a share of the contact", "a press deeper by"):
        table.add_column(name, justify="right")
    for setup, (value, low, high) in found["gap"].items():
        force, share = (needs[setup] for needs in of.values())
        interval = f"{value:.0%} ({low:.0%} to {high:.0%})"
        table.add_row(setup, interval, f"{force:.2f} N", f"{share:.0%}", f"{found['deeper_m'][setup] * 1e3:.2f} mm")
    return table


def overshoot_table(predicted: dict[str, Any]) -> tuple[Table, Table]:
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


def _kPa(modulus_Pa: float | None) -> str:
    return f"{modulus_Pa / 1e3:.1f}" if modulus_Pa is not None else "–"


def _percent(share: float | None) -> str:
    return f"{share * 100:.1f} %" if share is not None else "–"


LEFT = {"from", "parameters", "what it does", "what", "effects", "since", "trend", "like"}


def _table(title: str, first: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", header_style="bold")
    table.add_column(first)
    for name in columns:
        table.add_column(name, justify="left" if name in LEFT else "right")
    return table
