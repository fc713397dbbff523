"""All schedules of the toy within bounds: what befalls each of the first messages, and one event at any moment.

Exploration is by replay: a schedule says which messages are not delivered promptly, and everything else follows.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

from tests.support.toy_estimation import toy_numbers
from tests.support.toy_rounds import HEARTBEAT_S, TRAVEL_S, RoundsMessage, ToyBus

LOST = None
DELAYS_S = (2.3 * TRAVEL_S, 0.015)  # behind the answers to others; behind a repeat of itself
FATES = (LOST, *DELAYS_S)
SHORT_S, LONG_S = 0.0025, 2.5  # a moment of the exchange, and beyond the patience
LIMIT_S = 12.0
Event = Callable[[ToyBus], None]


@dataclass(frozen=True)
class Schedule:
    """``deviations``: number of a message -> its fate. ``event``: what happens after area events number ``moment``."""

    tree: str
    deviations: tuple[tuple[int, float | None], ...]
    event: str = ""
    moment: int = 0


def events_of(tree: str) -> Mapping[str, Event]:
    """By name, what may happen once: a crash with restart, a cut with healing, two revisions at once."""
    files = ToyBus(tree).files
    events: dict[str, Event] = {}
    for name, (how_long, away_s) in itertools.product(files, (("short", SHORT_S), ("long", LONG_S))):
        events[f"{name} crashes, {how_long}"] = partial(_crash, name, away_s)
    links = [(name, n.area) for name, content in files.items() for n in content.area.neighbours if name < n.area]
    for link, (how_long, away_s) in itertools.product(links, (("short", SHORT_S), ("long", LONG_S))):
        events[f"{link[0]}-{link[1]} is cut, {how_long}"] = partial(_cut, link, away_s)
    for one, other in itertools.combinations(files, 2):
        events[f"{one} and {other} have late readings"] = partial(_read_both, one, other)
        events[f"{one} and {other} crash at once"] = partial(_crash_both, one, other)
    events["the next scan"] = ToyBus.next_scan
    return events


def _crash(name: str, away_s: float, bus: ToyBus) -> None:
    bus.kill(name)
    bus.at(bus.now + away_s, partial(bus.start, name))


def _crash_both(one: str, other: str, bus: ToyBus) -> None:
    for name in (one, other):
        _crash(name, SHORT_S, bus)


def _cut(link: tuple[str, str], away_s: float, bus: ToyBus) -> None:
    both = link, link[::-1]
    bus.cut(*both)
    bus.at(bus.now + away_s, partial(bus.heal, *both))


def _read_both(one: str, other: str, bus: ToyBus) -> None:
    for name in (one, other):
        bus.read(name, bus.scan, 0.9)


def live_through(schedule: Schedule, events: Mapping[str, Event]) -> int:
    """Until all is well; how many messages there were until then.

    Raises:
        AssertionError: somebody waits for ever, two verdicts, an area counted twice or not at all.
    """
    number = itertools.count()
    deviations = dict(schedule.deviations)

    def find_fate(sender: str, receiver: str, message: RoundsMessage) -> float | None:
        return deviations.get(next(number), TRAVEL_S)

    with toy_numbers():
        bus = ToyBus(schedule.tree, find_fate)
        moments = itertools.count(1)

        def may_happen() -> None:
            if next(moments) == schedule.moment:
                events[schedule.event](bus)

        if schedule.event:
            bus.on_handled = may_happen
        bus.has_tokens = "crash" not in schedule.event
        bus.run(0.1)
        messages = next(number)
        bus.run(LONG_S + HEARTBEAT_S if "long" in schedule.event else HEARTBEAT_S)
        bus.run_until_at_rest(LIMIT_S)
    return messages


def count_moments(tree: str) -> int:
    """Area events of an exchange without faults."""
    with toy_numbers():
        bus = ToyBus(tree)
        bus.run(0.05)
        return bus.handled


def all_schedules(tree: str, most_deviations: int, with_event: int) -> Iterator[Schedule]:
    """Every schedule with so many deviations of single messages, and with so many beside one event."""
    messages = live_through(Schedule(tree, ()), {})
    for count in range(most_deviations + 1):
        for deviations in _deviate(messages, count):
            yield Schedule(tree, deviations)
    for event, moment in itertools.product(events_of(tree), range(1, count_moments(tree) + 1)):
        for count in range(with_event + 1):
            for deviations in _deviate(messages, count):
                yield Schedule(tree, deviations, event, moment)


def _deviate(messages: int, count: int) -> Iterator[tuple[tuple[int, float | None], ...]]:
    for numbers in itertools.combinations(range(messages), count):
        for fates in itertools.product(FATES, repeat=count):
            yield tuple(zip(numbers, fates, strict=True))
