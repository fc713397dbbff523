"""Tables as plain text."""

from __future__ import annotations

from collections.abc import Sequence

from dsse_core.printable import printable


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Table of columns padded to their widest cell, all printable; the first is flush left, the others right."""
    columns = [list(map(printable, column)) for column in zip(*rows, strict=True)] if rows else [[] for _ in header]
    table = [[name, *column] for name, column in zip(header, columns, strict=True)]
    widths = [max(map(len, column)) for column in table]
    row = "  ".join(f"%{width if k else -width}s" for k, width in enumerate(widths))
    return "\n".join([(row % cells).rstrip() for cells in zip(*table, strict=True)])
