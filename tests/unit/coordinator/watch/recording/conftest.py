"""Recordings under way."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from coordinator.watch.recording.entries import Entry
from coordinator.watch.recording.folder import begin_writing
from coordinator.watch.recording.recorder import Recorder
from coordinator.watch.recording.segment_log import SegmentLog
from tests.support.recordings import RUN, Record, load_areas_of


@pytest.fixture
def record(tmp_path: Path) -> Record:
    """Writes entries as one recorder does from its start to its end; the folder."""
    folder = tmp_path / "recording"

    def write(entries: Sequence[Entry]) -> Path:
        with ExitStack() as stack:
            stack.enter_context(begin_writing(folder, RUN, load_areas_of()))
            log = SegmentLog(folder)
            Recorder(log, RUN).take(entries)
            log.close()
        return folder

    return write
