"""The page of a run says what the recording says, alone and in one file; what is hostile in it is text."""

import dataclasses
import html.parser
import json
import re
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from palpd.config import Config, Plan
from palpd.daemon.motion_job import Job
from palpd.errors import BadInput, RecordingError
from palpd.history import after_run
from palpd.history.card import site_rows, tare_and_guard
from palpd.history.catalogue import Catalogue
from palpd.history.comparison import different_settings, modulus_differences
from palpd.history.facts import facts_of, load
from palpd.history.remarks import Remarks, remark
from palpd.history.report import RunReport, mood, page, report_of, save_sheet, site_history, write_report
from palpd.quantities import quantity
from palpd.recording.reader import Recording
from palpd.testing.simulated_recording import write_rows
from tests.history.conftest import PLAN

NOW = "2026-11-22T10:15:00+00:00"
EVIL = "<img src=x onerror=alert(1)> $\\frac{ [red]\x1b[2J"
EVIL_SITE = "<img src=x onerror=a()>$\\frac{"
MODULI = (("static_youngs_modulus_Pa", "static_ci95_Pa"), ("dynamic_corrected_Pa", "dynamic_corrected_ci95_Pa"))


class Outline(html.parser.HTMLParser):
    """Names of the elements and all text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_of_a_run_says_conditions_moduli_timing_and_hashes(simulated: Path) -> None:
    report = report_of(simulated / "day-0.mcap")
    text = Outline(page(report)).text
    facts, (site,) = report.facts, report.facts["sites"]
    assert site["static_ci95_Pa"] is not None
    for words in (
        "Done: 4 presses at 1 site.",
        f"{(site['static_youngs_modulus_Pa'] or 0) / 1e3:.1f}",
        f"{site['static_ci95_Pa'][0] / 1e3:.1f} to {site['static_ci95_Pa'][1] / 1e3:.1f}",
        f"{facts['loop']['ticks']} ticks, 0 missed",
        facts["recording_sha256"],
        facts["config_sha256"],
        "not measured, counts as rigid",
        "SIM00001",
        "contact 12 N",
        "Hertz, static modulus",
        '"contact_limit_N": 12.0',
    ):
        assert words in text, words
    assert mood(facts) == "done"
    assert "What to know of this run" not in text


def test_the_card_says_stiffness_hertz_tare_and_guard(simulated: Path) -> None:
    report = report_of(simulated / "day-0.mcap")
    site = report.facts["sites"][0]
    (row,) = site_rows(report.facts)
    assert row[:4] == ["A", *(quantity(site[key], "Pa", tuple(site[ci95])) for key, ci95 in MODULI), "fits"]  # type: ignore[literal-required]
    tare, guard = tare_and_guard(report.recording, report.facts)
    zeros = "a hold counts from the rest before it; a dynamic press counts from the tare, and nothing corrects it"
    assert re.search(rf"The zero moved by [+-]0\.0\d\d N in 0\.\d min; {zeros}\.", tare)
    assert "Age of the reference tare: not recorded." in tare
    assert "The way up of 5 mm was not made: nothing showed that the probe was free." in tare
    assert f"Largest contact force {report.facts['peak_force_N']:.2f} N of 12 N allowed" in guard
    assert guard.endswith("The guard never stepped in.")
    content = page(report)
    card = Outline(content[content.index('<section class="card">') : content.index("</section>")]).text
    assert all(words in card for words in (*row[:4], tare, guard))
    assert content.count('<details class="fold">') == content.count("<details class=") >= 4


def test_the_card_of_a_site_that_hertz_does_not_describe_says_the_range_of_e(simulated: Path) -> None:
    _, facts = load(simulated / "day-0.mcap")
    facts["sites"][0]["hertz_misfit"] = {"low_Pa": 105e3, "high_Pa": 135e3, "sentence": "E changes"}
    assert site_rows(facts)[0][3] == "does not fit: E from 105 to 135 kPa over depth"
    facts["sites"][0] |= {"hertz_misfit": None, "depths": facts["sites"][0]["depths"][:1], "presses": []}
    assert site_rows(facts)[0][3] == "not known from one depth"


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ({"reference_date": "2026-09-18T14:13:20+00:00"}, "Age of the reference tare: 3.0 days."),
        ({"reference_date": "2026-09-21T14:13:20+00:00"}, "Age of the reference tare: that of this run."),
        ({"reference_date": "2026-10-21T14:13:20+00:00"}, "Age of the reference tare: not known, its date is later than the run"),
        ({"lifts_first": True}, "Before anything else the arm went 5 mm up, and the probe was free."),
    ],
)
def test_the_card_says_how_old_the_reference_is_and_whether_the_way_up_was_made(
    simulated: Path, header: dict[str, Any], words: str
) -> None:
    recording, facts = load(simulated / "day-0.mcap")
    changed = dataclasses.replace(recording, header=recording.header | header)  # type: ignore[arg-type]
    assert words in tare_and_guard(changed, facts)[0]


def test_the_card_of_a_run_that_the_guard_stopped_says_why_and_the_headline_is_not_said_again(simulated: Path) -> None:
    report = report_of(simulated / "day-2.mcap")
    assert "The guard stepped in: contact force 2.53 N reached the limit of 2.5 N" in tare_and_guard(report.recording, report.facts)[1]
    known = page(report).split("What to know of this run")[1].split("</ul>")[0]
    assert "contact force 2.53 N" not in known
    assert "limit reached" in known


def test_the_page_is_one_file_that_asks_for_nothing(simulated: Path) -> None:
    content = page(report_of(simulated / "day-0.mcap", simulated / "day-1.mcap"))
    outline = Outline(content)
    assert not {"script", "link", "iframe", "img", "object"} & {tag for tag, _ in outline.elements}
    assert not re.findall(r"(?:src|href)=\"(?!#)", content)
    assert "prefers-color-scheme:dark" in content
    identifiers = [attributes["id"] for _, attributes in outline.elements if "id" in attributes]
    assert len(identifiers) == len(set(identifiers)), "anchors of the figures collide"


def test_a_press_that_was_cut_short_and_a_run_that_was_stopped_say_why(simulated: Path) -> None:
    cut = report_of(simulated / "day-1.mcap")
    assert mood(cut.facts) == "remarkable"
    text = Outline(page(cut)).text
    assert "site A, static press to 5 mm: 3.5 N limit reached" in text
    assert "1 depth cut short" in text
    stopped = report_of(simulated / "day-2.mcap")
    text = Outline(page(stopped)).text
    assert mood(stopped.facts) == "stopped"
    assert text.count("ontact force 2.53 N reached the limit of 2.5 N; the probe was retracted") == 2
    assert "site A, dynamic 3, 5 mm: not pressed" in text
    assert "ms before the end" in text


def test_deviations_from_the_plan_are_named_and_a_run_to_plan_has_none(simulated: Path, tmp_path: Path) -> None:
    recording, facts = load(simulated / "day-0.mcap")
    assert facts["deviations"] == []
    longer = {**recording.header, "plan": {**recording.header["plan"], "hold_s": 1.0, "repeats": 2, "depths_m": [0.003, 0.0051, 0.007]}}
    changed = dataclasses.replace(recording, header=longer)  # type: ignore[arg-type]
    deviations = facts_of(changed)["deviations"]
    assert "site A, static 3 mm: held for 0.30 s, planned 1 s" in deviations
    assert "site A, dynamic 3 mm: 1 of 2 presses" in deviations
    assert "site A, dynamic 5.1, 7 mm: not pressed" in deviations


def test_a_depth_that_was_missed_is_a_deviation(simulated: Path) -> None:
    recording, _ = load(simulated / "day-0.mcap")
    rows = recording.rows.copy()
    rows["surface_z_m"] += 2e-4
    deviations = facts_of(dataclasses.replace(recording, rows=rows))["deviations"]
    assert any(re.fullmatch(r"site A, static 5 mm: reached 5\.2\d\d mm, 0\.2\d\d mm deeper than planned", each) for each in deviations)


def test_two_runs_side_by_side_give_differences_with_intervals_and_what_else_differs(simulated: Path) -> None:
    one, mine = load(simulated / "day-0.mcap")
    other, theirs = load(simulated / "day-1.mcap")
    differences = {each.kind: each for each in modulus_differences(mine, theirs)}
    static = differences["static"]
    a, b = mine["sites"][0], theirs["sites"][0]
    assert static.difference_Pa == pytest.approx((b["static_youngs_modulus_Pa"] or 0.0) - (a["static_youngs_modulus_Pa"] or 0.0))
    halves = [(ci[1] - ci[0]) / 2 for ci in (a["static_ci95_Pa"], b["static_ci95_Pa"]) if ci is not None]
    assert len(halves) == 2
    assert static.ci95_Pa is not None
    assert (static.ci95_Pa[1] - static.ci95_Pa[0]) / 2 == pytest.approx(np.hypot(*halves))
    assert static.beyond_noise is False
    assert [(each.key, each.one, each.other) for each in different_settings(one.header, other.header)] == [
        ("safety.contact_limit_N", 12.0, 3.5)
    ]
    text = Outline(page(report_of(simulated / "day-0.mcap", simulated / "day-1.mcap"))).text
    assert "Difference to day-1" in text
    assert "within noise" in text
    assert "run beside" in text
    assert "safety.contact_limit_N" in text


def test_a_stiffer_site_differs_beyond_noise(simulated: Path) -> None:
    _, mine = load(simulated / "day-0.mcap")
    theirs = json.loads(json.dumps(mine))
    for key in ("static_youngs_modulus_Pa", "dynamic_corrected_Pa"):
        theirs["sites"][0][key] *= 1.5
    assert [each.beyond_noise for each in modulus_differences(mine, theirs)] == [True, True]
    theirs["sites"][0]["name"] = "B"
    assert modulus_differences(mine, theirs) == []


def evil_recording(folder: Path, simulated: Path) -> Path:
    """A recording whose header, footer and name hold what no page may carry out."""
    recording = Recording.load(simulated / "day-1.mcap")
    plan = PLAN.model_copy(update={"sites": (PLAN.sites[0].model_copy(update={"name": EVIL_SITE}),)})
    job = Job("palpation", Config(), plan, reference=(0.0,) * 6)
    about: Any = {**recording.header["about"], "sensor_serial": EVIL, "robot_host": EVIL}
    return write_rows(
        folder / f"{EVIL[:20].replace('/', '')}.mcap", recording.rows, job, about, {"verdict": "stopped", "reason": EVIL, "trips": []}
    )


def test_hostile_texts_are_escaped_in_page_figures_and_sheet(simulated: Path, tmp_path: Path) -> None:
    path = evil_recording(tmp_path, simulated)
    remark(path, NOW, note=EVIL)
    report = report_of(path)
    outline = Outline(page(report))
    assert "img" not in {tag for tag, _ in outline.elements}
    assert not any(name.startswith("on") for _, attributes in outline.elements for name in attributes)
    assert "<img src=x onerror=alert(1)>" in outline.text
    save_sheet(tmp_path / "sheet.pdf", report)


def test_a_sheet_is_one_page_as_pdf_or_picture(simulated: Path, tmp_path: Path) -> None:
    report = report_of(simulated / "day-1.mcap")
    for name in ("sheet.pdf", "sheet.png"):
        save_sheet(tmp_path / name, report)
    content = (tmp_path / "sheet.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert len(re.findall(rb"/Type /Page\b(?!s)", content)) == 1
    height, width, _ = matplotlib.image.imread(tmp_path / "sheet.png").shape
    assert height / width == pytest.approx(2**0.5, rel=0.01)


@pytest.mark.parametrize("key", ["kind", "config", "plan", "sites", "body", "about", "model_card", "epoch_offset_s", "versions", "dry"])
@pytest.mark.parametrize("value", ["gone", None, 5, "x", [1]])
def test_a_header_with_missing_or_wrong_keys_is_one_sentence_or_a_page(simulated: Path, key: str, value: Any) -> None:
    recording = Recording.load(simulated / "day-1.mcap") if value == "gone" else _loaded(simulated)
    header: dict[str, Any] = {**recording.header}
    if value == "gone":
        del header[key]
    else:
        header[key] = value
    spoilt = dataclasses.replace(recording, header=header)  # type: ignore[arg-type]
    sentence = ""
    try:
        page(RunReport(spoilt, facts_of(spoilt), Remarks()))
    except RecordingError as error:
        sentence = str(error)
    assert "\n" not in sentence
    assert not sentence or "day-1.mcap" in sentence


_kept: dict[Path, Recording] = {}


def _loaded(folder: Path) -> Recording:
    return _kept.setdefault(folder, Recording.load(folder / "day-1.mcap"))


def test_a_recording_that_was_deleted_under_its_report_is_one_sentence(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = runs / "day-0.mcap"
    read = Recording.load

    def deleted(at: Path) -> Recording:
        recording = read(at)
        at.unlink()
        return recording

    monkeypatch.setattr(Recording, "load", deleted)
    with pytest.raises(RecordingError, match="was removed"):
        report_of(path)
    assert after_run.look_back(path, runs) != []


def test_a_report_that_cannot_be_written_is_refused_and_leaves_the_old_one(runs: Path) -> None:
    report = report_of(runs / "day-0.mcap")
    with pytest.raises(BadInput, match="cannot be written"):
        write_report(runs / "absent" / "x.html", report)
    with pytest.raises(BadInput, match="cannot be written"):
        write_report(Path("/dev/full"), report)


def test_looking_back_writes_page_and_catalogue_and_nothing_else(runs: Path) -> None:
    assert after_run.look_back(runs / "day-0.mcap", runs) == []
    assert {path.name for path in runs.iterdir()} == {
        "day-0.mcap", "day-1.mcap", "day-2.mcap", "day-0.report.html", "catalogue.sqlite",
    }  # fmt: skip
    with Catalogue(runs) as catalogue:
        assert [entry.name for entry in catalogue.runs()] == ["day-0"], "the other recordings are left to palpd runs"


def test_from_three_runs_on_a_report_shows_the_trend_of_its_sites(runs: Path) -> None:
    assert site_history(runs / "day-2.mcap", runs) == {}
    with Catalogue(runs) as catalogue:
        catalogue.refresh()
    history = site_history(runs / "day-2.mcap", runs)
    assert [point.run.name for point in history["A"]] == ["day-0", "day-1", "day-2"]
    assert "Over the days" in page(report_of(runs / "day-2.mcap", history=history))
    assert "Over the days" not in page(report_of(runs / "day-2.mcap", history={"A": history["A"][:2]}))


def test_a_dry_run_and_a_run_without_sites_have_a_page(simulated: Path, tmp_path: Path) -> None:
    recording = Recording.load(simulated / "day-0.mcap")
    for number, (kind, dry) in enumerate((("palpation", True), ("free_motion", False), ("retract", False))):
        job = Job(kind, Config(), Plan(), dry=dry, reference=(0.0,) * 6)  # type: ignore[arg-type]
        path = write_rows(
            tmp_path / f"{number}.mcap", recording.rows[:3], job, recording.header["about"], {"verdict": "done", "reason": ""}
        )
        report = report_of(path)
        assert "Force over depth" not in page(report)
        save_sheet(tmp_path / f"{number}.png", report)
