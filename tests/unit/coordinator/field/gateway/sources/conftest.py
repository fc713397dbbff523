"""A source that reads for as long as a test needs, and what it hands over."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from coordinator.field.gateway.interface import Source
from tests.support import dsse_command

DEADLINE_S = 180.0


@dataclass
class Recorder:
    """An ``Emit`` that keeps everything."""

    readings: list[tuple[str, Any, Any, bool, str | None]] = field(default_factory=list)
    rejected: list[tuple[str, str]] = field(default_factory=list)

    def __call__(
        self, address: str, value: object, time: float | None = None, *, valid: bool = True, unit: str | None = None
    ) -> None:
        self.readings.append((address, value, time, valid, unit))

    def reject(self, reason: str, detail: str) -> None:
        self.rejected.append((reason, detail))

    def values_of(self, address: str) -> list[Any]:
        return [reading[1] for reading in self.readings if reading[0] == address]

    async def wait_until(self, holds: Callable[[], bool]) -> None:
        async with asyncio.timeout(DEADLINE_S):
            while not holds():
                await asyncio.sleep(0.01)


@contextlib.asynccontextmanager
async def _reading(source: Source, into: Recorder) -> AsyncIterator[asyncio.Task[None]]:
    task = asyncio.create_task(source.read(into))  # type: ignore[arg-type]
    try:
        yield task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError, Exception):
            await task


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture
def reading() -> Callable[[Source, Recorder], Any]:
    """``async with reading(source, recorder)``: the source reads during the block."""
    return _reading


@pytest.fixture
def error_of_losing(recorder: Recorder) -> Callable[..., Awaitable[BaseException | None]]:
    """The error with which a source ends when its server does: ``await error_of_losing(server, source)``."""

    async def lose(server: contextlib.AbstractAsyncContextManager[object], source: Source) -> BaseException | None:
        async with contextlib.AsyncExitStack() as stack:
            await stack.enter_async_context(server)
            async with _reading(source, recorder) as task:
                await recorder.wait_until(lambda: bool(recorder.readings))
                await stack.aclose()
                await recorder.wait_until(task.done)
                return task.exception()

    return lose


@pytest.fixture
def free_port() -> int:
    return dsse_command.free_port()


@pytest.fixture
def run() -> Callable[[Awaitable[None]], None]:
    """Run a coroutine with a deadline."""

    def run_it(test: Awaitable[None]) -> None:
        async def limited() -> None:
            async with asyncio.timeout(2 * DEADLINE_S):
                await test

        asyncio.run(limited())

    return run_it
