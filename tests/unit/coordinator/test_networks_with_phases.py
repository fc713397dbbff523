"""Networks with phases from the simulator to verdict, tables, pictures and page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import consensus_dsse as dsse
from agents.messages.packing import StateMessage
from agents.protocol.configuration import Configuration
from coordinator.lab.evaluation.answers import power_flow_as_json
from coordinator.lab.evaluation.result import RunResult
from coordinator.lab.simulator.simulate import Simulation, simulate_scenario
from coordinator.lab.simulator.subscriber import Subscriber
from coordinator.show.figures.profile_figures import describe_ungrounded, draw_angles, find_profile
from coordinator.show.figures.style import styled
from coordinator.show.report.grid_text import format_state
from coordinator.show.report.run_files import write_report
from coordinator.show.report.text import format_verdict
from coordinator.show.web.drawing import draw_scenario, draw_states
from coordinator.show.web.moment import Moments, encode_json
from coordinator.show.web.shown_tables import select_rows
from coordinator.watch.observe.grid_tables import GridTables, Tables
from coordinator.watch.observe.summary import summarise
from coordinator.watch.observe.watcher import Watcher
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.results import results_of_power_flow
from scenarios.faults.faults import change_links
from tests.support.ieee_feeders import load_feeder
from tests.support.phases import DEEP
from tests.support.scenario_with_phases import make_scenario

SCENARIO = make_scenario()
NODES = SCENARIO.network.n_nodes


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return simulate_scenario(SCENARIO, tmp_path_factory.mktemp("run") / "run")


def test_areas_agree_with_the_centre_in_every_phase(run: RunResult):
    assert run.verdict.consensus
    assert {area.quality for area in run.area_results} == {"good"}
    assert run.verdict.gap_vm_pu is not None
    assert run.verdict.gap_vm_pu < 1e-9
    found = json.loads((run.folder / "result.json").read_text())
    assert found["verdict"]["gap_at"] in SCENARIO.network.node_names
    assert f"(same telemetry, at {run.verdict.gap_at})" in format_verdict(run)
    assert found["summary"]["voltage"]["total"] == NODES
    assert found["summary"]["voltage"]["lowest"]["at"] == "646.b"


def test_loss_and_delta_windings_at_boundaries_change_nothing(tmp_path: Path):
    scenario = make_scenario(DEEP, is_rich=False)
    lossy = simulate_scenario(replace(scenario, faults=change_links(scenario.faults, {"loss": 0.6})), tmp_path / "run")
    assert lossy.verdict.consensus
    assert lossy.verdict.lost > 0
    assert lossy.verdict.gap_vm_pu is not None
    assert lossy.verdict.gap_vm_pu < 1e-9


def test_losses_are_those_of_all_phases_in_kw():
    solved = dsse.power_flow(SCENARIO)
    content = power_flow_as_json(SCENARIO, solved.result)["power_flow"]
    assert solved.loss_kw == pytest.approx(solved.areas.loss_kw.sum())
    assert content["loss_kw"] == pytest.approx(solved.areas.loss_kw.sum())
    assert content["loss_kvar"] == pytest.approx(solved.areas.loss_kvar.sum())
    assert repr(solved).startswith(f"<PowerFlow of 'feeder': {len(SCENARIO.network.buses)} buses")


def test_text_names_nodes_and_conductors(run: RunResult):
    rows = [line.split()[0] for line in format_state(run.buses, run.branches).splitlines() if line]
    assert rows[1 : 1 + NODES] == SCENARIO.network.node_names
    assert {"645-646.b", "645-646.c"} <= {*rows}


def test_the_report_has_all_figures_and_a_row_for_each_phase(run: RunResult):
    written = write_report(run, ["png"], ["run"])
    assert written.unwritten is None
    assert {path.stem for path in run.folder.glob("*.png")} >= {"gap", "errors", "magnitudes", "angles", "network"}
    page = (run.folder / "report.html").read_text()
    assert "phase of every bus" in page
    assert "646.b" in page


def test_angles_of_phases_count_from_those_at_no_load(run: RunResult):
    with styled():
        (axis,) = draw_angles(find_profile(run)).figure.axes
    drawn = np.concatenate([line.get_ydata() for line in axis.lines])  # type: ignore[arg-type]
    assert abs(drawn).max() < 3  # degrees, beside the 30 of the bank and the 120 of phases


class Watching(Subscriber):
    """A watcher of the states of a simulation."""

    def begin(self, run: str, files: Sequence[Configuration]) -> None:
        self.watcher = Watcher(run, frozenset(content.area.name for content in files))

    def take_state(self, at: float, state: StateMessage) -> None:
        self.watcher.take_state(state, at)


@pytest.fixture(scope="module")
def watcher() -> Watcher:
    watching = Watching()
    assert Simulation(SCENARIO, subscriber=watching).run() is None
    return watching.watcher


def test_the_page_draws_a_bus_by_its_lowest_phase_and_lists_all(watcher: Watcher):
    moments = Moments(GridTables(SCENARIO))
    content = moments.make(watcher, 0.0, 1.7e9)
    assert encode_json(content)
    drawn, grid = content["buses"]["vm_pu"], draw_scenario(SCENARIO)
    assert (len(drawn), len(content["branches"]["fresh"])) == (len(grid["buses"]["id"]), len(grid["branches"]["id"]))
    rows = select_rows(moments.tables, "bus", "671", 0, 1000)["rows"]
    assert (rows["id"], rows["phase"]) == (["671"] * 3, ["a", "b", "c"])
    assert drawn[grid["buses"]["id"].index(671)] == pytest.approx(min(rows["vm_pu"]), abs=1e-5)


def test_the_page_without_a_scenario_draws_each_bus_once(watcher: Watcher):
    content = Moments(None).make(watcher, 0.0, 1.7e9)
    drawn = draw_states("run", watcher.states)["buses"]
    assert sorted(drawn["id"]) == sorted(bus.id for bus in SCENARIO.network.buses)
    assert drawn["areas"][drawn["id"].index(671)] == ["east", "head", "west"]
    assert len(content["buses"]["id"]) == sum(len(area.network.buses) for area in SCENARIO.partition.areas)


def test_voltages_to_ground_are_not_judged_in_parts_without_ground():
    network = load_feeder("4bus-yd")  # a delta winding feeds buses 3 and 4
    buses = results_of_power_flow(solve_power_flow(network)).buses
    nothing: dict[str, Any] = {
        "meter": [],
        "status": [],
        "normalised_residual": np.zeros(0),
        "fresh": np.zeros(0, bool),
    }
    assert summarise(Tables(buses, None, nothing), None).voltage.total == buses.grounded.sum() < len(buses)
    names = ", ".join(map(str, network.gauge.ungrounded))
    assert f"Bus {names} have no path to ground" in describe_ungrounded(network)
    assert describe_ungrounded(SCENARIO.network) == ""
