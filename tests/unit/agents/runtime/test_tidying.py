"""A process gives free memory back after work, and leaves its heap alone while it only says that it is there."""

from __future__ import annotations

import pytest

from agents.runtime import heap


def test_memory_is_given_back_after_work_and_not_at_each_heartbeat(monkeypatch: pytest.MonkeyPatch) -> None:
    given_back: list[None] = []
    monkeypatch.setattr(heap, "give_back", lambda: given_back.append(None))
    own = heap.Heap()
    own.tidy_after(0.0)
    assert len(given_back) == 1  # what reading the area file has left
    heartbeats = 16
    for _ in range(heartbeats - 1):
        own.tidy_after(heap.WORK_S / heartbeats)
    assert len(given_back) == 1
    own.tidy_after(2 * heap.WORK_S / heartbeats)
    assert len(given_back) == 2
    own.tidy_after(heap.WORK_S)
    assert len(given_back) == 3
