"""The traps of Zenoh, each avoided: exit hangs, lost tokens, silent peers, occupied and unreachable endpoints."""

import socket
import subprocess
import sys
import textwrap
import threading
import time

import pytest

from agents.transport.zenoh_bus import Router, Session, TransportError

DEADLINE_S = 180.0


def wait_for(condition):
    deadline = time.monotonic() + DEADLINE_S
    pause = threading.Event()
    while not condition():
        assert time.monotonic() < deadline, "the condition did not come true in time"
        pause.wait(0.01)


@pytest.fixture
def connect(router):
    sessions = []

    def open_session():
        sessions.append(Session.connect(router.endpoints))
        return sessions[-1]

    yield open_session
    for session in sessions:
        session.close()


def test_a_router_on_port_0_says_where_it_listens(router):
    (endpoint,) = router.endpoints
    assert endpoint.startswith("tcp/127.0.0.1:")
    assert not endpoint.endswith(":0")


def test_clients_of_one_router_receive_each_other(connect):
    received = []
    connect().subscribe("dsse/test/*", lambda key, payload: received.append((key, payload)))
    put = connect().publisher("dsse/test/a")

    def put_until_received():
        put(b"hello")  # repeated: what is put before the router knows the subscriber is lost
        return bool(received)

    wait_for(put_until_received)
    assert received[0] == ("dsse/test/a", b"hello")


def test_a_late_watcher_sees_who_is_there_and_who_leaves(connect):
    area = connect()
    area.declare_presence("dsse/live/area/area1")
    changes = []
    connect().watch_presence("dsse/live/**", lambda key, alive: changes.append((key, alive)))
    wait_for(lambda: ("dsse/live/area/area1", True) in changes)
    area.close()
    wait_for(lambda: ("dsse/live/area/area1", False) in changes)


def test_those_who_are_there_are_found_at_once(connect):
    area, asking = connect(), connect()
    area.declare_presence("dsse/live/area/area1/1-7")
    wait_for(lambda: asking.find_presence("dsse/live/area/area1/*", DEADLINE_S) == ("dsse/live/area/area1/1-7",))
    assert asking.find_presence("dsse/live/area/area2/*", DEADLINE_S) == ()


def test_an_occupied_endpoint_is_named():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(TransportError, match="in use") as caught:
            Router.listen([endpoint])
    assert endpoint in str(caught.value)


def test_an_unreachable_endpoint_is_named():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound, not listening: nobody answers
        endpoint = f"tcp/127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(TransportError) as caught:
            Session.connect([endpoint], timeout_s=0.3)
    assert endpoint in str(caught.value)


@pytest.mark.parametrize("end", ["pass", "raise SystemExit(3)", "raise RuntimeError('boom')"])
def test_a_process_with_a_subscriber_ends_however_its_block_ends(router, end):
    code = f"""
    from agents.transport.zenoh_bus import Session
    with Session.connect({list(router.endpoints)!r}) as session:
        session.subscribe("dsse/**", lambda key, payload: None)
        session.declare_presence("dsse/live/x")
        {end}
    """
    finished = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], timeout=DEADLINE_S, capture_output=True, check=False
    )
    assert finished.returncode == {"pass": 0, "raise SystemExit(3)": 3}.get(end, 1)


def test_a_router_takes_more_clients_than_shared_memory_would_allow(router):
    sessions = []
    try:
        for _ in range(360):  # with shared memory on, the 352nd client is rejected
            sessions.append(Session.connect(router.endpoints))
    finally:
        for session in sessions:
            session.close()
    assert len(sessions) == 360
