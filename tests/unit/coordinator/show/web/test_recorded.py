"""A recording is played back on the page: from its log and from its tables alike, with a scenario and without."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from agents.messages.keys import live_key
from coordinator.show.web.playback.source import play_recording
from coordinator.watch.recording import recorded_tables as rows
from coordinator.watch.recording.closing import close_ended
from coordinator.watch.recording.entries import VANISHED, Entry
from coordinator.watch.recording.folder import begin_writing
from coordinator.watch.recording.recorder import Recorder
from coordinator.watch.recording.segment_log import SegmentLog
from dsse_core.errors import InvalidInputError
from scenarios.scenario import load_scenario
from tests.support.recordings import AT, ME, RUN, appeared, entry_of, load_areas_of, make_readings, make_state
from tests.support.served import client

AREAS = load_areas_of()
SCANS = 4
SPLIT = AREAS[0].identity
EDITED = "9f8e7d6c5b4a3928"


def write(folder: Path, *, closed: bool) -> Path:
    """Three areas, of which the first dies after the last scan."""
    with begin_writing(folder, RUN, AREAS):
        log = SegmentLog(folder)
        recorder = Recorder(log, RUN)
        recorder.take([appeared(content.area.name) for content in AREAS[:2]])
        for scan in range(1, SCANS + 1):
            for content in AREAS:
                when = AT + scan
                recorder.take([entry_of(make_readings(content, scan, scan, when), when)])
                n = len(content.area.network.buses)
                split = replace(SPLIT, edited=EDITED) if content.area.name == "area2" else SPLIT
                shown = {"vm": (1.0 - scan / 100,) * n, "ages": {"area3": 0.5}, "split": split}
                state = make_state(content, scan, scan, when, **shown)
                recorder.take([entry_of(state, when)])
        recorder.take([Entry(VANISHED, AT + 9, live_key(RUN, "area", "area1", ME))])
        log.close()
    if closed:
        assert close_ended(folder) == []
    return folder


@pytest.mark.parametrize("closed", [False, True], ids=["log", "tables"])
@pytest.mark.parametrize("known", [False, True], ids=["without scenario", "with scenario"])
def test_every_moment_of_a_recording_is_as_it_was(tmp_path: Path, closed: bool, known: bool):
    notes: list[str] = []
    source = play_recording(write(tmp_path / "r", closed=closed), load_scenario("ieee33") if known else None, notes)
    asked = client(source)
    frames = asked.get("/api/frames").json()
    assert (notes, frames["since"]) == ([], AT)
    assert frames["remarks"] == ["a recording holds no messages between areas"]
    assert frames["times"] == [0.0, 1.0, 2.0, 3.0, 4.0, 9.0]
    grid = asked.get("/api/grid").json()
    assert (grid["known"], len(grid["buses"]["id"])) == (known, 33)
    for k, at in enumerate(frames["times"]):
        moment = asked.get(f"/api/frame/{k}").json()
        assert (moment["at"], moment["time"], moment["grid_version"]) == (at, AT + at, grid["version"])
        if 1 <= at <= SCANS:
            assert {round(vm, 9) for vm in moment["buses"]["vm_pu"]} == {1.0 - at / 100}
            rows = asked.get(f"/api/rows?kind=meter&frame={k}").json()["rows"]
            assert {area["quality"] for area in moment["view"]["areas"].values()} <= {"good", "stale", "none"}
            areas = moment["view"]["areas"]
            assert areas["area1"]["scan"] == at
            assert {area["split"] for area in areas.values()} <= {SPLIT.digest, ""}
            assert (areas["area1"]["split_time"], areas["area1"]["split_edited"]) == (SPLIT.time, "")
            assert areas["area2"]["split_edited"] == EDITED
            described = sum(len(area.meters) - 1 for area in AREAS)
            assert rows["normalised_residual"].count(1.5) == described
            assert len([value for value in rows["estimate"] if value is not None]) == described
            assert moment["meters"]["meter"] == rows["id"][: len(moment["meters"]["meter"])]
    last = asked.get("/api/now").json()
    assert last["view"]["areas"]["area1"]["state"] == "gone"
    assert last["view"]["areas"]["area3"]["present"]  # it was there before the recording began
    assert {"area1"} == {event["area"] for event in last["events"] if event["kind"] == "vanished"}


def test_tables_of_an_earlier_recorder_are_played_and_named_as_without_estimates_of_readings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    earlier = {table: dict(rows.COLUMNS[table]) for table in rows.ADDED}
    (added, *_) = [[earlier[table].pop(name) for name in names] for table, names in rows.ADDED.items()]
    with monkeypatch.context() as before:
        for table, columns in earlier.items():
            before.setitem(rows.COLUMNS, table, columns)  # type: ignore[arg-type]
        before.setattr(rows, "_rows_of_readings", lambda *arguments: _without(rows_of_readings(*arguments), len(added)))
        folder = write(tmp_path / "r", closed=True)
    notes: list[str] = []
    source = play_recording(folder, None, notes)
    assert notes == []
    assert source.remarks[-1] == "this one holds no estimate and no residual of its readings"
    meters = client(source).get("/api/now").json()["meters"]
    assert {*meters["estimate"], *meters["normalised_residual"]} == {None}
    assert None not in meters["reading"]


rows_of_readings = rows._rows_of_readings


def _without(made: Iterable[rows.Row], count: int) -> Iterator[rows.Row]:
    for table, values in made:
        yield table, values[:-count]


def test_of_a_long_recording_the_newest_part_is_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("coordinator.watch.replay.recorded_messages.MOST_UPDATES", 8)
    notes: list[str] = []
    source = play_recording(write(tmp_path / "r", closed=False), None, notes)
    assert notes == ["the recording is long: its newest part is played"]
    assert source.times()[-1] - source.times()[0] < 9.0
    assert client(source).get("/api/now").json()["view"]["areas"]["area2"]["scan"] == SCANS


def test_an_empty_recording_says_so(tmp_path: Path):
    with begin_writing(tmp_path / "r", RUN, AREAS):
        pass
    with pytest.raises(InvalidInputError, match="nothing is recorded here yet"):
        play_recording(tmp_path / "r", None, [])


def test_a_folder_that_is_no_recording_is_named(tmp_path: Path):
    with pytest.raises(InvalidInputError, match=str(tmp_path)):
        play_recording(tmp_path, None, [])
