"""Ctrl-C in the middle of a drawing: it is finished before the command ends."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest
from rich.live import Live

from coordinator.watch import interrupts
from coordinator.watch.observe.live import live_table
from coordinator.watch.observe.progress import Progress
from coordinator.watch.observe.view import View
from coordinator.watch.observe.view_text import live_view


@pytest.fixture(autouse=True)
def _interrupts_of_a_command(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    monkeypatch.setitem(interrupts._state, "is_command", True)
    monkeypatch.setitem(interrupts._state, "decided", None)
    interrupts.raise_interrupts()
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What became of each drawing, in the middle of which Ctrl-C is pressed."""
    found: list[str] = []

    def update(*_: object, **__: object) -> None:
        found.append("in part")
        os.kill(os.getpid(), signal.SIGINT)
        found[-1] = "whole"

    monkeypatch.setattr(Live, "update", update)
    return found


def test_the_view_of_a_watcher_is_not_left_in_part_on_the_screen(drawn: list[str]) -> None:
    with pytest.raises(KeyboardInterrupt), live_view() as show:
        show(View("run", (), (), (), (), 0), (), (), None)
    assert drawn == ["whole"]


def test_the_table_of_a_run_is_not_left_in_part_on_the_screen(drawn: list[str]) -> None:
    with pytest.raises(KeyboardInterrupt), live_table("run") as show:
        show(Progress(0.0, (), ()))
    assert drawn == ["whole"]


def test_a_terminal_that_takes_nothing_is_left_at_the_second_ctrl_c() -> None:
    with pytest.raises(KeyboardInterrupt), interrupts.Uninterrupted():  # noqa: PT012
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        pytest.fail("the second one has not been raised")
