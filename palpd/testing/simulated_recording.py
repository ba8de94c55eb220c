"""A recording of a simulated run: a whole palpation in seconds, with the file that the daemon would have written."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpd.cell.cell_file import CellFile
from palpd.config import Config, Plan, filter_delay_s
from palpd.daemon.motion_job import Job
from palpd.daemon.motion_process import trip_report
from palpd.daemon.run_header import header_of
from palpd.daemon.sim_cell import FZ_OFFSET_N
from palpd.daemon.simulated_run import run
from palpd.recording.header import RecordingFooter, RunAbout
from palpd.recording.mcap_file import RecordingWriter
from palpd.recording.recorder import CHUNK_S

BEGAN_S = 1.79e9
"""Unix time at which a simulated run begins, where nothing else is asked for: 2026-09-21."""


def write_simulated(
    path: Path, plan: Plan, cell: CellFile | None = None, config: Config | None = None, began_s: float = BEGAN_S, seed: int = 0
) -> Path:
    """Carry out a plan without wires and write its recording.

    Args:
        plan: What is pressed.
        cell: The cell; by default an elastic one.
        config: The configuration; by default the shipped one.
        began_s: Unix time at which it begins.
        seed: Of the noise.
    """
    job = Job("palpation", config or Config(), plan, reference=(0.0, 0.0, FZ_OFFSET_N, 0.0, 0.0, 0.0))
    simulated = run(job, cell or CellFile.model_validate({}), seed=seed)
    about: RunAbout = {
        "robot_host": "simulated", "robot_model": job.config.robot.model, "sensor_serial": "SIM00001", "sensor_port": "none",
        "counts_per_N": [41.3, 41.1, 7.6], "counts_per_Nm": [1126.0, 1082.0, 1433.0], "calibration_source": "simulated",
        "pulled_over_pressed": None, "delay_s": filter_delay_s(job.config.sensor.filter_cutoff_Hz),
        "epoch_offset_s": began_s - float(simulated.rows["now_s"][0]),
    }  # fmt: skip
    outcome = simulated.outcome
    footer: RecordingFooter = {
        "verdict": outcome.verdict, "reason": outcome.reason, "trips": [trip_report(trip) for trip in outcome.trips], "stalls": [],
        "lost_rows": 0,
    }  # fmt: skip
    return write_rows(path, simulated.rows, job, about, footer)


def write_rows(path: Path, rows: NDArray[np.void], job: Job, about: RunAbout, footer: RecordingFooter) -> Path:
    """Write rows as the recorder does.

    Args:
        rows: Ticks (n,).
        job: What was carried out.
        about: The devices.
        footer: How it ended.
    """
    header = {**header_of(job, about, job.reference or (0.0,) * 6, tuple(rows[0]["tcp_pose"].tolist()))}
    header["started"] = str(np.datetime64(round(about["epoch_offset_s"] + float(rows["now_s"][0])), "s")) + "+00:00"
    writer = RecordingWriter(path, header)  # type: ignore[arg-type]
    chunk = max(1, round(CHUNK_S * job.config.robot.rate_Hz))
    for begin in range(0, len(rows), chunk):
        writer.write(rows[begin : begin + chunk])
        writer.flush()
    return writer.close(footer)
