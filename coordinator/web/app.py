"""The page and its API: nothing can be changed through it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from coordinator.web.guard import Guard
from coordinator.web.history import KINDS
from coordinator.web.moment import encode_json
from coordinator.web.openapi import describe_api
from coordinator.web.sources import Source
from coordinator.web.stream import Stream

STATIC = Path(__file__).parent / "static"
LONGEST_NAME = 200  # of what a history is asked for

Endpoint = Callable[[Request], Awaitable[Response]]


def make_app(source: Source, hosts: Sequence[str], token: str | None = None) -> Starlette:
    """The application that shows ``source`` to those who ask for one of ``hosts``, with ``token`` if there is one."""

    async def page(request: Request) -> Response:
        return FileResponse(STATIC / "index.html")

    async def grid(request: Request) -> Response:
        return Response(source.drawing.payload, media_type="application/json")

    async def now(request: Request) -> Response:
        return Response(source.newest.payload, media_type="application/json")

    async def history(request: Request) -> Response:
        kind, name = request.query_params.get("kind", ""), request.query_params.get("id", "")
        if kind not in KINDS or len(name) > LONGEST_NAME or (kind == "bus" and not name.isascii()):
            return _problem(400, f"kind is one of {', '.join(KINDS)}, id what is shown")
        if kind == "bus" and not name.removeprefix("-").isdigit():
            return _problem(400, "the id of a bus is its number")
        return _json(await asyncio.to_thread(source.read_history, kind, name))

    async def frames(request: Request) -> Response:
        return _json({"times": source.times(), "since": source.since})

    async def frame(request: Request) -> Response:
        number = int(request.path_params["number"])
        if number >= len(source.times()):
            return _problem(404, f"there are {len(source.times())} frames")
        return Response(source.frame(number), media_type="application/json")

    async def health(request: Request) -> Response:
        return JSONResponse({"status": "ok", "mode": source.mode})

    async def openapi(request: Request) -> Response:
        return JSONResponse(describe_api())

    endpoints: dict[str, Endpoint] = {
        "/": page,
        "/health": health,
        "/api/openapi.json": openapi,
        "/api/grid": grid,
        "/api/now": now,
        "/api/history": history,
        "/api/frames": frames,
        "/api/frame/{number:int}": frame,
    }
    routes: list[Any] = [Route(path, endpoint) for path, endpoint in endpoints.items()]
    routes += [Route("/api/stream", Stream(source)), Mount("/static", StaticFiles(directory=STATIC))]
    return Starlette(routes=routes, middleware=[Middleware(Guard, hosts=hosts, token=token)])


def _json(content: object) -> Response:
    return Response(encode_json(content), media_type="application/json")


def _problem(status: int, text: str) -> Response:
    return JSONResponse({"problem": text}, status)
