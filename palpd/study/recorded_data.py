"""What a study of real recordings needs, and its data."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from palpd.cell.cell_file import load_cell
from palpd.errors import BadInput
from palpd.recording.reader import Recording
from palpd.study.evaluation import Data, recorded


@dataclass(frozen=True)
class Sources:
    """Files of a study: free motion without and with the probe, the palpation, and enriched cells as SITE=FILE; false without any."""

    bare: Sequence[Path] = ()
    free: Sequence[Path] = ()
    palpation: Path | None = None
    cells: Sequence[str] = ()

    def __bool__(self) -> bool:
        return bool(self.bare or self.free or self.palpation or self.cells)


def load_recorded(sources: Sources) -> Data:
    """Read the recordings of a study. Raises BadInput where one that is needed is not given, or a cell names no site."""
    if not sources.free or sources.palpation is None:
        raise BadInput("a study of recordings needs both --free and --palpation; without any recording the emulated cell is studied")
    pairs = [each.partition("=") for each in sources.cells]
    if wrong := [site for site, equals, _ in pairs if not equals]:
        raise BadInput(f"--cell {wrong[0]} names no site; expected SITE=FILE")
    enriched = {site: load_cell(file) for site, _, file in pairs}
    bare, free = ([Recording.load(path) for path in paths] for paths in (sources.bare, sources.free))
    return recorded(bare, free, Recording.load(sources.palpation), enriched)
