"""What a program may ask of its host: that runs are carried out, and that the operator agrees to a motion.

A program is what `palpd calibrate`, `free-motion`, `stiffness`, `map` and `resolve` do: it asks for runs, computes, and returns figures. It
opens no device. Its host is the foreground command (palpd/daemon/session.py), or the service through a pipe (palpd/daemon/job_worker.py).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from palpd.config import Config, Plan
from palpd.daemon.display import Display
from palpd.daemon.finding import Finding
from palpd.daemon.motion_job import Kind
from palpd.daemon.supervisor import Report


@dataclass(frozen=True, slots=True)
class ProposedMotion:
    """A motion that waits for the operator's consent: the gap so far, what the motion decides, and what it does to the cell.

    Attributes:
        gap: What the diagnosis says of all recordings so far.
        decides: Which open explanations it separates, and by how much.
        duration_s: Duration of its rehearsal without wires.
        expected_peak_N: Largest contact force of that rehearsal.
        limit_N: Contact force at which the guard ends it.
        plan: The plan, as plan.yaml holds it.
    """

    gap: str
    decides: str
    duration_s: float
    expected_peak_N: float
    limit_N: float
    plan: dict[str, Any]


class ProgramHost(Protocol):
    """Carries out what a program asks for."""

    @property
    def config(self) -> Config:
        """The configuration of the cell."""
        ...

    @property
    def operator(self) -> str:
        """Who answers for what is kept, for people."""
        ...

    @property
    def display(self) -> Display:
        """Takes sentences and the name of a long calculation."""
        ...

    def carry_out(self, kind: Kind, plan: Plan, recording: Path | None = None, take_reference: bool = False, here: bool = False) -> Report:
        """Carry out one run, from opening the devices to the closed recording.

        Args:
            kind: What to do.
            plan: The plan of a palpation; other kinds ignore it.
            recording: File to record to; by default one in `paths.runs`, called by time and kind.
            take_reference: Whether the run takes its own reference tare.
            here: The operator's word that sites count from where the arm stands, whatever palpation was not finished.

        Returns:
            How the run ended.

        Raises:
            Refused: Nothing was moved.
        """
        ...

    def observe(self, watch_s: float) -> tuple[Finding, ...]:
        """Read both devices for some seconds, and judge them. Raises PalpdError where one does not open."""
        ...

    def approve(self, motion: ProposedMotion) -> bool:
        """Ask the operator for consent to a motion."""
        ...
