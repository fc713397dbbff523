"""The pages /metrics, /health and /ready over HTTP, for Prometheus, and for programs that restart or alarm."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Self

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from coordinator.listen import name_address
from coordinator.metrics.collect import RunCollector, Sight, format_health
from coordinator.observe.watch import Watcher
from dsse_core.errors import InvalidInputError

PATIENCE_S = 5.0  # with a client that opens a connection and asks nothing
AT_ONCE = 16  # questions; more are sent away
Answer = tuple[int, str, bytes]  # HTTP status, type and body


class MetricsPage:
    """Answers at ``host``:``port`` on threads of its own, from the newest sight shown, until its block ends."""

    def __init__(self, host: str, port: int) -> None:
        self._collector = RunCollector()
        registry = CollectorRegistry()
        registry.register(self._collector)
        ProcessCollector(registry=registry)
        self._answers: dict[str, Callable[[], Answer]] = {
            "/metrics": lambda: (200, CONTENT_TYPE_LATEST, generate_latest(registry)),
            "/health": lambda: _as_answer(*format_health(self._collector.sight.find_illness(time.monotonic()))),
            "/ready": lambda: _as_answer(*format_health(self._collector.sight.find_obstacles(time.monotonic()))),
        }
        try:
            self._server = _make_server(host, port, self._answers)
        except OSError as error:
            what = f"cannot listen there: {error.strerror or error}; choose another, such as 127.0.0.1:9464"
            raise InvalidInputError(f"--listen {host}:{port}", [what]) from None
        self.port = int(self._server.server_address[1])
        self.where = f"http://{name_address(host, self.port)}/metrics"

    def show(self, watcher: Watcher, now: float, trouble: str) -> None:
        """Answer with what ``watcher`` knows at ``now``; ``trouble``: why it sees nothing, empty if it does."""
        view = watcher.look(now)
        states = {area.name: state for area in view.areas if (state := watcher.state_of(area.name))}
        self._collector.sight = Sight(now, view, states, trouble)

    def show_trouble(self, now: float, trouble: str) -> None:
        """Answer with nothing but ``trouble``, of ``now``."""
        self._collector.sight = Sight(now, trouble=trouble)

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()


def _as_answer(status: int, body: str) -> Answer:
    return status, "application/json", body.encode()


def _make_server(host: str, port: int, answers: dict[str, Callable[[], Answer]]) -> ThreadingHTTPServer:
    class Handler(BaseHTTPRequestHandler):
        timeout = PATIENCE_S
        server_version, sys_version = "dsse", ""

        def do_GET(self) -> None:
            known = answers.get(self.path.split("?", 1)[0])
            nothing = f"here are {', '.join(answers)}\n".encode()
            status, kind, body = known() if known else (404, "text/plain", nothing)
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *arguments: object) -> None:
            """A question every few seconds for months is nothing to log."""

    class Server(ThreadingHTTPServer):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        daemon_threads = True
        seats = threading.BoundedSemaphore(AT_ONCE)

        def process_request(self, request: object, client_address: object) -> None:
            if self.seats.acquire(blocking=False):
                super().process_request(request, client_address)  # type: ignore[arg-type]
            else:
                self.shutdown_request(request)  # type: ignore[arg-type]

        def process_request_thread(self, request: object, client_address: object) -> None:
            try:
                super().process_request_thread(request, client_address)  # type: ignore[arg-type]
            finally:
                self.seats.release()

        def handle_error(self, request: object, client_address: object) -> None:
            """A client that goes away before it has its answer is none of ours."""

    return Server((host, port), Handler)
