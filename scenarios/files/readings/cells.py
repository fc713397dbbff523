"""The cells of a CSV file, found all at once by their positions: the file of a large grid has millions of cells."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Cells:
    """Rows with a cell for each of ``titles``: begin and end of each cell in ``raw``, (n_row, n_column)."""

    titles: list[str]
    raw: bytes
    start: np.ndarray
    end: np.ndarray

    @cached_property
    def are_filled(self) -> np.ndarray:
        """True where a cell is not empty, (n_row, n_column)."""
        return np.asarray(self.end > self.start)

    @cached_property
    def filled(self) -> list[bytes]:
        """Contents of the cells that are not empty, row by row."""
        rows = self.raw[self.raw.index(b"\n") + 1 :]
        return list(filter(None, rows.replace(b",", b"\n").split(b"\n")))


def split_cells(text: str) -> Cells | None:
    """The cells of ``text``; None where they are not plain.

    Cells are plain where ``text`` is CSV, all rows have the length of the first, and no cell contains a comma or a line
    end.
    """
    text = text if '"' in text else text.replace("\r\n", "\n").removesuffix("\n")
    if '"' in text or "\r" in text or "\n\n" in f"\n{text}":  # quoted cells, other line ends, empty lines
        if (plain := _write_plain(text)) is None:
            return None
        text = plain
    raw = f"{text}\n".encode()
    titles = text.partition("\n")[0].split(",")
    letters = np.frombuffer(raw, np.uint8)
    end = np.flatnonzero((letters == ord(",")) | (letters == ord("\n")))
    if len(end) % len(titles):
        return None
    ends_line = (letters[end] == ord("\n")).reshape(-1, len(titles))
    if ends_line[:, :-1].any() or not ends_line[:, -1].all():
        return None
    start = np.append(0, end[:-1] + 1)
    return Cells(titles, raw, start.reshape(ends_line.shape)[1:], end.reshape(ends_line.shape)[1:])


def _write_plain(text: str) -> str | None:
    """The same table without quotes and empty lines; None where it is not plain."""
    try:
        rows = [row for row in csv.reader(io.StringIO(text, newline=""), strict=True) if row]
    except csv.Error:
        return None
    lines = list(map(",".join, rows))
    plain, lengths = "\n".join(lines), set(map(len, rows))
    is_plain = len(lengths) == 1 and plain.count(",") == len(rows) * (lengths.pop() - 1)
    return plain if is_plain and plain.count("\n") == len(rows) - 1 and "\r" not in plain else None
