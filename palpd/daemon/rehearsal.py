"""A whole job in small on a simulated cell, before the watchdog is armed: whatever a run imports, allocates or calls is then in memory.

Python and numpy load parts on their first use, and the kernel reads code from the disk when it is first called. In a run from cold this
happened between two ticks: the surface fit imports numpy's Fourier transform at the first contact.
"""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import numpy as np

from palpd.cell.cell_file import nominal
from palpd.config import Config, Plan, PlanSite, Search, filter_delay_s
from palpd.control.inertial import MotionFeatures
from palpd.control.loop import Explainer, Loop, Outcome, Record
from palpd.control.safety import Limits
from palpd.control.sequence import Sequence
from palpd.daemon.clock import SimClock
from palpd.daemon.sim_cell import FZ_OFFSET_N, SimCell
from palpd.tick import TickRecord

RATE_HZ = 125.0
"""Rate of the rehearsed ticks: the slowest of a robot takes the fewest of them."""
MOST_TICKS = 1200
"""Longest rehearsal: the short plan takes some 900 ticks, half a second of work. Strokes in free air repeat themselves and are cut off."""
ABOVE_M = 0.002
"""Height above the simulated surface at which it begins."""
LOADED_M = 0.004
"""Depth at which the rehearsal of a retract begins."""
DEPTH_M, SPEED_M_PER_S, HOLD_S = 0.002, 0.02, 0.1
"""Press of the rehearsal: enough for a contact of more than 1 N, and short."""
ANYWHERE_M = 10.0
"""Limit of the rehearsed workspace: the simulated cell stands elsewhere than the real one."""


class Unrecorded:
    """Does the work of recording each tick and keeps none."""

    def __init__(self, record: Record) -> None:
        self._record = record

    def __call__(self, record: TickRecord) -> None:
        """Do the work for one tick."""
        self._record.rehearse(record)

    rehearse = __call__


def short(plan: Plan, config: Config) -> Plan:
    """The same kinds of steps as in a plan, once each and quickly.

    Args:
        plan: The plan of the job.
        config: Its configuration, for the highest speed.

    Returns:
        The plan of the rehearsal.
    """
    speed_m_per_s = min(SPEED_M_PER_S, config.safety.max_speed_m_per_s)
    changes = {
        "sites": (PlanSite(name="A", x_m=0.001),),
        "origin": None,
        "depths_m": (DEPTH_M,) if plan.depths_m else (),
        "press_speed_m_per_s": speed_m_per_s,
        "repeats": 1,
        "hold_s": HOLD_S,
        "safe_height_m": ABOVE_M,
        "search": Search(speed_m_per_s=speed_m_per_s),
    }
    free = plan.free.model_copy(update={"strokes": 1, "height_m": ABOVE_M}) if plan.free is not None else None
    return plan.model_copy(update=changes | {"free": free})


def rehearse(
    config: Config,
    sequence: Sequence,
    explainer: Explainer,
    limits: Limits,
    record: Record,
    *,
    loaded: bool,
    called_off: Callable[[], bool] = lambda: False,
) -> Outcome:
    """Carry out a sequence on a simulated cell, with the code, the model and the limits of the coming run.

    Args:
        sequence: A sequence of its own, of a `short` plan.
        explainer: The explainer of the run; it is copied.
        limits: The guard's limits of the run; its workspace is left out.
        record: Takes the ticks of the run; it keeps none of these.
        loaded: Whether the probe begins in the tissue.
        called_off: Whether the run is not wanted any more; the rehearsal then ends.

    Returns:
        How it ended; nothing depends on it.
    """
    sim = SimCell(nominal(), RATE_HZ, config.robot.acceleration_m_per_s2, home_above_m=-LOADED_M if loaded else ABOVE_M)
    reference = np.array((0.0, 0.0, FZ_OFFSET_N, 0.0, 0.0, 0.0))
    stand_in = replace(
        explainer,
        reference=reference,
        model=replace(explainer.model) if explainer.model is not None else None,  # its counts belong to the run
        zero=deepcopy(explainer.zero),
        motion=MotionFeatures(filter_delay_s(config.sensor.filter_cutoff_Hz)),
        tare=reference if explainer.tare is not None else None,
    )
    anywhere = ((-ANYWHERE_M, ANYWHERE_M),) * 3
    limits = replace(
        limits,
        min_z_m=None if limits.min_z_m is None else -ANYWHERE_M,
        workspace_m=None if limits.workspace_m is None else anywhere,
    )
    loop = Loop(sim.robot, sim.sensor, SimClock(RATE_HZ), sequence, stand_in, limits, Unrecorded(record))
    ticks = 0
    while ticks < MOST_TICKS and not called_off() and loop.tick():
        ticks += 1
    return loop.outcome
