"""A report as a single HTML file without scripts and requests, with all text escaped.

``report.html.j2`` beside this file is its template, with the style for light and dark screens and for paper.
"""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from coordinator.lab.evaluation.answers import DISTRIBUTIONS, version_of
from coordinator.show.figures.style import Drawing, as_svg, styled
from coordinator.show.report.settings import Origin
from dsse_core.files.drafts import whole_file
from dsse_core.printable import printable

TEMPLATE = "report.html.j2"
REPORT = "report.html"
MAX_ROWS = 1000
DRAWN_BY = ("matplotlib", "jinja2")


@dataclass(frozen=True)
class PageTable:
    """A table of a page, its cells as text. ``note``: below its title. ``left_out``: number of rows not shown."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    left_out: int = 0


@dataclass(frozen=True)
class Page:
    """The content of a report, from top to bottom.

    ``good``: True where ``outcome`` is a success, False where it is a failure, None where it is neither.
    """

    title: str
    subtitle: str
    outcome: str
    good: bool | None
    reasons: Sequence[str]
    findings: Sequence[str]
    tables: Sequence[PageTable]
    drawings: Sequence[Drawing]
    more_tables: Sequence[PageTable]
    origin: Origin


def write_page(page: Page, folder: Path) -> Path:
    """Writes ``report.html`` into ``folder``, and returns its path.

    Raises:
        OSError: the file cannot be written.
    """
    path, text = folder / REPORT, render_page(page)
    with whole_file(path) as draft:
        draft.write_text(text, encoding="utf-8")
    return path


def render_page(page: Page) -> str:
    """The page as HTML."""
    with styled():
        figures = [(each, Markup(as_svg(each.figure, each.name))) for each in page.drawings]  # matplotlib escapes it
    return _load_template().render(page=page, figures=figures, versions=list_versions())


def list_versions() -> dict[str, str]:
    """Versions of Python and of the packages that the results and the figures depend on: name -> version."""
    found = {name: version_of(name) or "not installed" for name in (*DISTRIBUTIONS, *DRAWN_BY)}
    return {"Python": platform.python_version(), **found}


@cache
def _load_template() -> jinja2.Template:
    folder = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=folder,
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_as_printable,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(TEMPLATE)


def _as_printable(value: Any) -> Any:
    """``value`` as printable text: characters that a browser hides or reorders become escapes. Markup stays."""
    return value if isinstance(value, Markup) else printable(value)
