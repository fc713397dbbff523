"""CRC-32 of many texts at once, as ``zlib.crc32`` finds it: by its table, one byte of all texts after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

POLYNOMIAL = np.uint32(0xEDB88320)
BYTE, ONE = np.uint32(0xFF), np.uint32(1)


def _make_table() -> np.ndarray:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & ONE, (table >> ONE) ^ POLYNOMIAL, table >> ONE)
    return table


TABLE = _make_table()


@dataclass(frozen=True)
class Texts:
    """Bytes of n texts: ``cells`` (longest, n), uint8, of which the first ``length`` (n,) count."""

    cells: np.ndarray
    length: np.ndarray

    def of(self, rows: np.ndarray) -> Texts:
        """The texts in ``rows`` (k,)."""
        return Texts(self.cells[:, rows], self.length[rows])


def write_bytes(texts: Sequence[bytes] | np.ndarray) -> Texts:
    """The ``Texts`` with ``texts`` side by side."""
    table = np.array(texts, dtype=np.bytes_)
    cells = np.ascontiguousarray(table.view(np.uint8).reshape(len(table), -1).T) if len(table) else np.zeros((0, 0))
    length = np.char.str_len(table) if isinstance(texts, np.ndarray) else np.array(list(map(len, texts)), dtype=int)
    return Texts(cells.astype(np.uint8), length)


def sum_up(begun: np.ndarray, texts: Texts) -> np.ndarray:
    """``zlib.crc32(text, begun)`` of each text: (n,), uint32."""
    state = ~begun
    for k, cell in enumerate(texts.cells):
        following = TABLE[(state ^ cell) & BYTE] ^ (state >> np.uint32(8))
        state = np.where(k < texts.length, following, state)
    return np.asarray(~state)
