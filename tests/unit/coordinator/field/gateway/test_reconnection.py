"""What fails is done again after a growing pause; each error is named once until it changes."""

from __future__ import annotations

import asyncio

import pytest

from coordinator.field.gateway import reconnection
from coordinator.field.gateway.reconnection import Link, describe_error, keep_on


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What would be slept."""
    found: list[float] = []

    async def sleep(pause_s: float) -> None:
        found.append(pause_s)

    monkeypatch.setattr(reconnection.asyncio, "sleep", sleep)
    return found


def test_pauses_grow_until_something_works(pauses: list[float]) -> None:
    logged: list[str] = []
    now = [0.0]
    link, attempts = Link("source", warn=logged.append, clock=lambda: now[0]), 0

    async def attempt() -> None:
        nonlocal attempts
        attempts += 1
        if attempts == 10:
            link.note_success()
            now[0] += 60.0
            raise OSError("gone")
        if attempts < 12:
            raise ConnectionRefusedError("nobody there")

    asyncio.run(keep_on(link, attempt))
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10.0, 10.0, 0.1, 0.2]
    assert link.failures == 11
    assert len(logged) == 4
    assert [
        "nobody there" in logged[0],
        "works again" in logged[1],
        "gone" in logged[2],
        "nobody there" in logged[3],
    ] == [True] * 4


def test_a_link_that_comes_and_goes_is_tried_less_often_and_fills_no_log(pauses: list[float]) -> None:
    logged: list[str] = []
    link, attempts = Link("source", warn=logged.append, clock=lambda: 0.0), 0

    async def attempt() -> None:
        nonlocal attempts
        attempts += 1
        if attempts <= 2000:
            link.note_success()
            raise OSError("gone")

    asyncio.run(keep_on(link, attempt))
    assert pauses[-1] == 10.0
    assert link.failures == 2000
    assert len(logged) < 10
    assert sum("gone" in each for each in logged) == 4


def test_of_several_errors_the_first_is_named_in_one_printable_line() -> None:
    group = ExceptionGroup("two", [ExceptionGroup("one", [ValueError("a\n\x1b[31mb")]), OSError("c")])
    text = describe_error(group)
    assert "ValueError" in text
    assert "\n" not in text
    assert "\x1b" not in text


def test_a_defect_of_a_foreign_source_does_not_end_the_gateway(pauses: list[float]) -> None:
    link, attempts = Link("source"), 0

    async def attempt() -> None:
        nonlocal attempts
        attempts += 1
        if attempts < 3:
            raise ZeroDivisionError

    asyncio.run(keep_on(link, attempt))
    assert link.error == "ZeroDivisionError"
