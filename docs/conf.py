"""Settings of the documentation; `make docs` builds it in build/docs, without a network."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_tools"))

import catalogue
import gallery
import pictures
import reference
import sketches

import pilfr_casadi

for part in (catalogue, gallery, pictures, reference, sketches):
    part.build()

project, copyright = "pilfr_casadi", "the authors of pilfr_casadi, Apache-2.0"
version = release = pilfr_casadi.__version__
extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx_design"]
exclude_patterns = ["_tools", "_templates"]
templates_path = ["_templates"]
default_role = "py:obj"  # a name in backticks of a docstring is a link where there is a page, and code elsewhere

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
autodoc_typehints = "none"  # types stand in the docstrings
autosummary_ignore_module_all = False
numpydoc_show_class_members = False  # the template lists them

if gallery.SCRIPTS:
    extensions.append("sphinx_gallery.gen_gallery")
    sphinx_gallery_conf = gallery.SETTINGS

html_theme = "pydata_sphinx_theme"
html_title = "pilfr_casadi"
html_static_path = ["_static"]
html_css_files = ["pilfr.css"]
html_show_sourcelink = html_copy_source = False
html_sidebars = {"index": [], "gallery/index": [], "getting_started": [], "comparison": [], "validation": []}
html_theme_options = {
    "header_links_before_dropdown": 8,
    "navbar_align": "left",
    "navbar_persistent": ["search-button"],
    "navbar_end": ["theme-switcher"],
    "show_prev_next": False,
    "collapse_navigation": True,  # its toggles would have no names for a screen reader
    "secondary_sidebar_items": {"**": ["page-toc"], "index": []},
    "article_header_start": [],
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}


def escape_bars(app, what, name, obj, options, lines):
    """Let `|z|` in a docstring be an absolute value and no substitution."""
    lines[:] = [line if line.startswith(" " * 4 + ">>>") else line.replace("|", r"\|") for line in lines]


def setup(app):
    """Connect the hooks."""
    gallery.connect(app)
    app.connect("autodoc-process-docstring", escape_bars, priority=100)
