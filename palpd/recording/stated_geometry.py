"""What the header of a recording states of tip and machine, beside the cell file that it is judged by."""

import math
from collections.abc import Sequence

from palpd.cell.cell_file import CellFile
from palpd.cell.effects.motion import COMPLIANCE
from palpd.recording.samples import Samples


def with_stated_machine(cell: CellFile, recordings: Sequence[Samples]) -> tuple[CellFile, list[str]]:
    """The cell behind the machine that the recordings state, where its file states none.

    Args:
        cell: The cell at the site of the recordings.
        recordings: Recordings of one cell, in the order in which they were made: the last stiffness counts.

    Returns:
        The cell, and a sentence for each value that cell file and header state differently: which of them counts.
    """
    stated = [samples.stated for samples in recordings if samples.stated is not None]
    notes, machines = [], [geometry["machine_stiffness_N_per_m"] for geometry in stated if geometry["machine_stiffness_N_per_m"]]
    for geometry in stated[-1:]:
        pairs = [("the tip radius", 1e3, " mm", cell.probe.tip_radius_m, geometry["tip_radius_m"])]
        if cell.tissue is not None:
            pairs.append(("Poisson's ratio", 1.0, "", cell.tissue.poisson_ratio, geometry["poisson_ratio"]))
        notes = [
            f"{name} of the cell file, {of_cell * scale:.4g}{unit}, counts; the recording's header states {of_header * scale:.4g}{unit}"
            for name, scale, unit, of_cell, of_header in pairs
            if not math.isclose(of_cell, of_header, rel_tol=1e-6)
        ]
    for stiffness_N_per_m in machines[-1:]:
        own, header = cell.effects.get(COMPLIANCE.id), f"the recording's header states {stiffness_N_per_m:.6g} N/m"
        if own is None:
            cell = cell.with_effects({**cell.effects, COMPLIANCE.id: {"stiffness_N_per_m": stiffness_N_per_m}})
            notes.append(f"the cell file states no {COMPLIANCE.id}; {header} of the machine, which counts")
        elif not math.isclose(own["stiffness_N_per_m"], stiffness_N_per_m, rel_tol=1e-6):
            notes.append(f"the {COMPLIANCE.id} of the cell file, {own['stiffness_N_per_m']:.6g} N/m, counts; {header}")
    return cell, notes
