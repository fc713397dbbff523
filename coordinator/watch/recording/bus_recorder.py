"""The recorder on the bus: a listener that writes the readings and states of all areas of a run."""

from __future__ import annotations

import logging
import signal
import sys
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Event

from agents.messages.keys import all_gateways, publisher_of
from agents.runtime.log import start_log
from agents.runtime.presence import read_leave
from agents.runtime.renewal import on_hangup
from agents.runtime.watchdog import Watchdog
from agents.security.access import COORDINATOR
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Session
from coordinator.watch.interrupts import ENDS
from coordinator.watch.observe.updates import Updates
from coordinator.watch.observe.watched_keys import PresenceByName, command_keys, processes_of, readings_keys, state_keys
from coordinator.watch.recording.closing import Closer, close_ended, remove_oldest
from coordinator.watch.recording.entries import APPEARED, MESSAGE, VANISHED, Entry, note
from coordinator.watch.recording.folder import RecordingOrder, begin_writing
from coordinator.watch.recording.recorder import Recorder, left
from coordinator.watch.recording.segment_log import SegmentLog
from dsse_core import operating_system
from dsse_core.errors import DsseError

log = logging.getLogger(__name__)
AWAKE_S = 0.1  # a signal that a thread of Zenoh has caught is acted on when this thread wakes
MOST_WAITING = 256 * 2**20  # bytes that have arrived and are not written yet, as behind a disk that hangs
SIZE_OF_ENTRY = 200  # bytes beside its payload
TIDY_S = 10.0  # between two looks at the size of the recording


def run_recorder(
    order: RecordingOrder,
    endpoints: Sequence[str],
    keys: Path | None = None,
    direct: bool = False,
    timeout_s: float = 10.0,
) -> int:
    """Records as a process of a run until SIGTERM or Ctrl-C. Returns 0, or 2 after a user's mistake."""
    start_log()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Zenoh's connecting would defer Python's handler to its end
    try:
        with Session.join(endpoints, timeout_s, load_keys(keys, COORDINATOR, order.run), direct=direct) as session:
            record_from(session, order)
    except DsseError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def record_from(session: Session, order: RecordingOrder, on_begun: Callable[[], None] = lambda: None) -> None:
    """Records until SIGTERM, SIGINT or, without keys, SIGHUP. With keys, SIGHUP renews them.

    ``on_begun``: called when the recorder is on the bus; all messages that arrive later are written.

    Raises:
        InvalidInputError: the folder holds something else, or another recorder writes there.
        OSError: the folder cannot be written at the start. Later, lost entries are counted, and the recorder goes on.
    """
    over, renew = Event(), Event()
    with begin_writing(order.folder, order.run, order.files):
        ends = [number for number in ENDS if not (session.keys and number == operating_system.HANGUP)]
        for number in ends:
            signal.signal(number, lambda *_: over.set())
        if session.keys:
            on_hangup(renew.set, over.set)
        arrivals = Updates(MOST_WAITING // SIZE_OF_ENTRY, MOST_WAITING)
        closer = Closer(order.folder)
        written = SegmentLog(order.folder, order.limit, closer.ask)
        recorder = Recorder(written, order.run)
        asked = _listen(session, order.run, [file.area.name for file in order.files] or None, arrivals)
        recorder.take([note(time.time(), "recorder started", run=order.run)])
        closer.ask()  # closes logs left by a killed recorder
        on_begun()
        _serve(session, order, arrivals, asked, recorder, closer, over, renew)
        written.write([note(time.time(), "recorder stopped", lost=written.lost)])
        written.close()
        closer.wait()
    if order.closes:
        for text in close_ended(order.folder):
            log.warning("%s", text)


def _listen(session: Session, run: str, areas: Collection[str] | None, arrivals: Updates) -> PresenceByName:
    """Puts all messages and presence to record into ``arrivals``, of ``areas`` if they are known.

    Returns the names whose presence is subscribed to; names of new publishers are added later.
    """

    def put(entry: Entry) -> None:
        arrivals.offer(entry, size=len(entry.payload) + SIZE_OF_ENTRY)

    def on_message(key: str, payload: bytes) -> None:
        asked.note(*publisher_of(key))
        put(Entry(MESSAGE, time.time(), key, payload))

    def on_leave(key: str, payload: bytes) -> None:
        if reason := read_leave(payload):
            put(left(time.time(), key, reason))

    def on_presence(key: str, alive: bool) -> None:
        put(Entry(APPEARED if alive else VANISHED, time.time(), key))

    asked = PresenceByName(session, run, on_presence, on_leave)
    asked.ask(processes_of(areas))
    for expression in (*state_keys(run, areas), *readings_keys(run, areas), *command_keys(run, areas)):
        session.subscribe(expression, on_message)
    session.subscribe(all_gateways(run), lambda key, payload: asked.note(*publisher_of(key)))
    return asked


def _serve(
    session: Session,
    order: RecordingOrder,
    arrivals: Updates,
    asked: PresenceByName,
    recorder: Recorder,
    closer: Closer,
    over: Event,
    renew: Event,
) -> None:
    watchdog = Watchdog()
    next_tidying = time.monotonic()
    watchdog.ready(next_tidying)
    while not over.is_set():
        watchdog.ping(time.monotonic())
        recorder.take(arrivals.take(AWAKE_S))
        asked.ask_noted()
        if dropped := arrivals.take_dropped():
            recorder.take([note(time.time(), "lost", entries=dropped, why="more arrived than could be written")])
        if renew.is_set() and session.interrupt():
            session.resume()
        renew.clear()
        closer.check()
        if order.limit and time.monotonic() >= next_tidying:
            next_tidying = time.monotonic() + TIDY_S
            _keep_limit(order, order.limit, recorder)
    recorder.take(arrivals.take(0.0))


def _keep_limit(order: RecordingOrder, limit: float, recorder: Recorder) -> None:
    with suppress(OSError):
        if removed := remove_oldest(order.folder, limit):
            recorder.take([note(time.time(), "removed", segments=removed, limit_gb=order.limit_gb)])
