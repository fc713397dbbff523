"""The asynchronous protocol of one area: events and time in, actions out. No bus, no clock, no randomness.

Solve when there is news; tell a neighbour when what it should hear has changed; repeat the last words at a
slow beat, so that a lost last message does not matter. Messages are absolute: of each sender the newest
(incarnation, sequence) counts, whatever was lost, repeated or overtaken on the way.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from agents.area_file import AreaFile
from agents.events import Action, Event, Finish, PresenceChanged, Publish, Received, Refused, StopRequested
from agents.freshness import find_fresh
from agents.hearing import Hearing
from agents.last_words import LastWords
from agents.messages import (
    AdmmMessage,
    BoundaryMessage,
    BoundaryNews,
    Header,
    Incarnation,
    LoadMessage,
    Message,
    TelemetryMessage,
)
from agents.quality import find_missing_readings, find_refused_clocks
from agents.readings import Readings
from agents.refusals import FUTURE, find_lead, find_refusal, find_unreasonable
from agents.reminders import Reminders
from agents.shown_state import ShownState
from agents.strategies.interface import Estimate, Knowledge, Strategy
from agents.strategies.start import find_no_load
from dsse_core.boundary_load import NetLoad


class AreaProtocol:
    """One area's part in the exchange.

    Args:
        started_at: wall-clock time, s since 1970, at monotonic time ``now``; only stamps messages.
    """

    def __init__(
        self, content: AreaFile, strategy: Strategy, incarnation: Incarnation, *, now: float, started_at: float
    ) -> None:
        self._content = content
        self._area = content.area
        self._strategy = strategy
        self._incarnation = incarnation
        self._clock_offset = started_at - now
        self._now = now
        self._next_beat = now + content.beat_s
        self._reminders = Reminders(content.beat_s)
        self._by_name = {n.area: n for n in self._area.neighbours}
        _, self._no_load_va = find_no_load(content.area)
        self._hearing = Hearing(content.beat_s)
        self._used: set[str] = set()  # neighbours whose boundary message is in use
        self._readings = Readings(content)
        self._words = LastWords(content.area.neighbours, self._hearing, self._header)
        self._estimate_told: Estimate | None = None  # to neighbours, the last
        self._state = ShownState(content, self._hearing, self._header)
        self._present: set[str] = set()
        self._gone: dict[str, str] = {}  # neighbour -> its farewell
        self._refused: Counter[str] = Counter()
        self._not_let_in: dict[str, int] = {}
        self._ahead: dict[
            str, float
        ] = {}  # neighbour, or "" for the plant, refused as from the future -> by how much, s

    def describe_backend(self) -> str:
        """See ``Strategy.describe_backend``."""
        return self._strategy.describe_backend()

    def wait_s(self, now: float) -> float:
        """How long the protocol may be left alone, s."""
        at = min(self._next_beat, self._reminders.next_due(), self._hearing.next_change(now))
        return max(0.0, at - now)

    def handle(self, events: Sequence[Event], now: float) -> Iterator[Action]:
        """Take in ``events``, all that arrived since the last call, and say what to do.

        To be carried out one by one as they come: neighbours need not wait for what only watchers see.
        """
        self._now = now
        news = now >= self._next_beat  # an iteration that ran out of steps goes on
        for event in events:
            match event:
                case StopRequested(reason):
                    yield Finish(reason)
                    return
                case Received(message, key_sender):
                    news |= self._take(message, key_sender)
                case Refused(reason, count):
                    self._not_let_in[reason] = max(count, self._not_let_in.get(reason, 0))
                case PresenceChanged(area, True):
                    self._present.add(area)
                    self._gone.pop(area, None)
                    news = True
                case PresenceChanged(area, False, farewell):
                    self._present.discard(area)
                    self._gone[area] = farewell
                    news = True
        done: list[Action] = []
        for action in self._react(news):
            done.append(action)
            yield action
        if now >= self._next_beat:
            self._next_beat = now + self._content.beat_s
            yield from self._repeat(done)

    def _react(self, news: bool) -> Iterator[Action]:
        used = set(self._hearing.usable(self._now))
        if self._hearing.telemetry is None:
            yield from self._show_state(None, ())
        elif news or used != self._used:
            self._used = used
            yield from self._work()
        elif self._state.has_aged(self._gone, self._now):
            yield self._renew_state()
        for name in self._reminders.take_due(self._now):
            yield Publish(self._words.boundary[name], name)
        yield from self._tell_freshness()

    # What comes in

    def _take(self, message: Message, key_sender: str) -> bool:
        """Keep ``message`` if it is the newest of its sender, else drop it; count what should not have come.

        False for what should not, for an older message and for a repeat. That clocks disagree is news once, and so is
        that they agree again.
        """
        reason = find_refusal(message, key_sender, self._content, self._now + self._clock_offset)
        if not reason and not isinstance(message, TelemetryMessage | LoadMessage):
            is_known = isinstance(message, BoundaryMessage | AdmmMessage) and message.kind == self._strategy.kind
            reason = self._strategy.find_refusal(cast("BoundaryNews", message)) if is_known else "other strategy"
        if reason:
            self._refused[reason] += 1
            if reason != FUTURE or key_sender in self._ahead:
                return False
            self._ahead[key_sender] = find_lead(message.header, self._now + self._clock_offset)
            return True
        agrees_again = self._ahead.pop(key_sender, None) is not None
        if isinstance(message, TelemetryMessage):
            if not self._hearing.take_telemetry(message, self._now):
                return agrees_again
            for reason in self._readings.take(message):
                self._refused[reason] += 1
        elif isinstance(message, LoadMessage | BoundaryMessage | AdmmMessage) and not self._hearing.take(
            message, self._now
        ):
            return agrees_again
        return True

    # What goes out

    def _work(self) -> Iterator[Action]:
        """Tell what is new. Numbers beyond all reason, a neighbour's perhaps, leave no estimate and no crash."""
        problem = ""
        for _ in range(2):  # with all that was heard; if that leads nowhere, from the own telemetry alone
            try:
                yield from self._words.tell_loads(self._readings.net_load, self._heard_loads())
                yield from self._estimate()
                break
            except (ArithmeticError, np.linalg.LinAlgError, RuntimeError, ValueError) as error:
                problem = f"no estimate: {type(error).__name__}: {error}"
                self._start_anew()
        else:
            yield from self._show_state(None, (problem,))
        self._stop_answered_reminders()

    def _start_anew(self) -> None:
        """Forget what cannot be computed with, as a restart would: where the iteration is, and all that was heard.

        What the neighbours have been told on such a ground is replaced by the first estimate that follows.
        """
        self._strategy, self._estimate_told = type(self._strategy)(self._content), None
        self._hearing.forget_neighbours()
        self._refused["led to no estimate"] += 1

    def _estimate(self) -> Iterator[Action]:
        """Solve, tell the neighbours what is new, and show the state."""
        estimate, notes = self._strategy.solve(self._knowledge())
        self._check_reasonable(estimate)
        if estimate is not None and self._is_to_be_told(estimate):
            self._estimate_told = estimate
            yield from self._tell_boundaries(estimate)
        yield from self._show_state(estimate, notes)

    def _check_reasonable(self, estimate: Estimate | None) -> None:
        """Raise ``ArithmeticError`` if no grid can be in this state."""
        if estimate is not None and not estimate.is_reasonable(self._no_load_va):
            raise ArithmeticError("it is beyond reason")

    def _is_to_be_told(self, estimate: Estimate) -> bool:
        """To somebody: the readings of a new scan may be the same, and a neighbour's turn may come later."""
        sent = [self._words.boundary.get(n.area) for n in self._area.neighbours]
        return estimate is not self._estimate_told or any(map(self._words.is_outdated, sent))

    def _knowledge(self) -> Knowledge:
        return Knowledge(
            measurements=self._readings.measurements,
            loads=self._heard_loads(),
            boundary={name: m for name, m in self._hearing.boundary.items() if name in self._used},
            present=frozenset(self._present),
            scan=self._scan,
        )

    def _heard_loads(self) -> dict[str, NetLoad]:
        return {name: message.load for name, message in sorted(self._hearing.loads.items())}

    def _tell_boundaries(self, estimate: Estimate) -> Iterator[Action]:
        fresh = self._find_fresh()
        for n in self._area.neighbours:
            last = self._words.boundary.get(n.area)
            message = replace(self._strategy.message_for(n, estimate, self._header(last)), fresh=fresh[n.area])
            _check_sayable(message, self._strategy.find_refusal(message))
            if last is None or self._words.is_outdated(last) or self._strategy.is_news(n, message, last):
                self._reminders.start(n.area, self._now)
                yield self._words.tell_boundary(message, n.area)

    def _tell_freshness(self) -> Iterator[Publish]:
        return self._words.tell_freshness(self._find_fresh())

    def _find_fresh(self) -> dict[str, bool]:
        return find_fresh(self._hearing, list(self._by_name), set(self._gone), self._now)

    def _stop_answered_reminders(self) -> None:
        for n in self._area.neighbours:
            if not self._strategy.awaits_answer(n):
                self._reminders.stop(n.area)

    def _show_state(self, estimate: Estimate | None, notes: Sequence[str]) -> list[Action]:
        sent = (self._words.loads, self._words.boundary)
        remarks = list(find_refused_clocks(self._ahead))
        if self._hearing.telemetry is not None:
            remarks += find_missing_readings(self._readings.silent, self._readings.invalid)
        state = self._state.change(estimate, notes, remarks, sent, self._gone, self._all_refused, self._now)
        return [Publish(state, None)] if state else []

    def _renew_state(self) -> Publish:
        return Publish(self._state.renew(self._gone, self._all_refused, self._now), None)

    @property
    def _all_refused(self) -> Mapping[str, int]:
        """By the protocol and at the door."""
        return self._refused + Counter(self._not_let_in) if self._not_let_in else self._refused

    def _repeat(self, just_done: Sequence[Action]) -> list[Publish]:
        """The last message to each neighbour and the last state, except those sent this very moment."""
        just_sent = {id(action.message) for action in just_done if isinstance(action, Publish)}
        list(self._tell_freshness())  # with the repeats
        last_words = list(self._words.repeat())
        if self._state.message is not None and id(self._state.message) not in just_sent:
            last_words.append(self._renew_state())
        return [publish for publish in last_words if id(publish.message) not in just_sent]

    @property
    def _scan(self) -> int:
        return self._hearing.scan

    def _header(self, last: Message | None) -> Header:
        return Header(
            run=self._content.run,
            sender=self._area.name,
            incarnation=self._incarnation,
            scan=self._scan,
            sequence=last.header.sequence + 1 if last else 1,
            time=self._now + self._clock_offset,
        )


def _check_sayable(message: BoundaryNews, refusal: str = "") -> None:
    """Raise ``ArithmeticError`` if the neighbour will refuse ``message``."""
    if reason := refusal or find_unreasonable(message):
        raise ArithmeticError(f"what it would tell a neighbour: {reason}")
