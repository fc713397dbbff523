"""Counterparts: the results of this program that each table of the thesis is compared with, and their computation."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from coordinator.lab.evaluation.result import RunOutcome
from coordinator.lab.simulator.simulate import Simulation
from coordinator.lab.strategy_check import check_with_strategy
from dsse_core.errors import DsseError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.network import Network
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from scenarios.scenario import load_scenario
from scenarios.telemetry import Telemetry, make_telemetry


class What(StrEnum):
    """The kinds of states that the thesis prints; the text describes the state of this program compared with them."""

    POWER_FLOW = "power flow"
    CENTRALISED = "centralised estimate, exact readings of the whole grid"
    AREA_POWER_FLOW = "power flow of {area}"
    LOCAL = "estimate of {area}, angles from its local slack"
    UPDATED = "estimate of {area}, angles from the substation"
    WHOLE = "estimates of all areas together"


@dataclass(frozen=True, slots=True)
class Counterpart:
    """The counterpart of a table: ``what`` of ``area`` (empty: the whole grid) in a run of ``scenario``."""

    scenario: str
    what: What
    area: str = ""

    def describe(self) -> str:
        return f"{self.what.format(area=self.area)}, {self.scenario}"


def _of_areas(scenario: str, what: What, tables: Mapping[str, str]) -> dict[str, Counterpart]:
    return {table: Counterpart(scenario, what, area) for table, area in tables.items()}


_UNSORTED: Mapping[str, Counterpart] = {
    "5.1": Counterpart("industrial13-thesis", What.POWER_FLOW),
    "5.3": Counterpart("industrial13-thesis", What.CENTRALISED),
    **_of_areas("industrial13-thesis", What.AREA_POWER_FLOW, {"5.4": "area1", "5.6": "area2"}),
    **_of_areas("industrial13-thesis", What.LOCAL, {"5.5": "area1", "5.7": "area2"}),
    **_of_areas("industrial13-thesis", What.UPDATED, {"5.8": "area1"}),
    "5.9": Counterpart("industrial13-thesis", What.WHOLE),
    **_of_areas("industrial13-thesis-load-error", What.AREA_POWER_FLOW, {"5.10": "area1", "5.11": "area2"}),
    "5.12": Counterpart("industrial13-thesis-message-error", What.WHOLE),
    "5.13": Counterpart("ieee33-thesis", What.POWER_FLOW),
    "5.15": Counterpart("ieee33-thesis", What.CENTRALISED),
    **_of_areas("ieee33-thesis", What.AREA_POWER_FLOW, {"5.16": "area1", "5.18": "area2", "5.20": "area3"}),
    **_of_areas("ieee33-thesis", What.LOCAL, {"5.17": "area1", "5.19": "area2", "5.21": "area3"}),
    **_of_areas("ieee33-thesis", What.UPDATED, {"5.22": "area2", "5.23": "area3"}),
    "5.24": Counterpart("ieee33-thesis", What.WHOLE),
}
BASES = {"5.9": "5.3", "5.10": "5.4", "5.11": "5.6", "5.12": "5.9", "5.24": "5.15"}
"""Table -> the table that the thesis compares it with: areas with the centre, a load error with none."""
COUNTERPARTS = {number: _UNSORTED[number] for number in sorted(_UNSORTED, key=lambda n: int(n.removeprefix("5.")))}
"""Number of the table, in the order of the thesis -> its counterpart."""

QUANTITIES = ("vm_pu", "va_deg", "load_mw", "load_mvar", "gen_mw", "gen_mvar")
States = Mapping[int, tuple[float, ...]]
"""Bus -> QUANTITIES; of an estimate, the first two."""


class ThesisRuns:
    """Runs of the scenarios of the thesis on the simulator; each is run once, and its result is kept."""

    def __init__(self) -> None:
        self._run = functools.cache(_run)

    def find(self, counterpart: Counterpart) -> States:
        """The states of ``counterpart``.

        Raises:
            DsseError: the run ends without consensus.
        """
        outcome, telemetry = self._run(counterpart.scenario)
        partition, whole = outcome.scenario.partition, outcome.scenario.network
        match counterpart.what:
            case What.POWER_FLOW:
                assert telemetry.truth is not None  # these scenarios have no real readings
                return _power_flow(telemetry.truth, whole)
            case What.CENTRALISED:
                return _estimate_from_exact_readings(counterpart.scenario)
            case What.WHOLE:
                found = outcome.comparison.decentralised
                return _states(whole.row, found.vm, found.va)
            case What.AREA_POWER_FLOW:
                return _power_flow(telemetry.area_power_flows[counterpart.area], whole)
        area, published = partition.area(counterpart.area), outcome.comparison.by_area[counterpart.area]
        row = area.network.row
        offset = published.va[row[area.slack_bus]] if counterpart.what is What.LOCAL else 0.0
        return _states(row, published.vm, published.va - offset)


def _run(name: str) -> tuple[RunOutcome, Telemetry]:
    scenario = check_with_strategy(load_scenario(name))
    simulation = Simulation(scenario)
    reason = simulation.run()
    if reason is not None:
        raise DsseError(f"{name}: {reason}")
    return simulation.evaluate(None), make_telemetry(scenario)


def _estimate_from_exact_readings(name: str) -> States:
    """Estimate of the whole grid with the meters of the thesis and exact readings, because the thesis does not give the
    noise of its readings.
    """
    scenario = load_scenario(name, changes={"telemetry.source": "network"})
    result = process_bad_data(scenario.network, make_telemetry(scenario).union).result
    return _states(scenario.network.row, result.vm, result.va)


def _power_flow(flow: PowerFlowResult, whole: Network) -> States:
    """States, loads and generations. A bus without generator generates nothing, so its load is what it draws, of a
    boundary bus with the areas beyond."""
    sources, found = {generator.bus for generator in whole.generators}, {}
    for bus, state in _states(flow.network.row, flow.vm, flow.va).items():
        row = flow.network.row[bus]
        drawn = -complex(flow.injection[row])
        of_bus = flow.network.buses[row]
        load = complex(of_bus.p_load, of_bus.q_load) if bus in sources else drawn
        powers = [whole.base_mva * power for power in (load, load - drawn)]
        found[bus] = (*state, *(part for power in powers for part in (power.real, power.imag)))
    return found


def _states(row: Mapping[int, int], vm: np.ndarray, va: np.ndarray) -> States:
    return {bus: (float(vm[k]), float(np.degrees(va[k]))) for bus, k in row.items()}
