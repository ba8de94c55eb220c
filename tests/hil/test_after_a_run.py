"""What the operator does after a run, in any order, over wires: every command says the same of the probe, and none gives a wrong number."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from benchmarks.after_a_run import COMMANDS, ENDS, PAGE, filled, rows_of
from palpd.errors import Refused
from palpd.testing.emulated_cell import PATIENT, PRESS, EmulatedCell
from palpd.testing.fixtures import skip_without_ur_rtde
from palpd.testing.operator import Operator
from palpd.testing.processes import until
from palpd.testing.served_cell import ServedCell, served
from tests.paths import ROOT

pytestmark = pytest.mark.hil
TABLE = rows_of((ROOT / "docs" / PAGE).read_text())
NEARBY = {"sites": [{"name": "A"}, {"name": "B", "x_m": 0.02}]}


def test_the_table_names_every_end_and_every_command() -> None:
    assert list(TABLE) == list(ENDS)
    assert {tuple(cells) for cells in TABLE.values()} == {tuple(COMMANDS)}


@pytest.mark.timeout(900)  # seven cells with some ten runs each: three minutes alone, more on a computer that does other work
def test_what_a_command_does_after_a_run_stands_in_the_table() -> None:
    skip_without_ur_rtde()
    with TemporaryDirectory() as folder:  # a socket's path is short, and tmp_path is long
        assert filled(Path(folder), TABLE) == TABLE


def test_on_monday_every_screen_says_the_same_of_a_probe_that_was_left_in_the_tissue(cell: Callable[..., EmulatedCell]) -> None:
    """Everything is killed in contact, the computer starts again, the sensor is cold, and somebody has changed the probe."""
    wired = cell(**PATIENT)
    with served(wired) as service:
        ENDS["power lost"](service)
        service.end()
        wired.blocks["cell"] = {"probe": {"mass_kg": 0.25}}
        wired.wires.ask("drift", N_per_s=0.3)
        service.begin()
        wired.wires.ask("drift", N_per_s=1e-9)  # 0 would warm it up at once
        shown = service.status()["probe"]
        assert shown["state"] == "pressed", shown
        assert COMMANDS["doctor"](service) == "pressed"
        printed = wired.palpd("status", "--config", wired.config).stdout
        assert "The probe is pressed" in printed
        assert "palpd retract leaves the tissue" in printed
        assert COMMANDS["calibrate"](service) == "refused: pressed"
        with pytest.raises(Refused, match="the probe is pressed"):
            service.do("arm")
        assert COMMANDS["retract"](service) == "leaves the tissue, then free"
        assert wired.truth()["contact_N"] == 0.0
        assert COMMANDS["calibrate"](service) == "kept", "the way out was level"


def test_a_start_over_another_site_after_an_abort_is_asked_about_and_goes_back(cell: Callable[..., EmulatedCell]) -> None:
    wired = cell(**PATIENT)
    with served(wired) as service:
        plan = PRESS | NEARBY
        Operator(service.do).arm()
        service.do("start", plan=plan)
        _until_site(service, 1)
        service.do("abort")
        service.until_idle()
        assert COMMANDS["retract"](service).startswith("leaves the tissue")
        Operator(service.do).arm()
        place = service.status()["place"]
        assert place["site"] == "B"
        assert place["unfinished"]
        with pytest.raises(Refused, match=r"20 mm from where it began, at its site B.*--return"):
            service.do("start", plan=plan)
        service.do("start", plan=plan, place="return")
        last = service.until_idle()
        assert last["verdict"] == "done", last
        back = service.status()["place"]
        assert (back["site"], back["unfinished"]) == ("A", None)
        assert back["x_m"] == pytest.approx(place["x_m"] - 0.02, abs=1e-3)
        assert back["origin_m"] == pytest.approx(place["origin_m"], abs=1e-3)


def _until_site(service: ServedCell, number: int) -> None:
    pressing = lambda: service.status().get("site") == number and service.cell.truth()["contact_N"] > 1.0  # noqa: E731
    until(pressing, f"the probe presses at site {number}")


def test_a_run_with_its_own_reference_is_refused_in_the_tissue_by_the_foreground_too(cell: Callable[..., EmulatedCell]) -> None:
    wired = cell(**PATIENT)
    daemon = wired.run(PRESS)
    wired.until_contact(daemon, 4.0)
    daemon.process.terminate()
    daemon.wait()
    again = wired.run(PRESS)
    assert again.wait() == 2
    assert "the probe is pressed" in again.stderr
