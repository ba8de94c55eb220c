"""What a thread asks of the kernel, and that a refusal is said."""

import os
from pathlib import Path

import pytest

from palpd.daemon import realtime


def latency_us() -> int:
    """What the kernel makes of all wishes together."""
    return int.from_bytes(Path(realtime.CPU_LATENCY).read_bytes()[:4], "little", signed=True)


@pytest.mark.skipif(not os.access(realtime.CPU_LATENCY, os.R_OK | os.W_OK), reason="the kernel's latency file may not be opened here")
def test_processors_do_not_sleep_for_as_long_as_it_lasts_and_no_longer() -> None:
    before_us = latency_us()
    with realtime.awake() as granted:
        assert granted
        assert latency_us() == 0
    assert latency_us() == before_us


def test_a_processor_that_may_sleep_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(realtime, "CPU_LATENCY", str(tmp_path / "absent"))
    with realtime.realtime() as granted:
        assert not granted.awake
        assert any("may sleep" in sentence for sentence in granted.missing)
