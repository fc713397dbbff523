"""The process of an area that goes over: what it had declared ends, and no request of its user is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest

from agents.messages.packing import CommandMessage, encode
from agents.orders.order_book import OrderBook
from agents.protocol.configuration import Configuration
from agents.protocol.events import Action, Event, Finish, GoOver, Offered, Ordered, StopRequested
from agents.runtime import loop
from agents.runtime.inbox import Inbox
from agents.security.access import OPERATOR
from agents.transport.renewable_bus import Declaration
from coordinator.lab.deployment.split import area_files
from scenarios.scenario import load_scenario
from tests.support.sample_messages import HEADER

PRESENT, _ = area_files(load_scenario("industrial13"), "run", ["tcp/127.0.0.1:7447"], time=0.0)
NEXT = replace(PRESENT, tolerance=1e-7)
OFF = next(meter.id for meter in PRESENT.meters if meter.source != "virtual")


class Bus:
    """Stands in for a session; ``keys``: what is declared."""

    def __init__(self) -> None:
        self.declarations: tuple[Declaration, ...] = ()
        self.keys: dict[int, str] = {}

    def declare(self, key: str, *_: object) -> Callable[[bytes], None]:
        declared = Declaration(lambda bus: None)
        self.declarations += (declared,)
        self.keys[id(declared)] = key
        return lambda payload: None

    publisher = subscribe = watch_presence = declare_presence = declare

    def withdraw(self, declared: Declaration) -> None:
        self.declarations = tuple(other for other in self.declarations if other is not declared)

    def declared(self) -> list[str]:
        return [self.keys[id(declared)] for declared in self.declarations]


class Protocol:
    """Goes over when it is offered something, and ends when it is asked to."""

    follow_on = staticmethod(lambda: None)

    def __init__(self, content: Configuration, seen: list[tuple[Configuration, list[Event]]]) -> None:
        self._content, self._seen = content, seen

    def describe_backend(self) -> str:
        return ""

    def wait_s(self, now: float) -> float:
        return 1.0

    def handle(self, events: Sequence[Event], now: float) -> Iterator[Action]:
        self._seen.append((self._content, list(events)))
        for event in events:
            match event:
                case Offered(Configuration() as configuration):
                    yield GoOver(configuration)
                case StopRequested(reason):
                    yield Finish(reason)
                    return


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Configuration, list[Event]]]:
    """What the protocols have been given: the configuration, and events."""
    seen: list[tuple[Configuration, list[Event]]] = []
    monkeypatch.setattr(loop, "make_protocol", lambda content, *_, **__: Protocol(content, seen))
    return seen


def run(*events: Event, orders: OrderBook | None = None) -> Bus:
    bus, inbox = Bus(), Inbox()
    bus.declare("links")
    for k, event in enumerate(events):
        inbox.put(k, event)
    session: Any = bus
    assert loop.run_agent(PRESENT, session, inbox, orders=orders) == "the test is over"
    return bus


def test_a_request_to_stop_that_comes_with_the_going_over_is_followed(seen):
    run(Offered(NEXT), StopRequested("the test is over"))
    assert [content for content, _ in seen] == [PRESENT, PRESENT, NEXT, NEXT]


def test_what_the_configuration_before_had_declared_ends_and_the_token_states_the_new_split(seen):
    bus = run(Offered(NEXT), StopRequested("the test is over"))
    keys = bus.declared()
    assert keys[0] == "links"
    assert len(keys) == len(run(StopRequested("the test is over")).declared())
    (token,) = {key for key in keys if "/live/area/area1/" in key and not key.endswith("/*")}
    assert token.endswith(f"-{NEXT.identity.digest}-{0:x}-{NEXT.identity.edited[:8]}")


def test_meters_that_the_operator_has_switched_off_stay_off(seen):
    orders = OrderBook.of(PRESENT)
    header = replace(HEADER, run="run", sender=OPERATOR)
    list(orders.take(encode(CommandMessage(header, "area1", (OFF,), (), False, False)), header.time))
    run(Offered(NEXT), StopRequested("the test is over"), orders=orders)
    ordered = [event for content, events in seen if content == NEXT for event in events if isinstance(event, Ordered)]
    assert [event.meters_off for event in ordered] == [(OFF,)]
