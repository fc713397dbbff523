"""The exact exchange on grids of every kind that the estimators know, with any meters, drawn by hypothesis."""

from dataclasses import replace

import numpy as np
import pytest
from exact_exchange import assert_equals_centralised, assert_same_decisions, run_feeder
from grids import MeterShares, make_grid, with_gross_errors
from hypothesis import event, example, given, reject
from hypothesis import strategies as st

from dsse_core.bad_data import process_bad_data
from dsse_core.errors import EstimationDivergedError, NotObservableError
from dsse_core.estimation import estimate_state

GRIDS = st.fixed_dictionaries(
    dict(
        seed=st.integers(0, 10**6),
        n_bus=st.integers(3, 40),
        n_area=st.integers(2, 9),
        chain=st.sampled_from([0.3, 0.6, 0.9]),
        decades=st.sampled_from([0.0, 1.0, 2.0]),
        loops=st.integers(0, 3),
        transformers=st.sampled_from([0.0, 0.15]),
        short=st.sampled_from([None, 1e-4, 1e-6]),
        slack_at_root=st.booleans(),
        shares=st.builds(
            MeterShares,
            voltage=st.sampled_from([0.0, 0.1, 0.3]),
            angle=st.sampled_from([0.0, 0.1, 0.3]),
            flow=st.sampled_from([0.3, 0.6, 1.0]),
            current=st.sampled_from([0.0, 0.2, 0.5]),
            injection=st.sampled_from([0.7, 0.9, 1.0]),
            boundary_injection=st.sampled_from([0.0, 0.5, 1.0]),
        ),
    )
)


def has_same_objective(bus, report):
    return sum(s.objective for s in bus.states.values()) == pytest.approx(report.objective, rel=1e-6)


def took_another_of_a_tie(bus, report):
    """Whether rounding has decided otherwise between meters that ``report`` names as indistinguishable; J is as low."""
    taken = {meter for state in bus.states.values() for meter in state.removed}
    if taken == {removed.measurement.meter.id for removed in report.removed}:
        return False
    for removed in report.removed:
        assert taken & {removed.measurement.meter.id, *removed.indistinguishable_from}
    assert has_same_objective(bus, report)
    event("another of a tie")
    return True


def at_their_minimum(bus, report, feeder):
    """``report``, or the centralised estimate from where the areas are: gross errors and currents may leave several."""
    if has_same_objective(bus, report):
        return report
    event("another minimum")
    v = {b: v for s in bus.states.values() for b, v in zip(s.buses, zip(s.vm, s.va, strict=True), strict=True)}
    vm, va = np.array([v[b.id] for b in feeder.network.buses]).T
    removed = {removed.measurement.meter.id for removed in report.removed}
    left = [m for m in feeder.measurements if m.meter.id not in removed]
    return replace(report, result=estimate_state(feeder.network, left, start=(vm, va), tolerance=1e-11))


WEAK = MeterShares(flow=0.3, current=0.5)
THREE_BUSES = {"seed": 467362, "n_bus": 3, "n_area": 3, "chain": 0.9, "decades": 1.0, "loops": 2, "transformers": 0.15}

MANY_CURRENTS = MeterShares(voltage=0.3, angle=0.1, flow=0.3, current=0.5, injection=0.7, boundary_injection=1.0)
TWO_MINIMA = {"seed": 279, "n_bus": 25, "n_area": 3, "chain": 0.6, "decades": 2.0, "loops": 0, "transformers": 0.0}
TWO_MINIMA |= {"short": None, "slack_at_root": True, "shares": MANY_CURRENTS}
FEW_METERS = MeterShares(voltage=0.0, angle=0.0, flow=0.6, current=0.0, injection=0.9, boundary_injection=0.5)
UNLIKE_IMPEDANCES = {
    "seed": 1438,
    "n_bus": 3,
    "n_area": 5,
    "chain": 0.3,
    "decades": 2.0,
    "loops": 0,
    "transformers": 0.15,
}
UNLIKE_IMPEDANCES |= {"short": 1e-6, "slack_at_root": True, "shares": FEW_METERS}


@pytest.mark.usefixtures("each_back_end")
@example({**THREE_BUSES, "short": None, "slack_at_root": False, "shares": WEAK}, 0.3, 81)  # critical after a removal
@example(TWO_MINIMA, 0.3, 380)
@example(UNLIKE_IMPEDANCES, 0.0, 40)  # critical where one area's are five thousand times those of the other
@given(GRIDS, st.sampled_from([0.0, 0.3, 0.6]), st.one_of(st.none(), st.integers(0, 1000)))
def test_any_grid_with_any_meters_reaches_it(grid, loss, gross_errors):
    feeder = make_grid(**grid)
    if not any(b.p_load for b in feeder.network.buses if b.id != feeder.network.slack.bus):
        reject()  # where nothing flows, a gross error leaves several minima
    if gross_errors is not None:
        feeder = with_gross_errors(np.random.default_rng(gross_errors), feeder)
    try:
        process_bad_data(feeder.network, feeder.measurements, tolerance=1e-11)
    except (NotObservableError, EstimationDivergedError):
        reject()
    bus, report = run_feeder(feeder, loss, 0)
    if took_another_of_a_tie(bus, report):
        return
    if gross_errors is not None and grid["shares"].current:
        report = at_their_minimum(bus, report, feeder)
    assert_equals_centralised(bus, report)
    if len(feeder.partition.areas) > 1:
        assert_same_decisions(bus, report)
