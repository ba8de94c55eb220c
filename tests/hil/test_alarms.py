"""Alarms before a real service on emulated wires: a stop by the guard is one, with its reason; an abort and a normal end are none."""

import threading
from collections.abc import Callable
from contextlib import closing

import pytest

from palpd.config import load_config
from palpd.streams.addresses import read_addresses
from palpd.streams.alarms import Alarms
from palpd.testing.emulated_cell import PATIENT, EmulatedCell
from palpd.testing.http_sink import listening
from palpd.testing.processes import until
from palpd.testing.served_cell import served

pytestmark = pytest.mark.hil


def test_a_stop_by_the_guard_is_an_alarm_and_an_abort_and_a_normal_end_are_none(cell: Callable[..., EmulatedCell]) -> None:
    chosen = {"addresses": ["phone"], "credentials": "secret.yaml", "events": ["stop", "overload", "late-ticks", "dead"]}
    emulated = cell(**PATIENT, alarms=chosen)
    with listening() as sink, served(emulated) as service:
        secret = emulated.folder / "secret.yaml"
        secret.write_text(f"phone: {sink.url}\n")
        secret.chmod(0o600)
        config = load_config(emulated.config)
        alarms = Alarms(config, service.socket, read_addresses(config.alarms), emulated.folder / "alarms.json", print)
        over = threading.Event()

        def look() -> None:
            with closing(alarms):
                while not over.wait(0.1):
                    alarms.step()

        thread = threading.Thread(target=look)
        thread.start()
        try:
            service.abort_in_the_tissue()
            service.do("retract")
            assert service.until_disarmed()["verdict"] == "done"
            service.press()
            assert [message["title"] for message in sink.received if "late" not in message["title"]] == []
            emulated.wires.ask("silent", s=2.0)
            reason = service.until_disarmed()["reason"]
            until(lambda: any("a run was stopped" in message["title"] for message in sink.received), "the alarm comes")
            assert reason in next(message["message"] for message in sink.received if "stopped" in message["title"])
        finally:
            over.set()
            thread.join()
