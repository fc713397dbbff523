"""Labels of points in a figure, each beside its point in a free place, as far as there is room."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from matplotlib.axes import Axes

from coordinator.show.figures.style import INK, PAPER

LETTER = 0.62  # width of a letter by its size
LINE = 1.15  # height
CELL_PT = 24.0
SIZES = (7.0, 6.0, 5.0, 4.0)  # points, tried in this order
NEAR, FAR = 1.0, 2.2
SIDES = ((1, 1), (-1, 1), (1, -1), (-1, -1), (0, 1), (0, -1), (1, 0), (-1, 0))

Box = tuple[float, float, float, float]  # left, bottom, right, top


@dataclass
class Room:
    """The boxes that are taken, by cells, so that a query looks at few of them."""

    _cells: dict[tuple[int, int], list[Box]] = field(default_factory=lambda: defaultdict(list))

    def take(self, box: Box) -> None:
        for cell in _cells_of(box):
            self._cells[cell].append(box)

    def overlap(self, box: Box) -> float:
        """Sum of the overlaps of ``box`` with the taken boxes, pt²."""
        met = {other for cell in _cells_of(box) for other in self._cells.get(cell, ())}
        return sum(_common(box, other) for other in met)


def label_points(
    axes: Axes, places: np.ndarray, texts: Sequence[str], obstacles: np.ndarray, mark_pt: float, *, all_of_them: bool
) -> None:
    """Write ``texts`` beside ``places`` (n, 2), data coordinates; marks of ``obstacles`` (m, 2) stay free.

    The layout of the figure must be final. With ``all_of_them``, a text without a free place stands where it overlaps
    least; otherwise it is left out.
    """
    if not texts:
        return
    scale = 72.0 / axes.figure.dpi
    points, marks = (axes.transData.transform(given) * scale for given in (places, obstacles))
    room, half = Room(), mark_pt / 2
    for x, y in marks.tolist():
        room.take((x - half, y - half, x + half, y + half))
    for (x, y), place, text in zip(points.tolist(), places, texts, strict=True):
        found = _find_place(room, x, y, text, half)
        overlap, size, box, align = found
        if overlap > 0 and not all_of_them:
            continue
        room.take(box)
        shift = (box[0] if align == "left" else box[2]) - x, (box[1] + box[3]) / 2 - y
        written = axes.annotate(
            text,
            place,
            shift,
            textcoords="offset points",
            ha=align,
            va="center",
            fontsize=size,
            color=INK,
            zorder=6,
            bbox={"facecolor": PAPER, "edgecolor": "none", "alpha": 0.6, "pad": 0.2},
        )
        written.set_in_layout(False)


def _find_place(room: Room, x: float, y: float, text: str, half: float) -> tuple[float, float, Box, str]:
    """Overlap, size of the letters, box and alignment at the first free place, or at the one with the least overlap."""
    best: tuple[float, float, Box, str] | None = None
    for size, distance, side in product(SIZES, (NEAR, FAR), SIDES):
        box = _box_at(x, y, text, size, half * distance + 1.0, side)
        overlap = room.overlap(box)
        if best is None or overlap < best[0]:
            best = overlap, size, box, "right" if side[0] < 0 else "left"
            if overlap == 0:
                break
    assert best is not None
    return best


def _box_at(x: float, y: float, text: str, size: float, gap: float, side: tuple[int, int]) -> Box:
    width, height = LETTER * size * len(text), LINE * size
    left = x + gap if side[0] > 0 else x - gap - width if side[0] < 0 else x - width / 2
    bottom = y + gap * 0.4 if side[1] > 0 else y - gap * 0.4 - height if side[1] < 0 else y - height / 2
    if side[0] == 0:
        bottom = y + gap if side[1] > 0 else y - gap - height
    return left, bottom, left + width, bottom + height


def _cells_of(box: Box) -> Iterator[tuple[int, int]]:
    left, bottom, right, top = (int(edge // CELL_PT) for edge in box)
    return product(range(left, right + 1), range(bottom, top + 1))


def _common(one: Box, other: Box) -> float:
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    return max(width, 0.0) * max(height, 0.0)
