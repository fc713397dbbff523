"""A table of results: named columns of one length, read-only."""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, TextIO, cast, overload

import msgspec
import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.nodes import PHASES
from dsse_core.printable import printable, shortened

SHOWN_ROWS = 3
SHOWN_COLUMNS = 6
SHOWN_IN_NOTEBOOK = 10  # rows; of a longer table the first and the last five
LONGEST_CELL = 24
COLUMN = re.compile(r"[a-z]\S*")  # a key of a scenario file as well, such as faults.link[1].loss
ROWS_AT_A_TIME = 4096  # of a file, whose cells take a few megabytes
NEEDS_QUOTES = re.compile('[,"\r\n]')
ALL_PHASES = "abc"  # of a row of a balanced network, in positive sequence, and of a total

Column = np.ndarray | tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ScanLabel:
    """Name of a scan, "" without one, and its ``time``, s since 1970; nan where it is not known."""

    name: str = ""
    time: float = math.nan

    def columns(self, n: int) -> tuple[Sequence[str], np.ndarray]:
        """The columns ``scan`` and ``time`` of ``n`` rows."""
        return [self.name] * n, as_times(np.full(n, self.time))


NO_SCAN = ScanLabel()


class Freshness(NamedTuple):
    """Quality and age of numbers. ``quality``: "" where the numbers have none. ``value_age_s``: time since the
    telemetry behind them was received, s, or nan. ``fresh``: they are of the present, and count as known.
    """

    quality: str = ""
    value_age_s: float = math.nan
    fresh: bool = True


IN_ONE_PLACE = Freshness()


def mark_rows(marks: Sequence[Freshness], of: np.ndarray) -> dict[str, Any]:
    """The columns ``quality``, ``value_age_s`` and ``fresh`` of rows; ``of`` (n,): place in ``marks`` of each."""
    quality, ages, fresh = zip(*marks, strict=True)
    return {
        "quality": [quality[k] for k in of.tolist()],
        "value_age_s": np.array(ages, dtype=float)[of],
        "fresh": np.array(fresh, dtype=bool)[of],
    }


def name_phases(phase: np.ndarray) -> list[str]:
    """The column ``phase`` of rows by their places in PHASES, (n,)."""
    names = ALL_PHASES, *PHASES[1:]
    return [names[k] for k in phase.tolist()]


def as_times(seconds: np.ndarray) -> np.ndarray:
    """``seconds`` since 1970 as times to the millisecond; NaT for nan."""
    known = np.isfinite(seconds)
    return np.where(known, np.round(1000 * np.where(known, seconds, 0.0)), -(2.0**63)).astype("int64").view("M8[ms]")


def name_by_phase(ids: Iterable[str], phases: Iterable[str]) -> list[str]:
    """Labels of rows: their ids, such as 671, of a row of one phase 671.b."""
    return [name if phase == ALL_PHASES else f"{name}.{phase}" for name, phase in zip(ids, phases, strict=True)]


class Table:
    """Columns by name: ``table.vm_pu`` and ``table["vm_pu"]``. ``len(table)``: the number of rows.

    A column of numbers, truth values or times is an array of shape (len(table),), read-only; a column of texts is a
    tuple of str. Unknown numbers are nan, unknown times NaT, unknown texts "". Column names end with their unit:
    ``p_kw``, ``va_deg``. ``dsse_core.results.columns`` has the columns of each table.
    """

    __slots__ = ("_columns", "_title")
    _columns: dict[str, Column]
    _title: str

    def __init__(self, title: str, columns: Mapping[str, np.ndarray | Sequence[str]]) -> None:
        """Makes a table; ``title``: the name of the rows, such as "branches"; ``columns``: copied.

        Raises:
            ValueError: columns of different lengths, of more than one dimension, or with impossible names.
        """
        kept = {name: _keep(name, column) for name, column in columns.items()}
        if len({len(column) for column in kept.values()}) > 1:
            lengths = ", ".join(f"{name} has {len(column)}" for name, column in kept.items())
            raise ValueError(f"the columns of a table have one length; {lengths}")
        object.__setattr__(self, "_title", title)
        object.__setattr__(self, "_columns", kept)

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the columns, in their order."""
        return tuple(self._columns)

    def __getitem__(self, name: str) -> Any:
        try:
            return self._columns[name]
        except KeyError:
            raise KeyError(self._unknown(name)) from None

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # of a table that is being made, copied or unpickled
            raise AttributeError(name)
        try:
            return self._columns[name]
        except KeyError:
            raise AttributeError(self._unknown(name)) from None

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a table of results cannot be changed; {name} stays as it is")

    def __reduce__(self) -> tuple[Any, ...]:
        return Table, (self._title, self._columns)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._columns]

    def __len__(self) -> int:
        return len(next(iter(self._columns.values()), ()))

    def __repr__(self) -> str:
        """The title, the size, all columns, and the first rows: ten lines at most."""
        head = f"{self._title}: {len(self)} rows, {len(self._columns)} columns"
        names = list(self._columns)
        lines = [head, "  columns: " + shortened(", ".join(names), 900)]
        shown = names[:SHOWN_COLUMNS]
        more = " ..." if len(names) > len(shown) else ""
        rows = [shown, *([_show(self._columns[n][k]) for n in shown] for k in range(min(SHOWN_ROWS, len(self))))]
        widths = [max(len(row[c]) for row in rows) for c in range(len(shown))]
        lines += ["  " + "  ".join(map(str.rjust, row, widths)) + more for row in rows]
        if len(self) > SHOWN_ROWS:
            lines.append(f"  ... and {len(self) - SHOWN_ROWS} rows more")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """HTML for notebooks, in the form of a data frame: all columns, the first rows and the last."""
        n, half = len(self), SHOWN_IN_NOTEBOOK // 2
        shown = list(range(n)) if n <= SHOWN_IN_NOTEBOOK else [*range(half), *range(n - half, n)]
        rows = [_html_row("td", k, (_show(column[k]) for column in self._columns.values())) for k in shown]
        if len(shown) < n:
            rows.insert(half, _html_row("td", "...", ["..."] * len(self._columns)))
        head = _html_row("th", "", self._columns)
        size = f"{html.escape(printable(self._title))}: {n} rows, {len(self._columns)} columns"
        table = f'<table border="1" class="dataframe"><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table>'
        return f'<div style="overflow-x: auto">{table}<p>{size}</p></div>'

    def rows(self) -> Iterator[tuple[Any, ...]]:
        """The rows, in order: tuples of int, float, bool, datetime and str, as the columns are."""
        return zip(*(_as_list(column) for column in self._columns.values()), strict=True)

    @overload
    def to_csv(self) -> str: ...

    @overload
    def to_csv(self, file: str | Path | TextIO) -> None: ...

    def to_csv(self, file: str | Path | TextIO | None = None) -> str | None:
        """Writes the table as CSV: numbers with all digits, and an empty cell where a value is unknown.

        ``file``: a path or an open file; without it the text is returned.
        """
        if file is None:
            text = io.StringIO(newline="")
            _write_csv(text, self._columns)
            return text.getvalue()
        if isinstance(file, str | Path):
            with Path(file).open("w", newline="", encoding="utf-8") as opened:
                _write_csv(opened, self._columns)
        else:
            _write_csv(file, self._columns)
        return None

    def to_pandas(self) -> Any:
        """A ``pandas.DataFrame`` with the same columns, which may be changed.

        Raises:
            InvalidInputError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise InvalidInputError("to_pandas", ["pandas is not installed; `pip install pandas`"]) from None
        return pandas.DataFrame({name: _as_own(column) for name, column in self._columns.items()})

    def _unknown(self, name: str) -> str:
        close = get_close_matches(name, self._columns, n=1)
        meant = f"; did you mean {close[0]!r}?" if close else ""
        return f"the table of {self._title} has no column {name!r}; it has {', '.join(self._columns)}{meant}"


def _keep(name: str, column: np.ndarray | Sequence[str]) -> Column:
    if not COLUMN.fullmatch(name) or hasattr(Table, name):
        raise ValueError(f"a column of a table cannot be called {name!r}")
    if not isinstance(column, np.ndarray):
        return tuple(column if set(map(type, column)) <= {str} else map(str, column))
    kept = column.copy()
    if kept.ndim != 1:
        raise ValueError(f"column {name} has the shape {kept.shape}; a column has one dimension")
    kept.flags.writeable = False
    return kept


def _as_list(column: Column) -> Sequence[Any]:
    return column if isinstance(column, tuple) else column.tolist()


def _as_own(column: Column) -> Any:
    return list(column) if isinstance(column, tuple) else column.copy()


def _show(value: Any) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else "" if value is None else str(value)
    return shortened(printable(text), LONGEST_CELL)


def _html_row(kind: str, label: object, cells: Iterable[str]) -> str:
    texts = "".join(f"<{kind}>{html.escape(cell)}</{kind}>" for cell in cells)
    return f"<tr><th>{html.escape(str(label))}</th>{texts}</tr>"


def _write_csv(file: TextIO, columns: Mapping[str, Column]) -> None:
    """Writes a header and one line per row; ``columns``: by their names, of one length."""
    file.write(",".join(_quote(tuple(columns))) + "\n")
    groups = [(is_text, list(group)) for is_text, group in groupby(columns.values(), key=_is_text)]
    for first in range(0, len(next(iter(columns.values()), ())), ROWS_AT_A_TIME):
        parts: list[Sequence[str]] = []
        for is_text, group in groups:
            cut = [column[first : first + ROWS_AT_A_TIME] for column in group]
            parts += map(_quote, cut) if is_text else [_join_numbers(cast(Sequence[np.ndarray], cut))]
        file.write("\n".join(map(",".join, zip(*parts, strict=True))) + "\n")


def _is_text(column: Column) -> bool:
    return isinstance(column, tuple) or column.dtype.kind not in "biuf"


def _quote(texts: Column) -> Sequence[str]:
    """Texts and times as cells, in quotes where they contain a comma, a quote or a line end."""
    cells = texts if isinstance(texts, tuple) else write_times(texts)
    if not NEEDS_QUOTES.search("".join(cells)):
        return cells
    return ['"' + cell.replace('"', '""') + '"' if NEEDS_QUOTES.search(cell) else cell for cell in cells]


def write_times(times: np.ndarray) -> list[str]:
    """``times`` as ISO 8601, UTC without a zone; "" for NaT."""
    texts: list[str] = np.datetime_as_string(times, unit="ms").tolist()
    return ["" if text == "NaT" else text for text in texts]


def _join_numbers(columns: Sequence[np.ndarray]) -> list[str]:
    """The cells of each row, with commas between them.

    One call of ``msgspec`` writes all numbers, in a fifth of the time of Python's ``repr`` of each.
    """
    text = msgspec.json.encode(list(zip(*map(_as_numbers, columns), strict=True))).decode()
    return text[len("[[") : -len("]]")].replace("null", "").split("],[")


def _as_numbers(column: np.ndarray) -> list[object]:
    """The numbers of ``column`` for ``msgspec``; those that it would write otherwise than Python as raw text.

    The two differ in exponents of one digit and of large numbers."""
    numbers: list[object] = column.tolist()
    if column.dtype.kind == "f":
        size = abs(column)
        alike = (size < 1e-9) | (size >= 1e-4) & (size < 1e16) | np.isnan(size)
        for row in np.flatnonzero(~alike).tolist():
            numbers[row] = msgspec.Raw(repr(numbers[row]).encode())
    return numbers
