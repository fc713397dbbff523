"""Two linked routers are one bus, and neighbours can do without any; each comes, goes and comes again."""

import itertools

import pytest

from agents.transport.zenoh_bus import Router, Session, TransportError
from tests.support.dsse_command import free_endpoint
from tests.support.waiting import wait_until


@pytest.fixture
def free_endpoints():
    """Endpoints on free ports; all different."""
    found = set()
    while len(found) < 2:
        found.add(free_endpoint())
    return list(found)


@pytest.fixture
def closing():
    """Close what was opened, whatever happens."""
    opened = []
    yield lambda thing: opened.append(thing) or thing
    for thing in reversed(opened):
        thing.close()


def publish_until_received(session, key, received):
    """Put numbered payloads on ``key`` until one that is new has been received."""
    put = session.publisher(key)
    numbers = itertools.count(len(received))
    before = len(received)

    def put_until_received():
        put(b"%d" % next(numbers))
        return len(received) > before

    wait_until(put_until_received)


def test_clients_of_two_linked_routers_receive_each_other_and_survive_the_loss_of_one(free_endpoints, closing):
    first = closing(Router.listen(free_endpoints[:1]))
    closing(Router.listen(free_endpoints[1:], others=free_endpoints[:1]))
    received, presence = [], []
    listener = closing(Session.connect(free_endpoints))  # of the first, which is the one to be lost
    listener.subscribe("dsse/test/a", lambda key, payload: received.append(payload))
    listener.watch_presence("dsse/live/*", lambda key, alive: presence.append(alive))
    sender = closing(Session.connect(free_endpoints[1:]))
    sender.declare_presence("dsse/live/speaker")
    publish_until_received(sender, "dsse/test/a", received)
    wait_until(lambda: presence and presence[-1])
    first.close()
    publish_until_received(sender, "dsse/test/a", received)
    wait_until(lambda: presence[-1])
    assert len(received) == len(set(received))


def test_neighbours_link_directly_in_any_order_and_again_after_one_was_gone(free_endpoints, closing):
    received, presence = [], []
    child = closing(Session.meet(free_endpoints[:1], listen=free_endpoints[1:]))  # nobody is there yet
    child.subscribe("dsse/test/*", lambda key, payload: received.append(payload))
    child.watch_presence("dsse/live/*", lambda key, alive: presence.append(alive))
    for _ in range(2):
        parent = closing(Session.meet((), listen=free_endpoints[:1]))
        parent.declare_presence("dsse/live/parent")
        publish_until_received(parent, "dsse/test/a", received)
        wait_until(lambda: presence and presence[-1])
        parent.close()
        wait_until(lambda: not presence[-1])


def test_what_passes_between_two_others_does_not_pass_here(free_endpoints, closing):
    received = {"middle": [], "end": []}
    middle = closing(Session.meet((), listen=free_endpoints[:1]))
    one = closing(Session.meet(free_endpoints[:1]))
    end = closing(Session.meet(free_endpoints[:1]))
    for session, name in ((middle, "middle"), (end, "end")):
        session.subscribe("dsse/test/*", lambda key, payload, name=name: received[name].append(key))
    publish_until_received(one, "dsse/test/a", received["middle"])
    publish_until_received(middle, "dsse/test/b", received["end"])
    assert set(received["end"]) == {"dsse/test/b"}


def test_a_neighbour_names_the_endpoint_that_is_occupied(free_endpoints, closing):
    closing(Session.meet((), listen=free_endpoints[:1]))
    with pytest.raises(TransportError, match="in use"):
        Session.meet((), listen=free_endpoints[:1])
