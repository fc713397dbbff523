"""The memory of a page and of its server while very many moments pass."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import click

from benchmarks.page.server import Server

LOOK_S = 0.2
COUNT = """
window.seen = {received: 0, shown: 0};
const Real = window.EventSource;
window.EventSource = class extends Real {
  constructor(url) { super(url); this.addEventListener("message", event => {
    window.seen.received += 1; window.seen.number = Number(event.lastEventId); }); }
};
new MutationObserver(() => { window.seen.shown += 1; })
  .observe(document, {subtree: true, attributeFilter: ["data-moment"]});
"""


@dataclass(frozen=True)
class Sample:
    """State after ``moments`` of the server: moments received and shown by the page, and memory, MB.

    ``nodes`` of documents and ``listeners`` are those that the browser keeps.
    """

    moments: int
    received: int
    shown: int
    heap_mb: float
    nodes: int
    listeners: int
    server_mb: float
    after_s: float


def sample_day(page: Any, server: Server, moments: int, samples: int) -> Iterator[Sample]:
    """``samples`` of memory in even steps until the server has made ``moments``.

    Raises:
        click.ClickException: the page no longer receives moments.
    """
    session, began = page.context.new_cdp_session(page), time.monotonic()
    for step in range(1, samples + 1):
        _wait_for(page, moments * step // samples)
        session.send("HeapProfiler.collectGarbage")
        heap, kept = session.send("Runtime.getHeapUsage"), session.send("Memory.getDOMCounters")
        seen = page.evaluate("window.seen")
        yield Sample(
            moments=seen["number"],
            received=seen["received"],
            shown=seen["shown"],
            heap_mb=heap["usedSize"] / 1e6,
            nodes=kept["nodes"],
            listeners=kept["jsEventListeners"],
            server_mb=server.resident_mb(),
            after_s=time.monotonic() - began,
        )


def _wait_for(page: Any, number: int) -> None:
    """Wait until the page has received moment ``number`` or a later one."""
    before, since = -1, time.monotonic()
    while (at := page.evaluate("window.seen.number ?? 0")) < number:
        if at > before:
            before, since = at, time.monotonic()
        if time.monotonic() - since > 300.0:
            raise click.ClickException(f"the page has received nothing since moment {at}")
        page.wait_for_timeout(LOOK_S * 1000)
