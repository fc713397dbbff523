"""A recording as a play: states, readings and presence of areas in the order of time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from agents.messages.packing import ReadingsMessage
from coordinator.show.web.playback.play import Play
from coordinator.show.web.playback.source import PlaybackSource
from coordinator.watch.recording.folder import read_about
from coordinator.watch.replay.recorded_messages import Update, read_newest_messages
from scenarios.scenario import Scenario


def play_recording(folder: Path, scenario: Scenario | None, notes: list[str]) -> PlaybackSource:
    """The recording at ``folder`` as a source; the newest part of a long one. Lost and omitted parts go to ``notes``.

    Raises:
        InvalidInputError: ``folder`` is no recording, or nothing in it can be read, as without pyarrow where all of it
            is Parquet.
    """
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
