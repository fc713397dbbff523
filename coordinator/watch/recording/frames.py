"""The format of a log: frames, of which an incomplete or damaged one is detected. Knows neither the bus nor tables.

A file begins with ``MAGIC``. A frame is ``MARK``, the length of its body and the CRC-32 of both (big-endian, 4 bytes
each), then the body. After damage the next frame is found by its mark and its checksum.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from dsse_core import operating_system
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import open_regular

MAGIC = b"dsse recording 1\n"
MARK = b"\xd5\x5e\xf4\x01"
_HEAD = struct.Struct(">4sII")
LARGEST = 16 * 2**20  # bytes of a body: twice the largest message of the bus
MOST_SEARCHED = 64 * LARGEST  # bytes of damaged frames that are checked beyond the size of the log


def frame(body: bytes) -> bytes:
    """The frame of ``body``, as it is written to a log."""
    length = len(body).to_bytes(4, "big")
    return _HEAD.pack(MARK, len(body), zlib.crc32(body, zlib.crc32(length))) + body


class FrameLog:
    """A new log at ``path``, locked until it is closed or the process that writes it ends.

    Raises:
        OSError: naming ``path``; where it exists, ``FileExistsError``. No new file remains.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        with contextlib.suppress(OSError):  # a system of files without locks
            operating_system.lock(self._file)
        self.size = 0
        try:
            self._write(MAGIC)
        except BaseException:
            self.close()
            with contextlib.suppress(OSError):
                path.unlink()
            raise

    def append(self, bodies: Iterable[bytes]) -> None:
        """Writes the frames of all ``bodies``, or none of them.

        Raises:
            OSError: naming ``path``; an incomplete part is cut off again, or is seen as a gap by a reader.
        """
        self._write(b"".join(map(frame, bodies)))

    def sync(self) -> None:
        """Waits until all written frames are on the disk, and survive a loss of power."""
        os.fsync(self._file)

    def close(self) -> None:
        os.close(self._file)

    def _write(self, content: bytes) -> None:
        left = memoryview(content)
        try:
            while left:
                left = left[os.write(self._file, left) :]
        except OSError as error:
            with contextlib.suppress(OSError):
                os.truncate(self._file, self.size)
            raise OSError(error.errno, error.strerror, str(self.path)) from None
        self.size += len(content)


@dataclass(frozen=True, slots=True)
class Gap:
    """``size`` bytes from byte ``at`` on that are no frames. ``is_end``: no frame was found after them."""

    at: int
    size: int
    is_end: bool

    def __str__(self) -> str:
        what = "the last frame was not written to its end" if self.is_end else "frames are damaged"
        return f"{what}: {self.size} bytes from byte {self.at} on are left out"


def read_frames(path: Path) -> Iterator[bytes | Gap]:
    """The bodies in the log at ``path`` in order, and a ``Gap`` for the bytes between them that are no frames.

    Raises:
        InvalidInputError: the file cannot be read, or is no log.
    """
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if not size:
                return  # killed before its first byte
            with mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) as content:
                yield from _read(path, content, size)
    except OSError as error:
        raise InvalidInputError(str(path), [f"cannot be read: {error.strerror}"]) from None


def _read(path: Path, content: mmap.mmap, size: int) -> Iterator[bytes | Gap]:
    if size < len(MAGIC) and MAGIC.startswith(content[:size]):
        return
    if content[: len(MAGIC)] != MAGIC:
        found = ascii(content[: len(MAGIC)])[2:-1]
        raise InvalidInputError(str(path), [f"is no log of a recording: it begins with {found!r}; move it elsewhere"])
    frames = _Frames(content, size)
    at = len(MAGIC)
    while at < size:
        body = frames.body_at(at)
        if body is None:
            following = frames.find_next(at + 1)
            yield Gap(at, following - at, following == size)
            at = following
        else:
            yield body
            at += _HEAD.size + len(body)


class _Frames:
    """The frames of a log of ``size`` bytes.

    The search for the next whole frame after damage ends when frames with wrong checksums of ``size`` +
    ``MOST_SEARCHED`` bytes have been read: a file full of beginnings of frames would be read millions of times.
    """

    def __init__(self, content: mmap.mmap, size: int) -> None:
        self._content, self._size = content, size
        self._left = size + MOST_SEARCHED

    def body_at(self, at: int) -> bytes | None:
        """The body of the frame at byte ``at``; None if no whole frame begins there."""
        if at + _HEAD.size > self._size:
            return None
        mark, length, checksum = _HEAD.unpack_from(self._content, at)
        end = at + _HEAD.size + length
        if mark != MARK or length > LARGEST or end > self._size:
            return None
        body = self._content[at + _HEAD.size : end]
        if zlib.crc32(body, zlib.crc32(length.to_bytes(4, "big"))) == checksum:
            return body
        self._left -= length
        return None

    def find_next(self, at: int) -> int:
        """First byte of the next whole frame; the size of the log if there is none, or the search has ended."""
        while self._left > 0 and (found := self._content.find(MARK, at)) >= 0:
            if self.body_at(found) is not None:
                return found
            at = found + 1
        return self._size


def is_being_written(path: Path) -> bool:
    """True where a process holds the lock of the log at ``path``; False where the log cannot be opened.

    True also where the file system has no locks.
    """
    try:
        lock = os.open(path, os.O_RDONLY | operating_system.FLAG_NO_WAIT)
    except OSError:
        return False
    try:
        operating_system.lock(lock)
    except OSError:
        return True
    finally:
        os.close(lock)
    return False
