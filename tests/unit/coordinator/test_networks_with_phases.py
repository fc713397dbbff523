"""Networks with phases from the simulator to verdict, tables, pictures and page."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

import consensus_dsse as dsse
from agents.messages.packing import StateMessage
from agents.protocol.configuration import Configuration
from coordinator.lab.evaluation.answers import power_flow_as_json
from coordinator.lab.evaluation.result import RunResult
from coordinator.lab.simulator.simulate import Simulation, simulate_scenario
from coordinator.lab.simulator.subscriber import Subscriber
from coordinator.show.figures.errors_figure import draw_errors
from coordinator.show.figures.network_figure import draw_network
from coordinator.show.figures.profile_figures import draw_angles, draw_magnitudes, find_profile
from coordinator.show.figures.residuals_figure import draw_residuals
from coordinator.show.figures.style import Drawing, styled
from coordinator.show.report.grid_text import format_state
from coordinator.show.report.phase_rows import describe_unbalance
from coordinator.show.report.run_report import make_run_page, write_report
from coordinator.show.report.text import format_verdict
from coordinator.show.web.drawing import draw_scenario, draw_states
from coordinator.show.web.moment import Moments, encode_json
from coordinator.show.web.shown_tables import draw_tables, select_rows
from coordinator.watch.observe.grid_tables import GridTables, Tables
from coordinator.watch.observe.summary import summarise
from coordinator.watch.observe.watcher import Watcher
from dsse_core.estimation.state_limits import OperatingLimits
from dsse_core.grid.gauge import describe_ungrounded
from dsse_core.grid.nodes import PHASES
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


def test_the_report_counts_buses_and_nodes_and_says_losses_and_unbalance_once_for_each(run: RunResult):
    page = make_run_page(run, [], [])
    of_buses, of_branches = page.more_tables[:2]
    n_bus, n_conductor = len(SCENARIO.network.buses), len(run.branches)
    assert of_buses.title == f"Buses ({n_bus}, {NODES} nodes)"
    assert of_branches.title == f"Branches ({len(SCENARIO.network.branches)}, {n_conductor} conductors)"
    buses = [dict(zip(of_buses.header, row, strict=True)) for row in of_buses.rows]
    said = {row["bus"]: row["unbalance |V-|/|V+| (%)"] for row in buses if row["unbalance |V-|/|V+| (%)"]}
    v = np.asarray(run.buses.vm_pu) * np.exp(1j * np.radians(run.buses.va_deg))
    turn = np.exp(2j * np.pi / 3)
    a, b, c = v[SCENARIO.network.nodes_at(671)]
    assert float(said["671"]) == pytest.approx(
        100 * abs((a + turn**2 * b + turn * c) / (a + turn * b + turn**2 * c)), abs=6e-3
    )
    assert [row["phase"] for row in buses if row["bus"] == "671" and row["unbalance |V-|/|V+| (%)"]] == ["a"]
    branches = [dict(zip(of_branches.header, row, strict=True)) for row in of_branches.rows]
    lost = sum(float(row["losses (kW)"] or 0) for row in branches)
    assert lost == pytest.approx(run.branches.loss_kw.sum(), abs=1e-3 * len(branches))
    assert [row["losses (kW)"] != "" for row in branches if row["branch"] == "645-646"] == [True, False]
    found = describe_unbalance(run)
    assert found in format_verdict(run)
    assert f"{np.nanmax(run.buses.unbalance_percent):.2f} % at bus" in found
    assert f"{run.branches.neutral_a.max():.1f} A in branch" in found


def test_text_says_losses_of_all_conductors_in_the_first_row_of_a_branch(run: RunResult):
    lines = format_state(run.buses, run.branches).splitlines()
    rows = [line.split() for line in lines if line.startswith("645-646.")]
    of_branch = np.array([branch == "645-646" for branch in run.branches.branch])
    assert float(rows[0][-1]) == pytest.approx(run.branches.loss_kw[of_branch].sum(), rel=1e-2)
    assert len(rows[1]) == len(rows[0]) - 2  # without those of the branch: neutral current and losses


def lines_of(drawing: Drawing, label: str) -> list[Line2D]:
    return [line for axis in drawing.figure.axes for line in axis.lines if line.get_label() == label]


def test_pictures_tell_phases_apart_without_colour(run: RunResult):
    with styled():
        profile, errors, residuals = draw_magnitudes(find_profile(run)), draw_errors(run), draw_residuals(run)
    nodes, comparison = SCENARIO.network.table.nodes, run.comparison
    marks = {"a": "o", "b": "s", "c": "^"}
    for phase, mark in marks.items():
        (true,), of_phase = lines_of(profile, f"true (power flow), phase {phase}"), nodes.phase == PHASES.index(phase)
        assert np.asarray(true.get_ydata()).tolist() == comparison.truth.vm[of_phase].tolist()
        of_errors = lines_of(errors, f"decentralised estimate, phase {phase}")
        drawn = np.asarray(of_errors[0].get_ydata())
        assert sorted(drawn[~np.isnan(drawn)]) == sorted((comparison.decentralised.vm - comparison.truth.vm)[of_phase])
        (used,) = lines_of(residuals, f"meter in use, phase {phase}")
        assert len(np.asarray(used.get_xdata())) == sum(of == phase for of in run.meters.phase)
        assert {line.get_marker() for line in (true, *of_errors, used)} == {mark}
    (axis,) = profile.figure.axes
    dashes = [str(each.get_linestyle()) for each in axis.collections if isinstance(each, LineCollection)]
    assert len({*dashes}) == len(dashes) == len(marks)
    ticks = [text.get_text() for text in errors.figure.axes[-1].get_xticklabels()]
    assert {*ticks} <= {str(bus.id) for bus in SCENARIO.network.buses}


def test_the_map_shows_the_worst_phase_and_the_phases_of_lines(run: RunResult):
    high = OperatingLimits(lowest_vm=0.5, highest_vm=1.0)
    network, vm = SCENARIO.network, run.comparison.decentralised.vm
    for limits, choose in ((high, max), (OperatingLimits(lowest_vm=1.0, highest_vm=1.5), min)):
        worst = [choose(vm[network.nodes_at(bus.id)]) for bus in network.buses]
        assert vm[limits.find_worst(network.table.nodes.item, vm)].tolist() == worst
    with styled():
        axis = draw_network(run).figure.axes[0]
    written = Counter(text.get_text() for text in axis.texts)
    phases = Counter(branch.primitive.from_phases for branch in network.active_branches if branch.primitive)
    assert {text: n for text, n in written.items() if text in phases} == {
        of: n for of, n in phases.items() if of != "abc"
    }
    drawn = [each for each in axis.collections if isinstance(each, LineCollection)]
    widths = Counter(
        np.round(np.concatenate([each.get_linewidths() for each in drawn if each.get_segments()]), 3).tolist()
    )
    assert [n for _, n in sorted(widths.items())] == [
        n
        for _, n in sorted(
            Counter(len(branch.primitive.from_phases) for branch in network.active_branches if branch.primitive).items()
        )
    ]


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


def test_the_page_has_a_number_for_each_node_and_conductor(watcher: Watcher):
    moments = Moments(GridTables(SCENARIO))
    content = moments.make(watcher, 0.0, 1.7e9)
    assert encode_json(content)
    grid = draw_scenario(SCENARIO)
    assert len(content["buses"]["vm_pu"]) == len(grid["nodes"]["bus"]) == NODES
    assert len(content["branches"]["fresh"]) == len(grid["conductors"]["branch"])
    rows = select_rows(moments.tables, "bus", "671", 0, 1000)["rows"]
    assert (rows["id"], rows["phase"]) == (["671"] * 3, ["a", "b", "c"])


def test_the_page_without_a_scenario_draws_each_bus_once(watcher: Watcher):
    content = Moments(None).make(watcher, 0.0, 1.7e9)
    drawn = draw_states("run", watcher.states)["buses"]
    assert sorted(drawn["id"]) == sorted(bus.id for bus in SCENARIO.network.buses)
    assert drawn["areas"][drawn["id"].index(671)] == ["east", "head", "west"]
    assert len(content["buses"]["id"]) == sum(area.network.n_nodes for area in SCENARIO.partition.areas)


def test_voltages_to_ground_are_not_judged_in_parts_without_ground():
    network = load_feeder("4bus-yd")  # a delta winding feeds buses 3 and 4
    buses = results_of_power_flow(solve_power_flow(network)).buses
    nothing: dict[str, Any] = {
        "meter": [],
        "status": [],
        "normalised_residual": np.zeros(0),
        "fresh": np.zeros(0, bool),
    }
    tables = Tables(buses, None, nothing)
    assert summarise(tables, None).voltage.total == buses.grounded.sum() < len(buses)
    content = draw_tables(tables, OperatingLimits(), has_grid=True)
    assert np.isnan(content["buses"]["vm_pu"]).tolist() == (~buses.grounded).tolist()
    assert buses.grounded[content["worst_nodes"]].all()
    names = ", ".join(map(str, network.gauge.ungrounded))
    remark = describe_ungrounded(network.gauge.ungrounded)
    assert f"Bus {names} have no path to ground" in remark
    assert f"\n{remark}\n\n" in format_state(buses, results_of_power_flow(solve_power_flow(network)).branches)
    assert describe_ungrounded(SCENARIO.network.gauge.ungrounded) == ""
