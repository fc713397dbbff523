"""A TCP proxy that harms what passes it: delay, black holes, resets. It needs no privileges and no netem."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import struct
import threading
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import Any, Self

from tests.support.waiting import DEADLINE_S

RESET_AT_CLOSE = struct.pack("ii", 1, 0)  # SO_LINGER on, for no time


class TcpFaultProxy:
    """Listens on a free port of this host and passes connections on to ``port`` of it, from a thread of its own.

    Bytes arrive in order, ``delay_s`` plus a random part of ``jitter_s`` late. A black hole holds back everything, new
    connections included, until it is healed: to both sides the other falls silent, as behind a dead link.
    """

    def __init__(self, port: int, seed: int = 0) -> None:
        self.delay_s = self.jitter_s = 0.0
        self._target, self._random = port, random.Random(seed)
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self.passed_on = 0  # connections that have reached the target
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="fault proxy", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        self.port = self._do(self._listen())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._do(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def black_hole(self) -> None:
        """From now on nothing passes."""
        self._call(self._open.clear)

    def heal(self) -> None:
        """What was held back goes on its way."""
        self._call(self._open.set)

    def reset(self) -> None:
        """Break every connection with a TCP reset to both sides."""
        self._call(self._reset)

    def _do(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(DEADLINE_S)

    def _call(self, function: Callable[[], None]) -> None:
        async def call() -> None:
            function()

        self._do(call())

    async def _listen(self) -> int:
        self._open = asyncio.Event()
        self._open.set()
        self._server = await asyncio.start_server(self._take, "127.0.0.1", 0)
        return int(self._server.sockets[0].getsockname()[1])

    async def _end(self) -> None:
        self._server.close()
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._reset()

    def _reset(self) -> None:
        for writer in self._writers:
            with contextlib.suppress(OSError):  # it has ended already
                writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_AT_CLOSE)
            writer.transport.abort()
        self._writers.clear()

    async def _take(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection until either side ends it."""
        self._start(self._serve(reader, writer))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        await self._open.wait()
        try:
            there, back = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:  # nobody listens there; the caller is to see the same
            writer.transport.abort()
            return
        self._writers.add(back)
        self.passed_on += 1
        for source, sink in ((reader, back), (there, writer)):
            late: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
            self._start(self._read(source, late))
            self._start(self._write(late, sink))

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _read(self, source: asyncio.StreamReader, late: asyncio.Queue[tuple[float, bytes]]) -> None:
        due, data = 0.0, b"not yet at the end"
        while data:
            try:
                data = await source.read(1 << 16)
            except OSError:
                data = b""
            due = max(due, self._loop.time() + self.delay_s + self.jitter_s * self._random.random())
            late.put_nowait((due, data))

    async def _write(self, late: asyncio.Queue[tuple[float, bytes]], sink: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while True:
                due, data = await late.get()
                await asyncio.sleep(due - self._loop.time())
                await self._open.wait()
                if not data:
                    break
                sink.write(data)
                await sink.drain()
        sink.close()
        self._writers.discard(sink)
