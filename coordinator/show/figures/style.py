"""Style of figures in all formats, and their output: as files, and as SVG inside a page.

Colours are those of Okabe and Ito, distinct for the colour-blind as well; marks differ by shape. Text, axes and other
black parts have the colour INK, which becomes the page's text colour; so figures suit light and dark pages.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from dsse_core.errors import InvalidInputError
from dsse_core.files.drafts import whole_file
from dsse_core.files.wording import describe_unknown
from dsse_core.grid.nodes import PHASES

INK, PAPER = "#000001", "#fffffe"  # in SVG distinct from each colour of the data
BLUE, VERMILLION, GREEN, PURPLE = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
ORANGE, SKY, GREY = "#e69f00", "#56b4e9", "#7f7f7f"
COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, GREY)
LINES = ("solid", "dashed", "dashdot", "dotted")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
TRUE: dict[str, Any] = {"color": INK, "marker": "o", "markerfacecolor": "none", "markersize": 7, "markeredgewidth": 0.8}
CENTRALISED: dict[str, Any] = {"color": BLUE, "marker": "x", "markersize": 6}
DECENTRALISED: dict[str, Any] = {"color": VERMILLION, "marker": ".", "markersize": 6}
COLOUR_OF_PHASE = {"": GREY, "a": ORANGE, "b": GREEN, "c": SKY, "s1": ORANGE, "s2": GREEN}
MARK_OF_PHASE = {"a": "o", "b": "s", "c": "^", "s1": "D", "s2": "v"}
DOT = 0.6  # size of these marks by that of a mark "." or "_" of which they take the place
WIDTH = 8.0  # inches
DPI = 130
PIXELS_PER_INCH = 118  # in a page, where there is room
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
MAX_VECTOR = 3000  # marks of one kind in a vector graphic; more become an image in it
RC: dict[str, Any] = {
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial"],
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.facecolor": "none",
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.edgecolor": GREY,
    "legend.facecolor": PAPER,
    "figure.dpi": DPI,  # the same for layout and PNG, so that texts are measured once
    "figure.facecolor": PAPER,
    "savefig.facecolor": PAPER,
    "figure.titlesize": "medium",
    "grid.color": GREY,
    "svg.fonttype": "none",  # text stays text for search and screen readers
    "svg.hashsalt": "dsse",  # equal figures give equal files
    "pdf.fonttype": 42,
}


@dataclass(frozen=True)
class Drawing:
    """A figure with its name, which its files have, and its ``title`` and ``caption``."""

    name: str
    title: str
    caption: str
    figure: Figure

    def save(self, path: str | Path) -> None:
        """Writes the figure in the format that the ending of ``path`` names: .png, .pdf, .svg or others of matplotlib.

        Raises:
            InvalidInputError: the ending names no format.
        """
        known = self.figure.canvas.get_supported_filetypes()
        if (suffix := Path(path).suffix.removeprefix(".").lower()) not in known:
            raise InvalidInputError(str(path), [describe_unknown("ending", suffix, tuple(known))])
        with styled():
            save(self.figure, Path(path).with_suffix(""), [suffix])

    def _repr_png_(self) -> bytes:
        """The picture for notebooks."""
        picture = io.BytesIO()
        with styled():
            fix_layout(self.figure)
            self.figure.savefig(picture, format="png", dpi=DPI)
        return picture.getvalue()


def styled() -> Any:
    """Context with the style, in which figures are drawn and written."""
    return mpl.rc_context(cast(Any, RC))


def new_figure(height: float, rows: int = 1, width: float = WIDTH) -> tuple[Figure, list[Axes]]:
    """A figure, ``width`` by ``height`` inches, and its ``rows`` axes, one below the other with a shared x axis."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0].tolist()
    return figure, axes


def style_by_phase(
    label: str, style: dict[str, Any], phases: np.ndarray
) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    """Yields for each of ``phases`` (n,), places in PHASES, the positions of its points and their style: a mark and a
    colour of its own, and a label. ``style``: of points without a phase.
    """
    known = np.unique(phases).tolist()
    for number in known:
        own: dict[str, Any] = {"label": label if known == [0] else f"{label}, several phases"}
        if phase := PHASES[number]:
            size = style["markersize"] * (DOT if style["marker"] in "._" else 1.0)
            own = {"label": f"{label}, phase {phase}", "marker": MARK_OF_PHASE[phase], "markersize": size}
            own["color"] = COLOUR_OF_PHASE[phase]
        yield np.flatnonzero(phases == number), style | own


def format_power_of_ten(value: float, _position: float = 0) -> str:
    """``10⁻⁴`` as plain text, faster than a formula; "" for values that are no power of ten."""
    exponent = round(math.log10(value)) if value > 0 else 0
    whole = math.isclose(value, 10.0**exponent, rel_tol=1e-6)
    return f"10{str(exponent).translate(SUPERSCRIPT)}" if whole else ""


def write_instead(axis: Axes, words: str) -> None:
    """Write ``words`` in the middle of axes without data."""
    axis.set_yticks([])
    axis.text(0.5, 0.5, words, transform=axis.transAxes, ha="center", va="center")


def fix_layout(figure: Figure) -> None:
    """Compute the layout once, for all formats written later."""
    engine = figure.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.execute(figure)
        figure.set_layout_engine("none")


def save(figure: Figure, path_without_suffix: Path, formats: Sequence[str]) -> tuple[Path, ...]:
    """Write the figure once for each of ``formats``; the paths.

    Raises:
        OSError: a file cannot be written.
    """
    paths = tuple(path_without_suffix.with_name(f"{path_without_suffix.name}.{suffix}") for suffix in formats)
    fix_layout(figure)
    for path, suffix in zip(paths, formats, strict=True):
        undated: dict[str, Any] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
        with whole_file(path) as draft:
            figure.savefig(draft, dpi=DPI, metadata=undated.get(suffix))
    return paths


def as_svg(figure: Figure, name: str) -> str:
    """The figure as an ``<svg>`` element for a page, ids beginning with ``name``; text as text, colours the page's."""
    fix_layout(figure)
    text = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(text, format="svg", metadata=nothing, transparent=True)
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<defs>\s*<style[^>]*>.*?</style>\s*</defs>", "", svg, count=1, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", svg)
    width = figure.get_figwidth() * PIXELS_PER_INCH
    head = rf'<svg \1 style="width: {width:.0f}px" aria-hidden="true" focusable="false">'
    svg = re.sub(r'^<svg [^>]*?(viewBox="[^"]*")[^>]*>', head, svg, count=1)
    return svg.replace(INK, "currentColor").replace(PAPER, "var(--paper)").strip()
