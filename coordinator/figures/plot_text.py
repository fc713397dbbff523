"""Names as pictures show them: as they are written, never as formulas."""

from __future__ import annotations

from dsse_core.printable import printable, shortened

LONGEST_TITLE = 120  # characters


def plot_text(text: object, longest: int = LONGEST_TITLE) -> str:
    """``text`` as matplotlib draws it letter by letter: what stands between two dollar signs would be mathematics."""
    return shortened(printable(text), longest).replace("$", r"\$")
