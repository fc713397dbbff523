"""The log of a recording: one segment after the other, each entry written through at once."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Sequence
from itertools import takewhile
from pathlib import Path

from coordinator.watch.recording.entries import Entry, encode_entry, note
from coordinator.watch.recording.folder import LOGS, log_of, name_segment
from coordinator.watch.recording.frames import FrameLog

log = logging.getLogger(__name__)
HOUR_S = 3600.0
SYNC_S = 1.0
SHARE_OF_LIMIT = 1 / 8  # of the limit of a recording: a segment of this size ends before its hour


def _nothing() -> None:
    """Does nothing."""


class SegmentLog:
    """Writes entries to the recording in ``folder``; no other process writes there.

    Args:
        limit: of the whole recording, bytes; a segment ends at the share ``SHARE_OF_LIMIT`` of it.
        on_segment_end: called when a segment has ended and can be closed.

    Entries that cannot be written, on a full disk for instance, are counted in ``lost``. A note reports them as soon as
    an entry can be written again.
    """

    def __init__(self, folder: Path, limit: float | None = None, on_segment_end: Callable[[], None] = _nothing) -> None:
        self._folder = folder
        self._largest = SHARE_OF_LIMIT * limit if limit else float("inf")
        self._on_segment_end = on_segment_end
        self._log: FrameLog | None = None
        self._why_none = OSError(None, "no log was begun", str(folder))  # cause of a log that is missing
        self._ends_at = 0.0
        self.lost = 0
        self._unreported = 0
        self._lock = threading.Lock()  # between closing a segment and having it on the disk
        self._stop = threading.Event()
        self._syncing = threading.Thread(target=self._sync_on, name="fsync of the recording", daemon=True)
        self._syncing.start()

    def write(self, entries: Sequence[Entry]) -> None:
        """Writes ``entries``, in the order of their arrival, through to the system."""
        left = list(entries)
        while left:
            if not self._is_of_segment(left[0].at):
                self._begin(left[0].at)
            now = list(takewhile(lambda entry: entry.at < self._ends_at, left))
            self._append(now)
            left = left[len(now) :]

    def close(self) -> None:
        """Ends the last segment, and the thread that syncs it."""
        self._stop.set()
        self._syncing.join()
        self._end()

    def _is_of_segment(self, at: float) -> bool:
        return self._log is not None and at < self._ends_at and self._log.size < self._largest

    def _append(self, entries: Sequence[Entry]) -> None:
        try:
            if self._log is None:
                raise self._why_none
            self._log.append(self._note_lost(entries[0].at) + [encode_entry(entry) for entry in entries])
            self._unreported = 0
        except OSError as error:
            if not self._unreported:
                log.error("%s: %s; entries are lost until the log can be written", error.filename, error.strerror)
            self.lost += len(entries)
            self._unreported += len(entries)

    def _note_lost(self, at: float) -> list[bytes]:
        what = {"entries": self._unreported, "why": "could not be written"}
        return [encode_entry(note(at, "lost", **what))] if self._unreported else []

    def _begin(self, at: float) -> None:
        self._end()
        self._ends_at = (at // HOUR_S + 1) * HOUR_S
        millisecond = at
        while self._log is None:
            try:
                (self._folder / LOGS).mkdir(exist_ok=True)
                self._log = FrameLog(log_of(self._folder, name_segment(millisecond)))
            except FileExistsError:
                millisecond += 0.001  # a segment began and ended within this millisecond
            except OSError as error:
                self._why_none = error
                return

    def _end(self) -> None:
        if self._log is None:
            return
        with self._lock:
            ended, self._log = self._log, None
        with contextlib.suppress(OSError):
            ended.sync()
        ended.close()
        self._on_segment_end()

    def _sync_on(self) -> None:
        """Syncs the log every ``SYNC_S`` on a thread of its own, because a slow disk must not delay the writing."""
        while not self._stop.wait(SYNC_S):
            with self._lock:
                if self._log is not None:
                    with contextlib.suppress(OSError):
                        self._log.sync()
