"""Configuration of the documentation (Sphinx).

Build it with `sphinx-build -W -d docs/_build/trees docs docs/_build/html`.
"""

from __future__ import annotations

import gc
import sys
from pathlib import Path

from sphinx.application import Sphinx

from frictrack.base import __version__

sys.path.insert(0, str(Path(__file__).resolve().parent / "generators"))

from generated_pages import write_generated_pages

gc.set_threshold(100_000, 20, 20)  # the trees of all pages are kept: looking through them took 7 % of the time

project = "frictrack"
author = "The frictrack developers"
copyright = "2026, the frictrack developers"
release = version = __version__

extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx_copybutton",
    "sphinx_design",
]
myst_enable_extensions = ["colon_fence", "deflist", "fieldlist"]
myst_heading_anchors = 3
nb_execution_mode = "off"
exclude_patterns = ["_build", "generators"]

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say them
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

html_theme = "pydata_sphinx_theme"
html_static_path = ["_static"]
html_css_files = ["frictrack.css"]
html_title = "frictrack"
html_show_sourcelink = False
html_copy_source = False
html_sidebars = {"benchmarks": [], "glossary": []}  # pages without a section
html_theme_options = {
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}


def setup(app: Sphinx) -> None:
    """Write the generated pages before Sphinx looks for sources."""
    app.connect("config-inited", write_generated_pages)
