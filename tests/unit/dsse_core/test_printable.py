"""What others have written is shown as it is, and obeyed by nothing that shows it."""

from __future__ import annotations

import unicodedata

import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.printable import listed, printable, printable_lines, shortened


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Ørsted 10 kV", "Ørsted 10 kV"),
        ("\x1b]0;owned\x07", r"\x1b]0;owned\x07"),
        ("\x9b2J", r"\x9b2J"),
        ("area1\r\nconsensus", r"area1\r\nconsensus"),
        ("\u202eevil\u2066", r"\u202eevil\u2066"),
        ("a\u200bb\u2028c\ufeff", r"a\u200bb\u2028c\ufeff"),
        ("\udcff.toml", r"\udcff.toml"),
        ("[/nope]", "[/nope]"),
        ("area1\u3164\u115f\ufe0f\u034f\u2800", r"area1\u3164\u115f\ufe0f\u034f\u2800"),
    ],
)
def test_no_character_steers_a_terminal_or_hides(text: str, shown: str):
    assert printable(text) == shown


def test_no_control_or_format_character_of_unicode_gets_through():
    for number in range(0x110000):
        character = chr(number)
        if unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp"):
            assert printable(character).isprintable()


def test_lines_are_kept_where_they_are_ours():
    assert printable_lines("one\n\x1b[2Jtwo\rthree") == "one\n\\x1b[2Jtwo\\rthree"


def test_an_error_shows_no_problem_as_two_and_obeys_none():
    error = InvalidInputError("file \x1b[31mred", ["key 'a\n  - a made-up problem': is unknown"])
    assert str(error) == "file \\x1b[31mred: 1 problem\n  - key 'a\\n  - a made-up problem': is unknown"
    assert str(error).isprintable() is False  # its own line ends, and nothing else
    assert str(error).replace("\n", "").isprintable()


def test_long_texts_and_lists_say_that_there_is_more():
    assert shortened("abcdefgh", 8) == "abcdefgh"
    assert shortened("abcdefghi", 8) == "abcde..."
    assert listed(["a", "b", "c"], 3) == "a, b, c"
    assert listed(("a", "b", "c"), 1, "; ") == "a and 2 more"
    assert listed(range(20)).endswith("10, 11 and 8 more")
