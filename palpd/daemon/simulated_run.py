"""A run without wires: `Cell` stands directly behind the loop, faster than real time.

It serves the sequence and the analysis. For bytes, timing and faults there are the emulated wires.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import EFFECTS
from palpd.cell.physics import Library
from palpd.config import filter_delay_s
from palpd.control.loop import Loop, Outcome
from palpd.daemon.clock import SimClock
from palpd.daemon.motion_job import Job, explainer_of, job_limits, sequence_of
from palpd.daemon.sim_cell import FZ_OFFSET_N, HOME_ABOVE_M, SimCell
from palpd.recording.header import RecordingHeader, RunAbout
from palpd.recording.tick_rows import RowWriter
from palpd.tick import ROW, ForceSensor, Request, TickRecord

SHOWN_S = 5.0
"""Simulated time between two reports of progress."""


class RowList:
    """Keeps each tick as a row (ROW of palpd.tick)."""

    def __init__(self) -> None:
        self.rows: list[np.void] = []

    def __call__(self, record: TickRecord) -> None:
        """Keep one tick."""
        row = np.zeros(1, ROW)
        RowWriter(row).fill(0, record)
        self.rows.append(row[0])

    def rehearse(self, record: TickRecord) -> None:
        """Keep nothing."""


@dataclass(frozen=True)
class SimulatedRecording:
    """The result of a run without wires: how it ended, its rows (n,) of ROW, and the header's part that the analysis needs."""

    outcome: Outcome
    rows: NDArray[np.void]
    header: RecordingHeader


def run(
    job: Job,
    cell: CellFile,
    *,
    seed: int = 0,
    requests: Mapping[int, Request] = MappingProxyType({}),
    home_above_m: float = HOME_ABOVE_M,
    library: Library = EFFECTS,
    behind: Callable[[ForceSensor], ForceSensor] = lambda sensor: sensor,
    about: RunAbout | None = None,
    show: Callable[[float], None] = lambda _: None,
) -> SimulatedRecording:
    """Carry out a job on a simulated cell.

    Args:
        job: The job; its reference tare is replaced by that of the simulated sensor.
        cell: The cell to press.
        seed: Seed of the noise.
        requests: What the operator asks, by the number of the tick.
        home_above_m: Height above the surface at which the arm begins.
        library: Effects that the cell file may name.
        behind: Another sensor that reads through the simulated one.
        about: What such a sensor says of itself; None: nothing.
        show: Shows how many seconds of the run are simulated, every SHOWN_S.

    Returns:
        The outcome and the rows.
    """
    config = job.config
    rate_Hz, delay_s = config.robot.rate_Hz, filter_delay_s(config.sensor.filter_cutoff_Hz)
    sensor = cell.sensor.model_copy(update={"filter_cutoff_Hz": config.sensor.filter_cutoff_Hz, "rate_Hz": 1000.0})
    sim = SimCell(cell.model_copy(update={"sensor": sensor}), rate_Hz, config.robot.acceleration_m_per_s2, seed, home_above_m, library)
    job = replace(job, reference=(0.0, 0.0, FZ_OFFSET_N, 0.0, 0.0, 0.0))
    record = RowList()
    ticks_a_step = max(1, round(SHOWN_S * rate_Hz))

    def request() -> Request:
        ticks = len(record.rows)
        if ticks % ticks_a_step == 0:
            show(ticks / rate_Hz)
        return requests.get(ticks, Request.NONE)

    loop = Loop(
        sim.robot,
        behind(sim.sensor),
        SimClock(rate_Hz),
        sequence_of(job, delay_s),
        explainer_of(job, about or {}, delay_s),
        job_limits(job),
        record,
        request=request,
    )
    outcome = loop.run()
    model = loop.explainer.model
    poisson = cell.tissue.poisson_ratio if cell.tissue else 0.5
    header: RecordingHeader = {
        "config": config.model_dump(mode="json"),
        "model_card": model.card if model is not None else None,
        "sites": [{"name": site.name, "x_m": site.x_m, "y_m": site.y_m} for site in job.plan.sites],
        "fits_slope": job.fits_slope,
        "body": {
            "tip_radius_m": config.cell.probe.tip_radius_m,
            "poisson_ratio": poisson,
            "delay_s": delay_s,
            "machine_stiffness_N_per_m": job.machine_stiffness_N_per_m,
        },
        "about": about or {},
    }
    return SimulatedRecording(outcome, np.array(record.rows), header)
