"""A state that is marked good is the centralised estimate of its scan, whatever is late, lost or restarted."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agents.messages.packing import DownMessage, StateMessage, UpMessage
from agents.protocol.quality import GOOD
from agents.protocol.rounds import RoundsProtocol
from dsse_core.estimation.bad_data import BadDataReport, process_bad_data
from dsse_core.estimation.decision import Decision, Totals, Verdict
from dsse_core.exchange.area_estimation import Received
from dsse_core.linear.boundary_information import BoundaryInformation
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.simulated_bus import SimulatedBus, area_files_of
from tests.support.tree_of_areas import tree_scenario

pytestmark = pytest.mark.quick

SCANS = (1, 2)


class Watched:
    """A scenario under way on the simulator; ``shown``: every state that was good when it was shown, whoever saw it."""

    def __init__(self, scenario: Scenario) -> None:
        self.telemetry = {scan: make_telemetry(scenario, scan=scan) for scan in SCANS}
        self.central = {scan: process_bad_data(scenario.network, self.telemetry[scan].union) for scan in SCANS}
        self.shown: list[StateMessage] = []
        files = area_files_of(scenario, strategy="information")
        self.bus = SimulatedBus(files, self.telemetry[1].by_area, on_state=lambda at, state: self._keep(state))
        self.bus.run_until_settled()
        self.bus.run(1.0)
        assert self.good_now == self.bus.files.keys()

    @property
    def good_now(self) -> set[str]:
        return {name for name, state in self.bus.states.items() if state.quality == GOOD}

    def lose_rounds_to(self, *receivers: str) -> None:
        self.bus.reject_delivery = lambda _, receiver, message: (
            isinstance(message, UpMessage | DownMessage) and receiver in receivers
        )

    def lose_nothing(self) -> None:
        self.bus.reject_delivery = lambda *_: False

    def end_well(self) -> None:
        """Lose nothing more: all become good, and whatever was shown as good is the centralised estimate."""
        self.lose_nothing()
        self.bus.run_until_settled()
        self.bus.run(0.5)
        assert self.good_now == self.bus.files.keys()
        self.assert_good_states_are_the_centralised_estimate()

    def _keep(self, state: StateMessage) -> None:
        if state.quality == GOOD:
            self.shown.append(state)

    def assert_good_states_are_the_centralised_estimate(self) -> None:
        for state in self.shown:
            assert gap_of(state, self.central[state.header.scan]) <= 1e-8, (state.header.sender, state.header.time)


def gap_of(state: StateMessage, report: BadDataReport) -> float:
    central = report.result
    rows = [central.network.row[bus] for bus in state.buses]
    return max(abs(central.vm[rows] - state.vm).max(), abs(central.va[rows] - state.va).max())


@pytest.mark.parametrize("lose_rounds", [False, True])
@pytest.mark.parametrize("ahead", ["b", "d"])
def test_two_scans_under_the_label_of_one_are_not_good(ahead: str, lose_rounds: bool):
    """Area c is late for the next scan, which ``ahead`` has first."""
    world = Watched(tree_scenario())
    if lose_rounds:
        world.lose_rounds_to("a", "b", "d", "e")
    others = set(world.bus.files) - {ahead, "c"}
    world.bus.next_scan(world.telemetry[2].by_area, late_s={"c": 0.2} | dict.fromkeys(others, 0.4))
    world.bus.run(1.0)
    world.end_well()


def test_who_has_not_received_that_the_search_for_bad_data_began_anew_is_not_good():
    """The substation's area restarts and uses its bad meter again until it has found it out once more."""
    scenario = load_scenario("ieee33")
    scenario = replace(scenario, telemetry=replace(scenario.telemetry, gross_errors={"p_flow@2:2-3": 20.0}))
    world = Watched(scenario)
    assert world.bus.states["area1"].removed == ("p_flow@2:2-3",)
    world.lose_rounds_to("area2", "area3")
    world.bus.kill("area1")
    world.bus.run(0.3)
    world.bus.start("area1")
    world.bus.run(1.0)
    world.end_well()


@pytest.mark.parametrize("to", ["area2", "area3"])
def test_who_lacks_the_numbers_of_the_hub_for_the_last_step_is_not_good(to: str):
    watched = Watched(load_scenario("ieee33"))
    hub = watched.bus.protocols["area1"]
    assert isinstance(hub, RoundsProtocol)
    estimation, verdicts = hub.round.estimation, []
    decide, honest = hub.round.decide, estimation.information_for

    def note(totals: Totals) -> Verdict:
        verdicts.append(decide(totals))
        return verdicts[-1]

    def fail_at_the_last_step(neighbour: str, received: Received) -> BoundaryInformation:
        if neighbour == to and verdicts and verdicts[-1].decision is Decision.FINAL:
            raise ArithmeticError("the digits are gone")
        return honest(neighbour, received)

    hub.round.decide, estimation.information_for = note, fail_at_the_last_step  # type: ignore[method-assign]
    watched.bus.next_scan(watched.telemetry[2].by_area)
    watched.bus.run(1.0)
    assert watched.bus.states[to].notes[0] == "no estimate: ArithmeticError: no numbers from area1"
    watched.assert_good_states_are_the_centralised_estimate()
