"""Values of keys, written on one line as ``--set`` takes them."""

from __future__ import annotations

import pytest

from scenarios.files.key_values import parse_value, write_value

VALUES = [
    *(0.3, 1e-7, 3, True, False, "network", 'with "quotes" and \\', "two\nlines", "Übertragung", [1, 2.5, "a"], []),
    {"count": 4},
    {"p_mw": 0.3, "q mvar": [{"deep": {"er": False}}]},
]


@pytest.mark.parametrize("value", VALUES, ids=str)
def test_what_is_written_reads_back_as_the_same_value(value: object) -> None:
    text = write_value(value)
    assert "\n" not in text
    assert parse_value(text) == value
