"""Settings of the gallery: scripts are run by the build unless pictures of theirs are stored beside them.

A script that needs recordings which are not in the repository stores its pictures under its own name: `plot_axis.py`
has `plot_axis.png`, and further ones begin with that name. It is shown with them and not run.
"""

from __future__ import annotations

import re
import shutil
import weakref
from pathlib import Path
from typing import Any

from common import DOCS, write
from matplotlib.axes import Axes
from matplotlib.figure import Figure

FOLDER = DOCS.parent / "examples" / "gallery"
SCRIPTS = sorted(FOLDER.glob("plot_*.py"))
STORED = {path.stem: sorted(FOLDER.glob(f"{path.stem}*.png")) for path in SCRIPTS if path.with_suffix(".png").exists()}
SHOWN = weakref.WeakSet[Figure]()  # a script has its figures in all blocks after the one that made them
RUN = [path.name for path in SCRIPTS if path.stem not in STORED]
SETTINGS = {
    "examples_dirs": str(FOLDER),
    "gallery_dirs": "gallery",
    "filename_pattern": "|".join(map(re.escape, RUN)) or "$^",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "thumbnail_size": (480, 336),
    "image_scrapers": ("matplotlib", "gallery.scrape_figures"),
    "capture_repr": (),
    "write_computation_times": False,
}


def build() -> None:
    """Write an empty page if there are no scripts."""
    if not SCRIPTS:
        write("gallery/index.rst", "Gallery\n=======\n\nThere are no scripts in ``examples/gallery`` yet.\n")


def scrape_figures(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the figures that a script holds; figures of this package are unknown to pyplot."""
    from sphinx_gallery.scrapers import figure_rst

    paths = []
    for value in list(block_vars["example_globals"].values()):
        figure = value.figure if isinstance(value, Axes) else value
        if isinstance(figure, Figure) and not hasattr(figure, "number") and figure not in SHOWN:
            SHOWN.add(figure)
            paths.append(next(block_vars["image_path_iterator"]))
            figure.savefig(paths[-1], dpi=110)
    return figure_rst(paths, gallery_conf["src_dir"])


def _copy_stored(app: Any) -> None:
    """Put stored pictures, and thumbnails of them, where the gallery has its own."""
    images = DOCS / "gallery" / "images"
    for stem, pictures in STORED.items():
        for picture in pictures:
            shutil.copy(picture, images / picture.name)
        shutil.copy(pictures[0], images / "thumb" / f"sphx_glr_{stem}_thumb.png")


def _show_stored(app: Any, docname: str, content: list[str]) -> None:
    """Show the stored pictures of a script before its code."""
    pictures = STORED.get(Path(docname).name, ()) if docname.startswith("gallery/") else ()
    shown = "".join(f".. image:: /gallery/images/{picture.name}\n\n" for picture in pictures)
    content[0] = content[0].replace(".. code-block:: Python", f"{shown}.. code-block:: Python", 1)


def connect(app: Any) -> None:
    """Connect the two to Sphinx, after the gallery itself."""
    app.connect("builder-inited", _copy_stored, priority=900)
    app.connect("source-read", _show_stored)
