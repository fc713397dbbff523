"""The gateway on the bus: its token, its publications, its subscriptions. Callbacks run on the loop's thread."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.messages.checks import MessageError
from agents.messages.keys import (
    all_incarnations,
    all_states,
    gateway_key,
    live_key,
    name_of_live,
    sender_of,
    telemetry_key,
)
from agents.messages.packing import Incarnation, StateMessage, decode
from agents.runtime.duplicate_guard import GIVES_WAY, DuplicateGuard, ReplacedError
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Session
from coordinator.field.gateway.maps.map_file import GatewayMap

log = logging.getLogger(__name__)
ROLE = "gateway"
GUARD_S = 0.5  # between two checks for another process of the gateway's name


@dataclass
class GatewayBus:
    """``send``: area -> puts a payload on its key. ``announce``: tells watchers the gateway's name."""

    content: GatewayMap
    incarnation: Incarnation
    session: Session
    send: Mapping[str, Callable[[bytes], None]]
    send_leave: Callable[[bytes], None]
    announce: Callable[[bytes], None]
    guard: DuplicateGuard

    def watch(self, on_area: Callable[[str], None], on_state: Callable[[StateMessage], None] | None) -> None:
        """Call ``on_area`` with each area of the map that appears and ``on_state`` with states, in the running loop."""
        loop, run = asyncio.get_running_loop(), self.content.run

        def later(callback: Callable[..., None], *arguments: Any) -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(callback, *arguments)

        def on_token(key: str, alive: bool) -> None:
            if alive:
                later(on_area, name_of_live(key)[1])

        def on_own(key: str, alive: bool) -> None:
            later(lambda: self.guard.take(key, alive, time.monotonic()))

        def on_payload(key: str, payload: bytes) -> None:
            state = _state_in(key, payload)
            if state is not None and on_state is not None:
                later(on_state, state)

        for area in self.send:  # each by its name: tokens of unknown areas are not sent here
            self.session.watch_presence(all_incarnations(run, "area", area), on_token)
        self.session.watch_presence(all_incarnations(run, ROLE, self.content.name), on_own)
        if on_state is not None:
            self.session.subscribe(all_states(run), on_payload)

    async def mind_successors(self) -> None:
        """Announce the gateway until a later process of the same name appears.

        Raises:
            ReplacedError: a later process has appeared; the leave message has been sent.
        """
        while True:
            self.announce(b"")
            await asyncio.sleep(GUARD_S)
            try:
                self.guard.check(time.monotonic())
            except ReplacedError:
                self.send_leave(GIVES_WAY.encode())
                raise

    def renew(self) -> None:
        """Load the keys from their files again."""
        if self.session.interrupt():
            self.guard.forget()
            self.session.resume()


@contextmanager
def join_bus(
    content: GatewayMap,
    incarnation: Incarnation,
    endpoints: Sequence[str],
    timeout_s: float,
    keys: Path | None,
    direct: bool,
) -> Iterator[GatewayBus]:
    """Keep the gateway present on the bus until the end of the block.

    Raises:
        InvalidInputError: the keys cannot be used.
        TransportError: no endpoint answers in time.
    """
    run, heartbeat_s = content.run, content.scenario.run.beat_s
    loaded = load_keys(keys, f"{ROLE}-{content.name}", run)
    with Session.join(endpoints, timeout_s, loaded, heartbeat_s=heartbeat_s, direct=direct) as session:
        send = {area: session.publisher(telemetry_key(run, area, content.name)) for area in content.areas}
        token = live_key(run, ROLE, content.name, incarnation)
        send_leave = session.publisher(token)
        session.declare_presence(token)
        guard = DuplicateGuard(f"gateway {content.name} of run {run}", incarnation, time.monotonic(), heartbeat_s)
        announce = session.publisher(gateway_key(run, content.name))
        yield GatewayBus(content, incarnation, session, send, send_leave, announce, guard)


def _state_in(key: str, payload: bytes) -> StateMessage | None:
    """The state message in ``payload``; None where it is another message, or not from the area of ``key``."""
    try:
        message = decode(payload)
    except MessageError:
        return None
    return message if isinstance(message, StateMessage) and message.header.sender == sender_of(key) else None
