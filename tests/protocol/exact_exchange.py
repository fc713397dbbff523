"""The exact exchange until it has settled, beside the centralised estimate that it must equal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from feeders import Feeder
from simulated_bus import SimulatedBus, area_files_of, with_links

from agents.protocol.rounds import RoundsProtocol
from dsse_core.estimation.bad_data import BadDataReport, process_bad_data
from dsse_core.estimation.estimator import EstimationResult
from dsse_core.estimation.residuals import CRITICAL_REDUNDANCY
from dsse_core.gauss_newton import LAST_STEP
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import Scenario
from scenarios.telemetry import make_telemetry

GAP = 1e-8  # p.u. and rad
SIGMA = 1e-6  # relative
# rad; an angle that zero injections fix has a sigma of rounding, or of EXACT_SIGMA, which counts for areas
EXACT = 1e-8


def settle(scenario: Scenario, loss: float = 0.0, seed: int = 0) -> tuple[SimulatedBus, BadDataReport]:
    """A bus on which the areas of ``scenario`` have settled, and the centralised estimate."""
    telemetry = make_telemetry(scenario)
    files = area_files_of(scenario, strategy="information", seed=seed)
    bus = SimulatedBus(with_links(files, LinkFaults(loss=loss)), telemetry.by_area)
    settle_bus(bus)
    return bus, process_bad_data(scenario.network, telemetry.union, tolerance=1e-12)


def run_feeder(feeder: Feeder, loss: float, seed: int, **faults: float) -> tuple[SimulatedBus, BadDataReport]:
    """The same of a random feeder or grid."""
    bus = SimulatedBus(feeder.area_files(loss, seed, **faults), feeder.telemetry())
    settle_bus(bus)
    return bus, process_bad_data(feeder.network, feeder.measurements, tolerance=1e-11)


def settle_bus(bus: SimulatedBus, limit_s: float = 600.0) -> None:
    """Until all areas have settled and bad data have been looked for."""
    while not (bus.settled and all(state.checked for state in bus.states.values())):
        assert bus.now < limit_s, {name: (state.checked, state.notes) for name, state in bus.states.items()}
        bus.run(0.05)
    bus.run_until_settled(limit_s)


def assert_equals_centralised(bus: SimulatedBus, report: BadDataReport) -> None:
    """State, standard deviations and removed meters of every area are those of ``report``.

    Standard deviations are those at the state before the areas' last step, which is as small as a last step may be.
    """
    centralised = report.result
    row = centralised.network.row
    sigma_vm, sigma_va = _before_the_last_step(bus, centralised).state_sigma()
    for state in bus.states.values():
        rows = [row[b] for b in state.buses]
        np.testing.assert_allclose(state.vm, centralised.vm[rows], atol=GAP)
        turn = np.exp(1j * (np.array(state.va) - centralised.va[rows]))
        np.testing.assert_allclose(np.angle(turn), 0.0, atol=GAP)
        np.testing.assert_allclose(state.sigma_vm, sigma_vm[rows], rtol=SIGMA)
        fixed = sigma_va[rows] < EXACT
        np.testing.assert_allclose(np.array(state.sigma_va)[~fixed], sigma_va[rows][~fixed], rtol=SIGMA)
        assert np.all(np.array(state.sigma_va)[fixed] < EXACT)
        assert state.rejected == {}
    removed = {removed.measurement.meter.id for removed in report.removed}
    assert {meter for state in bus.states.values() for meter in state.removed} == removed


def _before_the_last_step(bus: SimulatedBus, centralised: EstimationResult) -> EstimationResult:
    """``centralised`` at the state that the areas' last information is of."""
    row, va, vm = centralised.network.row, centralised.va.copy(), centralised.vm.copy()
    for protocol in bus.protocols.values():
        assert isinstance(protocol, RoundsProtocol)
        estimation = protocol._round.estimation
        rows, n = [row[b.id] for b in estimation.area.network.buses], len(estimation.area.network.buses)
        va[rows], vm[rows] = np.split(estimation.linearized_at[: 2 * n], 2)
    turn = np.exp(1j * (va - centralised.va))
    assert max(abs(np.angle(turn)).max(), abs(vm - centralised.vm).max()) < LAST_STEP
    return replace(centralised, vm=vm, va=va)


def assert_same_decisions(bus: SimulatedBus, report: BadDataReport) -> None:
    """The areas have decided what ``report`` has, in its order; critical meters are the same but at the limit."""
    removed = [meter.measurement.meter.id for meter in report.removed]
    for protocol in bus.protocols.values():
        assert isinstance(protocol, RoundsProtocol)
        assert list(protocol.removed) == removed
    result = report.result
    redundancy = result.residual_variance / np.where(result.sigmas > 0, result.sigmas, np.inf) ** 2
    on_edge = (redundancy > CRITICAL_REDUNDANCY / 10) & (redundancy < CRITICAL_REDUNDANCY * 10)
    either = {meter.id for meter, is_on_edge in zip(result.plan.meters, on_edge, strict=True) if is_on_edge}
    critical = (meter for state in bus.states.values() for meter in state.critical)
    assert sorted(m for m in critical if m not in either) == sorted(m for m in report.critical if m not in either)
