"""Sink ``jsonl``: a JSON object on each line of standard output, or of a file that grows."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncIterator

from coordinator.field.gateway.interface import MapPath, Result, Sink
from dsse_core.files.strict_table import Table


class JsonLinesSettings(Table):
    """Keys of ``[[results]]``. ``path``: a file to append to, in place of standard output."""

    path: MapPath | None = None


class JsonLinesSink(Sink):
    """Writes each result at once. A thread writes to standard output, since a full pipe blocks the writer."""

    Settings = JsonLinesSettings
    settings: JsonLinesSettings

    async def write(self, results: AsyncIterator[Result]) -> None:
        if self.settings.path is None:
            async for result in results:
                await asyncio.to_thread(_print, json.dumps(result, allow_nan=False))
        else:
            with self.settings.path.open("a", encoding="utf-8") as file:
                async for result in results:
                    file.write(json.dumps(result, allow_nan=False) + "\n")
                    file.flush()


def _print(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
