"""An action again and again on a thread of its own, while a test does something else."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def repeating(act: Callable[[], None], period_s: float) -> Iterator[None]:
    """``act`` each ``period_s`` until the end of the block, and never after it."""
    over = threading.Event()

    def go_on() -> None:
        while not over.wait(period_s):
            act()

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
