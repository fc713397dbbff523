"""Two processes under one name: the older incarnation gives way, because a receiver of both takes the newer one.

Each process shows a token and watches the tokens of its own name. The token of a killed incarnation may be seen for a
while after its end; if the clock was set back since, that incarnation even looks newer. So a process gives way only
after the time in which the bus notices a death.

A process with an older file does not take the place of one with a newer file. Where the running process has the file of
a newer split, the later one was probably started by mistake. Its older file would keep every area's state from being
good.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from agents.messages.keys import all_incarnations, incarnation_of, split_of
from agents.messages.packing import Incarnation
from agents.peers.rejections import LONGEST_LEAD_S
from agents.protocol.configuration import Configuration
from agents.runtime.presence import MAX_INCARNATIONS
from dsse_core.errors import DsseError
from dsse_core.split_identity import SplitIdentity

# The larger of both: longer than the bus takes to notice a death (2 s or 8 heartbeats).
OVERLAP_S, OVERLAP_HEARTBEATS = 3.0, 12.0
GIVES_WAY = "gives way to a newer incarnation"  # leave message of the older one
REPLACED_CODE = 3  # its exit code: if it were restarted, it would be newer and replace the other process
ANSWER_S = 1.0  # within which the bus answers which tokens are there


class ReplacedError(DsseError):
    """Another process runs under the name of this one, and began later or has a newer file."""


def find_overlap_s(heartbeat_s: float) -> float:
    """Longest time for which the token of a process may be seen after its end, s."""
    return max(OVERLAP_S, OVERLAP_HEARTBEATS * heartbeat_s)


class DuplicateGuard:
    """Newer incarnations seen by process ``whom``, incarnation ``own``; ``now``: monotonic time, s."""

    def __init__(self, whom: str, own: Incarnation, now: float, heartbeat_s: float) -> None:
        self._overlap_s = find_overlap_s(heartbeat_s)
        self._whom = whom
        self._own = own
        self._began = now
        self._since: dict[Incarnation, float] = {}  # newer incarnation -> when it was first seen

    def take(self, key: str, alive: bool, now: float) -> None:
        """Note that the token on ``key`` appeared or vanished; a token from the future is ignored, as messages are."""
        incarnation = incarnation_of(key)
        latest_ms = self._own.start_ms + 1000 * (now - self._began + LONGEST_LEAD_S)
        if incarnation is None:
            return
        if not alive:
            self._since.pop(incarnation, None)
        elif self._own < incarnation and incarnation.start_ms <= latest_ms and len(self._since) < MAX_INCARNATIONS:
            self._since.setdefault(incarnation, now)

    def forget(self) -> None:
        """Know of no newer incarnation any more, until it is seen again."""
        self._since.clear()

    def next_due(self) -> float:
        """Earliest time at which ``check`` may raise, monotonic, s; infinity without a newer incarnation."""
        return min(self._since.values(), default=float("inf")) + self._overlap_s

    def check(self, now: float) -> None:
        """Raise ReplacedError if a newer incarnation has been there for so long that it must be alive."""
        for incarnation, since in self._since.items():
            if now - since >= self._overlap_s:
                raise ReplacedError(
                    f"two processes run as {self._whom} at once: this incarnation, {self._own}, and a newer one, "
                    f"{incarnation}; this one ends. Stop the other one if it is not wanted, and start this one again"
                )


class SeesPresence(Protocol):
    """Interface of a bus on which processes show tokens: a session of Zenoh."""

    def find_presence(self, key_expression: str, timeout_s: float) -> tuple[str, ...]: ...


def take_place(
    content: Configuration,
    bus: SeesPresence,
    following: Configuration | None = None,
    clock: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Wait until no process of the area with a newer file is on the bus; a killed one is seen for a while.

    ``following``: the file of the next split, to which the killed process may have gone over.

    Raises:
        ReplacedError: such a process has been there for so long that it must be running.
    """
    over = clock() + find_overlap_s(content.beat_s)
    known = [given.identity for given in (content, following) if given is not None]
    while (newer := _find_newer(content, bus, known)) is not None:
        if clock() >= over:
            raise ReplacedError(
                f"area {content.area.name} of run {content.run} runs already, with a newer file: {newer}; the file "
                f"given here is of {content.identity}. Give the newer file, or stop the running process, or "
                "take its place all the same with --older-file"
            )
        wait(content.beat_s)


def _find_newer(content: Configuration, bus: SeesPresence, known: Sequence[SplitIdentity]) -> SplitIdentity | None:
    """The newest split that a process of the area states, if it is newer than those ``known`` here; else None."""
    own = max(known, key=lambda split: split.age_order)
    tokens = bus.find_presence(all_incarnations(content.run, "area", content.area.name), ANSWER_S)
    splits = [split_of(key) for key in tokens if incarnation_of(key)]
    others = [split for split in splits if split not in known and split.is_newer_than(own)]
    return max(others, key=lambda split: split.age_order, default=None)
