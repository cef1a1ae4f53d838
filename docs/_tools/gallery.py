"""Settings of the gallery: scripts are run by the build unless a picture of theirs is stored beside them."""

from __future__ import annotations

import re
from pathlib import Path

from common import write

FOLDER = Path(__file__).parents[2] / "examples" / "gallery"
SCRIPTS = sorted(FOLDER.glob("plot_*.py"))
STORED = [path for path in SCRIPTS if path.with_suffix(".png").exists()]
RUN = [path.name for path in SCRIPTS if path not in STORED]
SETTINGS = {
    "examples_dirs": str(FOLDER),
    "gallery_dirs": "gallery",
    "filename_pattern": "|".join(map(re.escape, RUN)) or "$^",
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "plot_gallery": "True",
}


def build() -> None:
    """Write an empty page if there are no scripts."""
    if not SCRIPTS:
        write("gallery/index.rst", "Gallery\n=======\n\nThere are no scripts in ``examples/gallery`` yet.\n")
