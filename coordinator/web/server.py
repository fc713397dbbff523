"""The web server: where it listens, certificates, a token beyond loopback, and an end to those who never ask."""

from __future__ import annotations

import asyncio
import ipaddress
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from coordinator.listen import name_address, parse_listen
from coordinator.web.app import make_app
from coordinator.web.sources import Source
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import read_bounded

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")
MOST_READERS = 200
REQUEST_S = 10.0  # in which a request must have come whole
PATIENCE_S = 10.0  # with a reader that takes nothing
LEAST_TOKEN, MOST_TOKEN = 16, 4096  # characters


@dataclass(frozen=True)
class Place:
    """Where a page is served: ``host`` and ``port`` (0: any that is free), certificate and key in PEM, and a token."""

    host: str
    port: int
    certificate: Path | None = None
    key: Path | None = None
    token: str | None = None

    @property
    def is_loopback(self) -> bool:
        """Whether nobody but this machine gets there."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    def url(self, port: int) -> str:
        """What to open."""
        return f"{'https' if self.certificate else 'http'}://{name_address(self.host, port)}/"


def choose_place(
    listen: str, certificate: Path | None, key: Path | None, token_file: Path | None, names: tuple[str, ...]
) -> Place:
    """The place that the options describe.

    Raises:
        InvalidInputError: all that is wrong or missing; beyond loopback certificate, key and token are needed.
    """
    host, port = parse_listen(listen, "127.0.0.1:8080")
    problems = []
    if (certificate is None) != (key is None):
        problems.append("--tls-cert and --tls-key go together")
    token = None
    if token_file is not None:
        try:
            token = read_bounded(token_file, MOST_TOKEN).decode("ascii").strip()
        except UnicodeDecodeError:
            problems.append(f"--token-file {token_file}: a token is of ASCII letters and digits")
        if token is not None and len(token) < LEAST_TOKEN:
            problems.append(f"--token-file {token_file}: {len(token)} characters; {LEAST_TOKEN} at least")
    place = Place(host, port, certificate, key, token)
    if not place.is_loopback:
        needed = {"--tls-cert and --tls-key": certificate, "--token-file": token_file, "--name": names or None}
        problems += [f"beyond loopback {name} is needed" for name, given in needed.items() if given is None]
    if problems:
        raise InvalidInputError(f"dsse serve --listen {listen}", problems)
    return place


class PatientProtocol(H11Protocol):
    """Closes a connection on which no whole request comes in time, and aborts one whose reader takes nothing for long:
    else a few hundred of them would fill the server.
    """

    _abortion: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._ask_in_time()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._abortion = asyncio.get_running_loop().call_later(PATIENCE_S, self.transport.abort)

    def resume_writing(self) -> None:
        if self._abortion is not None:
            self._abortion.cancel()
        super().resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._abortion is not None:
            self._abortion.cancel()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._ask_in_time()

    def _ask_in_time(self) -> None:
        asked = self.cycle

        def close_if_silent() -> None:
            if self.cycle is asked and not self.transport.is_closing():
                self.transport.close()

        asyncio.get_running_loop().call_later(REQUEST_S, close_if_silent)


def serve(source: Source, place: Place, names: tuple[str, ...], on_ready: Callable[[str], object]) -> None:
    """Serve ``source`` until SIGINT or SIGTERM; ``names``: those under which the host is asked for, beside its own.

    Raises:
        OSError: the place is taken or is not there.
    """
    family = socket.AF_INET6 if ":" in place.host else socket.AF_INET
    with socket.socket(family) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((place.host, place.port))
        listener.listen()  # who is told the address may ask at once
        port = listener.getsockname()[1]
        own = (place.url(port).partition("//")[2].rstrip("/"),)
        others = LOOPBACK_NAMES if place.is_loopback else names
        hosts = (*own, *(f"{name.lower()}:{port}" for name in others), *(names if port in (80, 443) else ()))
        config = uvicorn.Config(
            make_app(source, hosts, place.token),
            http=PatientProtocol,
            ws="none",
            lifespan="off",
            log_level="warning",
            access_log=False,
            server_header=False,
            limit_concurrency=MOST_READERS,
            timeout_keep_alive=5,
            timeout_graceful_shutdown=1,
            h11_max_incomplete_event_size=16 * 1024,
            ssl_certfile=place.certificate,
            ssl_keyfile=place.key,
        )
        on_ready(place.url(port))
        uvicorn.Server(config).run(sockets=[listener])
