"""Pictures of parties and their messages for the pages, as SVG in docs/figures: ``python docs/pictures.py``.

A picture is a list of boxes (x, y, lines of text) and arrows (from, to, text) on a grid of cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path

FIGURES = Path(__file__).parent / "figures"
CELL, HIGH, WIDE, TALL = 210, 92, 150, 52  # of a cell, and of a box in it
INK, PAPER, LINE, QUIET = "#1c2733", "#ffffff", "#48627d", "#eef3f8"


@dataclass(frozen=True)
class Box:
    """A party: column and row of its cell, and its text, the first line bold."""

    column: float
    row: float
    text: str
    wide: float = 1.0

    @property
    def centre(self) -> tuple[float, float]:
        return 45 + WIDE / 2 + self.column * CELL, 20 + TALL / 2 + self.row * HIGH

    def draw(self) -> str:
        x, y = self.centre
        width = WIDE * self.wide
        lines = self.text.split("\n")
        words = "".join(
            f'<text x="{x}" y="{y + 5 + 16 * (k - (len(lines) - 1) / 2):.0f}" text-anchor="middle"'
            f"{' font-weight=' + chr(34) + 'bold' + chr(34) if k == 0 else ''}>{escape(line)}</text>"
            for k, line in enumerate(lines)
        )
        return (
            f'<rect x="{x - width / 2}" y="{y - TALL / 2}" width="{width}" height="{TALL}" rx="6" '
            f'fill="{QUIET}" stroke="{LINE}"/>{words}'
        )

    def edge_towards(self, other: Box) -> tuple[float, float]:
        """The point of the frame on the way to ``other``."""
        (x, y), (to_x, to_y) = self.centre, other.centre
        width = WIDE * self.wide / 2
        share = min(width / max(abs(to_x - x), 1e-9), TALL / 2 / max(abs(to_y - y), 1e-9))
        return x + share * (to_x - x), y + share * (to_y - y)


@dataclass(frozen=True)
class Arrow:
    """Messages from one box to another, or both ways, with their text on the middle of the line."""

    start: str
    end: str
    text: str = ""
    both: bool = False

    def draw(self, boxes: dict[str, Box]) -> str:
        start, end = boxes[self.start], boxes[self.end]
        (x1, y1), (x2, y2) = start.edge_towards(end), end.edge_towards(start)
        lines = self.text.split("\n")
        x, y = (x1 + x2) / 2, (y1 + y2) / 2 + 4 - 7 * (len(lines) - 1)
        marks = 'marker-end="url(#tip)"' + (' marker-start="url(#tip)"' if self.both else "")
        words = "".join(
            f'<text x="{x:.0f}" y="{y + 14 * k:.0f}" text-anchor="middle" font-size="12" stroke="{PAPER}" '
            f'stroke-width="5" paint-order="stroke">{escape(line)}</text>'
            for k, line in enumerate(lines)
        )
        return f'<line x1="{x1:.0f}" y1="{y1:.0f}" x2="{x2:.0f}" y2="{y2:.0f}" stroke="{LINE}" {marks}/>{words}'


def draw(boxes: dict[str, Box], arrows: list[Arrow]) -> str:
    """The picture as SVG, on white so that it can be read on a dark page, too."""
    width = max(box.centre[0] + WIDE * box.wide / 2 for box in boxes.values()) + 45
    height = max(box.centre[1] + TALL / 2 for box in boxes.values()) + 20
    parts = [arrow.draw(boxes) for arrow in arrows] + [box.draw() for box in boxes.values()]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" '
        f'font-family="sans-serif" font-size="13" fill="{INK}">\n'
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" '
        f'orient="auto-start-reverse"><path d="M0 0 L8 4 L0 8 z" fill="{LINE}"/></marker></defs>\n'
        f'<rect width="100%" height="100%" fill="{PAPER}"/>\n' + "\n".join(parts) + "\n</svg>\n"
    )


PICTURES = {
    "protocol": draw(
        {
            "meters": Box(0, 0, "plant, gateways\nreadings of a scan"),
            "hub": Box(1.6, 0, "hub\nadds up, decides"),
            "left": Box(0.6, 1.7, "area\nfarther from the hub"),
            "right": Box(2.6, 1.7, "area\nfarther from the hub"),
            "watcher": Box(3.2, 0, "coordinator, watch\ncompare states"),
        },
        [
            Arrow("meters", "hub", "telemetry"),
            Arrow("meters", "left", "telemetry"),
            Arrow("left", "hub", "Up(k): R, z, totals\nDown(k): R, z, verdict", both=True),
            Arrow("right", "hub", "Up(k)\nDown(k)", both=True),
            Arrow("hub", "watcher", "state"),
            Arrow("right", "watcher", "state"),
        ],
    ),
    "quality": draw(
        {
            "own": Box(0, 0, "own findings\nreadings, clocks, gateways", 1.25),
            "left": Box(0, 1.3, "neighbour\nits side is complete", 1.25),
            "area": Box(1.5, 0.65, "area\nworst finding = word", 1.1),
            "right": Box(3, 1.3, "neighbour\nits side is complete", 1.1),
            "watcher": Box(3, 0, "coordinator, watch\nsilence, mismatch", 1.1),
        },
        [
            Arrow("own", "area"),
            Arrow("left", "area", "complete, y, split", both=True),
            Arrow("area", "right", "complete, y, split", both=True),
            Arrow("area", "watcher", "word and notes"),
        ],
    ),
    "deployment": draw(
        {
            "a": Box(0, 0, "agents of host A\none for each area"),
            "b": Box(0, 1.3, "agents of host B\none for each area"),
            "router_a": Box(1.5, 0, "router of host A\nport 7447"),
            "router_b": Box(1.5, 1.3, "router of host B\nport 7447"),
            "gateway": Box(3, 0, "gateway or plant\nreadings"),
            "watch": Box(3, 1.3, "watch, serve,\nmetrics, record, operator", 1.15),
        },
        [
            Arrow("a", "router_a", "loopback", both=True),
            Arrow("b", "router_b", "loopback", both=True),
            Arrow("router_a", "router_b", "TLS", both=True),
            Arrow("gateway", "router_a", "telemetry"),
            Arrow("router_b", "watch", "states"),
        ],
    ),
}

if __name__ == "__main__":
    for name, picture in PICTURES.items():
        (FIGURES / f"{name}.svg").write_text(picture, encoding="utf-8")
