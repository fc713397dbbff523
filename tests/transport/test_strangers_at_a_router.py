"""A router without keys that knows who takes part in the run: what anybody else announces ends there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import pytest

from agents.messages.keys import all_live, all_readings, all_states
from agents.messages.packing import WIRE_VERSION
from agents.security.access import Access
from agents.transport.zenoh_bus import Router, Session
from coordinator.watch.observe.attachment import attach
from coordinator.watch.observe.run_address import RunAddress
from dsse_core.reading_rules import ANYBODY
from tests.support.speaking import speaking
from tests.support.waiting import DEADLINE_S, wait_until

ROOT = "dsse/v3/run"
PAIR = Access("run", {"a": ("b",), "b": ("a",)}, gateways={"north": ("a",)})
KEYS = (
    "area/a/up/b",
    "area/b/down/a",
    "area/a/state",
    "area/b/readings",
    "telemetry/a/plant",
    "telemetry/a/north",
    "command/a",
    "command/plant",
    "clock",
    "gateway/north",
)
TOKENS = (
    "run/live/area/a/1-00000001",
    "run/live/plant/plant/1-00000001",
    "run/live/gateway/north/1-00000001",
    "run/live/coordinator/coordinator/1-00000001",
)
KEYS_OF_STRANGERS = (
    "area/stranger/up/a",
    "area/stranger/state",
    "area/a/up/stranger",
    "area/a/state/more",
    "telemetry/stranger/plant",
    "telemetry/b/north",
    "telemetry/a/stranger",
    "gateway/stranger",
    "command/stranger",
    "anything",
)
TOKENS_OF_STRANGERS = (
    "run/live/area/stranger/1-00000001",
    "run/live/gateway/stranger/1-00000001",
    "run/live/plant/stranger/1-00000001",
    "run/live/stranger/a/1-00000001",
    "run/live/area/a/1/2",
    "other/live/area/a/1-00000001",
)
LISTENERS = {
    "a": (f"{ROOT}/area/*/*/a", f"{ROOT}/telemetry/a/*", f"{ROOT}/command/a", f"{ROOT}/clock"),
    "b": (f"{ROOT}/area/*/*/b", f"{ROOT}/telemetry/b/*"),
    "plant": (f"{ROOT}/command/plant",),
    "watcher": (all_states("run"), all_readings("run"), f"{ROOT}/command/*", f"{ROOT}/gateway/*"),
}


@contextmanager
def router_of(access: Access) -> Iterator[Router]:
    with Router.listen(["tcp/127.0.0.1:0"], access=access) as router:
        yield router


@contextmanager
def bus_of(access: Access) -> Iterator[tuple[Session, set[str], set[str]]]:
    """Somebody's session on a bus on which all listen; the keys of messages and tokens that anybody has received."""
    messages, tokens = set[str](), set[str]()
    with router_of(access) as router, ExitStack() as opened:
        for expressions in LISTENERS.values():
            session = opened.enter_context(Session.connect(router.endpoints))
            for expression in expressions:
                session.subscribe(expression, lambda key, payload: messages.add(key))
            session.watch_presence(all_live("run"), lambda key, alive: tokens.add(key))
            session.watch_presence("dsse/*/run/live/*/*/*", lambda key, alive: tokens.add(key))
        yield opened.enter_context(Session.connect(router.endpoints)), messages, tokens


def test_a_router_that_knows_its_run_passes_on_what_its_processes_publish_and_nothing_else() -> None:
    due = {f"{ROOT}/{key}" for key in KEYS}
    shown = {f"dsse/v3/{key}" for key in TOKENS} | {"dsse/v1/run/live/area/b/1-00000001"}
    with bus_of(PAIR) as (somebody, messages, tokens):
        for key in (*(f"dsse/v3/{key}" for key in TOKENS_OF_STRANGERS), *sorted(shown)):
            somebody.declare_presence(key)
        put = [somebody.publisher(f"{ROOT}/{key}") for key in (*KEYS_OF_STRANGERS, *KEYS)]

        def publish_all() -> bool:
            for publish in put:
                publish(b"")
            return messages >= due and tokens >= shown

        wait_until(publish_all)
        assert publish_all()  # once more, now that everybody knows who listens
        assert (messages, tokens) == (due, shown)


@pytest.mark.parametrize(("gateways", "passes"), [({}, False), ({ANYBODY: ("a", "b")}, True)])
def test_gateways_that_nobody_has_named_are_received_where_the_rules_allow_any(
    gateways: dict[str, tuple[str, ...]], passes: bool
) -> None:
    of_any, last = f"{ROOT}/telemetry/b/any", f"{ROOT}/command/plant"
    with bus_of(replace(PAIR, gateways=gateways)) as (somebody, messages, _):
        put = [somebody.publisher(key) for key in (of_any, last)]

        def publish_all() -> bool:
            for publish in put:
                publish(b"")
            return messages >= ({of_any, last} if passes else {last})

        wait_until(publish_all)
        wait_until(publish_all)
        assert (of_any in messages) == passes


def test_a_watcher_finds_a_run_whose_router_passes_on_nothing_else() -> None:
    with (
        router_of(PAIR) as router,
        speaking(router.endpoints, WIRE_VERSION, "run", "a"),
        attach(RunAddress(router.endpoints, None, DEADLINE_S)) as look,
    ):
        wait_until(lambda: look(0.05).names_of("area") == {"a"})
        assert look.run == "run"
