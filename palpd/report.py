"""Tables for the terminal from what other modules computed; computes nothing."""

from typing import Any

from rich.table import Table


def site_table(sites: list[dict[str, Any]], bias_N: float | None) -> Table:
    """How stiff each site is, static against dynamic, and what the correction did. `bias_N` is the model card's."""
    table = Table(title="How stiff each site is", title_justify="left", header_style="bold")
    for name in ("site", "true E", "static E", "off"):
        table.add_column(name, justify="left" if name == "site" else "right")
    for name in ("dynamic E\noriginal", "dynamic E\ncorrected", "YMBT\noriginal", "YMBT\ncorrected", "peak\nforce", "cut\nshort"):
        table.add_column(name, justify="right")
    table.add_column("correction\n= bias + inertial", justify="right")
    for site in sites:
        true, static = site.get("true_youngs_modulus_Pa"), site["static_youngs_modulus_Pa"]
        table.add_row(
            site["name"],
            _kPa(true),
            _kPa(static),
            f"{static / true - 1:+.1%}" if static and true else "–",
            _kPa(site["dynamic_original_Pa"]),
            _kPa(site["dynamic_corrected_Pa"]),
            _percent(site["ymbt_original"]),
            _percent(site["ymbt_corrected"]),
            f"{site['peak_force_N']:.2f} N" if site["peak_force_N"] is not None else "–",
            ", ".join(f"{d * 1e3:g} mm" for d in site["cut_short_depths_m"]) or "none",
            _parts(site["correction_N"], bias_N),
        )
    return table


def depth_table(sites: list[dict[str, Any]]) -> Table:
    """Every hold: depth commanded and reached, force, modulus."""
    table = Table(title="Static palpation", title_justify="left", header_style="bold")
    for name in ("site", "commanded", "reached", "force", "E"):
        table.add_column(name, justify="left" if name == "site" else "right")
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


def overshoot_table(predicted: dict[str, Any]) -> tuple[Table, Table]:
    """Delays between a force and the arm's answer, and what they cost in newtons."""
    delays = Table(title="From a force to the arm at rest", title_justify="left", header_style="bold")
    for name in ("delay", "ms", "from"):
        delays.add_column(name, justify="right" if name == "ms" else "left")
    for term in predicted["delays"]:
        delays.add_row(term["name"], f"{term['duration_s'] * 1e3:.1f}", term["source"])
    delays.add_row("together", f"{sum(term['duration_s'] for term in predicted['delays']) * 1e3:.1f}", "")
    forces = Table(title="Predicted force beyond a limit", title_justify="left", header_style="bold")
    speeds = sorted({row["speed_m_per_s"] for row in predicted["overshoot"]})
    forces.add_column("against", justify="right")
    for speed in speeds:
        forces.add_column(f"at {speed * 1e3:g} mm/s", justify="right")
    for stiffness in sorted({row["stiffness_N_per_m"] for row in predicted["overshoot"]}):
        of = {row["speed_m_per_s"]: row["overshoot_N"] for row in predicted["overshoot"] if row["stiffness_N_per_m"] == stiffness}
        forces.add_row(f"{stiffness / 1e3:g} N/mm", *(f"{of[speed]:.2f} N" for speed in speeds))
    return delays, forces


def _kPa(modulus_Pa: float | None) -> str:
    return f"{modulus_Pa / 1e3:.1f} kPa" if modulus_Pa is not None else "–"


def _percent(share: float | None) -> str:
    return f"{share * 100:.1f} %" if share is not None else "–"


def _parts(correction_N: float | None, bias_N: float | None) -> str:
    if correction_N is None or bias_N is None:
        return "none"
    return f"{correction_N:+.3f} N = {bias_N:+.3f} {'+' if correction_N >= bias_N else '-'} {abs(correction_N - bias_N):.3f}"
