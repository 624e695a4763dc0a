"""The site of the documentation, by Sphinx: `make docs`.

Its source folder is the repository, so that links between files lead where they lead on GitHub. A file that
is no page (source, a test, a scene) is copied into the site where a page links to it. Tables are made of the
data of docs/reports.
"""

import sys
from pathlib import Path

import mitsuba_bdpt  # isort: skip (before mitsuba, which autodoc imports)
from sphinx.writers.html5 import HTML5Translator

sys.path.append(str(Path(__file__).resolve().parents[1] / "scripts"))
import pages  # isort: skip

project = "mitsuba-bdpt"
release = mitsuba_bdpt.__version__
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx_external_toc",
    "sphinx-mathjax-offline",
]
include_patterns = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/**"]
exclude_patterns = [
    ".git",
    ".venv",
    "build",
    "dist",
    "integrators",
    "references",
    "renders",
    "results",
    "tests",
]
external_toc_path = "docs/toc.yml"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # make notebook and .ci/run run the notebook
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
default_role = "code"

html_theme = "furo"
html_title = f"mitsuba-bdpt {release}"
html_show_copyright = False
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["site.css"]
html_extra_path = ["index.html"]


class Translator(HTML5Translator):
    """Opens files that are no pages in the browser, with the title of their link."""

    def starttag(self, node, tagname, *args, **attributes):
        """Return the opening tag of a node."""
        if attributes.pop("download", None) is not None:
            attributes["title"] = node.get("reftitle", "")
        return super().starttag(node, tagname, *args, **attributes)


def setup(app):
    """Called by Sphinx."""
    app.set_translator("html", Translator)
    app.connect("source-read", _fill)


def _fill(app, docname, source):
    source[0] = pages.filled(source[0])
