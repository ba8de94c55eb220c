"""palpd inject over emulated wires: the seal, the second channel of the real recorder, and decisions that know nothing of it."""

import hashlib
import json
import re
from collections.abc import Callable

import numpy as np
import pytest
import yaml

from palpd.daemon.replay import replay
from palpd.history.injections import kept_injections
from palpd.recording.reader import Recording
from palpd.recording.second_channel import SecondChannel
from palpd.testing.emulated_cell import PATIENT, PRESS, EmulatedCell

pytestmark = pytest.mark.hil


def test_an_injection_is_sealed_before_the_run_and_only_the_second_channel_has_it(cell: Callable[..., EmulatedCell]) -> None:
    wired = cell(**PATIENT)
    plan, out = wired.folder / "plan.yaml", wired.folder / "out.json"
    plan.write_text(yaml.safe_dump({**PRESS, "depths_m": [0.004]}))
    wired.calibrate()
    done = wired.palpd("inject", "--config", wired.config, "--plan", plan, "--json", out, patience_s=120.0)
    assert done.returncode == 0, done.stderr
    shown = re.match(r"Sealed before the run: ([0-9a-f]{64})\n", done.stdout)
    assert shown is not None, done.stdout
    (kept,) = kept_injections(wired.folder / "runs")
    assert hashlib.sha256(kept.planted.text.encode()).hexdigest() == shown[1]
    assert (bool(kept.verdict), kept.reason) == (True, "")
    assert json.loads(out.read_text())["last"] in done.stdout
    assert not list((wired.folder / "state" / "injections").iterdir())
    (path,) = (wired.folder / "runs").glob("*-injection.mcap")
    recording = Recording.load(path)
    assert recording.header.get("injection") == shown[1]
    filled = np.arange(recording.rows["frame_t_s"].shape[1]) < recording.rows["frames"][:, None]
    planted = SecondChannel(kept.planted).wrench(recording.rows, filled)
    assert recording.second is not None
    assert recording.second.tobytes() == planted.tobytes()
    assert (recording.second != recording.rows["tared"][filled]).any() == bool(kept.planted.effect)
    replayed = replay(recording)
    assert (replayed["decisions_identical"], replayed["verdict"]) == (True, "done")
