"""Connections to the page: a limit of their number, and an end of those without handshake, request or reading."""

from __future__ import annotations

import asyncio
import socket
import time
from dataclasses import dataclass
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from coordinator.watch.http_front import LONGEST_REQUEST, PATIENCE_S, REQUEST_S, make_room

HANDSHAKE_S = 10.0  # limit of the TLS handshake
FAREWELL_S = 2.0  # limit of the TLS shutdown
AGAIN_S = 0.1  # until the next accept, where this process cannot open more files


class PatientProtocol(H11Protocol):
    """Closes a connection without a whole request in time, and aborts one whose reader takes no data for long.
    Otherwise a few hundred such connections would fill the server.
    """

    _abortion: asyncio.TimerHandle | None = None
    silent_since: float = 0.0

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._ask_in_time()

    @property
    def is_silent(self) -> bool:
        """True where the connection does not wait for an answer."""
        return self.cycle is None or self.cycle.response_complete

    def end(self) -> None:
        """Aborts the connection at once, without an answer."""
        self.connections.discard(self)
        self.transport.abort()

    def data_received(self, data: bytes) -> None:
        if len(data) > LONGEST_REQUEST:  # h11 limits requests that come in pieces
            self.transport.abort()
        else:
            super().data_received(data)

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
        asked, self.silent_since = self.cycle, time.monotonic()

        def close_if_silent() -> None:
            if self.cycle is asked and not self.transport.is_closing():
                self.transport.close()

        asyncio.get_running_loop().call_later(REQUEST_S, close_if_silent)


@dataclass(frozen=True, eq=False)
class Arrival:
    """An accepted connection that is not yet among those of the server; with TLS, its handshake has not ended.

    ``others``: the set of all arrivals, which contains this one.
    """

    link: socket.socket
    task: asyncio.Task[None]
    others: set[Arrival]
    silent_since: float

    def end(self) -> None:
        """Ends the connection at once, even before its handshake."""
        self.others.discard(self)
        self.task.cancel()

    def forget(self, task: asyncio.Task[None]) -> None:
        """Removes the arrival after the end of its ``task``; closes its socket if the server did not take it."""
        self.others.discard(self)
        if task.cancelled() or task.exception() is not None:  # not logged: faulty clients would fill the log
            self.link.close()


class PatientServer(uvicorn.Server):
    """Server that accepts connections itself, because asyncio counts none before its TLS handshake has ended. With
    MOST_READERS connections, arriving ones included, the connection idle longest is closed for a new one.
    """

    _door: asyncio.Task[None] | None = None
    _arrivals: set[Arrival]

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=[])
        (listener,) = sockets or []
        listener.setblocking(False)
        self._arrivals = set()
        self._door = asyncio.create_task(self._take_all(listener))

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        tasks = [task for task in (self._door, *(arrival.task for arrival in self._arrivals)) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await super().shutdown(sockets=sockets)

    async def _take_all(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                link, _ = await loop.sock_accept(listener)
            except OSError:  # the process can open no more files, or the connection is gone already
                await asyncio.sleep(AGAIN_S)
                continue
            self._make_room()
            task = loop.create_task(self._let_in(link))
            arrival = Arrival(link, task, self._arrivals, time.monotonic())
            self._arrivals.add(arrival)
            task.add_done_callback(arrival.forget)
            await asyncio.sleep(0)  # lets other connections be served while many arrive

    async def _let_in(self, link: socket.socket) -> None:
        """Adds the connection to those of the server, after its handshake with TLS.

        Raises:
            OSError: the handshake fails or takes too long.
        """
        limits = {"ssl_handshake_timeout": HANDSHAKE_S, "ssl_shutdown_timeout": FAREWELL_S} if self.config.ssl else {}
        await asyncio.get_running_loop().connect_accepted_socket(
            lambda: PatientProtocol(self.config, self.server_state, self.lifespan.state),
            link,
            ssl=self.config.ssl,
            **limits,
        )

    def _make_room(self) -> None:
        """Closes the connection idle longest, if there is no room for one more."""
        readers = [reader for reader in self.server_state.connections if isinstance(reader, PatientProtocol)]
        silent: list[PatientProtocol | Arrival] = [reader for reader in readers if reader.is_silent]
        make_room(len(readers) + len(self._arrivals), [*silent, *self._arrivals])
