"""A run that is over, moment by moment: every message between areas, every state, forwards and backwards."""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from agents.area_files.area_file import AreaFile
from agents.messages.keys import live_key
from agents.messages.packing import Header, Incarnation, Message, ReadingsMessage, StateMessage
from coordinator.observe.grid_tables import GridTables
from coordinator.observe.watch import Watcher
from coordinator.simulator.audience import Audience
from coordinator.simulator.simulate import Simulation
from coordinator.web.drawing import Drawing, draw_scenario, draw_states, encode_drawing
from coordinator.web.moment import Moments, encode_json
from coordinator.web.sources import Frame
from scenarios.scenario import Scenario

MOST_FRAMES = 20_000
IN_SIMULATION = Incarnation(1, 1)  # in whose name areas of a simulation are shown as present


@dataclass(frozen=True, slots=True)
class Presence:
    """The token ``key`` has appeared or vanished."""

    key: str
    alive: bool


@dataclass(slots=True)
class Sent:
    """A message on its way to ``receiver``; ``arrived``: when, None if it is lost."""

    sender: str
    receiver: str
    kind: str
    at: float
    arrived: float | None = None


Happening = StateMessage | ReadingsMessage | Presence


@dataclass
class Play(Audience):
    """What has happened in ``run``, in its order: ``happenings`` with their times, and ``messages`` between areas.

    Times are s from the begin of the play, which is ``since``, s since 1970; 0 where there was no such time.
    """

    run: str = ""
    since: float = 0.0
    happenings: list[tuple[float, Happening]] = field(default_factory=list)
    messages: list[Sent] = field(default_factory=list)
    _on_the_way: dict[tuple[object, ...], Sent] = field(default_factory=dict)

    def begin(self, run: str, files: Sequence[AreaFile]) -> None:
        self.run = run

    def take_state(self, at: float, state: StateMessage) -> None:
        self.happenings.append((at, state))

    def take_readings(self, at: float, readings: ReadingsMessage) -> None:
        self.happenings.append((at, readings))

    def take_presence(self, at: float, area: str, alive: bool) -> None:
        self.happenings.append((at, Presence(live_key(self.run, "area", area, IN_SIMULATION), alive)))

    def take_message(self, at: float, receiver: str, message: Message, arrives: bool) -> None:
        header, kind = message.header, message.kind
        identity = _identify(header, receiver, kind)
        if not arrives:
            sent = Sent(header.sender, receiver, kind, at)
            self.messages.append(sent)
            self._on_the_way[identity] = sent
        elif (found := self._on_the_way.pop(identity, None)) is not None:
            found.arrived = at


def _identify(header: Header, receiver: str, kind: str) -> tuple[object, ...]:
    return header.sender, receiver, kind, header.sequence, header.time


class PlaybackSource:
    """``play``, drawn from ``scenario`` if there is one; a frame is a time at which something has happened.

    Raises:
        ValueError: nothing has happened.
    """

    mode = "playback"

    def __init__(self, play: Play, scenario: Scenario | None) -> None:
        if not play.happenings:
            raise ValueError("nothing has happened")
        self._play, self._known = play, GridTables(scenario) if scenario else None
        self._areas = frozenset(area.name for area in scenario.partition.areas) if scenario else None
        times = {at for at, _ in play.happenings}
        times |= {at for sent in play.messages for at in (sent.at, sent.arrived) if at is not None}
        self._times = sorted(times)[:MOST_FRAMES]
        self._sent_at = [sent.at for sent in play.messages]
        self._moments = Moments(self._known)
        for at, watcher in self._walk():
            self._moments.note(watcher, at, at)
        estimates = {item.header.sender: item for _, item in play.happenings if isinstance(item, StateMessage)}
        drawn = draw_scenario(scenario) if scenario else draw_states(play.run, estimates)
        self._drawing = encode_drawing(drawn, self.mode)

    def _walk(self) -> Iterator[tuple[float, Watcher]]:
        """The watcher after each moment at which a state was published, or an area came or went."""
        watcher = Watcher(self._play.run, self._areas)
        happenings = self._play.happenings
        for k, (at, item) in enumerate(happenings):
            _show(watcher, at, item)
            if k + 1 == len(happenings) or happenings[k + 1][0] > at:
                yield at, watcher

    @property
    def newest(self) -> Frame:
        return Frame(len(self._times), self.frame(len(self._times) - 1))

    @property
    def drawing(self) -> Drawing:
        return self._drawing

    def read_history(self, kind: str, name: str) -> dict[str, Any]:
        key: Any = int(name) if kind == "bus" else name
        return self._moments.history.of[kind].read(key)

    @property
    def since(self) -> float:
        return self._play.since

    def times(self) -> Sequence[float]:
        return self._times

    def frame(self, number: int) -> bytes:
        """Made when it is asked for, from the beginning: of all frames together there may be gigabytes."""
        at = self._times[number]
        watcher = Watcher(self._play.run, self._areas)
        for then, item in self._play.happenings:
            if then > at:
                break
            _show(watcher, then, item)
        before = self._times[number - 1] if number else 0.0
        events = [event for event in self._moments.events.kept if event["time"] <= at]
        moment = Moments(self._known).make(
            watcher,
            at,
            at,
            number=number,
            grid_version=self._drawing.version,
            mode=self.mode,
            time=self._play.since + at,
            has_messages=bool(self._play.messages),
            messages=[_describe(sent, at) for sent in self._messages_at(before, at)],
        )
        return encode_json(moment | {"events": events})

    def _messages_at(self, before: float, at: float) -> Iterator[Sent]:
        """Those on their way, those that have just arrived, and those that were just lost."""
        for sent in self._play.messages[: bisect.bisect_right(self._sent_at, at)]:
            is_lost_now = sent.arrived is None and sent.at > before
            if is_lost_now or sent.at == at or (sent.arrived is not None and sent.arrived > before):
                yield sent


def _show(watcher: Watcher, at: float, item: Happening) -> None:
    match item:
        case StateMessage():
            watcher.take_state(item, at)
        case ReadingsMessage():
            watcher.take_readings(item)
        case Presence(key, alive):
            watcher.take_presence(key, alive)


def _describe(sent: Sent, at: float) -> dict[str, Any]:
    arrived = sent.arrived if sent.arrived is not None and sent.arrived <= at else None
    return {
        "from": sent.sender,
        "to": sent.receiver,
        "kind": sent.kind,
        "sent": sent.at,
        "arrived": arrived,
        "lost": sent.arrived is None,
    }


def play_simulation(scenario: Scenario) -> PlaybackSource:
    """Run ``scenario`` on the simulator, to its verdict or its time limit, and keep all that happens."""
    play = Play()
    simulation = Simulation(scenario, audience=play)
    simulation.run()
    return PlaybackSource(play, scenario)
