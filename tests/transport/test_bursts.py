"""What an area says at the end of a scan, a dozen small messages at once, arrives whole: recorders get each once."""

from __future__ import annotations

import time

from agents.transport.zenoh_bus import Router, Session

BURST, BURSTS, DEADLINE_S = 12, 400, 60.0


def test_no_message_of_a_burst_is_dropped_before_it_is_sent(router: Router):
    received: list[bytes] = []
    with Session.connect(router.endpoints) as listener, Session.connect(router.endpoints) as sender:
        listener.subscribe("dsse/burst/*", lambda key, payload: received.append(payload))
        publishers = [sender.publisher(f"dsse/burst/{k}") for k in range(BURST)]
        _wait(lambda: bool(received), lambda: publishers[0](b""))
        for burst in range(BURSTS):
            for k, put in enumerate(publishers):
                put(b"%d %d" % (burst, k) + bytes(600))
            _wait(lambda expected=(burst + 1) * BURST: len(set(received) - {b""}) >= expected)  # type: ignore[misc]


def _wait(holds, again=lambda: None) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not holds():
        assert time.monotonic() < deadline, "a message is lost"
        again()
        time.sleep(0.0005)
