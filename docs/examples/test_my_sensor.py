"""A test of a sensor plug-in on emulated wires: the whole daemon presses, and the sensor is that of my package."""

import pytest

from palpd.recording.reader import Recording
from palpd.testing.emulated_cell import PATIENT, PRESS
from palpd.testing.fixtures import cb3, cell  # noqa: F401 - pytest finds fixtures by their names here


def test_a_press_ends_well_and_shows_the_true_force(cell):  # noqa: F811
    emulated = cell(stiffness_N_per_m=500.0, **PATIENT, sensor={"kind": "my-sensor"})
    daemon = emulated.run(PRESS)
    assert daemon.wait() == 0, daemon.stderr
    recording = Recording.load(daemon.recording)
    count_N = 0.131  # of Fz; the largest of many noisy frames is up to two counts off, and the press some 5 N
    assert recording.rows["force_N"].max() == pytest.approx(emulated.truth()["peak_contact_N"], abs=3 * count_N)


def test_a_sensor_that_falls_silent_in_the_tissue_stops_the_arm(cell):  # noqa: F811
    emulated = cell(stiffness_N_per_m=500.0, **PATIENT, sensor={"kind": "my-sensor"})
    daemon = emulated.run(PRESS)
    emulated.until_contact(daemon, 0.5)
    emulated.wires.ask("silent", s=3.0)
    assert daemon.wait() == 3
    assert daemon.report["trips"][0]["trip"] == "SENSOR_STALE"
