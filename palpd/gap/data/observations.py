"""All that a diagnosis knows of its recordings before it simulates a hypothesis. `observe` makes it once, in the order of its lines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import Effect
from palpd.cell.effects.motion import COMPLIANCE
from palpd.gap.data.cleaning import clean, without_rounding
from palpd.gap.data.plausibility import channel_notes, check_recordings, recording_notes
from palpd.gap.data.prepare import PreparedRecording, prepare, stated_cell
from palpd.gap.data.recorded_noise import noise_of_fz_N, with_recorded_noise
from palpd.gap.data.rounding import Rounding, rounding_of
from palpd.gap.data.scatter import Scatter, scatter_effects
from palpd.gap.user_simulator import UserSimulator
from palpd.recording.samples import Samples, common_site
from palpd.recording.stated_geometry import with_stated_machine


@dataclass(frozen=True)
class Observations:
    """Recordings of one cell, cleaned, cut into bins, with their noise.

    Attributes:
        cell: The nominal cell at the site of the recordings, with all noise and resolution stated.
        site: That site; None where the cell file has none of its name.
        recordings: Each as it was read, cleaned and prepared.
        rounding: How fz is rounded; None where noise dithers it.
        coarse: Whether fz has steps that are much coarser than stated.
        excess_noise: Whether the noise is larger than stated.
        scatter: Effects that show in the scatter of the readings alone.
        decisive: Sentences that make every verdict doubtful.
        notes: Further sentences for the reader.
    """

    cell: CellFile
    site: str | None
    recordings: tuple[PreparedRecording, ...]
    rounding: Rounding | None
    coarse: bool
    excess_noise: bool
    scatter: Scatter
    decisive: tuple[str, ...]
    notes: tuple[str, ...]


def observe(
    recordings: Sequence[Samples], cell: CellFile, library: Mapping[str, Effect], simulators: Sequence[UserSimulator], max_bins: int
) -> Observations:
    """Check, clean and prepare the recordings of one cell.

    Args:
        library: The effects that may be present.
        simulators: A user's own simulator for each recording; empty where palpd itself simulates the nominal cell.
        max_bins: Largest number of bins of all recordings together, approximately; at least LEAST_BINS for each.

    Raises:
        RecordingError: The recordings cannot be judged.
    """
    site = common_site(recordings)
    known = any(place.name == site for place in cell.sites)
    cell = stated_cell(cell.at_site(site))
    own = simulators or COMPLIANCE.id not in library  # who leaves it out of the list says that the machine is rigid
    cell, stated = (cell, []) if own else with_stated_machine(cell, recordings)
    recordings = [without_rounding(samples) for samples in recordings]
    decisive, notes = check_recordings(recordings, cell, sized=not simulators), recording_notes(recordings, cell)
    cell, noise_far, noise_notes = with_recorded_noise(recordings, cell)
    cleaned = [clean(samples, cell) for samples in recordings]
    coarse_N = [its.coarse_step_N for its in cleaned]
    rounding = rounding_of(max(coarse_N), cell, noise_of_fz_N(recordings, cell))
    prepared = prepare([its.samples for its in cleaned], cell, library, max_bins, rounding, simulators)
    return Observations(
        cell=cell,
        site=site if known else None,
        recordings=prepared,
        rounding=rounding,
        coarse=max(coarse_N) > 0.0,
        excess_noise=any(its.samples is not its.unclipped for its in cleaned),
        scatter=scatter_effects(prepared, cleaned, cell, library),
        decisive=(*decisive, *noise_far),
        notes=(*(f"{sentence}." for sentence in stated), *notes, *noise_notes, *channel_notes(prepared, cell)),
    )
