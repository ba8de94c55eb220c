"""Metrics for Prometheus: state and latch of the service, ticks, ages, force and work times of its loop.

A scrape reads what is here; it asks neither service nor loop. Names and units follow Prometheus: seconds, newtons, `_total` for counts.
"""

import time
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any, cast

from palpd.errors import BadInput, Refused
from palpd.recording.ring import Rows
from palpd.streams.service_watch import Status

STATES = ("away", "disarmed", "checking", "armed", "running", "waiting")
"""Values of palpd_state: those of the service, and `away` where none answers."""
DURATIONS_S = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 4e-3, 8e-3, 16e-3, 50e-3)
"""Upper bounds of the histograms: a tick takes 2 or 8 ms, and 50 ms are the silence that the guard allows a device."""


class MetricsServer:
    """Serves /metrics at a host and port from its creation on. Raises BadInput without the library, Refused where the port is taken."""

    def __init__(self, host: str, port: int) -> None:
        try:
            import prometheus_client as prometheus
            from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, StateSetMetricFamily
        except ImportError:
            raise BadInput("--metrics needs prometheus-client, which is not installed; install palpd[live]") from None
        self._gauge, self._counter = GaugeMetricFamily, CounterMetricFamily
        self._info, self._states = InfoMetricFamily, StateSetMetricFamily
        registry = prometheus.CollectorRegistry()
        self._work = prometheus.Histogram("palpd_tick_work_seconds", "Work of a tick", buckets=DURATIONS_S, registry=registry)
        self._late = prometheus.Histogram(
            "palpd_tick_wakeup_delay_seconds", "Time from when a tick was planned to when it began", buckets=DURATIONS_S, registry=registry
        )
        self._status: Status | None = None
        self._newest: dict[str, float] = {}
        self._counts = {"ticks": 0, "missed": 0, "rejected": 0, "lost": 0}
        registry.register(cast(Any, self))  # it only collects
        prometheus.ProcessCollector(registry=registry)
        prometheus.ProcessCollector("palpd_service", self._service_pid, registry=registry)
        try:
            self._server, self._thread = prometheus.start_http_server(port, host, registry)
        except OSError as error:
            raise Refused(f"metrics cannot be served at {host}:{port} ({error.strerror or error}); choose another port or host") from None

    @property
    def port(self) -> int:
        """The port; the system has chosen one where 0 was asked for."""
        return int(self._server.server_port)

    def show_ticks(self, rows: Rows, lost: int) -> None:
        """Count new rows.

        Args:
            rows: New rows (n,), at least one.
            lost: Rows that were overwritten before this process took them, since it began.
        """
        self._counts = {
            "ticks": self._counts["ticks"] + len(rows),
            "missed": self._counts["missed"] + int(rows["missed"].sum()),
            "rejected": self._counts["rejected"] + int(rows["rejected"].sum()),
            "lost": lost,
        }
        for work_us, late_s in zip(rows["work_us"].tolist(), (rows["now_s"] - rows["planned_s"]).tolist(), strict=True):
            self._work.observe(work_us * 1e-6)
            self._late.observe(max(0.0, late_s))
        row = rows[-1]
        now_s, frames = float(row["now_s"]), int(row["frames"])
        self._newest = {
            "now_s": now_s,
            "robot_s": float(row["robot_t_s"]),
            "sensor_s": float(row["frame_t_s"][frames - 1]) if frames else self._newest.get("sensor_s", float("nan")),
            "force_N": float(row["force_N"]),
            "absolute_N": float(row["absolute_N"]),
        }

    def show_service(self, status: Status | None) -> None:
        """Keep the newest status; None while no service answers."""
        self._status = status

    def collect(self) -> Iterator[Any]:
        """Yield what a scrape reads besides the histograms."""
        status, newest, counts = self._status, self._newest, self._counts
        state = status["state"] if status is not None else "away"
        yield self._gauge("palpd_up", "1 while the service answers", value=float(status is not None))
        yield self._states("palpd_state", "State of the service", value={name: name == state for name in STATES})
        latched = bool(status and status.get("latched"))
        yield self._gauge("palpd_latched", "1 while a stop is latched", value=float(latched))
        yield self._info(
            "palpd", "Versions and process of the service", value={"version": version("palpd"), "pid": str(self._service_pid())}
        )
        yield self._counter("palpd_ticks", "Ticks that were seen", value=counts["ticks"])
        yield self._counter("palpd_ticks_missed", "Ticks that the loop missed", value=counts["missed"])
        yield self._counter("palpd_sensor_frames_rejected", "Frames that the parser rejected", value=counts["rejected"])
        yield self._counter("palpd_stream_lost_ticks", "Ticks that this process read too late", value=counts["lost"])
        if not newest:
            return
        now_s = newest["now_s"]
        yield self._gauge("palpd_tick_age_seconds", "Age of the newest tick at this scrape", value=time.monotonic() - now_s)
        yield self._gauge("palpd_robot_age_seconds", "Age of the robot's state in the newest tick", value=now_s - newest["robot_s"])
        yield self._gauge("palpd_sensor_age_seconds", "Age of the newest sensor frame in the newest tick", value=now_s - newest["sensor_s"])
        yield self._gauge("palpd_force_newtons", "Compensated contact force of the newest tick", value=newest["force_N"])
        yield self._gauge("palpd_absolute_force_newtons", "Raw force against the reference tare", value=newest["absolute_N"])

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _service_pid(self) -> int:
        return int(self._status["pid"]) if self._status is not None else 0
