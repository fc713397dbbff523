"""Logs and tables that grow by a line at a time: each line is there whole, or not at all, also where a disk is full."""

from __future__ import annotations

import contextlib
from io import FileIO
from pathlib import Path


class WholeLines:
    """The file at ``path``, open to be read and appended to.

    Raises:
        OSError: naming ``path``, also from ``append``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = FileIO(path, "a+")

    def append(self, line: str) -> None:
        """Writes ``line``, which includes its line end, at once."""
        left = line.encode()
        before = self.file.seek(0, 2)
        try:
            while left:
                left = left[self.file.write(left) or 0 :]
        except OSError as error:
            self.cut_to(before)
            raise OSError(error.errno, error.strerror, str(self.path)) from None

    def read(self) -> bytes:
        """The whole content of the file."""
        self.file.seek(0)
        return self.file.readall()

    def cut_to(self, size: int) -> None:
        """Keep the first ``size`` bytes."""
        with contextlib.suppress(OSError):
            self.file.truncate(size)

    def close(self) -> None:
        self.file.close()
