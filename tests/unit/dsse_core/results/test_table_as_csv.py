"""CSV files: each cell is what Python writes for it, whatever library writes many of them at once."""

from __future__ import annotations

import csv
import io
import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dsse_core.results import table as table_module
from dsse_core.results.table import Table

EDGES = [0.0, -0.0, 5e-324, 1e-10, 9.999999999999999e-10, 1e-9, 1e-5, 9.999999999999999e-5, 1e-4, 1e16, 1e22, math.inf]
TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\r\0"), max_size=8)


def cells_of(table: Table) -> list[list[str]]:
    return list(csv.reader(io.StringIO(table.to_csv(), newline="")))[1:]


@settings(max_examples=300, deadline=None)
@given(st.lists(st.floats(allow_nan=False) | st.sampled_from(EDGES), min_size=1, max_size=30))
def test_no_number_is_written_in_another_way_than_python_writes_it(numbers: list[float]):
    both = np.array([*numbers, *(-number for number in numbers)])
    table = Table("numbers", {"number": both, "beside": both[::-1]})
    assert cells_of(table) == [[repr(a), repr(b)] for a, b in zip(both.tolist(), both[::-1].tolist(), strict=True)]


def test_numbers_of_all_sizes_read_back_to_the_bit():
    bits = np.random.default_rng(1).integers(0, 2**64, 20_000, dtype=np.uint64)
    numbers = bits.view(float)[np.isfinite(bits.view(float))]
    found = [float(cell) for (cell,) in cells_of(Table("numbers", {"number": numbers}))]
    assert struct.pack(f"{len(found)}d", *found) == numbers.tobytes()


@given(st.lists(st.tuples(TEXTS, TEXTS), min_size=1, max_size=9))
def test_no_text_is_torn_into_cells(rows: list[tuple[str, str]]):
    first, second = zip(*rows, strict=True)
    table = Table("texts", {"first": first, "number": np.arange(len(rows)), "second": second})
    assert cells_of(table) == [[a, str(k), b] for k, (a, b) in enumerate(rows)]


def test_what_is_unknown_is_empty_and_kinds_of_columns_may_alternate():
    columns = {"a": np.array([np.nan, 1.5]), "b": ("x", ""), "c": np.array([True, False]), "d": np.array([3, -4])}
    assert Table("kinds", columns).to_csv() == "a,b,c,d\n,x,true,3\n1.5,,false,-4\n"
    assert Table("nothing", {"a": np.zeros(0), "b": ()}).to_csv() == "a,b\n"


def test_no_row_is_lost_where_rows_are_written_in_parts(monkeypatch: pytest.MonkeyPatch):
    table = Table("parts", {"k": np.arange(10), "text": [str(k) for k in range(10)]})
    whole = table.to_csv()
    for at_a_time in (1, 3, 5, 10):
        monkeypatch.setattr(table_module, "ROWS_AT_A_TIME", at_a_time)
        assert table.to_csv() == whole
