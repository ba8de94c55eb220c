"""`palpd stiffness`: press a rigid plate, and keep how far sensor, mount and arm give way."""

from palpd.analysis.results import machine_stiffness
from palpd.config import Plan
from palpd.daemon.program_host import ProgramHost
from palpd.daemon.stored_state import MachineStiffness, State, now
from palpd.daemon.supervisor import Report
from palpd.errors import RecordingError
from palpd.recording.reader import Recording


def measured_stiffness(host: ProgramHost) -> tuple[Report, MachineStiffness | None]:
    """Press the plate under the probe and keep the stiffness in the configuration's state.

    Args:
        host: Carries out the run.

    Returns:
        The report of the run, and the stiffness where the run came to its end.

    Raises:
        PalpdError: Where the devices refuse, or the recording does not show the stiffness of a machine. Nothing is kept then.
    """
    report = host.carry_out("stiffness", Plan())
    if report.exit_code or report.recording is None:
        return report, None
    value_N_per_m, ci95_N_per_m = machine_stiffness(Recording.load(report.recording).rows)
    machine = MachineStiffness(value_N_per_m, ci95_N_per_m, now(), report.about.get("sensor_serial"))
    if machine.too_soft:
        raise RecordingError(f"the presses measure {machine.too_soft}")
    State(host.config.paths.state).keep("stiffness", machine)
    return report, machine
