"""Sphinx builds the site of these pages: ``sphinx-build -W --keep-going -n docs build/docs``."""

import re
from importlib.metadata import version as version_of

from sphinx.application import Sphinx

project = "consensus-dsse"
author = "The consensus-dsse maintainers"
version = release = version_of("consensus-dsse")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
myst_heading_anchors = 4  # links to headings, by the names that GitHub gives them

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"

nitpick_ignore_regex = [("py:.*", ".*")]  # types of other packages, whose own pages cannot be read from here
suppress_warnings = ["ref.python"]  # several classes have a field `bytes`

html_theme = "furo"
html_title = f"consensus-dsse {release}"


def keep_bars(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Magnitudes such as |r + jx| are no substitutions of reStructuredText."""
    lines[:] = [line.replace("|", r"\|") for line in lines]


attributes: dict[
    str, list[str]
] = {}  # lines of each attribute before napoleon, which takes a colon for the end of a type


def note_attribute(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Keep the text of an attribute, before napoleon."""
    if what == "attribute":
        attributes[name] = list(lines)


def read_markdown_of_keys(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Meanings of keys of files are Markdown, as the reference pages have them: code spans become literals."""
    if what == "attribute":
        text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", "\n".join(attributes[name]))
        lines[:] = re.sub(r"(?<!`)`([^`]+)`(?![`_])", r"``\1``", text).split("\n")


def setup(app: Sphinx) -> None:
    app.connect("autodoc-process-docstring", note_attribute, priority=100)
    app.connect("autodoc-process-docstring", read_markdown_of_keys, priority=900)
    app.connect("autodoc-process-docstring", keep_bars, priority=901)
