"""Sphinx configuration of the documentation site; `make docs` builds it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(CHECKOUT / "docs" / "_extensions"))
# Matplotlib's and Dr.Jit's threads would compete with Sphinx's for the same cores.
os.environ.setdefault("MPLBACKEND", "agg")

import wrf_mi  # noqa: E402

project = "wrf_mi"
author = "the authors of wrf_mi"
copyright = "the authors of wrf_mi, MIT licence"
version = release = wrf_mi.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx.ext.mathjax",
    "myst_nb",
    "sphinx_design",
    "sphinx_copybutton",
    "checkout_links",
    "findings_tables",
    "notebook_pages",
    "plain_docstrings",
]
exclude_patterns = ["_build", "_extensions", "_templates", "notebooks/thumbnails"]
nitpicky = False
# A class is found by its short name and by that of its module; outputs of notebooks have types that HTML does not show.
suppress_warnings = ["ref.python", "mystnb.unknown_mime_type"]

myst_enable_extensions = ["colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 3
# Notebooks are executed before the sources are read (`notebook_pages`).
nb_execution_mode = "off"
nb_output_stderr = "remove"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_inherit_docstrings = False  # an attribute that is None would have the docstring of the type of its base's
# scikit-learn adds these to its estimators, with references to its own site.
MADE_BY_SKLEARN = "set_predict_request, set_score_request"
autodoc_default_options = {"members": True, "show-inheritance": False, "exclude-members": MADE_BY_SKLEARN}
autosummary_generate = True
# Names of wrf_mi have pages of their own, which those of the packages do not repeat.
autosummary_context = {"own_pages": ", ".join(wrf_mi.__all__)}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_attr_annotations = False
# Single backticks in docstrings are code.
default_role = "code"

html_theme = "furo"
html_title = f"wrf_mi {release}"
html_static_path: list[str] = []
templates_path = ["_templates"]
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}

# External links cannot be checked without network; missing internal ones are warnings of the build, and so errors.
linkcheck_ignore = [r"https?://.*"]
linkcheck_anchors = True


def setup(app):  # type: ignore[no-untyped-def]
    """Write the page of the table of radio fields beside the pages of the site."""
    from wrf_mi.apps.table.page import table_page

    def write(app, exception):  # type: ignore[no-untyped-def]
        if exception is None and app.builder.format == "html":
            (Path(app.outdir) / "table.html").write_text(
                table_page(CHECKOUT / "benchmarks" / "table"), encoding="utf-8"
            )

    app.connect("build-finished", write)
