"""Files that a user gives, read within limits. All files of users that this package reads are opened here."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from dsse_core import operating_system
from dsse_core.errors import InvalidInputError

LARGEST_TEXT = 64 * 2**20  # bytes
LARGEST_JSON = 256 * 2**20  # of a network or an area; a million buses of ``dsse generate`` take 184 MB
LARGEST_TOML = 16 * 2**20  # its reader takes a second for each MiB
LARGEST_PEM = 2**20


def open_regular(path: Path) -> BinaryIO:
    """``path``, opened to be read; a pipe or a device is refused at once, without waiting for its other end.

    Raises:
        OSError: ``path`` cannot be read, or is a folder, a pipe or a device; ``strerror`` states the finding and the
            cure. Errors of the system keep their subclass, such as ``FileNotFoundError``.
    """
    try:
        mode = path.stat().st_mode  # before it is opened: opening alone moves some devices
        if stat.S_ISREG(mode):
            file = open(path, "rb", opener=_open_without_waiting)  # noqa: SIM115
            mode = os.fstat(file.fileno()).st_mode
            if stat.S_ISREG(mode):
                return file
            file.close()
    except OSError as error:
        cure = "let the user of this process read it" if isinstance(error, PermissionError) else "check the path"
        raise OSError(error.errno, f"{error.strerror}; {cure}", str(path)) from None
    except ValueError as error:  # a zero byte in the path
        raise OSError(None, f"{error}; check the path", str(path)) from None
    what = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
    raise OSError(None, f"is {what}; give a regular file", str(path))


def _open_without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | operating_system.FLAG_NO_WAIT)


def read_bounded(path: Path, largest: int) -> bytes:
    """The content of ``path``, at most ``largest`` bytes.

    Raises:
        OSError: as ``open_regular``, or the file is too large.
    """
    with open_regular(path) as file:
        try:
            content = file.read(largest + 1)
            size = max(os.fstat(file.fileno()).st_size, len(content))
        except OSError as error:
            raise OSError(error.errno, f"{error.strerror}; check the path", str(path)) from None
    if len(content) > largest:
        raise OSError(None, f"has {size:,} bytes, the limit is {largest:,}; give a smaller file", str(path))
    return content


def read_text(
    path: Path,
    *,
    largest: int = LARGEST_TEXT,
    encoding: str = "utf-8-sig",
    errors: str = "strict",
    what: str | None = None,
) -> str:
    """The text in ``path``, at most ``largest`` bytes, without a byte order mark; errors call the file ``what``, by
    default its path.

    Raises:
        InvalidInputError: the file cannot be read, is no regular file, is too large, or is no text in ``encoding``.
    """
    try:
        return read_bounded(path, largest).decode(encoding, errors)
    except OSError as error:
        raise InvalidInputError(what or str(path), [f"cannot be read: {error.strerror}"]) from None
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        problem = f"line {line}: not UTF-8 text ({error.reason} at byte {error.start}); save the file as UTF-8"
        raise InvalidInputError(what or str(path), [problem]) from None
