"""CRC-32 of many texts: what zlib finds for each."""

from __future__ import annotations

import zlib

import numpy as np

from scenarios.crc32 import sum_up, write_bytes

TEXTS = ["", "1", "12:1-2", "Stra\u00dfe 7", "a\0b", "b\0", "x" * 300]


def test_the_sum_of_each_text_is_that_of_zlib_whatever_its_length_and_its_letters() -> None:
    texts = [text.encode() for text in TEXTS]
    begun = np.array([zlib.crc32(b"p_flow@") + k for k in range(len(texts))], dtype=np.uint32)
    expected = [zlib.crc32(text, start) for text, start in zip(texts, begun.tolist(), strict=True)]
    assert sum_up(begun, write_bytes(texts)).tolist() == expected


def test_numbers_written_by_numpy_sum_up_as_texts() -> None:
    numbers = np.array([0, 7, -3, 10**12])
    expected = [zlib.crc32(str(number).encode()) for number in numbers.tolist()]
    assert sum_up(np.zeros(4, dtype=np.uint32), write_bytes(numbers.astype(np.bytes_))).tolist() == expected


def test_no_texts_have_no_sums() -> None:
    assert sum_up(np.zeros(0, dtype=np.uint32), write_bytes([])).tolist() == []
