"""Recordings, replays and results of networks with phases: each voltage has its node, as on the bus."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agents.messages.packing import StateMessage
from coordinator.lab.stages.play import play_on_simulator
from coordinator.watch.observe.area_flows import make_area_flows
from coordinator.watch.recording.closing import close_ended
from coordinator.watch.recording.recorded_tables import COLUMNS
from coordinator.watch.recording.row_checks import RowCheck
from coordinator.watch.replay.recorded_messages import read_newest_messages
from coordinator.watch.replay.result_messages import read_result_messages
from coordinator.watch.tables import write_tables
from dsse_core.errors import InvalidInputError
from dsse_core.results.results import results_of_power_flow
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.recordings import RUN, read_table, record_simulated

SCENARIO = load_scenario("ieee13")
AREAS = {area.name: area for area in SCENARIO.partition.areas}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_simulated(tmp_path_factory.mktemp("phases") / "recording", 1, "ieee13")


def test_a_replay_of_phases_has_the_recorded_states_to_the_bit(recording: Path) -> None:
    found = play_on_simulator(recording)
    assert (found.scans, found.compared, found.unequal) == (1, len(AREAS), 0)
    close_ended(recording)
    closed = play_on_simulator(recording)
    assert (closed.compared, closed.unequal, closed.agrees) == (len(AREAS), 0, True)


def test_recorded_rows_are_nodes_and_conductors_in_kv_and_kw_of_a_phase(recording: Path) -> None:
    close_ended(recording)
    states = [m for _, m in read_newest_messages(recording, RUN, []) if isinstance(m, StateMessage) and m.buses]
    last = {state.header.sender: state for state in states}
    for table, at in (("buses", 0), ("branches", 1)):
        rows = [row for row in read_table(recording, table) if row["final"]]
        for name, area in AREAS.items():
            expected = make_area_flows(area, last[name])[at]
            own = [row for row in rows if row["area"] == name]
            assert [row["phase"] for row in own] == list(expected.phase)
            key = ("vm_kv", "i_from_a")[at]
            rounding = 1e-12 * np.nanmax(np.abs(expected[key]))  # a current of no load is a difference of large ones
            np.testing.assert_allclose([row[key] for row in own], expected[key], rtol=1e-12, atol=rounding)


def test_a_node_stands_once_in_a_recorded_estimate_and_its_phase_is_one(tmp_path: Path) -> None:
    names = ("time", "scan", "area", "incarnation", "estimate", "bus", "phase")
    assert {*names} <= {*COLUMNS["buses"]}
    whose = (1.0, 1, "area1", "18bcfe56801-596bc35a", 1)
    RowCheck(tmp_path, "buses", names).check([(*whose, 671, phase) for phase in ("a", "b", None, "s1")])
    with pytest.raises(InvalidInputError, match=r"row 2: bus: '671\.a' stands twice in one message"):
        RowCheck(tmp_path, "buses", names).check([(*whose, 671, "a")] * 2)
    with pytest.raises(InvalidInputError, match="row 1: phase"):
        RowCheck(tmp_path, "buses", names).check([(*whose, 671, "d")])


def test_tables_of_results_are_played_node_by_node_and_of_another_network_refused_by_node(tmp_path: Path) -> None:
    truth = make_telemetry(SCENARIO).truth
    assert truth is not None
    tables = results_of_power_flow(truth, partition=SCENARIO.partition, meters=SCENARIO.meters)
    write_tables(tmp_path, tables)
    states = [m for _, m in read_result_messages(tmp_path, SCENARIO, []) if isinstance(m, StateMessage)]
    for state in states:
        area = AREAS[state.header.sender]
        rows = SCENARIO.partition.rows_of_nodes[area.name]
        assert state.nodes == area.network.nodes
        np.testing.assert_allclose(state.vm, truth.vm[rows], rtol=0, atol=1e-15)
    lines = (tmp_path / "buses.csv").read_text().splitlines()
    (tmp_path / "buses.csv").write_text("\n".join(line for line in lines if not line.startswith("611,")) + "\n")
    with pytest.raises(InvalidInputError, match=r"its buses are not those of 'ieee13': 611\.c"):
        read_result_messages(tmp_path, SCENARIO, [])
