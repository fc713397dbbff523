"""A process that should be kept out: it speaks and listens where it must not, or floods the router's port.

python -m tests.support.stranger lie ENDPOINT [KEYS NAME]     prints what it received as JSON after its last message
python -m tests.support.stranger connect ENDPOINT [KEYS NAME]   prints "in", or why not
python -m tests.support.stranger flood[-wildly] ENDPOINT        until it is killed
"""

from __future__ import annotations

import itertools
import json
import socket
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from agents.messages.keys import all_from_neighbours, all_incarnations, neighbour_key, state_key, telemetry_key
from agents.runtime.presence import begin_incarnation
from agents.security.access import Access
from agents.security.credentials import Keys
from agents.transport.zenoh_bus import Session, TransportError
from coordinator.lab.plant.telemetry_messages import make_payloads
from scenarios.scenario import load_scenario
from tests.support.impostor import Impostor
from tests.support.waiting import DEADLINE_S

RUN = "ieee33"
ROUNDS = 300
LATER = 1_000_000  # scans ahead of the real plant
CONNECTIONS = 20


def publish_lies(endpoint: str, keys: Path | None, name: str) -> None:
    """As area2, tell lies in the name of others, and listen to what is not for area2."""
    scan = int(1000 * time.time()) + LATER
    lies = make_payloads(replace(load_scenario(RUN), seed=99), RUN, begin_incarnation(), scan)
    with (
        Impostor.calling([endpoint], keys, name) as liar,  # a session receives itself, whoever forbids it
        Impostor.calling([endpoint], keys, name) as ear,
    ):
        ear.listen(f"dsse/v3/{RUN}/area/*/state", telemetry_key(RUN, "area1"))
        ear.listen(all_from_neighbours(RUN, "area3"), all_from_neighbours(RUN, "area2"))  # the second is its due
        ear.listen(all_incarnations(RUN, "area", "*"), all_incarnations(RUN, "plant", "*"))
        ear.listen(all_incarnations(RUN, "area", "area1"), all_incarnations(RUN, "area", "area2"))
        liar.show(f"dsse/v3/{RUN}/live/area/area9/1-2")
        keys_of_others = {telemetry_key(RUN, area): lie for area, lie in lies.items()}
        for kind in ("information", "tally", "load"):
            keys_of_others[neighbour_key(RUN, "area3", kind, "area1")] = b"lie"
        keys_of_others |= {neighbour_key(RUN, "area9", "information", "area1"): b"lie", state_key(RUN, "area1"): b"lie"}
        puts = [put for key, lie in keys_of_others.items() for put in liar.publish([key], lie)]
        pause, deadline = threading.Event(), time.monotonic() + DEADLINE_S
        for _ in range(ROUNDS):
            for put in puts:
                put()
            pause.wait(0.002)
        while not any(key.endswith("/area2") for _, key in ear.received) and time.monotonic() < deadline:
            pause.wait(0.01)
        print(
            json.dumps({"received": sorted({key for _, key in ear.received}), "seen": sorted(ear.seen), "scan": scan})
        )


def connect(endpoint: str, keys: Path, name: str) -> None:
    """Get a link, whatever is wrong with the credentials."""
    try:
        with Session.connect([endpoint], 1.0, Keys(keys, name, Access(RUN, {}))):
            print("in")
    except TransportError as error:
        print(error)


def shout(endpoint: str, keys: Path | None, name: str) -> None:
    """Send rubbish to all areas in the name of one that does not exist, as fast as can be."""
    areas = [area.name for area in load_scenario(RUN).partition.areas]
    with Impostor.calling([endpoint], keys, name) as impostor:
        puts = impostor.publish([neighbour_key(RUN, "area9", "information", area) for area in areas], b"rubbish" * 20)
        for number in itertools.count():
            for put in puts:
                put()
            if number == ROUNDS:
                print("shouting", flush=True)


def flood(endpoint: str, wildly: bool) -> None:
    """Open connection after connection and send rubbish; ``wildly``: without waiting for what becomes of it."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")

    def go_on() -> None:
        while True:
            with suppress(OSError), socket.create_connection((host, int(port)), 1.0) as link:
                link.sendall(b"rubbish" * 100)
                if not wildly:
                    link.settimeout(DEADLINE_S)
                    link.recv(1)

    for _ in range(CONNECTIONS):
        threading.Thread(target=go_on, daemon=True).start()
    threading.Event().wait()


if __name__ == "__main__":
    what, at, *whose = sys.argv[1:]
    own = (Path(whose[0]), whose[1]) if whose else (None, "stranger")
    if what.startswith("flood"):
        flood(at, wildly=what == "flood-wildly")
    else:
        {"lie": publish_lies, "connect": connect, "shout": shout}[what](at, *own)  # type: ignore[operator]
