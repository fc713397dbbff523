"""Names for figures: drawn as they are written, never as formulas."""

from __future__ import annotations

from dsse_core.grid.network import Network
from dsse_core.printable import printable, shortened

LONGEST_TITLE = 120  # characters


def plot_text(text: object, longest: int = LONGEST_TITLE) -> str:
    """``text`` for matplotlib to draw letter by letter; it would take text between dollar signs as mathematics."""
    return shortened(printable(text), longest).replace("$", r"\$")


def name_places(network: Network) -> tuple[str, str]:
    """The words for a place with a voltage of its own, and for several: bus, or node where buses have phases."""
    return ("bus", "buses") if network.table.nodes.is_balanced else ("node", "nodes")
