"""Source ``jsonl``: a JSON object on each line of standard input."""

from __future__ import annotations

import asyncio
import os
import threading

from coordinator.field.gateway.interface import Emit, Source
from coordinator.field.gateway.sources.lines import PIECE, TOO_LONG, LineCutter
from coordinator.field.gateway.sources.texts import NotUsableError, as_time, as_validity, parse_object
from dsse_core.files.strict_table import Table

STDIN = 0
MALFORMED = "malformed"


class JsonLinesSettings(Table):
    """Keys of ``[source]``: none."""


class JsonLinesSource(Source):
    """Reads ``{"address": ..., "value": ..., "time": ..., "valid": ..., "unit": ...}``, with the first two
    required, or ``{"time": ..., "values": {ADDRESS: VALUE, ...}}``, until the end of standard input.

    The reader waits until the gateway has taken its last pieces, of 64 KiB each; a faster producer waits at its pipe.
    """

    Settings = JsonLinesSettings

    async def read(self, emit: Emit) -> None:
        pieces: asyncio.Queue[bytes] = asyncio.Queue()
        loop, cutter = asyncio.get_running_loop(), LineCutter()
        taken = threading.Semaphore(2)

        def read_all() -> None:  # ``os.read`` waits without a lock of ``sys.stdin``: the process can always end
            while True:
                taken.acquire()
                piece = os.read(STDIN, PIECE)
                try:
                    loop.call_soon_threadsafe(pieces.put_nowait, piece)
                except RuntimeError:  # the loop is closed
                    return
                if not piece:
                    return

        threading.Thread(target=read_all, daemon=True).start()
        while piece := await pieces.get():
            for line in cutter.cut(piece):
                _take(line, emit)
            taken.release()
            await asyncio.sleep(0)
        for line in cutter.cut(b"\n"):
            _take(line, emit)


def _take(line: str | None, emit: Emit) -> None:
    if line is None:
        emit.reject(MALFORMED, TOO_LONG)
        return
    if line.strip():
        take_object(line, emit)


def take_object(line: str, emit: Emit) -> None:
    """Hand over the readings of one line."""
    try:
        found = parse_object(line)
    except NotUsableError as error:
        emit.reject(MALFORMED, f"line {line!r:.120}: {error}")
        return
    time, valid = as_time(found.get("time")), as_validity(found.get("valid"))
    values, address = found.get("values"), found.get("address")
    unit = None if found.get("unit") is None else str(found["unit"])
    if isinstance(values, dict) and values:
        for name, value in values.items():
            emit(name, value, time, valid=valid, unit=unit)
    elif isinstance(address, str) and "value" in found:
        emit(address, found["value"], time, valid=valid, unit=unit)
    else:
        emit.reject(MALFORMED, f"line {line!r:.120}: it has neither address and value nor values")
