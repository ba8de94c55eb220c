"""How soon a webhook hears of a service that was killed: `python -m benchmarks.alarms [--kills 20]` prints a line of markdown.

A real service without devices and a real `palpd alarms` stand on this computer, without systemd. So the socket that was not closed tells of
the death, which is the slower way; where systemd says more before that, as it does of a service at rest, the message comes sooner.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from palpd.daemon.socket_client import NoDaemon, ask
from palpd.testing.http_sink import HttpSink, listening
from palpd.testing.processes import kill, until

TARGET_S = 5.0
"""Longest time that a kill may take to be heard."""
SETTLE_S = 2.0
"""Time in which the alarms see a service that has come back: they look for it once a second."""


def measure(kills: int, folder: Path, sink: HttpSink) -> list[float]:
    """Kill a service that often; returns the time from each kill to its message, in s."""
    secret, config = folder / "secret.yaml", folder / "config.yaml"
    secret.write_text(f"phone: {sink.url}\n")
    secret.chmod(0o600)
    alarms = {"addresses": ["phone"], "credentials": str(secret), "events": ["dead"], "quiet_s": 1}
    config.write_text(json.dumps({"alarms": alarms, "sensor": {"port": str(folder / "absent")}}))
    path, times = folder / "state" / "palpd.sock", []
    with ExitStack() as stack:
        watcher = subprocess.Popen([sys.executable, "-m", "palpd", "alarms", "--config", str(config)], stdout=subprocess.PIPE, text=True)
        stack.enter_context(watcher)
        stack.callback(watcher.kill)
        assert watcher.stdout is not None
        watcher.stdout.readline()
        for number in range(kills):
            service = subprocess.Popen([sys.executable, "-m", "palpd", "serve", "--config", str(config)], stderr=subprocess.DEVNULL)
            stack.enter_context(service)
            stack.callback(service.kill)
            until(lambda: _answers(path), "the service answers", every_s=0.1)
            time.sleep(SETTLE_S)
            killed_s = kill(service.pid)
            until(lambda: len(sink.received) > number, "the message comes")  # noqa: B023
            times.append(sink.received[number]["came_s"] - killed_s)
            service.wait()
    return times


def _answers(path: Path) -> bool:
    try:
        return bool(ask(path, {"do": "status"}, 5.0))
    except NoDaemon:
        return False


def main() -> None:
    """Measure and print; ends with 1 where a kill was heard too late."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    kills = parser.parse_args().kills
    with listening() as sink, tempfile.TemporaryDirectory() as name:
        times = measure(kills, Path(name), sink)
    p50, most = np.percentile(times, [50, 100])
    print("| kill -9 of the service to the message at a webhook | n | median | longest |")
    print("|---|---|---|---|")
    print(f"| without systemd, quiet interval over | {kills} | {p50:.2f} s | {most:.2f} s |")
    sys.exit(0 if most <= TARGET_S else 1)


if __name__ == "__main__":
    main()
