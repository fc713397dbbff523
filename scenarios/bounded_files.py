"""A user's text file, read within limits: no more than its size limit, and only from a regular file."""

from __future__ import annotations

import stat
from pathlib import Path

from dsse_core.errors import InvalidInputError

LARGEST = 64 * 1024 * 1024  # bytes
LARGEST_JSON = 256 * 1024 * 1024  # of a network file; a million buses of ``dsse generate`` take 184 MB
LARGEST_TOML = 16 * 1024 * 1024  # its reader takes a second for each MiB


def read_text(path: Path, *, encoding: str = "utf-8", errors: str = "strict", largest: int = LARGEST) -> str:
    """The text in ``path``, at most ``largest`` bytes of it.

    Raises:
        InvalidInputError: the file cannot be read, is a folder, a pipe or a device, is too large, or is no such text.
    """
    try:
        kind = path.stat().st_mode
        if not stat.S_ISREG(kind):
            what = "a folder" if stat.S_ISDIR(kind) else "a pipe or a device"
            raise InvalidInputError(str(path), [f"cannot read the file (it is {what}); give a regular file"])
        with path.open("rb") as file:
            content = file.read(largest + 1)
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the path
        reason = getattr(error, "strerror", None) or error
        raise InvalidInputError(str(path), [f"cannot read the file ({reason}); check the path"]) from None
    if len(content) > largest:
        raise InvalidInputError(str(path), [f"has more than {largest // 2**20} MiB, the limit; give a smaller file"])
    try:
        return content.decode(encoding, errors)
    except UnicodeDecodeError as error:
        raise InvalidInputError(str(path), [f"not UTF-8 text ({error.reason} at byte {error.start})"]) from None
