"""The newest moment as server-sent events: a slow reader gets fewer of them."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from starlette.types import Receive, Scope, Send

from coordinator.show.web.sources import Source

LOOK_S = 0.05
PULSE_S = 2.0  # between two signs of life without a new moment, which takes long to make for a large grid
HEADERS = [(b"content-type", b"text/event-stream"), (b"x-accel-buffering", b"no")]


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
