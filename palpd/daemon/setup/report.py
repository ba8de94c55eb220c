"""What a commission says of the table "Never tested on hardware" of the README, and of cell.yaml."""

from collections.abc import Callable
from dataclasses import dataclass

from palpd.cell.cell_file import CellFile
from palpd.config import Config
from palpd.daemon.setup.commission import Commission

NOT_TRIED = "not tried"
MEASURED = (
    ("sensor", "noise_rms_N", "look", "noise_fxy_N"),
    ("sensor", "filter_cutoff_Hz", "sensor", "filter_cutoff_Hz"),
    ("robot", "servo_natural_frequency_Hz", "free-motion", "servo_natural_frequency_Hz"),
)
"""Block and key of cell.yaml, and the step and figure that measure it."""
Answer = tuple[bool, str] | None
"""Whether it is as assumed, and what was measured; None where nothing was."""


@dataclass(frozen=True, slots=True)
class Assumption:
    """A row of the README's table, by its first column, and what a commission says of it."""

    rests_on: str
    answer: Callable[[Commission], Answer]

    def state(self, commission: Commission) -> str:
        """`confirmed: value`, `different: value`, or `not tried`."""
        answer = self.answer(commission)
        return NOT_TRIED if answer is None else f"{'confirmed' if answer[0] else 'different'}: {answer[1]}"


def _measured(step: str, key: str, as_text: str) -> Callable[[Commission], Answer]:
    """The verdict of the finding that holds a figure, with the figure."""

    def answer(commission: Commission) -> Answer:
        finding = commission.finding(step, key)
        return None if finding is None else (finding.verdict == "ok", as_text.format(finding.figures[key]))

    return answer


def _slopes(commission: Commission) -> Answer:
    finding = commission.finding("weight", "slopes_part_at")
    return (
        None
        if finding is None
        else (finding.figures["slopes_part_at"] == "reading", f"they part at the {finding.figures['slopes_part_at']}")
    )


def _sign(commission: Commission) -> Answer:
    ratio = commission.figure("weight", "ratio")
    return None if ratio is None or abs(ratio) < 0.2 else (ratio > 0.0, f"a hung weight reads {ratio:+.2f} of itself")


def _registers(commission: Commission) -> Answer:
    ratio = commission.figure("weight", "ratio")
    if ratio is None or commission.figure("sensor", "from_registers") != 1.0:
        return None
    return commission.passed("weight"), f"a known weight reads {ratio:.2f} of itself"


ASSUMPTIONS = (
    Assumption("ur_rtde 1.6.5's behaviour, measured against an emulated controller", lambda _: None),
    Assumption("what the first 5 mm up of each run and the level test take for free air",
               _measured("level", "changed_N", "{:.2f} N over 5 mm")),
    Assumption("the RTDE watchdog stops the program", _measured("watchdog", "stopped_after_ms", "after {:.0f} ms")),
    Assumption("the robot's stops, and the steps at its pendant, as UR's documents have them", lambda _: None),
    Assumption("the servo lag of 8 Hz, ζ = 1 in `cell.robot`",
               _measured("free-motion", "servo_natural_frequency_Hz", "{:.1f} Hz at the ζ of cell.robot")),
    Assumption("the two slopes of Fz part where the sensor reads zero untared, not where it carries nothing (`sensor.fz_slopes: pressed`)",
               _slopes),
    Assumption("raw Fz < 0 when pressed", _sign),
    Assumption("registers 350/450 hold capacity and counts", _registers),
    Assumption("one-pole filter, zero left off, counter at 1 kHz",
               _measured("look", "rate_Hz", "{:.0f} frames/s; order and place of the filter not tried")),
    Assumption("USB latency of the DAQ", _measured("look", "arrival_every_ms", "frames arrive every {:.1f} ms")),
    Assumption("ATI Net F/T (`sensor.kind: ati-net-ft`): protocol, status bits, units from public drivers", lambda _: None),
)  # fmt: skip
"""The rows of the table, in its order; tests/daemon/test_setup.py compares both."""


def measured_cell(config: Config, commission: Commission) -> CellFile:
    """The cell of a configuration with what was measured in place of what was assumed: noise, filter, servo, stiffness of the machine.

    A delay of the readings is none of it: recordings have the sensor's own times, and `palpd diagnose` fits what remains.
    """
    cell, values = config.cell, dict[str, dict[str, object]]()
    for block, key, step, figure in MEASURED:
        if (finding := commission.finding(step, figure)) is not None:
            values.setdefault(block, {})[key] = finding.figures[figure]
    stiffness_N_per_m = commission.figure("stiffness", "stiffness_N_per_m")
    effects = {"robot.compliance": {"stiffness_N_per_m": stiffness_N_per_m}} if stiffness_N_per_m is not None else {}
    blocks = {block: getattr(cell, block).model_copy(update=changes) for block, changes in values.items()}
    return cell.model_copy(update={**blocks, "effects": {**cell.effects, **effects}})
