"""When to repeat a message that awaits an answer: sooner than at the next beat, but ever more patiently."""

from __future__ import annotations

FIRST = 0.1  # of a beat; each further wait is twice the one before


class Reminders:
    """Per neighbour the time of the next repeat; ``beat_s``: interval at which everything is repeated anyway."""

    def __init__(self, beat_s: float) -> None:
        self._first = FIRST * beat_s
        self._waits: dict[str, tuple[float, float]] = {}  # neighbour -> (due, wait)

    def start(self, neighbour: str, now: float) -> None:
        """A message that awaits an answer has just been sent for the first time."""
        self._waits[neighbour] = (now + self._first, self._first)

    def stop(self, neighbour: str) -> None:
        """The answer has come."""
        self._waits.pop(neighbour, None)

    def next_due(self) -> float:
        """The earliest time at which ``take_due`` names a neighbour."""
        return min((due for due, _ in self._waits.values()), default=float("inf"))

    def take_due(self, now: float) -> list[str]:
        """The neighbours to be reminded now."""
        due = [name for name, (at, _) in self._waits.items() if at <= now]
        for name in due:
            wait = 2 * self._waits[name][1]
            self._waits[name] = (now + wait, wait)
        return due
