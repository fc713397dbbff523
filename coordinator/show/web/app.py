"""The page and its API, which is read-only; the newest moment goes to readers as server-sent events."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import Receive, Scope, Send

from coordinator.show.web.guard import Guard
from coordinator.show.web.history import KINDS_WITH_A_PAST
from coordinator.show.web.moment import encode_json
from coordinator.show.web.openapi import describe_api
from coordinator.show.web.shown_tables import MOST_ROWS, select_rows
from coordinator.show.web.sources import Source
from coordinator.watch.http_front import Front

LOOK_S = 0.05
PULSE_S = 2.0  # between two signs of life without a new moment, which takes long to make for a large grid
HEADERS = [(b"content-type", b"text/event-stream"), (b"x-accel-buffering", b"no")]
STATIC = Path(__file__).parent / "static"
LONGEST_NAME = 200  # characters of an id in a request
KINDS_OF_ROWS = ("bus", "branch", "meter")
WHICH_ROWS = ("first", "count", "frame")
MOST_DIGITS = 9  # of a number in a request

Endpoint = Callable[[Request], Awaitable[Response]]


def make_app(source: Source, front: Front, token: str | None = None) -> Guard:
    """The application that serves ``source`` to requests that ``front`` accepts, with ``token`` if it is given."""
    serve = _Endpoints(source)
    endpoints: dict[str, Endpoint] = {
        "/": serve.page,
        "/health": serve.health,
        "/api/openapi.json": serve.openapi,
        "/api/grid": serve.grid,
        "/api/now": serve.now,
        "/api/history": serve.history,
        "/api/rows": serve.rows,
        "/api/frames": serve.frames,
        "/api/frame/{number}": serve.frame,
    }
    routes: list[Any] = [Route(path, endpoint) for path, endpoint in endpoints.items()]
    routes += [Route("/api/stream", Stream(source)), Mount("/static", StaticFiles(directory=STATIC))]
    return Guard(Starlette(routes=routes), front, token)  # outermost: also guards answers to internal errors


@dataclass(frozen=True)
class _Endpoints:
    """The endpoints of the server, with answers from ``source``."""

    source: Source

    async def page(self, request: Request) -> Response:
        return FileResponse(STATIC / "index.html")

    async def grid(self, request: Request) -> Response:
        return Response(self.source.drawing.payload, media_type="application/json")

    async def now(self, request: Request) -> Response:
        return Response(self.source.newest.payload, media_type="application/json")

    async def history(self, request: Request) -> Response:
        kind, name = request.query_params.get("kind", ""), request.query_params.get("id", "")
        if kind not in KINDS_WITH_A_PAST or len(name) > LONGEST_NAME or (kind == "bus" and not name.isascii()):
            return _problem(400, f"kind is one of {', '.join(KINDS_WITH_A_PAST)}, id what is shown")
        if kind == "bus" and not name.removeprefix("-").isdigit():
            return _problem(400, "the id of a bus is its number")
        return _json(await asyncio.to_thread(self.source.read_history, kind, name))

    async def rows(self, request: Request) -> Response:
        asked = request.query_params
        kind, name, place = asked.get("kind", ""), asked.get("id"), asked.get("at")
        given = [asked.get(key) for key in WHICH_ROWS]
        if kind not in KINDS_OF_ROWS or len(name or "") > LONGEST_NAME or len(place or "") > LONGEST_NAME:
            return _problem(400, f"kind is one of {', '.join(KINDS_OF_ROWS)}, id what is shown")
        if place is not None and kind != "meter":
            return _problem(400, "at is for meters: those at a bus or branch")
        first, count, number = (None if value is None else _read_number(value) for value in given)
        if -1 in (first, count, number):
            return _problem(400, f"{', '.join(WHICH_ROWS)} are numbers")
        if number is not None and number >= len(self.source.times()):
            return _problem(404, f"there are {len(self.source.times())} frames")

        def select() -> dict[str, Any]:
            most = MOST_ROWS if count is None else min(count, MOST_ROWS)
            return select_rows(self.source.tables(number), kind, name, first or 0, most, place)

        return _json(await asyncio.to_thread(select))

    async def frames(self, request: Request) -> Response:
        is_complete, times = self.source.is_complete, self.source.times()  # in this order: no frames after the end
        since, remarks = self.source.since, self.source.remarks
        return _json({"times": times, "since": since, "remarks": remarks, "complete": is_complete})

    async def frame(self, request: Request) -> Response:
        number = _read_number(request.path_params["number"])
        if not 0 <= number < len(self.source.times()):
            return _problem(404, f"there are {len(self.source.times())} frames")
        return Response(await asyncio.to_thread(self.source.frame, number), media_type="application/json")

    async def health(self, request: Request) -> Response:
        return JSONResponse({"status": "ok", "mode": self.source.mode})

    async def openapi(self, request: Request) -> Response:
        return JSONResponse(describe_api())


def _read_number(text: str) -> int:
    """The number of the first MOST_DIGITS digits of ``text``, which exceed every count; -1 if it is no number."""
    return int(text[:MOST_DIGITS]) if text.isascii() and text.isdigit() else -1


def _json(content: object) -> Response:
    return Response(encode_json(content), media_type="application/json")


def _problem(status: int, text: str) -> Response:
    return JSONResponse({"problem": text}, status)


@dataclass(frozen=True)
class Stream:
    """An application that sends the newest moments of ``source`` until the reader disconnects."""

    source: Source

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": HEADERS})
        if scope["method"] == "HEAD":
            await send({"type": "http.response.body", "body": b""})
            return
        reading = asyncio.create_task(self._send_all(send))
        leaving = asyncio.create_task(_wait_for_leave(receive))
        try:
            await asyncio.wait((reading, leaving), return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (reading, leaving):
                task.cancel()
            await asyncio.gather(reading, leaving, return_exceptions=True)

    async def _send_all(self, send: Send) -> None:
        number = -1
        while True:
            waited_s = 0.0
            while (frame := self.source.newest).number == number and waited_s < PULSE_S:
                await asyncio.sleep(LOOK_S)
                waited_s += LOOK_S
            body = b"event: pulse\ndata\n\n"  # a browser ignores events without data
            if frame.number != number:
                number, body = frame.number, b"id: %d\ndata: %s\n\n" % (frame.number, frame.payload)
            await send({"type": "http.response.body", "body": body, "more_body": True})


async def _wait_for_leave(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
