"""Columns of numbers as text: to the last digit what ``%`` writes."""

from __future__ import annotations

import numpy as np
import pytest

from coordinator.show.report.number_cells import write_fixed, write_significant, write_texts
from dsse_core.printable import all_printable, printable

HALVES = np.concatenate([np.arange(-400, 400) / 8, np.arange(-400, 400) / 1000 + 0.0005])
EDGES = np.array([0.0, -0.0, np.nan, np.inf, -np.inf, 9999.6, 999.95, 0.99951, 9.9996e-5, 1e22, 5e-324, 1.7e308])
DECADES = np.concatenate([10.0 ** np.arange(-7, 18.0), np.nextafter(10.0 ** np.arange(-7, 18.0), 0)])


def draw_numbers() -> np.ndarray:
    rng = np.random.default_rng(5)
    sizes = rng.standard_normal(3000) * 10.0 ** rng.integers(-12, 19, 3000)
    rounded = [round(x, k) for x, k in zip(rng.uniform(-1e4, 1e4, 3000), rng.integers(0, 7, 3000), strict=True)]
    return np.concatenate([sizes, rounded, HALVES, EDGES, DECADES, -DECADES])


def read(cells: np.ndarray) -> list[str]:
    return ["".join(map(chr, column)) for column in cells.T.tolist()]


@pytest.mark.parametrize("digits", range(7))
def test_a_number_is_never_rounded_otherwise_than_percent_f_does(digits: int) -> None:
    numbers = draw_numbers()
    expected = [f"%.{digits}f" % x for x in numbers.tolist()]
    assert [text.lstrip() for text in read(write_fixed(numbers, digits))] == expected


@pytest.mark.parametrize("digits", range(1, 7))
def test_a_number_is_never_written_otherwise_than_percent_g_does(digits: int) -> None:
    numbers = draw_numbers()
    expected = [f"%.{digits}g" % x for x in numbers.tolist()]
    assert [text.lstrip() for text in read(write_significant(numbers, digits))] == expected


def test_no_number_stands_apart_from_the_right_edge() -> None:
    for cells in (write_fixed(draw_numbers(), 2), write_significant(draw_numbers(), 3)):
        assert (cells[-1] != ord(" ")).all()


def test_texts_beyond_ascii_keep_their_letters_and_their_width() -> None:
    assert read(write_texts(["Stra\u00dfe", "\U0001f600x", ""])) == ["Stra\u00dfe", "\U0001f600x    ", "      "]


def test_one_name_that_steers_a_terminal_is_escaped_among_many_that_do_not() -> None:
    names = ["a", "b\x1b[2J", "c\nd"]
    assert all_printable(names) == [printable(name) for name in names]
    assert "\x1b" not in "".join(all_printable(names))
