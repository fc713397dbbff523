"""The pages /metrics, /health and /ready over HTTP, for Prometheus, and for programs that restart a system or alarm."""

from __future__ import annotations

import asyncio
import logging
import re
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from http import HTTPStatus
from types import TracebackType
from typing import Self

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from coordinator.watch.http_front import LONGEST_REQUEST, PATIENCE_S, REQUEST_S, Front, make_room, open_listener
from coordinator.watch.listen import name_address
from coordinator.watch.metrics.collect import Observation, RunCollector, format_health
from coordinator.watch.observe.grid_tables import GridTables
from coordinator.watch.observe.watcher import Watcher
from dsse_core.errors import InvalidInputError

log = logging.getLogger(__name__)
Answer = tuple[int, str, bytes]  # HTTP status, type and body
END_OF_HEAD = b"\r\n\r\n"
REQUEST_LINE = re.compile(r"([A-Z]{1,16}) (\S+) HTTP/1\.[01]")
HEADER_LINE = re.compile(r"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([^\0\r\n]*?)[ \t]*")
PLAIN = "text/plain; charset=utf-8"


class MetricsPage:
    """HTTP server at ``host``:``port`` on its own thread, which answers from the newest sight until its block ends.

    ``names``: names of this host that requests beyond loopback may use, beside its addresses. ``known``: the grid, if
    its scenario is known.
    """

    def __init__(self, host: str, port: int, names: Iterable[str] = (), known: GridTables | None = None) -> None:
        self._collector = RunCollector(known)
        self._registry = CollectorRegistry()
        self._registry.register(self._collector)
        ProcessCollector(registry=self._registry)
        self._written: tuple[Observation, bytes] | None = None
        try:
            self._listener = open_listener(host, port)
        except OSError as error:
            what = f"cannot listen there: {error.strerror or error}; choose another, such as 127.0.0.1:9464"
            raise InvalidInputError(f"--listen {host}:{port}", [what]) from None
        self.port = int(self._listener.getsockname()[1])
        self.where = f"http://{name_address(host, self.port)}/metrics"
        self._front = Front.of(host, self.port, names, by_address=True)
        self._loop = asyncio.new_event_loop()
        self._over = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="metrics page", daemon=True)

    def show(self, watcher: Watcher, now: float, trouble: str) -> None:
        """Answer from now on with the view of ``watcher`` at ``now``; ``trouble``: why there is no link, else empty."""
        self._collector.sight = Observation(now, watcher.look(now), watcher.copy(), trouble)

    def show_trouble(self, now: float, trouble: str) -> None:
        """Answer from now on with ``trouble`` alone, found at ``now``."""
        self._collector.sight = Observation(now, trouble=trouble)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner, self._listener:
            runner.run(self._serve())

    async def _serve(self) -> None:
        connections: set[_Connection] = set()
        server = await self._loop.create_server(lambda: _Connection(self._answer, connections), sock=self._listener)
        await self._over.wait()
        server.close()
        for connection in list(connections):
            connection.end()

    def _answer(self, method: str, target: str, headers: Iterable[tuple[str, str]]) -> tuple[Answer, Mapping[str, str]]:
        """The answer to a request, and additional headers."""
        if found := self._front.find_rejection(method, headers):
            return (found.status, PLAIN, found.text.encode()), found.headers
        pages: dict[str, Callable[[], Answer]] = {
            "/metrics": lambda: (200, CONTENT_TYPE_LATEST, self._write_metrics()),
            "/health": lambda: _as_answer(*format_health(self._collector.sight.find_illness(time.monotonic()))),
            "/ready": lambda: _as_answer(*format_health(self._collector.sight.find_obstacles(time.monotonic()))),
        }
        page = pages.get(target.partition("?")[0])
        return (page() if page else (404, PLAIN, f"here are {', '.join(pages)}\n".encode())), {}

    def _write_metrics(self) -> bytes:
        """The metrics of the newest sight, as text; written once for each sight."""
        sight = self._collector.sight
        if self._written is None or self._written[0] is not sight:
            self._written = sight, generate_latest(self._registry)
        return self._written[1]


def _as_answer(status: int, body: str) -> Answer:
    return status, "application/json", body.encode()


class _Connection(asyncio.Protocol):
    """Connection with one request and its answer. It is closed where the request is not complete in time, or the reader
    does not receive the answer in time. Of too many connections, the one silent longest is closed.
    """

    def __init__(
        self,
        answer: Callable[[str, str, Iterable[tuple[str, str]]], tuple[Answer, Mapping[str, str]]],
        connections: set[_Connection],
    ) -> None:
        self._answer = answer
        self._connections = connections
        self._received = bytearray()
        self._is_answered = False
        self.silent_since = time.monotonic()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        make_room(len(self._connections), self._connections)
        self._connections.add(self)
        self._deadline = asyncio.get_running_loop().call_later(REQUEST_S, self.end)

    def end(self) -> None:
        """Close the connection at once, without an answer."""
        self._connections.discard(self)
        self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._deadline.cancel()
        self._connections.discard(self)

    def data_received(self, data: bytes) -> None:
        if self._is_answered:
            return
        searched = max(0, len(self._received) - len(END_OF_HEAD))
        self._received += data
        end = self._received.find(END_OF_HEAD, searched)
        if max(end, len(self._received) if end < 0 else 0) > LONGEST_REQUEST:
            self.end()
        elif end >= 0:
            self._is_answered = True
            self._deadline.cancel()
            self._deadline = asyncio.get_running_loop().call_later(PATIENCE_S, self.end)
            self._transport.write(self._find_answer(self._received[:end].decode("latin-1")))
            self._transport.close()  # once the reader has received all

    def _find_answer(self, head: str) -> bytes:
        """The answer to a request with this head, as bytes."""
        first, *lines = head.split("\r\n")
        request, fields = REQUEST_LINE.fullmatch(first), [HEADER_LINE.fullmatch(line) for line in lines]
        more: Mapping[str, str] = {}
        if request is None or None in fields:
            answer: Answer = (400, PLAIN, b"no request of HTTP/1.1\n")
        else:
            try:
                headers = [(found[1].lower(), found[2]) for found in fields if found]
                answer, more = self._answer(request[1], request[2], headers)
            except Exception:
                log.exception("%s", ascii(request[2])[:200])
                answer = 500, PLAIN, b"a defect, which the log describes\n"
        status, kind, body = answer
        has_body = request is None or request[1] != "HEAD"
        about = {"Content-Type": kind, "Content-Length": str(len(body)), "Connection": "close"}
        about |= {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff", **more}
        written = "".join(f"{name}: {value}\r\n" for name, value in about.items())
        return f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\n{written}\r\n".encode("latin-1") + body * has_body
