"""A file that a user gives to an agent or a router, read within limits."""

from __future__ import annotations

import errno
import stat
from pathlib import Path

LARGEST_TOML = 16 * 2**20  # bytes; its reader takes a second for each MiB
LARGEST_JSON = 256 * 2**20
LARGEST_PEM = 2**20


def read_bounded(path: Path, largest: int) -> bytes:
    """The content of ``path``, at most ``largest`` bytes.

    Raises:
        OSError: it cannot be read, is no regular file, or is too large; ``strerror`` says what was found.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode) and not stat.S_ISDIR(status.st_mode):  # a folder is told by ``open``
        raise OSError(errno.EINVAL, "is no regular file; give one", str(path))
    with path.open("rb") as file:
        content = file.read(largest + 1)
    if len(content) > largest:
        size = max(status.st_size, len(content))
        raise OSError(errno.EFBIG, f"has {size:,} bytes, the limit is {largest:,}; give a smaller file", str(path))
    return content
