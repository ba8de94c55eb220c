"""The example of the how-to for plug-ins: a package of somebody else tests its sensor on palpd's emulated wires."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from palpd.testing.fixtures import skip_without_ur_rtde
from tests.paths import ROOT

pytestmark = pytest.mark.hil


def test_the_example_of_a_sensor_plug_in_is_tested_outside_of_the_tree(tmp_path: Path) -> None:
    skip_without_ur_rtde()
    for name in ("my_sensor.py", "test_my_sensor.py"):
        shutil.copy(ROOT / "docs" / "examples" / name, tmp_path)
    info = tmp_path / "my_sensor-1.0.dist-info"  # as pip leaves it
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-sensor\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[palpd.sensors]\nmy-sensor = my_sensor:open_my_sensor\n")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    tested = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_my_sensor.py"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert tested.returncode == 0, tested.stdout + tested.stderr
    assert "2 passed" in tested.stdout
