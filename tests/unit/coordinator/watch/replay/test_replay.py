"""Replay: the same readings give the same states; what is not recorded is named and nothing else is left out."""

from __future__ import annotations

from pathlib import Path

import pytest

from coordinator.lab.simulator.simulate import simulate_scenario
from coordinator.lab.stages.play import play_on_simulator
from coordinator.watch.recording.closing import close_ended
from coordinator.watch.recording.folder import LOGS, begin_writing, list_segments, table_of
from coordinator.watch.recording.frames import MARK
from coordinator.watch.recording.recorder import Recorder
from coordinator.watch.recording.segment_log import SegmentLog
from coordinator.watch.replay.replay import Comparison, format_replay
from coordinator.watch.replay.ticks import read_ticks
from dsse_core.errors import InvalidInputError
from scenarios.scenario import load_scenario
from tests.support.recordings import AT, RUN, entry_of, load_areas_of, make_readings, make_state, record_simulated


@pytest.mark.parametrize("is_closed", [True, False])
@pytest.mark.parametrize("scenario", ["ieee33", "ieee33-lossy", "industrial13"])
def test_a_replay_on_the_simulator_has_the_recorded_states_to_the_bit(
    tmp_path: Path, scenario: str, is_closed: bool
) -> None:
    folder = record_simulated(tmp_path, 4, scenario)
    if is_closed:
        close_ended(folder)
    found = play_on_simulator(folder)
    areas = len(load_areas_of(load_scenario(scenario)))
    assert (found.scans, found.compared, found.unequal) == (4, 4 * areas, 0)
    assert found.agrees
    assert not found.left_out
    assert "to the bit" in format_replay(found, "the simulator", 1.0)


def test_readings_that_had_aged_are_played_as_they_were_used(tmp_path: Path) -> None:
    changes = {"run.scan_s": 1.0, "measurements.flow.period_s": 2.0, "measurements.voltage.period_s": 5.0}
    scenario = load_scenario("ieee33", changes=changes)
    folder = record_simulated(
        tmp_path, 5, scenario, measured_at=lambda scan, meter: scan - 1.7 - 0.1 * (len(meter) % 5)
    )
    ticks = list(read_ticks(folder, []))
    sigmas = [dict(zip(t.readings["area1"].meters, t.readings["area1"].sigmas, strict=True)) for t in ticks]
    assert any(sigmas[0][meter] != sigmas[-1][meter] for meter in sigmas[0].keys() & sigmas[-1].keys())
    found = play_on_simulator(folder)
    assert (found.scans, found.unequal) == (5, 0)
    assert found.agrees


def test_the_cut_of_a_link_in_the_recorded_run_does_not_keep_a_scan_from_coming_out_again(tmp_path: Path) -> None:
    recorded = simulate_scenario(load_scenario("ieee33-cut", changes={"record": {}}), tmp_path)
    assert recorded.verdict.consensus
    found = play_on_simulator(tmp_path / "recording")
    assert (found.compared, found.missing, found.agrees) == (3, [], True)


def test_good_states_that_are_missing_are_not_called_absent_from_the_record() -> None:
    text = format_replay(Comparison(scans=1, missing=[(1, "area1")]), "the simulator", 1.0)
    assert "no good state is recorded" not in text
    assert "not found again: area1 in 1" in text


def test_states_that_do_not_come_out_again_are_seen(tmp_path: Path) -> None:
    folder = record_simulated(tmp_path, 2, "industrial13")
    of_another_grid = load_scenario("industrial13", changes={"measurements.zero_injection": "measured"})
    found = play_on_simulator(folder, of_another_grid)
    assert not found.agrees
    assert found.unequal > 0
    assert "DIFFERENT" in format_replay(found, "the simulator", 1.0)


def test_a_scan_in_which_an_area_took_other_readings_is_named_and_left_out(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    record_simulated(folder, 2)
    used = list(read_ticks(folder, []))[1].readings["area2"]
    message = make_readings(load_areas_of()[1], 2, 3, AT)
    times = (AT,) * len(used.values)
    for k in (0, 1):  # said again, it is the same message
        again = type(message)(message.header, used.taken_at, used.meters, used.values, used.sigmas, times)
        with begin_writing(folder, RUN):
            log = SegmentLog(folder)
            Recorder(log, RUN).take([entry_of(again, 1_800_000_000.0 + 20 * k)])
            log.close()
    found = play_on_simulator(folder)
    assert found.agrees
    assert found.left_out == {2: "area2 took readings twice, as after a restart"}
    assert len(list(read_ticks(folder, []))[1].readings["area2"].meters) == len(used.meters)


def test_an_area_that_was_not_there_takes_no_part(tmp_path: Path) -> None:
    folder = record_simulated(tmp_path, 4, away={"area3": 2}, between_s=5.0)
    found = play_on_simulator(folder)
    assert found.scans == 4
    assert not found.left_out
    assert found.agrees
    assert found.compared >= 3 * 3


def test_a_scan_without_the_readings_of_an_area_is_named_and_the_others_are_played(tmp_path: Path) -> None:
    folder = record_simulated(tmp_path, 4)
    (path,) = (folder / LOGS).iterdir()
    content = bytearray(path.read_bytes())
    frames = content.split(MARK)
    at = next(k for k, frame in enumerate(frames) if b"readings" in frame[:200] and b"area2" in frame[:200])
    frames[at] = frames[at][:-1] + bytes([frames[at][-1] ^ 1])
    path.write_bytes(MARK.join(frames))
    found = play_on_simulator(folder)
    assert found.left_out == {1: "no readings of area2 are recorded"}
    assert found.scans == 3
    assert found.agrees
    assert "frames are damaged" in found.notes[0]
    assert "left out, no readings of area2 are recorded: scan 1" in format_replay(found, "the simulator", 1.0)


def test_a_missing_hour_leaves_out_its_scans_alone(tmp_path: Path) -> None:
    folder = record_simulated(tmp_path, 6, apart_s=1500.0)  # two or three an hour
    close_ended(folder)
    segments = list_segments(folder)
    assert len(segments) == 3
    table_of(folder, "readings", segments[1]).unlink()
    found = play_on_simulator(folder)
    assert set(found.left_out.values()) == {"no readings of area1, area2, area3 are recorded"}
    assert found.scans + len(found.left_out) == 6
    assert found.agrees


def test_a_foreign_table_is_one_note(tmp_path: Path) -> None:
    folder = record_simulated(tmp_path, 3)
    close_ended(folder)
    (folder / "events" / "20200101T000000-000.parquet").write_bytes(b"PAR1 not at all")
    found = play_on_simulator(folder)
    assert found.agrees
    assert found.scans == 3
    assert "is no table of a recording" in found.notes[0]


def test_without_area_files_a_scenario_must_be_given(tmp_path: Path) -> None:
    with begin_writing(tmp_path, RUN):
        log = SegmentLog(tmp_path)
        Recorder(log, RUN).take([entry_of(make_readings(load_areas_of()[0]))])
        log.close()
    with pytest.raises(InvalidInputError, match="give the scenario of the split: dsse replay FOLDER SCENARIO"):
        play_on_simulator(tmp_path)


def test_a_recording_without_readings_is_one_clear_error(tmp_path: Path) -> None:
    with begin_writing(tmp_path, RUN, load_areas_of()):
        log = SegmentLog(tmp_path)
        Recorder(log, RUN).take([entry_of(make_state(content)) for content in load_areas_of()])
        log.close()
    with pytest.raises(InvalidInputError, match="no scan of which the readings"):
        play_on_simulator(tmp_path)


def test_the_areas_of_another_grid_are_one_clear_error(tmp_path: Path) -> None:
    folder = record_simulated(tmp_path, 2)
    with pytest.raises(InvalidInputError, match="area area3 is not among the area files: scan 1, 2"):
        play_on_simulator(folder, load_scenario("industrial13"))
