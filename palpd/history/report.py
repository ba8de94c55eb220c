"""The report of a run: one self-contained page, or one printed sheet (PDF, PNG), from its recording alone."""

import json
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from palpd.analysis.figure_style import inline_svg, save_figure, styled_figure
from palpd.analysis.page import rendered_page
from palpd.errors import BadInput
from palpd.files import write_text
from palpd.history import figures
from palpd.history.card import site_rows, tare_and_guard
from palpd.history.catalogue import FILE, Catalogue, RunFilter
from palpd.history.comparison import DifferentSetting, ModulusDifference, different_settings, modulus_differences
from palpd.history.facts import RunFacts, load, reading
from palpd.history.remarks import Remarks, remarks_of
from palpd.history.stored import name_in, printable
from palpd.history.trend import ModulusPoint, modulus_points
from palpd.quantities import kilopascals
from palpd.recording.reader import Recording
from palpd.tick import Phase

KIND_WORDS = {
    "palpation": "palpation",
    "injection": "palpation of palpd inject (no moduli)",
    "free_motion": "free motion",
    "stiffness": "stiffness of the machine",
    "retract": "way out of the tissue",
    "calibrate": "reference tare",
    "check": "check of the devices",
}
FIGURES = ("forces", "map", "course", "loop", "trend")
MOST_REMARKABLE = 4
"""Sentences on what to know of a run that the card shows; all stand below it."""
LAST_TICKS = 10
"""Ticks before a stop that are shown."""
MOST_RUNS = 200
"""Newest runs that the trend of a report looks at."""
FEWEST_RUNS = 3
"""Runs of a site from which on a report shows its trend."""
MOST_SETTINGS = 40
"""Settings that differ between two runs, and are listed."""
SHEET_IN = (8.27, 11.69)
"""A4."""
SHEET_LETTERS = (12, 26, 26, 50, 10, 16)
"""Most letters of a cell in each column of its table."""


@dataclass(frozen=True)
class RunReport:
    """What a report is made of. `history` are the points of the catalogue by site, for the trend."""

    recording: Recording
    facts: RunFacts
    remarks: Remarks
    beside: Recording | None = None
    beside_facts: RunFacts | None = None
    history: Mapping[str, Sequence[ModulusPoint]] | None = None


def report_of(recording: Path, beside: Path | None = None, history: Mapping[str, Sequence[ModulusPoint]] | None = None) -> RunReport:
    """Read what a report is made of.

    Args:
        recording: The recording of the run.
        beside: The recording of a run to compare it with; None for none.
        history: Points of the catalogue by site, for the trend; None: no trend.

    Returns:
        The parts of the report.

    Raises:
        RecordingError: A recording cannot be read.
        BadInput: The remarks cannot be read.
    """
    mine, facts = load(recording)
    theirs, their_facts = (None, None) if beside is None else load(beside)
    return RunReport(mine, facts, remarks_of(recording), theirs, their_facts, history)


def site_history(recording: Path, folder: Path) -> dict[str, list[ModulusPoint]]:
    """Points for the trend: the sites of a run in the newest runs of a folder, as the catalogue knows them now.

    Returns:
        Points by site, oldest first; none where the run or the catalogue has none.
    """
    name = name_in(folder, recording)
    if name is None or not (folder / FILE).exists():
        return {}
    with Catalogue(folder) as catalogue:
        entries = catalogue.runs(RunFilter(kind="palpation", most=MOST_RUNS))
    mine = next((entry for entry in entries if entry.name == name), None)
    return {} if mine is None else {site.site: modulus_points(entries, site.site) for site in mine.sites}


def write_report(path: Path, report: RunReport) -> None:
    """Write the page; a file that exists is replaced.

    Args:
        path: The HTML file.

    Raises:
        RecordingError: The recording holds what no page can show.
        BadInput: The file cannot be written.
    """
    write_text(path, page(report))


def page(report: RunReport) -> str:
    """The report as HTML.

    Raises:
        RecordingError: The recording holds what no page can show.
    """
    facts, header = report.facts, report.recording.header
    with reading(report.recording.path):
        differences = [] if report.beside_facts is None else modulus_differences(facts, report.beside_facts)
        settings = [] if report.beside is None else different_settings(header, report.beside.header)
        return rendered_page(
            "palpd.history",
            "report.html.j2",
            title=printable(facts["name"]),
            f=facts,
            remarks=report.remarks,
            kind=KIND_WORDS.get(facts["kind"], facts["kind"]),
            when=when(facts["started"]),
            robot=str(facts["about"].get("robot_host", "?")),
            sensor=str(facts["about"].get("sensor_serial") or "of unknown serial"),
            mood=mood(facts),
            headline=headline(facts),
            sites=site_rows(facts),
            tare_and_guard=tare_and_guard(report.recording, facts),
            misfits=[f"Site {site['name']}: {misfit['sentence']}." for site in facts["sites"] if (misfit := site["hertz_misfit"])],
            depths=_depth_rows(facts),
            remarkable=_remarkable(facts),
            most_remarkable=MOST_REMARKABLE,
            duration=_duration(facts["duration_s"]),
            timing=_timing_rows(facts),
            last_ticks=_last_ticks(report.recording) if facts["verdict"] != "done" else [],
            conditions=report_conditions(report.recording, facts),
            hashes=[
                ("recording", facts["recording_sha256"]),
                ("config.yaml as parsed", facts["config_sha256"]),
                ("plan.yaml as parsed", facts["plan_sha256"]),
                ("inertial model", facts["model_sha256"] or "no model"),
            ],
            config=json.dumps(header["config"], indent=1, ensure_ascii=False),
            plan=json.dumps(header["plan"], indent=1, ensure_ascii=False),
            beside="" if report.beside_facts is None else printable(report.beside_facts["name"]),
            differences=[_difference_row(each) for each in differences],
            settings=[_setting_row(each) for each in settings[:MOST_SETTINGS]],
            more_settings=max(0, len(settings) - MOST_SETTINGS),
            left_out=max(0, sum(map(figures.is_pressed, facts["sites"])) - figures.MOST_SITES),
            figures=dict.fromkeys(FIGURES, "")
            | {name: _svg(name, height_in, draw) for name, (height_in, draw) in _figures(report).items()},
        )


def sheet(report: RunReport) -> Figure:
    """The report on one printed page: what it was, the table of moduli, forces, course and timing.

    Raises:
        RecordingError: The recording holds what no page can show.
    """
    facts, drawings = report.facts, _figures(report)
    drawn = {name: drawings[name] for name in ("forces", "map", "course") if name in drawings}
    table = [[*row[:4], *row[5:]] for row in site_rows(facts)[: figures.MOST_SITES]]
    name, words = printable(facts["name"]), headline(facts)
    with reading(report.recording.path), figures.any_text(), styled_figure(*SHEET_IN) as figure:
        conditions = ", ".join(f"{key} {value}" for key, value in report_conditions(report.recording, facts)[:3])
        lines = [
            f"{KIND_WORDS.get(facts['kind'], facts['kind'])}, {when(facts['started'])}, {_duration(facts['duration_s'])}. {words}",
            *_remarkable(facts)[:MOST_REMARKABLE],
            *tare_and_guard(report.recording, facts),
            conditions,
        ]
        text = "\n".join(_wrapped(printable(line), 120) for line in lines if line)
        head_in = 0.8 + 0.17 * text.count("\n") + 0.22 * (len(table) + 1)
        heights_in = [head_in, *(height_in for height_in, _ in drawn.values())]
        places: Any = figure.subfigures(len(heights_in), 1, height_ratios=heights_in)  # an array: there always are several
        head, *parts = places
        head.text(0.02, 0.97, name[:80].replace("$", r"\$"), fontsize=13, weight="bold", va="top")
        head.text(0.02, 0.97 - 0.3 / head_in, text.replace("$", r"\$"), fontsize=8, va="top", linespacing=1.35)
        if table:
            axes = head.add_axes((0.02, 0.0, 0.96, (0.22 + 0.2 * len(table)) / head_in))
            axes.axis("off")
            titles = ["site", "static E (95 %)", "dynamic, corrected", "Hertz", "peak", "cut short"]
            cells = [[printable(cell).replace("$", r"\$")[: SHEET_LETTERS[k]] for k, cell in enumerate(row)] for row in table]
            widths = np.array(SHEET_LETTERS) / sum(SHEET_LETTERS)
            drawing = axes.table(
                cellText=cells, colLabels=titles, colWidths=widths, loc="upper left", cellLoc="left", colLoc="left", edges="horizontal"
            )
            drawing.auto_set_font_size(False)
            drawing.set_fontsize(8)
        for part, (_, draw) in zip(parts, drawn.values(), strict=True):
            draw(part)
        return figure


def refuse_ending(path: Path | None, ending: str) -> None:
    """Refuse a name whose ending says another format.

    Args:
        path: The file; None is no file.
        ending: The only ending that is right.

    Raises:
        BadInput: It has another one.
    """
    if path is not None and path.suffix != ending:
        raise BadInput(f"{path} ends with {path.suffix!r}, expected {ending}; give such a name")


def save_sheet(path: Path, report: RunReport) -> None:
    """Write the printed page.

    Args:
        path: The file, .pdf or .png.

    Raises:
        BadInput: The file cannot be written.
    """
    figure = sheet(report)
    with figures.any_text():
        save_figure(figure, path)


# --- figures ----------------------------------------------------------------------------------------------------------------------


def _figures(report: RunReport) -> dict[str, tuple[float, Callable[[figures.Drawing], None]]]:
    """What is drawn: the height of each figure in inches, and what draws it."""
    facts, recording = report.facts, report.recording
    drawings: dict[str, tuple[float, Callable[[figures.Drawing], None]]] = {}
    if pressed := [site for site in facts["sites"] if figures.is_pressed(site)]:
        rows = -(-min(len(pressed), figures.MOST_SITES) // figures.SITES_A_ROW)
        drawings["forces"] = 0.6 + 2.4 * rows, lambda figure: figures.draw_forces(figure, recording, facts["sites"], report.beside)
    measured = [each["static_youngs_modulus_Pa"] or each["dynamic_corrected_Pa"] for each in facts["sites"]]
    if len(measured) - measured.count(None) > 1:
        places_m = np.array([(each["x_m"], each["y_m"]) for each in recording.header["sites"]], float)
        drawings["map"] = 2.2, lambda figure: figures.draw_map(figure, places_m, facts["sites"])
    drawings["course"] = 3.6, lambda figure: figures.draw_course(figure, recording, facts["trips"])
    drawings["loop"] = 2.6, lambda figure: figures.draw_loop(figure, recording)
    history = {site: points for site, points in (report.history or {}).items() if len(points) >= FEWEST_RUNS}
    if history:
        rows = -(-min(len(history), figures.MOST_SITES) // figures.SITES_A_ROW)
        drawings["trend"] = 0.6 + 2.0 * rows, lambda figure: figures.draw_trend(figure, history, facts["started_s"])
    return drawings


def _svg(name: str, height_in: float, draw: Callable[[figures.Drawing], None]) -> Markup:
    with figures.any_text(), styled_figure(4.4 if name == "map" else 10.0, height_in) as figure:
        draw(figure)
        return inline_svg(figure, name)


# --- words ------------------------------------------------------------------------------------------------------------------------


def when(started: str) -> str:
    """Date and time as people read them: 2026-11-22 23:22:10."""
    return started[:19].replace("T", " ")


def mood(facts: RunFacts) -> str:
    """Whether a run went as it should: `done`, `remarkable` (done, and something to know of it) or `stopped`."""
    if facts["verdict"] != "done":
        return "stopped"
    return "remarkable" if fault_sentences(facts) or facts["cut_short"] or facts["deviations"] else "done"


def headline(facts: RunFacts) -> str:
    """How a run ended, in one sentence."""
    if facts["verdict"] != "done":
        reason = facts["reason"] or f"the run ended {facts['verdict']}"
        return reason[:1].upper() + reason[1:]
    if not facts["sites"]:
        return "Done."
    presses = sum(len(site["presses"]) + sum(depth["E_Pa"] is not None for depth in site["depths"]) for site in facts["sites"])
    pressed = sum(map(figures.is_pressed, facts["sites"]))
    count = len(facts["cut_short"])
    cut = f", {count} {'depth' if count == 1 else 'depths'} cut short" if count else ""
    return f"Done: {presses} presses at {pressed} {'site' if pressed == 1 else 'sites'}{cut}."


def fault_sentences(facts: RunFacts) -> list[str]:
    """What stopped a run, and what was lost of it or kept data from its loop."""
    sentences = [str(trip["reason"]) for trip in facts["trips"]]
    stalls = facts["loop"].get("stalls")
    if stalls is not None:
        for number, longest_s, what in (
            (stalls["computer"], stalls["computer_longest_s"], "this computer stood still"),
            (stalls["sensor"], stalls["sensor_longest_s"], "the sensor was silent"),
            (stalls["robot"], stalls["robot_longest_s"], "the robot was silent"),
        ):
            if number:
                sentences.append(f"{what} {number} {'time' if number == 1 else 'times'}, at most {longest_s * 1e3:.0f} ms")
    if facts["loop"]["missed"]:
        sentences.append(f"{facts['loop']['missed']} of {facts['loop']['ticks']} ticks were missed")
    if facts["lost_rows"]:
        sentences.append(f"{facts['lost_rows']} ticks were overwritten before the recorder read them")
    if facts["damaged_ticks"]:
        sentences.append(f"{facts['damaged_ticks']} ticks could not be restored from the damaged file")
    return sentences


def _remarkable(facts: RunFacts) -> list[str]:
    """What to know of a run besides why it ended, the gravest first."""
    sentences = [*fault_sentences(facts), *facts["cut_short"], *facts["deviations"]]
    return [each for each in sentences if facts["verdict"] == "done" or each != facts["reason"]]


def _duration(duration_s: float) -> str:
    minutes, seconds = divmod(round(duration_s), 60)
    return f"{minutes} min {seconds} s" if minutes else f"{duration_s:.1f} s"


def _depth_rows(facts: RunFacts) -> list[list[str]]:
    """Every hold, and the presses to one depth together: commanded, reached, force, modulus."""
    rows = []
    for site in facts["sites"]:
        name = str(site["name"])
        for hold in site["depths"]:
            force_N = "–" if hold["force_N"] is None else f"{hold['force_N']:.2f}"
            depths = f"{hold['commanded_m'] * 1e3:g}", _mm(hold["achieved_m"])
            rows.append([name, "static", *depths, force_N, kilopascals(hold["E_Pa"]), _cut(hold["cut_short"])])
        for depth_m in sorted({press["commanded_m"] for press in site["presses"]}):
            presses = [press for press in site["presses"] if press["commanded_m"] == depth_m]
            reached_m = float(np.mean([press["achieved_m"] for press in presses]))
            force_N = f"{np.mean([press['original_N'] - press['correction_N'] for press in presses]):.2f}"
            modulus = kilopascals(float(np.mean([press["corrected_Pa"] for press in presses])))
            depths, cut = (f"{depth_m * 1e3:g}", _mm(reached_m)), _cut(any(press["cut_short"] for press in presses))
            rows.append([name, f"dynamic, {len(presses)} ×", *depths, force_N, modulus, cut])
    return rows


def _cut(cut_short: bool) -> str:
    return "cut short" if cut_short else ""


def _mm(depth_m: float | None) -> str:
    return "–" if depth_m is None else f"{depth_m * 1e3:.3f}"


def _timing_rows(facts: RunFacts) -> list[tuple[str, str, str]]:
    loop = facts["loop"]
    return [
        (words, f"{loop[f'{key}_p50']:.0f} µs", f"{loop[f'{key}_p99']:.0f} µs")  # type: ignore[literal-required]
        for key, words in (("work_us", "work of a tick"), ("wakeup_us", "woke up late by"))
        if f"{key}_p50" in loop
    ]


def _last_ticks(recording: Recording) -> list[tuple[str, str, str, str, str, str]]:
    rows = recording.rows[-LAST_TICKS:]
    end_s = float(rows["now_s"][-1])
    return [
        (
            f"{(end_s - float(row['now_s'])) * 1e3:.0f}",
            Phase(int(row["phase"])).name.lower(),
            f"{row['force_N']:.2f}",
            f"{row['tcp_pose'][2] * 1e3:.2f}",
            f"{row['tcp_speed'][2] * 1e3:.1f}",
            "stop" if row["command_stop"] else f"{row['command_m_per_s'][2] * 1e3:.1f}",
        )
        for row in rows
    ]


def report_conditions(recording: Recording, facts: RunFacts) -> list[tuple[str, str]]:
    """The conditions of a run in words, the most important first.

    Raises:
        RecordingError: The header lacks what a recording of palpd has.
    """
    with reading(recording.path):
        header = recording.header
        config = header["config"]
        about, card, safety, sensor = facts["about"], facts["model_card"], config["safety"], config["sensor"]
        stiffness = facts["machine_stiffness_N_per_m"]
        model = "none, nothing was corrected"
        if card:
            model = f"{card.get('method', '?')}, {card['rmse_N'] * 1e3:.0f} mN rmse, bias {card['bias_N']:+.3f} N"
        counts = ", ".join(f"{each:g}" for each in about.get("counts_per_N", []))
        cutoff_Hz = sensor["filter_cutoff_Hz"]
        read = "none" if cutoff_Hz is None else f"{cutoff_Hz:g} Hz, read at {sensor['rate_Hz']:g} Hz"
        return [
            ("robot", f"{about.get('robot_model', '?')} at {about.get('robot_host', '?')}"),
            ("sensor", f"{about.get('sensor_serial') or 'of unknown serial'} at {about.get('sensor_port', '?')}"),
            ("tip radius", f"{header['body']['tip_radius_m'] * 1e3:g} mm, Poisson's ratio {header['body']['poisson_ratio']:g}"),
            ("inertial model", model),
            ("machine stiffness", "not measured, counts as rigid" if stiffness is None else f"{stiffness / 1e3:.4g} N/mm"),
            ("filter", read),
            ("calibration", f"{about.get('calibration_source', '?')}: {counts} counts per N (fx, fy, fz); Fz {sensor['fz_slopes']}"),
            ("limits", ", ".join(f"{name} {safety[f'{name}_limit_N']:g} N" for name in ("contact", "absolute", "lateral"))),
            ("reference tare", ", ".join(f"{each:.3f}" for each in header["reference"][:3]) + " N (fx, fy, fz in the sensor's axes)"),
            ("plan", _plan_words(header["plan"])),
            ("versions", ", ".join(f"{name} {version}" for name, version in facts["versions"].items())),
        ]


def _plan_words(plan: Mapping[str, Any]) -> str:
    depths = ", ".join(f"{depth_m * 1e3:g}" for depth_m in plan["depths_m"])
    return (
        f"{len(plan['sites'])} sites, {plan['mode']}, {depths} mm at {plan['press_speed_m_per_s'] * 1e3:g} mm/s, holds of "
        f"{plan['hold_s']:g} s, {plan['repeats']} dynamic presses a depth"
    )


def _difference_row(each: ModulusDifference) -> list[str]:
    relative = f"{100 * each.difference_Pa / each.one_Pa:+.1f} %" if each.one_Pa else "–"
    difference, *bounds = (f"{'' if of < 0.0 else '+'}{kilopascals(of, each.one_Pa)}" for of in (each.difference_Pa, *(each.ci95_Pa or ())))
    interval = f" ({' to '.join(bounds)})" if bounds else ""
    words = {None: "", True: "differs", False: "within noise"}[each.beyond_noise]
    values = kilopascals(each.one_Pa), kilopascals(each.other_Pa), f"{difference}{interval}"
    return [str(each.site), each.kind, *values, relative, words]


def _setting_row(each: DifferentSetting) -> list[str]:
    return [each.key, *("not given" if value is None else json.dumps(value, ensure_ascii=False)[:200] for value in (each.one, each.other))]


def _wrapped(line: str, letters: int) -> str:
    return "\n".join(textwrap.wrap(line, letters)[:3])
