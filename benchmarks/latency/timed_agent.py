"""Processes that ``benchmarks.latency`` starts beside itself: agents that time themselves, and an echo."""

from __future__ import annotations

import json
import queue
import signal
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import agents.runtime.ingress_filter
import agents.runtime.link
from agents.__main__ import main as run_agent
from agents.protocol.events import Action
from agents.protocol.rounds import RoundsProtocol
from agents.transport.zenoh_bus import Session

PING, PONG = "dsse/v3/latency/ping", "dsse/v3/latency/pong"


def run_timed_agent(area_file: str, out: str) -> int:
    """Run an agent; at its end write counts and seconds of its decoding, solving and encoding to ``out``."""
    seconds: defaultdict[str, float] = defaultdict(float)
    calls: Counter[str] = Counter()

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                seconds[name] += time.perf_counter() - start
                calls[name] += 1

        return call

    agents.runtime.ingress_filter.decode = timed("decode", agents.runtime.ingress_filter.decode)  # type: ignore[attr-defined]
    agents.runtime.link.encode = timed("encode", agents.runtime.link.encode)  # type: ignore[attr-defined]
    handle = RoundsProtocol.handle

    def timed_handle(*arguments: Any) -> Iterator[Action]:
        actions, following = handle(*arguments), timed("solve", next)
        while (action := following(actions, None)) is not None:
            yield action
        calls["handled"] += 1

    RoundsProtocol.handle = timed_handle  # type: ignore[method-assign, assignment]
    code = run_agent([area_file])
    calls["solve"] = calls.pop("handled", 0)
    Path(out).write_text(json.dumps({"seconds": seconds, "calls": calls}))
    return code


def run_echo(endpoint: str) -> int:
    """Send each payload of PING back on PONG, until SIGTERM."""
    updates: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    with Session.connect([endpoint]) as session:
        signal.signal(signal.SIGTERM, lambda *_: updates.put(None))
        answer = session.publisher(PONG)
        session.subscribe(PING, lambda _key, payload: updates.put(payload))
        while (payload := updates.get()) is not None:
            answer(payload)
    return 0
