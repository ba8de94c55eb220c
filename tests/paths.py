"""Where things lie that tests read."""

import os
from pathlib import Path

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "docs" / "examples" / "my_effect.py"
LAWS = ROOT / "docs" / "examples" / "laws"
SHARED_DATA = Path(os.environ.get("PALPD_SHARED_DATA", ROOT.parent / "shared" / "data"))
"""Real measurements, which are not part of the repository; tests skip where they are absent."""
