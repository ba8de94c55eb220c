"""A whole run without wires: the cell's physics directly behind the loop."""

from typing import Any

from palpd.cell.cell_file import CellFile
from palpd.config import Config, Plan
from palpd.daemon.motion_job import Job, Kind
from palpd.daemon.simulated_run import SimulatedRecording, run
from palpd.tick import Request


def cell_file(**blocks: Any) -> CellFile:
    """The nominal cell with these blocks changed."""
    return CellFile.model_validate(blocks)


def ran(
    cell: CellFile,
    plan: Plan | None = None,
    kind: Kind = "palpation",
    requests: dict[int, Request] | None = None,
    machine_stiffness_N_per_m: float | None = None,
    seed: int = 0,
    **config: Any,
) -> SimulatedRecording:
    """Run a job on that cell at 125 Hz; `requests` maps a tick to what the operator asks in it."""
    job = Job(kind, Config.model_validate(config), plan or Plan(), machine_stiffness_N_per_m=machine_stiffness_N_per_m)
    return run(job, cell, seed=seed, requests=requests or {})
