"""The areas' iterates are the centre's: the same verdicts, x_k at every k, and the same meters taken out."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from unittest import mock

import numpy as np
import pytest

from dsse_core.errors import EstimationDivergedError, NotObservableError
from dsse_core.estimation.bad_data import BadDataReport, process_bad_data
from dsse_core.estimation.decision import Decision, Verdict
from dsse_core.estimation.estimator import WholeGrid
from dsse_core.estimation.residuals import find_dead
from dsse_core.exchange.area_estimation import AreaEstimation
from dsse_core.grid.measurement import Source
from dsse_core.observability import find_indispensable_rows
from tests.golden.centralised.oracle_cases import Drawn, draw_examples, draw_feeders, draw_grids
from tests.support.back_ends import BACK_ENDS, back_end
from tests.support.exact_exchange import assert_equals_centralised, assert_same_decisions, settle_bus
from tests.support.feeders import Feeder, make_feeder
from tests.support.grids import MeterShares, make_grid, with_gross_errors
from tests.support.loaded_feeders import make_loaded_feeder, make_outvoted_feeder
from tests.support.rings import make_ring_feeder
from tests.support.simulated_bus import SimulatedBus

MOST_OF_ALL, ALL, AT_THE_END = 1e-9, 1e-7, 1e-8  # p.u. and rad
MOST = 0.95  # of all x_k
SAME_FIT = 1e-6  # of J, relative, where rounding decides which of two equal residuals is the largest


@dataclass
class Trace:
    """What has been carried out, and x after it: the state that the next verdict is on."""

    verdicts: list[str] = field(default_factory=list)
    states: list[np.ndarray] = field(default_factory=list)

    def add(self, verdict: Verdict, x: np.ndarray) -> None:
        if verdict.takes_step or verdict.decision in (Decision.SHORTEN, Decision.USE_CURRENTS):
            self.verdicts.append(str(replace(verdict, share=round(verdict.share, 6))))
            self.states.append(x.copy())


@contextmanager
def traced(carries_out: type, trace_of: Callable[[Any], Trace]) -> Iterator[None]:
    """Whatever objects of the class ``carries_out`` carry out goes into the trace of each."""
    original = carries_out.carry_out

    def carry_out(self, verdict: Verdict, *rest: Any) -> None:
        original(self, verdict, *rest)
        trace_of(self).add(verdict, self.x)

    with mock.patch.object(carries_out, "carry_out", carry_out):
        yield


def trace_centre(feeder: Feeder) -> tuple[Trace, BadDataReport]:
    trace = Trace()
    with traced(WholeGrid, lambda _: trace):
        return trace, process_bad_data(feeder.network, feeder.measurements, backend="sparse")


def trace_areas(feeder: Feeder) -> tuple[dict[str, Trace], SimulatedBus]:
    traces = {area.name: Trace() for area in feeder.partition.areas}
    with traced(AreaEstimation, lambda estimation: traces[estimation.area.name]):
        bus = SimulatedBus(feeder.area_files(0.0, 0), feeder.telemetry())
        settle_bus(bus)
    return traces, bus


def feeder_of(drawn: Drawn) -> Feeder:
    arguments = drawn["arguments"]
    if drawn["kind"] == "grid":
        feeder = make_grid(**arguments | {"shares": MeterShares(**arguments["shares"])})
    else:
        feeder = make_feeder(**arguments)
    if drawn["gross_errors"] is not None:
        feeder = with_gross_errors(np.random.default_rng(drawn["gross_errors"]), feeder)
    return feeder


def find_gaps(feeder: Feeder, traces: dict[str, Trace], centre: Trace) -> list[float]:
    """Between areas and centre at each k: the largest of any voltage, p.u. or rad."""
    row, n = feeder.network.row, len(feeder.network.buses)
    gaps = []
    for k, x in enumerate(centre.states):
        gap = 0.0
        for area in feeder.partition.areas:
            own, n_own = traces[area.name].states[k], len(area.network.buses)
            rows = [row[bus.id] for bus in area.network.buses]
            gap = max(gap, float(abs(own[n_own : 2 * n_own] - x[n:][rows]).max()))
            gap = max(gap, float(abs(np.angle(np.exp(1j * (own[:n_own] - x[:n][rows])))).max()))
        gaps.append(gap)
    return gaps


@dataclass
class Compared:
    gaps: list[float] = field(default_factory=list)
    ends: list[float] = field(default_factory=list)

    def compare(self, feeder: Feeder, name: str) -> None:
        try:
            centre, report = trace_centre(feeder)
        except (NotObservableError, EstimationDivergedError):
            return
        traces, bus = trace_areas(feeder)
        first = len(find_dead([m.meter for m in feeder.measurements], [m.value for m in feeder.measurements]))
        report = replace(report, removed=report.removed[first:])  # dead voltmeters, which areas leave out by themselves
        removed = tuple(removed.measurement.meter.id for removed in report.removed)
        by_areas = {protocol.removed for protocol in bus.protocols.values()}
        assert len(by_areas) == 1, name
        if by_areas != {removed}:
            assert_are_tied(report, *by_areas)
            objective = sum(state.objective for state in bus.states.values())
            assert objective == pytest.approx(report.objective, rel=SAME_FIT), (name, removed, by_areas)
            return
        for trace in traces.values():
            assert trace.verdicts == centre.verdicts, name
        gaps = find_gaps(feeder, traces, centre)
        self.gaps += gaps
        self.ends.append(gaps[-1])


def assert_are_tied(report: BadDataReport, by_areas: tuple[str, ...]) -> None:
    """Where the areas first take out another meter than the centre, that cannot tell the two apart."""
    for removed, other in zip(report.removed, by_areas, strict=False):
        if other != removed.measurement.meter.id:
            assert other in removed.indistinguishable_from
            return
    pytest.fail(f"areas take out {len(by_areas)} meters, the centre {len(report.removed)}")


def has_load(feeder: Feeder) -> bool:
    return any(b.p_load for b in feeder.network.buses if b.id != feeder.network.slack.bus)


def compare_all(drawn: Iterator[Drawn]) -> Compared:
    """Each grid with one of the back ends of areas."""
    compared = Compared()
    for k, one in enumerate(drawn):
        with back_end(BACK_ENDS[k % len(BACK_ENDS)]):
            if has_load(feeder := feeder_of(one)):
                compared.compare(feeder, f"{k}: {one}")
    return compared


def assert_are_the_centres(compared: Compared) -> None:
    assert max(compared.gaps) < ALL
    assert max(compared.ends) < AT_THE_END
    assert np.quantile(compared.gaps, MOST) < MOST_OF_ALL


# Shares of all x_k are of one collection, not of many small ones: ``n_cases``.


@pytest.mark.long
def test_on_the_examples_of_any_grid():
    assert_are_the_centres(compare_all(draw_examples()))


@pytest.mark.n_cases(few=6, long=12, many=300)
def test_on_random_grids(n_cases):
    assert_are_the_centres(compare_all(itertools.islice(draw_grids(), n_cases)))


@pytest.mark.usefixtures("each_back_end")
def test_meters_that_cannot_be_spared_behind_a_busbar_are_the_centres():
    """Of grid 71 the hub is a busbar of 1e-6 p.u., where a dense factor would round away the damping at no load."""
    feeder, compared = feeder_of(next(itertools.islice(draw_grids(), 71, None))), Compared()
    compared.compare(feeder, "grid 71")
    assert_are_the_centres(compared)
    _, report = trace_centre(feeder)
    _, bus = trace_areas(feeder)
    assert not report.removed
    meters = [m.meter for m in feeder.measurements]
    real = {meter.id for meter in meters if meter.source is not Source.VIRTUAL}
    indispensable = np.flatnonzero(find_indispensable_rows(feeder.network, meters))
    critical = {meters[k].id for k in indispensable} & real
    assert critical
    assert {meter for state in bus.states.values() for meter in state.critical} == critical


@pytest.mark.n_cases(few=4, long=10, many=400)
def test_on_random_feeders_sound_and_with_gross_errors(n_cases):
    assert_are_the_centres(compare_all(itertools.islice(draw_feeders(), 0, None, 400 // n_cases)))


@pytest.mark.n_cases(few=2, long=2, many=60)
def test_where_rings_pass_through_an_area_and_its_parent_and_taps_do_not_cancel_around_them(n_cases):
    """In draws 7 and 16 areas by themselves would begin elsewhere, by 3e-4 and 7e-4 p.u."""
    compared = Compared()
    for k in (7, 16) if n_cases == 2 else range(n_cases):
        if feeder := make_ring_feeder(k, 2 + k % 5, 1 + k % 3, decades=1.0 + 2.0 * (k % 2)):
            compared.compare(feeder, f"ring {k}")
    assert_are_the_centres(compared)


@pytest.mark.n_cases(few=2, long=8, many=200)
def test_where_rings_pass_through_any_areas(n_cases):
    """Some variables are relayed by areas that are not at their bus; a third of the grids has gross errors."""
    compared, widest = Compared(), 0
    for k in range(n_cases):
        feeder = make_ring_feeder(k, 5 + k % 6, 1 + 5 * k % 11, decades=0.5 + k % 3, anywhere=True)
        assert feeder is not None
        widest = max(boundary.d for area in feeder.partition.areas for boundary in area.boundaries.values())
        if k % 3 == 1:
            feeder = with_gross_errors(np.random.default_rng(k), feeder)
        compared.compare(feeder, f"ring {k}")
    assert widest > 8
    assert_are_the_centres(compared)


@pytest.mark.random_cases(few=1, long=2, many=50)
@pytest.mark.parametrize("full", [True, False])
def test_near_the_limit_of_loading_undamped_steps_end_in_areas_and_centre_alike(random_seed, full):
    """At 90 to 99 % of the largest load: no step control is needed, and none is there."""
    feeder = make_loaded_feeder(random_seed, full=full)
    centre, report = trace_centre(feeder)
    assert not report.result.memory.from_flat_start
    with back_end(BACK_ENDS[random_seed % len(BACK_ENDS)]):
        traces, bus = trace_areas(feeder)
    assert {trace.verdicts == centre.verdicts for trace in traces.values()} == {True}
    assert_equals_centralised(bus, report)
    assert max(find_gaps(feeder, traces, centre)) < ALL


@pytest.mark.usefixtures("each_back_end")
def test_where_a_removal_makes_the_iteration_diverge_areas_and_centre_rest_on_the_estimate_before():
    feeder = make_outvoted_feeder()
    report = process_bad_data(feeder.network, feeder.measurements, backend="sparse")
    assert report.detected
    assert report.removed == ()
    assert (report.suspect.meter.id, report.suspect.reason) == ("vm@3", "diverges")
    bus = SimulatedBus(feeder.area_files(0.0, 0), feeder.telemetry())
    settle_bus(bus)
    assert_equals_centralised(bus, report)
    assert_same_decisions(bus, report)
    for state in bus.states.values():
        assert state.quality == "degraded"
        assert "vm@3 stands out, and stays because without it the iteration does not converge" in state.notes[0]


@pytest.mark.usefixtures("each_back_end")
def test_no_two_areas_state_two_standard_deviations_of_the_bus_that_they_share():
    """They would where own rows after the last step, 1e-7 here, stand beside what the neighbours told before it."""
    shares = MeterShares(voltage=0.1, angle=0.3, injection=0.9, boundary_injection=0.5)
    grid = {"seed": 776114, "n_bus": 7, "n_area": 3, "chain": 0.3, "decades": 0.0, "loops": 1, "transformers": 0.0}
    feeder = make_grid(**grid, short=None, slack_at_root=True, shares=shares)
    _, bus = trace_areas(with_gross_errors(np.random.default_rng(307), feeder))
    stated: dict[int, list[tuple[float, float]]] = {}
    for state in bus.states.values():
        for bus_id, *sigmas in zip(state.buses, state.sigma_vm, state.sigma_va, strict=True):
            stated.setdefault(bus_id, []).append(tuple(sigmas))
    shared = [sigmas for sigmas in stated.values() if len(sigmas) > 1]
    assert shared
    for sigmas in shared:
        np.testing.assert_allclose(sigmas[1:], [sigmas[0]] * (len(sigmas) - 1), rtol=1e-9)
