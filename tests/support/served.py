"""A page of a simulated run, or of states that tests make up, without a bus."""

from __future__ import annotations

import asyncio
import functools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import httpx

from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.lab.simulator.simulate import Simulation
from coordinator.show.web.app import make_app
from coordinator.show.web.playback.play import Play
from coordinator.show.web.playback.source import PlaybackSource
from coordinator.show.web.server import PageAddress, serve
from coordinator.show.web.sources import LiveSource, Source
from coordinator.watch.http_front import Front
from coordinator.watch.observe.watcher import Watcher

HOST = "127.0.0.1:8080"


@functools.cache
def played(name: str = "industrial13-lossy") -> PlaybackSource:
    play, scenario = Play(), choose_scenario(name)
    Simulation(scenario, subscriber=play).run()
    return PlaybackSource(play, scenario)


class Client:
    """Asks ``app`` without a socket."""

    def __init__(self, app: Any) -> None:
        self._app = app

    def request(self, method: str, path: str, **more: Any) -> httpx.Response:
        async def ask() -> httpx.Response:
            transport = httpx.ASGITransport(self._app)
            async with httpx.AsyncClient(transport=transport, base_url=f"http://{HOST}") as asking:
                return await asking.request(method, path, **more)

        return asyncio.run(ask())

    def get(self, path: str, **more: Any) -> httpx.Response:
        return self.request("GET", path, **more)


def client(source: Source, token: str | None = None) -> Client:
    return Client(make_app(source, Front((HOST,)), token))


@contextmanager
def live(watcher: Watcher) -> Iterator[LiveSource]:
    """A live source of what ``watcher`` knows."""

    def look(duration_s: float) -> Watcher:
        time.sleep(min(duration_s, 0.02))
        return watcher

    source = LiveSource(look, None, watcher.run)
    source.start()
    try:
        yield source
    finally:
        source.close()


@contextmanager
def serving(source: Source, place: PageAddress | None = None, names: tuple[str, ...] = ()) -> Iterator[str]:
    """A server in a thread of its own; its URL."""
    import uvicorn

    ready, servers, urls = threading.Event(), list[Any](), list[str]()
    begin = uvicorn.Server.run

    def run(server: uvicorn.Server, *args: Any, **kwargs: Any) -> None:
        servers.append(server)
        server.install_signal_handlers = lambda: None  # type: ignore[attr-defined]
        asyncio.run(server._serve(**kwargs))

    def on_ready(url: str) -> None:
        urls.append(url)
        ready.set()

    uvicorn.Server.run = run  # type: ignore[method-assign]
    thread = threading.Thread(target=serve, args=(source, place or PageAddress("127.0.0.1", 0), names, on_ready))
    thread.start()
    try:
        assert ready.wait(180)
        wait_for(lambda: bool(servers) and servers[0].started)
        yield urls[0]
    finally:
        uvicorn.Server.run = begin  # type: ignore[method-assign]
        for server in servers:
            server.should_exit = True
        thread.join(180)


def wait_for(holds: Callable[[], bool], deadline_s: float = 180.0) -> None:
    deadline = time.monotonic() + deadline_s
    while not holds():
        assert time.monotonic() < deadline, f"did not happen within {deadline_s} s"
        time.sleep(0.01)
