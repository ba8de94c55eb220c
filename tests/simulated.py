"""A whole run without wires: the cell's physics directly behind the loop."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpd.cell_file import CellFile
from palpd.clock import SimClock
from palpd.config import Config, Plan
from palpd.loop import Explainer, Loop, Outcome, Turn
from palpd.motion import Job, fill, limits_of, sequence_of
from palpd.sim import FZ_OFFSET_N, SimCell
from palpd.tick import ROW, Request

DELAY_S = 1 / (2 * math.pi * 150)
REFERENCE = (0.0, 0.0, FZ_OFFSET_N, 0.0, 0.0, 0.0)


@dataclass
class Ran:
    outcome: Outcome
    rows: np.ndarray[Any, np.dtype[np.void]]
    header: dict[str, Any]
    cell: SimCell


def cell_file(**blocks: Any) -> CellFile:
    """The nominal cell with these blocks changed, and a 1 kHz sensor."""
    return CellFile.model_validate({"sensor": {"rate_Hz": 1000}, **blocks})


def ran(
    cell: CellFile,
    plan: Plan | None = None,
    kind: str = "palpation",
    requests: dict[int, Request] | None = None,
    machine_stiffness_N_per_m: float | None = None,
    seed: int = 0,
    **config: Any,
) -> Ran:
    """Run a job on that cell at 125 Hz; `requests` maps a tick to what the operator asks in it."""
    settings = Config.model_validate(config)
    job = Job(kind, settings, plan or Plan(), reference=REFERENCE, machine_stiffness_N_per_m=machine_stiffness_N_per_m)  # type: ignore[arg-type]
    rows: list[np.void] = []

    class Record:
        def __call__(self, turn: Turn) -> None:
            row = np.zeros(1, ROW)[0]
            fill(row, turn)
            rows.append(row)

        def rehearse(self, turn: Turn) -> None: ...

    sim = SimCell(cell, 125.0, seed=seed)
    loop = Loop(
        sim.robot,
        sim.sensor,
        SimClock(125.0),
        sequence_of(job, DELAY_S),
        Explainer(np.array(REFERENCE)),
        limits_of(settings),
        Record(),
        request=lambda: (requests or {}).get(len(rows), Request.NONE),
    )
    outcome = loop.run()
    header = {
        "sites": [site.model_dump() for site in job.plan.sites],
        "body": {
            "delay_s": DELAY_S,
            "machine_stiffness_N_per_m": machine_stiffness_N_per_m,
            "tip_radius_m": settings.cell.probe.tip_radius_m,
            "poisson_ratio": 0.5,
        },
    }
    return Ran(outcome, np.array(rows), header, sim)
