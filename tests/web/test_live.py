"""What pages see of the ring and the service."""

import asyncio
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from palpd.tick import Mode, Phase
from palpd.web.live import MOST_WAITING
from palpd.web.page import Page, PageSettings
from palpd.web.ticks import TickStream
from tests.web.conftest import Browser
from tests.web.fake_service import FakeService


@pytest.fixture
def ticks(service: FakeService) -> TickStream:
    watching = TickStream()
    watching.watch(service.ring.name)
    return watching


def test_a_frame_has_few_points_and_leaves_no_peak_out(ticks: TickStream, service: FakeService) -> None:
    for number in range(40):
        service.write(number, 100.0 + number / 125.0, 9.0 if number == 17 else 1.0)
    points = ticks.read()
    assert len(points) == 4
    assert max(point[3] for point in points if point[3] is not None) == 9.0
    assert [point[0] for point in points] == sorted(point[0] for point in points if point[0] is not None)
    assert ticks.read() == []
    assert ticks.health.rate_Hz == pytest.approx(125.0)
    assert ticks.health.robot_age_ms == pytest.approx(4.0)
    assert ticks.health.sensor_age_ms == pytest.approx(2.0)


def test_missed_ticks_and_lost_rows_are_counted_and_a_new_run_begins_at_zero(ticks: TickStream, service: FakeService) -> None:
    for number in range(10):
        service.write(number, number / 125.0, missed=1)
    ticks.read()
    assert (ticks.run, ticks.health.missed, ticks.health.lost) == (1, 10, 0)
    for number in range(10, 10 + service.ring.capacity + 5):
        service.write(number, number / 125.0)
    ticks.read()
    assert ticks.health.lost == 5
    service.write(0, 900.0)
    service.write(1, 900.008)
    points = ticks.read()
    assert ticks.run == 2
    assert points[0][0] == 0.0
    assert (ticks.health.missed, ticks.health.lost) == (0, 0)


def test_presses_are_told_apart_and_a_reading_that_is_none_is_no_number(ticks: TickStream, service: FakeService) -> None:
    at = {"site": 0, "mode": Mode.DYNAMIC, "depth_m": 0.004, "surface_z_m": 0.1}
    number = 0
    for repeat in (0, 1):
        for phase in (Phase.BASELINE, Phase.PRESS, Phase.RETRACT):
            service.write(number, number * 0.008, float("nan"), phase=phase, repeat=repeat, **at)
            ticks.read()
            number += 1
    assert [point[-1] for point in ticks.points] == [0, 1, 1, 0, 2, 2]
    assert all(point[3] is None for point in ticks.points)
    json.dumps(list(ticks.points), allow_nan=False)


def test_lines_end_at_a_gap_in_time_at_another_site_and_around_a_pause(ticks: TickStream, service: FakeService) -> None:
    at = {"site": 0, "mode": Mode.DYNAMIC, "depth_m": 0.004, "surface_z_m": 0.1, "phase": Phase.PRESS}
    courses: list[tuple[float, dict[str, Any]]] = [
        (0.000, at), (0.008, at), (0.300, at),
        (0.308, at | {"phase": Phase.PAUSED}), (0.316, at | {"phase": Phase.PAUSED}), (0.324, at),
        (0.332, at | {"site": 1}), (0.340, at | {"site": 1}),
    ]  # fmt: skip
    for number, (t_s, fields) in enumerate(courses):
        service.write(number, t_s, 1.0, **fields)
        ticks.read()
    ended = [point[0] for point in ticks.points if point[4] is None]
    assert ended == [0.3, 0.308, 0.324, 0.332]
    assert all(point[1:6] == [None] * 5 and point[6] == 0 for point in ticks.points if point[4] is None)
    presses = [point[6] for point in ticks.points if point[4] is not None]
    assert presses == [1, 1, 1, 0, 0, 2, 3, 3], "a press that begins again after a pause is another curve"


def test_an_end_of_a_line_within_one_reading_is_seen_and_ticks_that_are_thinned_end_none(ticks: TickStream, service: FakeService) -> None:
    for number in range(200):
        service.write(number, number / 125.0 + (1.0 if number >= 100 else 0.0), 1.0)
    points = ticks.read()
    assert len([point for point in points if point[4] is None]) == 1
    for number in range(200, 400):
        service.write(number, 1.0 + number / 125.0, 1.0)
    assert all(point[4] is not None for point in ticks.read())


def test_a_retract_and_a_look_go_on_after_the_palpation_and_the_next_palpation_begins_anew(service: FakeService, tmp_path: Path) -> None:
    async def whole() -> None:
        live = Page(PageSettings(service.path, tmp_path)).live
        live.hear({"event": "status", **service.status, "state": "running", "job": "palpation"})
        for number in range(3):
            service.write(number, 100.0 + number, 1.0, surface_z_m=0.1)
        live.ticks.read()
        jobs = ({"state": "checking"}, {"state": "running", "job": "retract"}, {"state": "running", "job": "level_test"})
        for minute, job in enumerate(jobs):
            live.hear({"event": "status", **service.status, **job})
            service.write(0, 5000.0 + 60.0 * minute, 2.0)
            live.ticks.read()
        assert live.ticks.run == 1, "the page keeps its charts"
        assert [point[0] for point in live.ticks.points if point[4] is not None] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
        assert sum(point[4] is None for point in live.ticks.points) == 5, "no line leads from one to the next"
        live.hear({"event": "status", **service.status, "state": "running", "job": "palpation"})
        service.write(0, 9000.0, 1.0)
        live.ticks.read()
        assert (live.ticks.run, [point[0] for point in live.ticks.points]) == (2, [0.0])

    asyncio.run(whole())


def test_a_ring_that_cannot_be_opened_reads_as_one_without_rows() -> None:
    ticks = TickStream()
    ticks.watch("palpd-absent")
    assert not ticks.readable
    assert ticks.read() == []


def received(browser: Browser, service: FakeService, kinds: set[str], during: Any = None) -> dict[str, dict[str, Any]]:
    """The first event of each kind that a page receives, with `during` carried out once the server follows the service."""
    events: dict[str, dict[str, Any]] = {}
    with browser() as client, client.websocket_connect("ws://127.0.0.1:8700/live") as page:
        waiting = True
        while waiting or kinds - set(events):
            event = page.receive_json()
            events.setdefault(event["event"], event)
            if waiting and event["event"] == "status":
                waiting = False
                if during is not None:
                    events.pop("lost", None)
                    during()
    return events


def test_a_page_receives_where_everything_stands_frames_and_events(browser: Browser, service: FakeService) -> None:
    def run() -> None:
        service.publish({"event": "status", **service.status, "state": "running"})
        service.publish({"event": "log", "id": "1", "line": "<script>alert(1)</script>"})
        service.write(1, 5.0, 3.0)

    events = received(browser, service, {"status", "frame", "log", "sites"}, run)
    assert events["status"]["limits"] == {"contact_N": 12.0, "absolute_N": 25.0}
    assert events["log"]["line"] == "<script>alert(1)</script>"
    assert events["frame"]["h"][2] == pytest.approx(0.0, abs=5.0)


def test_a_service_that_dies_is_said_at_once(browser: Browser, service: FakeService) -> None:
    events = received(browser, service, {"lost"}, service.close)
    assert "no daemon answers" in events["lost"]["reason"] or "has ended" in events["lost"]["reason"]


def test_a_page_that_does_not_read_is_dropped_and_delays_nobody(service: FakeService, tmp_path: Path) -> None:
    async def crowd() -> None:
        live = Page(PageSettings(service.path, tmp_path)).live
        stuck: asyncio.Queue[str | None] = asyncio.Queue(MOST_WAITING)
        reading: asyncio.Queue[str | None] = asyncio.Queue(MOST_WAITING)
        live.pages = {1: stuck, 2: reading}
        for number in range(MOST_WAITING + 1):
            live.publish({"event": "frame", "number": number})
            assert json.loads(reading.get_nowait() or "")["number"] == number
        assert list(live.pages) == [2]
        assert [stuck.get_nowait() for _ in range(stuck.qsize())] == [None]

    asyncio.run(crowd())


def test_the_server_imports_nothing_heavy() -> None:
    heavy = ("scipy", "pydantic", "onnxruntime", "matplotlib", "jinja2", "structlog", "typer", "rich", "mcap", "serial", "palpd.config")
    program = f"import sys, palpd.web.__main__; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
