"""A report as one HTML file that needs nothing else: no script, no request; all text in it escaped.

``report.html.j2`` beside this file says how it looks, on screens light and dark and on paper.
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

from coordinator.evaluation.answers import DISTRIBUTIONS, version_of
from coordinator.figures.style import Drawing, as_svg, styled
from coordinator.report.settings import Origin
from dsse_core.files.drafts import whole_file
from dsse_core.printable import printable

TEMPLATE = "report.html.j2"
REPORT = "report.html"
MAX_ROWS = 1000
DRAWN_BY = ("matplotlib", "jinja2")


@dataclass(frozen=True)
class PageTable:
    """A table as a page shows it, its cells as text. ``note``: below its title. ``left_out``: rows not shown."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    left_out: int = 0


@dataclass(frozen=True)
class Page:
    """What a report says, from top to bottom.

    ``good``: whether ``outcome`` is as wished, None where there is no such thing.
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
    """Write ``report.html``; its path.

    Raises:
        OSError: it cannot be written.
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
    """Python and the packages that matter, those that draw included."""
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
    """What a browser shows as nothing, or turns around, is shown as an escape."""
    return value if isinstance(value, Markup) else printable(value)
