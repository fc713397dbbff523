"""Rows of one task shared out among threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from numbers import Integral
from queue import Empty, SimpleQueue

from dsse_core import operating_system
from dsse_core.errors import InvalidInputError

CHUNKS = 8  # for each thread: the last thread to end must not keep the others waiting for long
MOST_ROWS = 1024  # of a chunk


def find_threads(threads: int | None) -> int:
    """``threads``, or as many as there are processors that this process may use.

    Raises:
        InvalidInputError: ``threads`` is no positive integer.
    """
    if threads is not None and not (isinstance(threads, Integral) and threads >= 1):
        raise InvalidInputError(
            "threads", [f"found {threads!r}; give an integer from 1 on, or None for all processors"]
        )
    if threads is not None:
        return threads
    return operating_system.count_processors()


def share_out(n_row: int, threads: int, begin: Callable[[], Callable[[int, int], None]], *, together: int = 1) -> None:
    """Has ``threads`` threads do rows 0 to ``n_row`` - 1; the calling thread does them if ``threads`` is 1.

    ``begin`` is called once in each thread. It returns the function that does the rows from its first argument, a
    multiple of ``together``, up to before its second. An exception in one thread ends the others after their rows at
    hand, and is raised here.
    """
    size = max(1, min(MOST_ROWS, -(-n_row // (CHUNKS * threads))))
    size += -size % together
    chunks: SimpleQueue[tuple[int, int]] = SimpleQueue()
    for first in range(0, n_row, size):
        chunks.put((first, min(first + size, n_row)))
    failures: list[BaseException] = []

    def work() -> None:
        try:
            do = begin()
            while not failures:
                do(*chunks.get_nowait())
        except Empty:
            pass
        except BaseException as error:
            failures.append(error)
            raise

    if threads == 1:
        work()
        return
    with ThreadPoolExecutor(threads) as pool:
        for future in [pool.submit(work) for _ in range(threads)]:
            future.result()
