"""Tables of arrays: buses, branches and meters column by column; their objects are made on request."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from inspect import signature
from itertools import pairwise
from operator import attrgetter
from typing import Any, Generic, TypeVar, overload

import numpy as np

Item = TypeVar("Item")
DEAR = 8  # an object made by itself takes so many times as long as an object made with all others


class Records(Sequence[Item], Generic[Item]):
    """A sequence of objects that are kept as columns; equal to the tuple of them.

    All objects are made at the first request for all, or after so many requests for single ones that this pays.

    ``columns``: name of an attribute -> its values, (n,), an array or, of text and objects, a sequence.
    """

    def __init__(self, make: Callable[..., Item], columns: dict[str, Any]) -> None:
        self.make, self.columns, self._asked = make, columns, 0
        lengths = {name: len(column) for name, column in columns.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"columns of {getattr(make, '__name__', make)} differ in length: {lengths}")

    @cached_property
    def objects(self) -> tuple[Item, ...]:
        plain = [column.tolist() if isinstance(column, np.ndarray) else column for column in self.columns.values()]
        if list(signature(self.make).parameters)[: len(plain)] == list(self.columns):
            return tuple(map(self.make, *plain))
        return tuple(self.make(**dict(zip(self.columns, values, strict=True))) for values in zip(*plain, strict=True))

    def take(self, rows: np.ndarray) -> Records[Item]:
        """The items at the positions ``rows``, (k,), as columns."""
        return Records(self.make, {name: _take_of_column(column, rows) for name, column in self.columns.items()})

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.make, self.columns)  # without the objects: the receiving process makes its own

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __repr__(self) -> str:
        return f"<Records of {len(self)} rows: {', '.join(self.columns)}>"

    @overload
    def __getitem__(self, key: int) -> Item: ...

    @overload
    def __getitem__(self, key: slice) -> tuple[Item, ...]: ...

    def __getitem__(self, key: int | slice) -> Item | tuple[Item, ...]:
        if isinstance(key, slice) or "objects" in vars(self) or self._asked * DEAR >= len(self):
            return self.objects[key]
        self._asked += 1
        values = ((name, column[key]) for name, column in self.columns.items())
        return self.make(**{name: v.item() if isinstance(v, np.generic) else v for name, v in values})

    def __iter__(self) -> Iterator[Item]:
        return iter(self.objects)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and self.objects == tuple(other)

    def __hash__(self) -> int:
        return hash(self.objects)


def _take_of_column(column: Any, rows: np.ndarray) -> Any:
    if isinstance(column, np.ndarray):
        return column[rows]
    return column.take(rows) if isinstance(column, Records) else [column[row] for row in rows.tolist()]


def take_items(items: Sequence[Item], rows: np.ndarray) -> Sequence[Item]:
    """The items at the positions ``rows``, (k,): columns where ``items`` are columns, else a tuple."""
    return items.take(rows) if isinstance(items, Records) else tuple(items[row] for row in rows.tolist())


def split_by(number: np.ndarray, count: int) -> list[np.ndarray]:
    """The positions of each of the numbers 0 to ``count`` - 1 in ``number`` (n,), in rising order."""
    order = np.argsort(number, kind="stable")
    ends = np.searchsorted(number[order], np.arange(count + 1)).tolist()
    return [order[first:last] for first, last in pairwise(ends)]


def read_column(items: Sequence[Any], name: str, dtype: type) -> np.ndarray:
    """The attribute ``name`` of all ``items``, shape (n,)."""
    if isinstance(items, Records) and name in items.columns:
        column = items.columns[name]
        return column if isinstance(column, np.ndarray) and column.dtype == object else np.asarray(column, dtype=dtype)
    if isinstance(items, Records):
        items = items.objects
    values = [getattr(item, name) for item in items]
    return read_ids(values) if dtype is np.int64 else np.array(values, dtype=dtype)


def read_ids(values: Sequence[int]) -> np.ndarray:
    """Ids of buses as an array, (n,)."""
    try:
        return np.array(values, dtype=np.int64)
    except OverflowError:  # an id that no bus of a network has, but that an error must be able to name
        return np.array(values, dtype=object)


def read_given(items: Sequence[Any], name: str) -> Iterable[Any]:
    """The attribute ``name``, which has a default, of all ``items``; nothing where columns have none of this name."""
    if isinstance(items, Records):
        given: Iterable[Any] = items.columns.get(name, ())
        return given
    return map(attrgetter(name), items)


class Rows:
    """Mapping of ids, given as a column, to their rows."""

    def __init__(self, ids: np.ndarray) -> None:
        self._ids = ids
        n = len(ids)
        self._counts_up = n > 0 and ids[-1] - ids[0] == n - 1 and bool((ids[1:] - ids[:-1] == 1).all())

    @cached_property
    def _order(self) -> np.ndarray:
        return np.argsort(self._ids, kind="stable")

    @cached_property
    def are_unique(self) -> bool:
        return self._counts_up or not bool((np.diff(self._ids[self._order]) == 0).any())

    def row_of(self, wanted: int) -> int:
        """The row of one id; -1 where there is none."""
        if not self._counts_up:
            return int(self.find(np.array([wanted]))[0])
        row = wanted - int(self._ids[0])
        return row if 0 <= row < len(self._ids) else -1

    def find(self, wanted: np.ndarray) -> np.ndarray:
        """The rows of the ids ``wanted``, shape (k,); -1 where there is none."""
        n = len(self._ids)
        if n == 0:
            return np.full(len(wanted), -1)
        if self._counts_up:
            rows: np.ndarray = wanted - self._ids[0]
            if rows.dtype == np.int64 and (rows.view(np.uint64) < n).all():
                return rows
            return np.where((rows >= 0) & (rows < n), rows, -1).astype(np.int64)
        at = np.searchsorted(self._ids, wanted, sorter=self._order)
        rows = self._order[np.minimum(at, n - 1)]
        return np.where(self._ids[rows] == wanted, rows, -1)


def find_distinct(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first position of each distinct number of ``numbers`` (n,), (k,) rising; and for each of ``numbers``, (n,),
    the place of its first position among these.
    """
    n = len(numbers)
    if np.diff(np.sort(numbers)).all():
        return np.arange(n), np.arange(n)
    _, first, number = np.unique(numbers, return_index=True, return_inverse=True)
    order = np.argsort(first)
    position = np.empty(len(first), dtype=np.intp)
    position[order] = np.arange(len(first))
    return first[order], position[number]


def rows_of_texts(known: Iterable[str | bytes], wanted: Iterable[str | bytes | None]) -> np.ndarray:
    """The position of each text ``wanted`` in ``known``; -1 for a text that is not there, -2 for None."""
    row: dict[str | bytes | None, int] = {text: k for k, text in enumerate(known)}
    row[None] = -2
    return np.array([row.get(text, -1) for text in wanted], dtype=np.int64)
