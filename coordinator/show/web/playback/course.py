"""The course of a play: the watcher at any moment of it, found without reading the play from its beginning."""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Iterator
from functools import cached_property

from agents.messages.packing import ReadingsMessage, StateMessage
from coordinator.show.web.moment import Events, find_links
from coordinator.show.web.playback.play import Play
from coordinator.watch.observe.watcher import Watcher
from coordinator.watch.replay.recorded_messages import Presence, Update

STEP = 64  # least number of updates between two copies of the watcher
MOST_LOOKS = 1000  # views of a play for its events and its past, beside those at which an area came or went
MOST_EVENTS = 50_000  # of a play


class WatchedPlay:
    """``play`` as a watcher would have seen it at each time. ``areas``: their names, if they are known."""

    def __init__(self, play: Play, areas: frozenset[str] | None) -> None:
        self._play, self._areas = play, areas
        self._times = [at for at, _ in play.updates]
        senders = {item.header.sender for _, item in play.updates if not isinstance(item, Presence)}
        self._step = max(STEP, len(senders))  # so that the copies together grow in proportion to the play
        self._kept: list[Watcher] = []
        watcher = Watcher(play.run, areas)
        for k, (at, item) in enumerate(play.updates):
            if k % self._step == 0:
                self._kept.append(watcher.copy())
            _show(watcher, at, item)

    def watcher_at(self, at: float) -> Watcher:
        """A watcher that has received all updates up to ``at``."""
        end = bisect.bisect_right(self._times, at)
        place = min(end // self._step, len(self._kept) - 1)
        watcher = self._kept[place].copy()
        for then, item in self._play.updates[place * self._step : end]:
            _show(watcher, then, item)
        return watcher

    def walk(self) -> Iterator[tuple[float, Watcher]]:
        """Each time of an update, with the watcher after it. In a play with more than ``MOST_LOOKS`` times: one time in
        each of ``MOST_LOOKS`` equal intervals, and each time at which an area came or went.
        """
        watcher, came_or_went = Watcher(self._play.run, self._areas), False
        for (at, item), following in zip(self._play.updates, [*self._times[1:], math.inf], strict=True):
            _show(watcher, at, item)
            came_or_went |= isinstance(item, Presence)
            if following > at and (came_or_went or self._slice_of(following) > self._slice_of(at)):
                came_or_went = False
                yield at, watcher

    @cached_property
    def _slice_s(self) -> float:
        """Interval of the times of ``walk``, s; 0: all times."""
        return (self._times[-1] - self._times[0]) / MOST_LOOKS if len({*self._times}) > MOST_LOOKS else 0.0

    def _slice_of(self, at: float) -> float:
        return (at - self._times[0]) // self._slice_s if self._slice_s and at < math.inf else at

    def find_events(self) -> Events:
        """The events of the play in the order of their times, the newest ``MOST_EVENTS`` of them."""
        events = Events(deque(maxlen=MOST_EVENTS))
        for at, watcher in self.walk():
            view = watcher.look(at)
            events.take(at, view, find_links(view))
        return events


def _show(watcher: Watcher, at: float, item: Update) -> None:
    match item:
        case StateMessage():
            watcher.take_state(item, at)
        case ReadingsMessage():
            watcher.take_readings(item)
        case Presence(key, alive):
            watcher.take_presence(key, alive, at)
