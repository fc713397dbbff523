"""``python -m benchmarks.crowd.stranger ENDPOINT RUN COUNT LARGE ROUTER``: announces areas that belong to no run.

The process has no keys and keeps to no rule. It publishes tokens, states and readings of ``COUNT`` areas and gateways
under ordinary names and under names of markup, wide and control characters, some with several incarnations, some of
other roles and wire versions; of ``LARGE`` areas it publishes states of very many buses. It prints ``announced`` when
all is published, and stays until its input ends. A router with keys gives it no link: it has all ready, and tries to
connect again and again.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import zenoh

from agents.messages.keys import gateway_key, live_key, readings_key, state_key
from agents.messages.packing import Header, Incarnation, Message, ReadingsMessage, StateMessage, encode
from agents.transport.bus_config import at_once, bus_config, in_the_background

DEADLINE_S = 30.0
BUSES = 10  # of an ordinary area, and
LARGE_BUSES = 90_000  # of a large one: as many as go into a message
MARKUP = "<img src=x onerror=alert(1)>"
NAMES = ("stranger", "9", MARKUP, "区域面积", "\x1b[2J\x1b]0;owned\x07", "a" * 280, "-", "\u202earea")
ROLES = ("area",) * 7 + ("gateway", "plant", MARKUP)
NOW = Incarnation(1, 1)


def name_of(k: int) -> str:
    return f"{NAMES[k % len(NAMES)]}{k}"


def tokens_of(run: str, k: int) -> Iterator[str]:
    """Tokens of stranger ``k``: every tenth has an older incarnation, too, every hundredth another version."""
    role = ROLES[k // len(NAMES) % len(ROLES)]
    yield live_key(run, role, name_of(k), NOW)
    if k % 10 == 0:
        yield live_key(run, role, name_of(k), Incarnation(0, 1))
    if k % 100 == 0:
        yield live_key(run, role, name_of(k), NOW).replace("/v", f"/v9{k % 30}", 1)


def state_of(run: str, k: int, buses: int) -> StateMessage:
    """A state marked good, of ``buses`` buses from number ``k * buses`` on."""
    name, ones = name_of(k), (1.0,) * buses
    body: dict[str, Any] = {
        **dict.fromkeys(("vm", "va", "sigma_vm", "sigma_va"), ones),
        **dict.fromkeys(("removed", "critical", "old_sides"), (f"{MARKUP}{k}",)),
        **{"sent": {"area1": (1, 1), name_of(k + 1): (1, 1)}, "ages": {"area1": 0.1}, "rejected": {MARKUP: 1}},
        **{key: {} for key in ("received", "faults", "scans")},
        **{"referenced": True, "objective": 1.0, "degrees_of_freedom": 1, "checked": True, "quality": "good"},
        **{"messages": 1, "bytes": 1, "lost": 0, "notes": (MARKUP,) * 3, "telemetry_age": 0.0},
    }
    return StateMessage(Header(run, name, NOW, 1, 1, 0.0), tuple(range(k * buses, (k + 1) * buses)), **body)


def readings_of(run: str, k: int) -> ReadingsMessage:
    """Readings of two meters, one of which has a name that areas of the feeder use."""
    numbers: dict[str, Any] = dict.fromkeys(("values", "sigmas", "times", "estimates", "normalised"), (1.0, 1.0))
    header = Header(run, name_of(k), NOW, 1, 1, 0.0)
    return ReadingsMessage(header=header, meters=("vm1", f"{MARKUP}{k}"), taken_at=0.0, **numbers)


def announce(endpoint: str, run: str, count: int, large: int, router: str) -> None:
    """Publish all tokens, states and readings on the bus at ``endpoint``, and stay until standard input ends."""
    connect = in_the_background([endpoint]) if router == "keys" else at_once([endpoint], DEADLINE_S)
    config = bus_config("peer" if router == "keys" else "client", None, connect=connect)
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:

        def put(key: str, message: Message) -> None:
            session.put(key, encode(message), congestion_control=zenoh.CongestionControl.BLOCK)

        tokens = []
        for k in range(count):
            tokens += [session.liveliness().declare_token(key) for key in tokens_of(run, k)]
            put(state_key(run, name_of(k)), state_of(run, k, BUSES))
            put(readings_key(run, name_of(k)), readings_of(run, k))
            session.put(gateway_key(run, name_of(k)), b"")
        for k in range(large):
            put(
                state_key(run, name_of(k)),
                replace(state_of(run, k, LARGE_BUSES), header=Header(run, name_of(k), NOW, 1, 2, 0.0)),
            )
        print("announced", len(tokens), flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    os.nice(19)  # its processor would be another host's
    announce(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), sys.argv[5])
