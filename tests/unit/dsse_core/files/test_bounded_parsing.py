"""Texts that two readers take differently, or that cost far more than their length, are rejected unread."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from dsse_core.files import bounded_parsing
from dsse_core.files.bounded_file import read_text
from dsse_core.files.bounded_parsing import DEEPEST_KEY, parse_json, parse_toml

DEEP = ".".join("a" * 40_000)


@pytest.mark.parametrize(
    "text",
    [
        f"{DEEP} = 1",
        f"[{DEEP}]",
        f"[[ {DEEP} ]]",
        "x = { " + " . ".join(["a"] * 9) + " = 1 }",
        ".".join(['"a b"'] * 9) + " = 1",
        ".".join(["'a.b'"] * 9) + " = 1",
        ".".join(['"\\""'] * 9) + " = 1",
        f'x = """\n"" \\""" """""\n{DEEP} = 1',
        f"x = '''\n'' # \"\"\" '''''\n{DEEP} = 1",
        f'x = "#" # "\n{DEEP} = 1',
        f"x = '\\'\n{DEEP} = 1",
    ],
)
def test_a_deep_key_does_not_reach_the_reader_that_takes_its_square(text: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"a key of [\d,]+ parts joined by dots, the limit is 8 \(at line [1-3]\)"):
            parse_toml(text)
        assert tracemalloc.get_traced_memory()[1] < 40 * len(text) + 100_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "text",
    [
        ".".join("a" * DEEPEST_KEY) + " = 1",
        f"x = '{DEEP}'",
        f'x = "\\"{DEEP}"',
        f"x = 1 # {DEEP} = 1",
        f'x = """\n{DEEP} = 1\n"""',
        f"x = '''\n{DEEP} = 1\n'''",
        "x = [1.5, 2.5e3, 1979-05-27T07:32:00.999999]",
    ],
)
def test_what_only_looks_like_a_deep_key_is_read(text: str) -> None:
    assert parse_toml(text)


@pytest.mark.parametrize("text", ['x = """' + '\\"""' * 200_000, "'" * 400_001, '"' * 400_001, "a" * 2_000_000])
def test_strings_without_an_end_are_looked_at_once(text: str) -> None:
    with pytest.raises(ValueError, match=r"line|document"):
        parse_toml(text)


def test_more_headers_than_fit_into_memory_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_parsing, "MOST_KEY_PARTS", 10)
    assert parse_toml("[[a]]\nb.c = 1.5\n" * 3)
    with pytest.raises(ValueError, match="headers and dotted keys have 12 parts, the limit is 10"):
        parse_toml("[[a]]\nb.c = 1.5\n" * 4)


@pytest.mark.parametrize("text", ['{"a": 1, "b": 2, "a": 3}', '[{"x": {"a": 1, "\\u0061": 1}}]'])
def test_a_key_given_twice_is_rejected_whatever_its_values(text: str) -> None:
    with pytest.raises(ValueError, match="key 'a' is given twice; keep one of them"):
        parse_json(text)


class CountedKey(str):
    """A key that counts how often it is compared."""

    comparisons = 0
    __hash__ = str.__hash__

    def __eq__(self, other: object) -> bool:
        CountedKey.comparisons += 1
        return str.__eq__(self, other)


def test_the_work_for_keys_given_twice_grows_with_their_number_not_with_its_square() -> None:
    count = 20_000
    CountedKey.comparisons = 0
    pairs = [(CountedKey(k % (count // 2)), k) for k in range(count)]
    with pytest.raises(ValueError, match="given twice"):
        bounded_parsing._take_each_once(pairs)
    assert 0 < CountedKey.comparisons < 10 * count


@pytest.mark.parametrize("text", ['{"\\ud800_module": 1}', '["\\uDFFF"]', '["\\ude00\\ud83d"]', '["\ud800"]'])
def test_half_of_a_character_which_other_readers_leave_out_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match="half of a character"):
        parse_json(text)
    assert parse_json('["\\ud83d\\ude00", "\\\\ud800"]') == ["\U0001f600", "\\ud800"]


def test_more_values_than_fit_into_memory_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_parsing, "MOST_VALUES", 10)
    assert parse_json("[" + "0," * 9 + "0]")
    with pytest.raises(ValueError, match="it has 11 values, the limit is 10"):
        parse_json("[" + "0," * 10 + "0]")


def test_a_byte_order_mark_is_no_part_of_a_text(tmp_path: Path):
    path = tmp_path / "marked.toml"
    path.write_bytes(b"\xef\xbb\xbfversion = 1\n")
    assert parse_toml(read_text(path)) == {"version": 1}


@pytest.mark.parametrize("digits", ["0x" + "f" * 5000, "0b" + "1" * 20_000, "0o" + "7_" * 3000 + "7"])
def test_an_integer_that_python_does_not_print_is_not_read_in_another_base(digits: str) -> None:
    with pytest.raises(ValueError, match=r"an integer of more than 3,000 digits in base 16, 8 or 2 \(at line 2\)"):
        parse_toml(f"a = 1\nseed = {digits}")


def test_long_texts_that_look_like_integers_in_another_base_are_read() -> None:
    digits = "0x" + "f" * 5000
    assert parse_toml(f'a = "{digits}" # {digits}') == {"a": digits}
