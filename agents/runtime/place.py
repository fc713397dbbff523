"""The place of an area on the bus: a process with an older file does not take it from one with a newer file.

A process that begins later takes the place of one that runs under its name (``duplicate_guard.py``). Where the running
process has the file of a newer split, the later one was probably started by mistake. Its older file would keep every
area's state from being good.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from agents.messages.keys import all_incarnations, incarnation_of, split_of
from agents.protocol.configuration import Configuration
from agents.runtime.duplicate_guard import ReplacedError, find_overlap_s
from agents.transport.zenoh_bus import Session
from dsse_core.split_identity import SplitIdentity

ANSWER_S = 1.0  # within which the bus answers which tokens are there


def take_place(
    content: Configuration,
    session: Session,
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
    while (newer := _find_newer(content, session, known)) is not None:
        if clock() >= over:
            raise ReplacedError(
                f"area {content.area.name} of run {content.run} runs already, with a newer file: {newer}; the file "
                f"given here is of {content.identity}. Give the newer file, or stop the running process, or "
                "take its place all the same with --older-file"
            )
        wait(content.beat_s)


def _find_newer(content: Configuration, session: Session, known: Sequence[SplitIdentity]) -> SplitIdentity | None:
    """The newest split that a process of the area states, if it is newer than those ``known`` here; else None."""
    own = max(known, key=lambda split: split.age_order)
    tokens = session.find_presence(all_incarnations(content.run, "area", content.area.name), ANSWER_S)
    splits = [split_of(key) for key in tokens if incarnation_of(key)]
    others = [split for split in splits if split not in known and split.is_newer_than(own)]
    return max(others, key=lambda split: split.age_order, default=None)
