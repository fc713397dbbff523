"""Two operators at once: no order is lost, whichever comes first and whatever each has seen of the other."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agents.messages.packing import Incarnation, StateMessage
from agents.orders.order_book import OrderBook
from agents.orders.order_file import OrderFile
from agents.protocol.events import Ordered
from coordinator.field.operate.operator import Operator
from dsse_core.errors import InvalidInputError
from tests.support.shown_states import a_state

RUN = "run"
METERS = {"area1": ("vm@1", "vm@2"), "area2": ("vm@3",)}
START_MS = int(1000 * time.time())


class Areas:
    """The areas of a run as operators see them: each follows commands, and shows what it has followed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.books: dict[str, OrderBook] = {}
        self.states = {area: a_state() for area in METERS}
        self.restart()

    def restart(self) -> None:
        files = {area: OrderFile.of(self._folder / f"{area}.toml", RUN, area) for area in METERS}
        self.books = {area: OrderBook(area, RUN, METERS[area], files[area]) for area in METERS}

    def publisher(self, key: str) -> Callable[[bytes], None]:
        area = next(area for area in METERS if area in key)
        return lambda payload: self.take(area, payload)

    def take(self, area: str, payload: bytes) -> None:
        for event in self.books[area].take(payload, time.time()):
            if isinstance(event, Ordered):
                self.states[area] = replace(self.states[area], command=event.order, meters_off=event.meters_off)

    def meters_off(self) -> set[str]:
        return {meter for state in self.states.values() for meter in state.meters_off}


class View:
    """What one operator has seen of the areas when it last looked; ``before_look``: what happens meanwhile."""

    def __init__(self, areas: Areas, before_look: Callable[[], object] = lambda: None) -> None:
        self._areas, self._before_look = areas, before_look
        self._seen = dict(areas.states)

    def __call__(self, duration_s: float) -> View:
        self._before_look()
        self._seen = dict(self._areas.states)
        return self

    def state_of(self, area: str) -> StateMessage:
        return self._seen[area]


def operator(areas: Areas, random: int, before_look: Callable[[], object] = lambda: None) -> Operator:
    view: Any = View(areas, before_look)
    session: Any = areas
    return Operator(session, RUN, view, 20.0, view, tuple(METERS), (), Incarnation(START_MS, random))


@pytest.mark.parametrize("second", [1, 9], ids=["with the lower number", "with the higher number"])
@pytest.mark.parametrize("meter", ["vm@2", "vm@3"])
def test_orders_of_two_operators_who_have_not_seen_each_other_add_up(tmp_path: Path, second: int, meter: str):
    areas = Areas(tmp_path)
    first, other = operator(areas, 5), operator(areas, second)
    assert first.switch_off(["vm@1"]) == {"vm@1": "area1"}
    assert other.switch_off([meter])[meter] == ("area1" if meter == "vm@2" else "area2")
    assert areas.meters_off() == {"vm@1", meter}
    areas.restart()
    assert {m for book in areas.books.values() for event in book.begin() for m in event.meters_off} == {"vm@1", meter}


@pytest.mark.parametrize("second", [1, 9], ids=["with the lower number", "with the higher number"])
def test_an_order_that_another_operator_has_overtaken_is_given_again(tmp_path: Path, second: int):
    areas = Areas(tmp_path)
    late, prompt = operator(areas, 5), operator(areas, second)
    received: list[tuple[str, bytes]] = []

    def lose(area: str) -> Callable[[bytes], None]:
        return lambda payload: received.append((area, payload))

    late._publishers |= {area: lose(area) for area in METERS}  # its first commands are on their way

    def overtake() -> None:
        if received and "vm@1" not in areas.meters_off() and "vm@2" not in areas.meters_off():
            prompt.switch_off(["vm@2"])
            for area, payload in received:
                areas.take(area, payload)  # and come after those of the other one
            late._publishers.clear()

    late.look._before_look = overtake  # type: ignore[attr-defined]
    assert late.switch_off(["vm@1"]) == {"vm@1": "area1"}
    assert areas.meters_off() == {"vm@1", "vm@2"}


def test_an_order_is_done_when_it_is_followed_itself_not_when_another_one_is(tmp_path: Path):
    areas = Areas(tmp_path)
    operator(areas, 5).switch_off(["vm@1", "vm@2"])
    one, other = operator(areas, 6), operator(areas, 7)
    assert other.switch_on(["vm@2"]) == {"vm@2": "area1"}
    assert one.switch_on(["vm@1"]) == {"vm@1": "area1"}
    assert areas.meters_off() == set()


def test_a_meter_that_no_area_has_is_refused_with_what_is_near_it(tmp_path: Path):
    areas = Areas(tmp_path)
    voltages = {name: (1.0,) * 3 for name in ("vm", "va", "sigma_vm", "sigma_va")}
    areas.states["area2"] = a_state(**voltages, buses=(671, 671, 680), phases=("a", "b", "a"))
    with pytest.raises(InvalidInputError) as refused:
        operator(areas, 5).switch_off(["vm@2", "vm@671.c", "vm@672"])
    first, second = refused.value.problems
    assert "no area has a meter 'vm@671.c' (bus 671 is in area2, with phases a, b); ids are in the area files" in first
    assert "no area has a meter 'vm@672' (no area shows bus 672; near are 1, 671, 680); ids are" in second
    assert areas.meters_off() == set()
