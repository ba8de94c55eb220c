"""An ATI Net F/T in place of the HEX-70, over its real protocol: a site's modulus, and faults of its stream in the middle of a press."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from palpd.recording.reader import Recording
from palpd.testing.emulated_cell import PATIENT, PRESS, EmulatedCell, emulated_cell
from palpd.testing.fixtures import skip_without_ur_rtde
from palpd.tick import Trip

pytestmark = pytest.mark.hil

E_PA = 72_000.0
CELL = {
    "tissue": {"youngs_modulus_Pa": E_PA},
    "sensor": {"noise_rms_N": 0.01, "resolution_fz_N": 0.001, "resolution_fxy_N": 0.001},
    "probe": {"mass_kg": 0.2},
}
"""One elastic site, behind a transducer that is quieter and finer than a HEX-70."""
PLAN = PRESS | {"mode": "both", "depths_m": [0.004, 0.006], "hold_s": 1.0, "search": {"speed_m_per_s": 0.01, "max_travel_m": 0.06}}
SENSOR = {"kind": "ati-net-ft", "filter_cutoff_Hz": 152.0, "capacity_N": 290.0}


@pytest.fixture(scope="module")
def wired(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmulatedCell]:
    """A UR5 with a Net F/T whose page is on port 8049."""
    folder = tmp_path_factory.mktemp("cell")
    (folder / "cell.yaml").write_text(yaml.safe_dump(CELL))
    skip_without_ur_rtde()
    with emulated_cell(folder, "ur5", folder / "cell.yaml", "--net-ft-port", "8049") as cell:
        yield cell


def test_a_site_that_is_pressed_behind_a_net_ft_has_its_modulus(wired: EmulatedCell, tmp_path: Path) -> None:
    cell = EmulatedCell(wired.wires, "ur5", tmp_path, PATIENT | {"sensor": SENSOR, "cell": CELL})
    daemon = cell.run(PLAN)
    assert daemon.wait() == 0, daemon.stderr
    (site,) = daemon.report["sites"]
    assert site["static_youngs_modulus_Pa"] == pytest.approx(E_PA, rel=0.03)
    assert site["dynamic_original_Pa"] == pytest.approx(E_PA, rel=0.04)
    recording = Recording.load(Path(daemon.report["recording"]))
    assert recording.header["about"]["sensor_serial"] == "FT12345"
    assert recording.header["about"]["calibration_source"] == "netftapi2.xml"
    assert recording.rows["rejected"].sum() == 0
    frames_per_s = recording.rows["frames"].sum() / (recording.rows["now_s"][-1] - recording.rows["now_s"][0])
    assert frames_per_s == pytest.approx(1000.0, rel=0.02)


@pytest.mark.parametrize(
    ("verb", "arguments", "trip"),
    [
        ("silent", {"s": 3.0}, Trip.SENSOR_STALE),
        ("records", {"lost": 120}, Trip.SENSOR_REJECTS),
        ("status", {"word": 0x80020000, "s": 1.0}, Trip.SENSOR_STATUS),
        ("records", {"swapped": 10}, None),
    ],
)
def test_a_fault_of_the_stream_in_a_press_stops_the_arm_and_single_records_do_not(
    wired: EmulatedCell, tmp_path: Path, verb: str, arguments: dict[str, float], trip: Trip | None
) -> None:
    wired.wires.ask("heal")
    cell = wired.anew(tmp_path, 1000.0, **PATIENT, sensor=SENSOR, cell=CELL)
    daemon = cell.run(PRESS | {"depths_m": [0.004], "repeats": 1})
    cell.until_contact(daemon, 0.3)
    cell.wires.ask(verb, **arguments)
    code = daemon.wait()
    rows = Recording.load(Path(daemon.report["recording"])).rows
    assert [each["trip"] for each in daemon.report["trips"]] == ([] if trip is None else [trip.name])
    assert code == (0 if trip is None else 3)
    if trip is None:
        assert rows["rejected"].sum() == 10
    else:
        assert rows["command_stop"][-1] == 1
