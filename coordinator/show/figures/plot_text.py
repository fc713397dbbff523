"""Names for figures: drawn as they are written, never as formulas."""

from __future__ import annotations

from dsse_core.printable import printable, shortened

LONGEST_TITLE = 120  # characters


def plot_text(text: object, longest: int = LONGEST_TITLE) -> str:
    """``text`` for matplotlib to draw letter by letter; it would take text between dollar signs as mathematics."""
    return shortened(printable(text), longest).replace("$", r"\$")
