"""Cutter of a stream of bytes into whole lines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

LONGEST_LINE = 2**20  # bytes
PIECE = 2**16  # bytes of one read; between two pieces the gateway publishes
TOO_LONG = f"a line of more than {LONGEST_LINE} bytes"


@dataclass
class LineCutter:
    """Cuts pieces of bytes into lines; an incomplete line waits for the next piece."""

    _rest: bytes = b""
    _is_skipping: bool = False

    def cut(self, piece: bytes) -> Iterator[str | None]:
        """Every line that ``piece`` completes, without its line end; None for a line that is too long."""
        *whole, self._rest = (self._rest + piece).split(b"\n")
        for line in whole:
            if self._is_skipping or len(line) > LONGEST_LINE:
                self._is_skipping = False
                yield None
            else:
                yield line.rstrip(b"\r").decode("utf-8", "replace")
        if len(self._rest) > LONGEST_LINE:
            self._rest, self._is_skipping = b"", True
