"""Two linked routers are one bus, and neighbours can do without any; each comes, goes and comes again."""

import itertools

import pytest
from dsse_command import free_endpoint
from waiting import wait_until

from agents.transport.zenoh_bus import Router, Session, TransportError


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


def speak_until_heard(session, key, heard):
    """Put numbered payloads on ``key`` until one that is new has been heard."""
    put = session.publisher(key)
    numbers = itertools.count(len(heard))
    before = len(heard)

    def put_until_heard():
        put(b"%d" % next(numbers))
        return len(heard) > before

    wait_until(put_until_heard)


def test_clients_of_two_linked_routers_hear_each_other_and_survive_the_loss_of_one(free_endpoints, closing):
    first = closing(Router.listen(free_endpoints[:1]))
    closing(Router.listen(free_endpoints[1:], others=free_endpoints[:1]))
    heard, presence = [], []
    listener = closing(Session.connect(free_endpoints))  # of the first, which is the one to be lost
    listener.subscribe("dsse/test/a", lambda key, payload: heard.append(payload))
    listener.watch_presence("dsse/live/*", lambda key, alive: presence.append(alive))
    speaker = closing(Session.connect(free_endpoints[1:]))
    speaker.declare_presence("dsse/live/speaker")
    speak_until_heard(speaker, "dsse/test/a", heard)
    wait_until(lambda: presence and presence[-1])
    first.close()
    speak_until_heard(speaker, "dsse/test/a", heard)
    wait_until(lambda: presence[-1])
    assert len(heard) == len(set(heard))


def test_neighbours_link_directly_in_any_order_and_again_after_one_was_gone(free_endpoints, closing):
    heard, presence = [], []
    child = closing(Session.meet(free_endpoints[:1], listen=free_endpoints[1:]))  # nobody is there yet
    child.subscribe("dsse/test/*", lambda key, payload: heard.append(payload))
    child.watch_presence("dsse/live/*", lambda key, alive: presence.append(alive))
    for _ in range(2):
        parent = closing(Session.meet((), listen=free_endpoints[:1]))
        parent.declare_presence("dsse/live/parent")
        speak_until_heard(parent, "dsse/test/a", heard)
        wait_until(lambda: presence and presence[-1])
        parent.close()
        wait_until(lambda: not presence[-1])


def test_what_passes_between_two_others_does_not_pass_here(free_endpoints, closing):
    heard = {"middle": [], "end": []}
    middle = closing(Session.meet((), listen=free_endpoints[:1]))
    one = closing(Session.meet(free_endpoints[:1]))
    end = closing(Session.meet(free_endpoints[:1]))
    for session, name in ((middle, "middle"), (end, "end")):
        session.subscribe("dsse/test/*", lambda key, payload, name=name: heard[name].append(key))
    speak_until_heard(one, "dsse/test/a", heard["middle"])
    speak_until_heard(middle, "dsse/test/b", heard["end"])
    assert set(heard["end"]) == {"dsse/test/b"}


def test_a_neighbour_names_the_endpoint_that_is_occupied(free_endpoints, closing):
    closing(Session.meet((), listen=free_endpoints[:1]))
    with pytest.raises(TransportError, match="in use"):
        Session.meet((), listen=free_endpoints[:1])
