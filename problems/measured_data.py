"""Where recordings of third parties are looked for; they are not part of this repository."""

from __future__ import annotations

import os
from pathlib import Path


def measured(name: str) -> Path | None:
    """Folder of a data set below `$PILFR_DATA`, or in `shared/data` beside the repository; None where it is missing."""
    base = os.environ.get("PILFR_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(base) / name
    return folder if folder.is_dir() else None
