"""Sizes of the pages of a Parquet file, from the header of each page. The list of contents at the end of the file may
state other sizes, and a reader unpacks the sizes that the headers state.

A header is a struct of Thrift's compact protocol (github.com/apache/parquet-format, PageHeader): field 2 the size when
unpacked, 3 the size in the file, 5 or 8 (data) and 7 (dictionary) a struct whose field 1 is the number of values.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, BinaryIO, NamedTuple

LONGEST_HEADER = 2**14  # bytes; the least and greatest value in it are cut at 4 KiB by writers
WINDOW = 2**18  # bytes that are read at once
DEEPEST = 4  # structs in a header

_UNPACKED, _IN_FILE, _KINDS, _VALUES = 2, 3, (5, 7, 8), 1
_TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _DOUBLE, _BINARY, _STRUCT = 1, 2, 3, 4, 5, 6, 7, 8, 12


class Page(NamedTuple):
    """A page. ``size``: bytes when it is unpacked. ``values``: number of its values."""

    size: int
    values: int


def read_pages(file: BinaryIO, begin: int, end: int) -> Iterator[Page]:
    """The pages between bytes ``begin`` and ``end`` of ``file``; the last one ends at ``end``.

    Raises:
        ValueError: the last page ends elsewhere, or a header is invalid.
    """
    at, window, base = begin, b"", begin
    while at < end:
        left = base + len(window) - at
        if left <= 0 or (left < LONGEST_HEADER and len(window) == WINDOW):
            file.seek(at)
            window, base = file.read(WINDOW), at
        try:
            header, after = _read_struct(window, at - base, 0)
            size, in_file = header[_UNPACKED], header[_IN_FILE]
            values = sum(header[kind][_VALUES] for kind in _KINDS if kind in header)
        except (IndexError, KeyError, TypeError):
            raise ValueError(f"no header of a page at byte {at}") from None
        if min(size, in_file, values) < 0:
            raise ValueError(f"a page of {size} bytes, {in_file} in the file, and {values} values at byte {at}")
        yield Page(size, values)
        at = base + after + in_file
    if at != end:
        raise ValueError(f"a page ends at byte {at}, behind its column, which ends at {end}")


def _read_struct(content: bytes, at: int, depth: int) -> tuple[dict[int, Any], int]:
    """The fields of a struct that are integers or structs, and the position after its end.

    Raises:
        IndexError: the struct goes on behind ``content``.
        ValueError: the struct has a field or a depth that no header has.
    """
    if depth >= DEEPEST:
        raise ValueError("a header of a page nests too deeply")
    fields: dict[int, Any] = {}
    number = 0
    while (head := content[at]) != 0:
        at += 1
        kind = head & 15
        if head >> 4:
            number += head >> 4
        else:
            number, at = _read_integer(content, at)
        if kind in (_TRUE, _FALSE):
            continue
        if kind in (_I16, _I32, _I64):
            fields[number], at = _read_integer(content, at)
        elif kind == _BINARY:
            length, at = _read_varint(content, at)
            at += length
        elif kind == _STRUCT:
            fields[number], at = _read_struct(content, at, depth + 1)
        elif kind in (_BYTE, _DOUBLE):
            at += 1 if kind == _BYTE else 8
        else:
            raise ValueError(f"a header of a page with a field of type {kind}")
    return fields, at + 1


def _read_integer(content: bytes, at: int) -> tuple[int, int]:
    """A signed integer, and the position after its end."""
    value, at = _read_varint(content, at)
    return (value >> 1) ^ -(value & 1), at


def _read_varint(content: bytes, at: int) -> tuple[int, int]:
    """An integer in groups of seven bits, and the position after its end.

    Raises:
        IndexError: the integer goes on behind ``content``.
        ValueError: it has more than 64 bits.
    """
    value = 0
    for shift in range(0, 70, 7):
        byte = content[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise ValueError("an integer of more than 64 bits in the header of a page")
