"""Source of a played run, moment by moment, forwards and backwards: every message between areas, every state."""

from __future__ import annotations

import bisect
import threading
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any

from agents.messages.packing import ReadingsMessage, StateMessage
from coordinator.show.web.drawing import Drawing, draw_scenario, draw_states, encode_drawing
from coordinator.show.web.moment import MOST_EVENTS, Moments, encode_json
from coordinator.show.web.playback.course import WatchedPlay
from coordinator.show.web.playback.play import Play, Sent
from coordinator.show.web.sources import Frame
from coordinator.watch.observe.grid_tables import GridTables, Tables, find_tables
from coordinator.watch.recording.folder import read_about
from coordinator.watch.replay.recorded_messages import Update, read_newest_messages
from coordinator.watch.replay.result_messages import RUN, holds_results, read_result_messages
from dsse_core.errors import InvalidInputError
from scenarios.scenario import Scenario

PATIENCE_S = 1.0  # wait of a request for a past that is not complete yet


class PastOfPlay:
    """The past of the play of ``course``. A thread goes through it, because tables of thousands of buses are slow."""

    def __init__(self, course: WatchedPlay, scenario: Scenario | None) -> None:
        self._course = course
        self._moments = Moments(GridTables(scenario) if scenario else None)
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._find, name="past of the play", daemon=True)
        self._beginning = threading.Lock()
        self._is_over = False

    def read(self, kind: str, name: str) -> dict[str, Any]:
        """Times and columns found after ``PATIENCE_S`` at most; ``complete``: True where the past is complete."""
        with self._beginning:
            if self._thread.ident is None:
                self._thread.start()
        self._thread.join(PATIENCE_S)
        is_complete = not self._thread.is_alive()
        with self._lock:
            return self._moments.history.read(kind, name) | {"complete": is_complete}

    def close(self) -> None:
        """Ends the computation of the past."""
        self._is_over = True

    def _find(self) -> None:
        for at, watcher in self._course.walk():
            if self._is_over:
                return
            with self._lock:
                self._moments.note(watcher, at, at)


MOST_FRAMES = 20_000


class PlaybackSource:
    """Source of ``play``, drawn from ``scenario`` if it is known. A frame is a time of an update or a message.

    ``remarks``: sentences about parts that it lacks. ``is_complete``: True where the play does not grow any more.
    ``drawing``: that of ``scenario``, if it has been made already. A frame is made on request, from the nearest earlier
    copy of the watcher, because all frames together may have gigabytes.

    Raises:
        ValueError: ``play`` has no updates.
    """

    mode = "playback"

    def __init__(
        self,
        play: Play,
        scenario: Scenario | None,
        remarks: Sequence[str] = (),
        *,
        drawing: Drawing | None = None,
        is_complete: bool = True,
    ) -> None:
        if not play.updates:
            raise ValueError("nothing has happened")
        self._play, self._known = play, GridTables(scenario) if scenario else None
        times = {at for at, _ in play.updates}
        times |= {at for sent in play.messages for at in (sent.at, sent.arrived) if at is not None}
        self._times = sorted(times)[:MOST_FRAMES]
        is_whole = not play.is_full and len(times) <= MOST_FRAMES
        self.remarks = (*remarks, *(() if is_whole else ("the run is long: its first part is played",)))
        self._sent_at = [sent.at for sent in play.messages]
        self._longest_way_s = max((s.arrived - s.at for s in play.messages if s.arrived is not None), default=0.0)
        names = frozenset(area.name for area in scenario.partition.areas) if scenario else None
        self._course = WatchedPlay(play, names)
        events = self._course.find_events()
        self._events, self._scan_s = list(events.kept), events.scan_s
        self._past = PastOfPlay(self._course, scenario)
        self._drawing = drawing or encode_drawing(_draw(play, scenario), self.mode)
        self.is_complete = is_complete

    def close(self) -> None:
        """Ends the computation of the past."""
        self._past.close()

    @cached_property
    def newest(self) -> Frame:
        return Frame(len(self._times), self.frame(len(self._times) - 1))

    @property
    def drawing(self) -> Drawing:
        return self._drawing

    def read_history(self, kind: str, name: str) -> dict[str, Any]:
        past = self._past.read(kind, name)
        return past | {"complete": past["complete"] and self.is_complete}

    @property
    def since(self) -> float:
        return self._play.since

    def times(self) -> Sequence[float]:
        return self._times

    def tables(self, number: int | None = None) -> Tables:
        at = self._times[len(self._times) - 1 if number is None else number]
        watcher = self._course.watcher_at(at)
        return find_tables(watcher, watcher.look(at), self._known)

    def frame(self, number: int) -> bytes:
        at, before = self._times[number], self._times[number - 1] if number else 0.0
        moment = Moments(self._known).make(
            self._course.watcher_at(at),
            at,
            at,
            number=number,
            grid_version=self._drawing.version,
            mode=self.mode,
            time=self._play.since + at,
            has_messages=bool(self._play.messages),
            messages=[_describe(sent, at) for sent in self._messages_at(before, at)],
        )
        end = bisect.bisect_right(self._events, at, key=itemgetter("time"))
        shown = {"events": self._events[max(0, end - MOST_EVENTS) : end], "scan_s": self._scan_s}
        return encode_json(moment | shown)

    def _messages_at(self, before: float, at: float) -> Iterator[Sent]:
        """Messages on their way at ``at``, and those that have arrived or were sent and lost since ``before``."""
        begin = bisect.bisect_left(self._sent_at, before - self._longest_way_s)
        for sent in self._play.messages[begin : bisect.bisect_right(self._sent_at, at)]:
            is_lost_now = sent.arrived is None and sent.at > before
            if is_lost_now or sent.at == at or (sent.arrived is not None and sent.arrived > before):
                yield sent


def _draw(play: Play, scenario: Scenario | None) -> dict[str, Any]:
    if scenario is not None:
        return draw_scenario(scenario)
    return draw_states(play.run, {s.header.sender: s for _, s in play.updates if isinstance(s, StateMessage)})


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


def play_recording(folder: Path, scenario: Scenario | None, notes: list[str]) -> PlaybackSource:
    """The recording, or the tables of results, at ``folder`` as a source; the newest part of a long one. Lost and
    omitted parts go to ``notes``.

    Raises:
        InvalidInputError: ``folder`` is neither, or nothing in it can be read, as without pyarrow where all of it is
            Parquet; tables of results without a scenario.
    """
    if holds_results(folder):
        if scenario is None:
            problem = "holds tables of results; name their scenario: dsse serve SCENARIO --recording FOLDER"
            raise InvalidInputError(str(folder), [problem])
        run, kept = RUN, read_result_messages(folder, scenario, notes)
    else:
        run = read_about(folder).run
        kept = read_newest_messages(folder, run, notes)
    since = kept[0][0]
    remarks = [*dict.fromkeys(notes), *_find_lacking(item for _, item in kept)]
    play = Play(run=run, since=since, updates=[(at - since, item) for at, item in kept])
    return PlaybackSource(play, scenario, remarks)


def _find_lacking(updates: Iterable[Update]) -> Iterator[str]:
    """Remarks on the content of a page that the recording lacks."""
    yield "a recording holds no messages between areas"
    used = [item for item in updates if isinstance(item, ReadingsMessage) and item.meters]
    if not used:
        yield "this one holds no readings"
    elif not any(item.estimates for item in used):
        yield "this one holds no estimate and no residual of its readings"
