"""The steps in their order, and how an operator is led through them."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from palpd.daemon.finding import Finding
from palpd.daemon.interrupts import last_words, received
from palpd.daemon.job_client import service_at
from palpd.daemon.setup import motion_steps, still_steps
from palpd.daemon.setup.cell import NoOperator, SetupCell
from palpd.daemon.setup.commission import Commission, StepResult, StepVerdict
from palpd.daemon.stored_state import now
from palpd.errors import BadInput, PalpdError, Refused, Stopped


@dataclass(frozen=True, slots=True)
class SetupStep:
    """One step: what it will do, in one sentence, and what does it. One that `moves` is offered only where no step before it has failed."""

    name: str
    does: str
    carry_out: Callable[[SetupCell], Sequence[Finding]]
    needs: tuple[str, ...] = ()
    moves: bool = False


STEPS = (
    SetupStep("robot", "Finds the controller, reads its version, and counts its states for 2 s.", still_steps.find_robot),
    SetupStep("sensor", "Finds the DAQ, takes its calibration, and opens it.", still_steps.find_sensor, ("robot",)),
    SetupStep("tool", "Starts the control script, which moves nothing, and compares the pendant's TCP and payload with ruler and scales.",
              still_steps.compare_tool, ("robot",)),
    SetupStep("look", "Judges this PC and both devices for 10 s, the arm at rest.", still_steps.look, ("sensor",)),
    SetupStep("weight", "Checks sign, size and slopes with a weight that you hang on the probe.", still_steps.hang_weight, ("sensor",)),
    SetupStep("check", "Judges config.yaml and plan.yaml together.", still_steps.check_files, ("robot",)),
    SetupStep("reference", "Takes the reference tare, the probe free and still.", still_steps.take_reference, ("weight",)),
    SetupStep("level", "Goes 5 mm straight up at 5 mm/s.", motion_steps.level_test, ("tool", "check", "reference"), moves=True),
    SetupStep("watchdog", "Goes 5 mm up and falls silent on the way, so that the controller must stop the arm; then goes up 5 mm again.",
              motion_steps.measure_watchdog, ("level",), moves=True),
    SetupStep("free-motion", "Goes 2 cm up and down ten times in free air, and learns the inertial model.",
              motion_steps.learn_inertia, ("watchdog",), moves=True),
    SetupStep("stiffness", "Presses a rigid plate three times.", motion_steps.press_plate, ("free-motion",), moves=True),
    SetupStep("press", "Goes down at 2 mm/s until 1 N, and presses 1 mm deep; the guard ends it at 2 N.",
              motion_steps.first_press, ("free-motion",), moves=True),
    SetupStep("service", "Puts the files of the service into place; needs root.", still_steps.install_service, ("press",)),
)  # fmt: skip
NAMES = tuple(step.name for step in STEPS)
SIGN = {"ok": "ok  ", "warn": "warn", "fail": "FAIL"}


def set_up(cell: SetupCell, redo: Collection[str] = (), skip: Collection[str] = ()) -> Commission:
    """Lead the operator through the steps that are not done, in their order.

    Args:
        cell: The cell, and who answers.
        redo: Names of steps to do again.
        skip: Names of steps to leave out.

    Returns:
        All steps so far: the last one that the operator stopped at is not among them, or has failed.

    Raises:
        BadInput: There is no step of such a name.
        Refused: A service serves this cell, or another set-up of it is under way.
        NoOperator: Nobody answers.
        Stopped: A signal has ended the run of a step.
    """
    for name in (*redo, *skip):
        if name not in NAMES:
            raise BadInput(f"{name!r} is no step of palpd setup; expected one of {', '.join(NAMES)}")
    if cell.config_file.exists() and service_at(cell.config.paths.control_socket):
        raise Refused("the service of this cell holds the devices; stop it (systemctl stop palpd), and begin palpd setup again")
    with cell.held():
        _lead_through(cell, redo, skip)
    return cell.state.commission()


def _lead_through(cell: SetupCell, redo: Collection[str], skip: Collection[str]) -> None:
    """Do what is not done, until the operator stops."""
    for number, step in enumerate(STEPS, start=1):
        commission, title = cell.state.commission(), f"{number}/{len(STEPS)} {step.name}"
        before = commission.steps.get(step.name)
        if before is not None and before.verdict != "fail" and step.name not in redo:
            cell.operator.say(f"{title}: {before.verdict} on {before.date[:16]}")
        elif step.name in skip:
            _keep(cell, step, StepResult(now(), "skipped"))
        elif not _done(cell, step, title):
            return


def _done(cell: SetupCell, step: SetupStep, title: str) -> bool:
    """Do a step until the operator is content, or skips it. False where the operator stops here."""
    operator = cell.operator
    operator.say(f"{title}: {step.does}")
    if missing := missing_for(step, cell.state.commission()):
        operator.say(f"It needs {', '.join(missing)}, which {'was' if len(missing) == 1 else 'were'} skipped or failed.")
    answers = ("skip", "stop") if missing else ("stop", "go", "skip") if step.moves else ("go", "skip", "stop")  # no motion by Enter alone
    while True:
        stands = "The arm will move: a hand on the emergency stop" if step.moves and "go" in answers else "The arm stands"
        answer = operator.choose(f"{stands}. What now?", answers, "go" * step.moves)
        if answer == "stop":
            return False
        if answer == "skip":
            _keep(cell, step, StepResult(now(), "skipped"))
            return True
        findings = _attempt(cell, step)
        if received():  # what an abort has cut off has measured nothing
            raise Stopped(last_words()[0])
        for finding in findings:
            operator.say(line(finding))
        verdicts = {finding.verdict for finding in findings}
        verdict: StepVerdict = "fail" if "fail" in verdicts else "warn" if "warn" in verdicts else "ok"
        _keep(cell, step, StepResult(now(), verdict, tuple(findings)))
        if verdict != "fail":
            return True
        operator.say(f"{step.name} has failed. Do what the lines say, then go again; no step that moves the arm is offered before.")
        answers = ("stop", "go", "skip")


def _attempt(cell: SetupCell, step: SetupStep) -> Sequence[Finding]:
    if step.moves and (asked := cell.state.protective_stops().cause_asked):
        return [Finding(step.name, "fail", asked, "palpd recover-robot asks for it; then redo this step")]
    latch = cell.state.latch() if step.moves else None
    if latch is not None:
        question = f"The last run was stopped on {latch.date}: {latch.reason}. Have you looked at the cell, and may it be cleared?"
        if not cell.confirms(f"{question} The arm moves then.", moves=True):
            return [Finding(step.name, "fail", f"a stop of {latch.date} is not cleared", "look at the cell, then redo this step")]
        cell.state.clear_latch()
    try:
        return step.carry_out(cell)
    except NoOperator:
        raise
    except PalpdError as error:
        return [Finding(step.name, "fail", str(error))]


def missing_for(step: SetupStep, commission: Commission) -> list[str]:
    """What keeps a step from being offered: what it needs and was not done, and for one that moves each earlier failure."""
    earlier = NAMES[: NAMES.index(step.name)]
    failed = [name for name in earlier if name in commission.steps and commission.steps[name].verdict == "fail"]
    return [name for name in earlier if (name in step.needs and not commission.passed(name)) or (step.moves and name in failed)]


def _keep(cell: SetupCell, step: SetupStep, result: StepResult) -> None:
    cell.state.keep("commission", Commission({**cell.state.commission().steps, step.name: result}))


def line(finding: Finding) -> str:
    """A finding as one line: verdict, what was measured, what was expected, what to do."""
    expected = f"; expected {finding.expected}" if finding.expected else ""
    return f"  {SIGN[finding.verdict]}  {finding.name}: {finding.measured}{expected}" + (
        f". Do: {finding.advice}" if finding.advice else ""
    )
