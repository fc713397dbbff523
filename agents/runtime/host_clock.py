"""The clock of the host, as an agent follows it: it may be set at any time, by a time service or by hand."""

from __future__ import annotations

import time

LEAST_STEP_S = 1e-3  # a smaller change of the clock is not reported
QUICK_S = 1e-4  # two clocks read in a longer time were not read at one moment: the process was interrupted


class HostClock:
    """``offset``: from monotonic to wall-clock time, s.

    Args:
        error_s: injected fault: lead of the clock, s.
    """

    def __init__(self, error_s: float = 0.0) -> None:
        self._error_s = error_s
        self.offset = self._read()[0]

    def has_been_set(self) -> bool:
        """True where the clock has been set since the last call; ``offset`` is then the new one.

        False where the two clocks could not be read at one moment; a later call finds the change.
        """
        offset, is_certain = self._read()
        if not is_certain or abs(offset - self.offset) <= LEAST_STEP_S:
            return False
        self.offset = offset
        return True

    def _read(self) -> tuple[float, bool]:
        """The offset, and whether both clocks were read at one moment."""
        before = time.monotonic()
        wall = time.time()
        return wall + self._error_s - before, time.monotonic() - before < QUICK_S
