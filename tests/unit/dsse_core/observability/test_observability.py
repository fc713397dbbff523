"""Observability is decided by rank, and the error says where the gap is and what would close it."""

import re
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dsse_core.errors import InvalidInputError, NotObservableError
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.grid.admittance import build_admittance, flat_start
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.observability import check_observable, find_indispensable_rows

Kind = MeasurementKind
P_FLOW, Q_FLOW = Kind.P_FLOW, Kind.Q_FLOW
P_INJECTION, Q_INJECTION = Kind.P_INJECTION, Kind.Q_INJECTION


def meters_named(cure):
    """The meters that the text of a cure asks for."""
    what, branch, bus = re.fullmatch(r"(.*?)(?: of branch (\S+))? at bus (\d+)", cure).groups()
    kinds = {
        "voltage magnitude": [Kind.VM],
        "voltage angle": [Kind.VA],
        "voltage magnitude and voltage angle": [Kind.VM, Kind.VA],
        **{f"{q} {place}": [Kind(f"{k}_{place}") for k in q.lower().split(" and ")]
           for q in ("P", "Q", "P and Q") for place in ("flow", "injection")},
    }  # fmt: skip
    return [Meter(kind, int(bus), branch) for kind in kinds[what]]


def pq(bus, branch=None, source=Source.TELEMETERED):
    kinds = (P_FLOW, Q_FLOW) if branch else (P_INJECTION, Q_INJECTION)
    return [Meter(kind, bus, branch, source) for kind in kinds]


def gap_of(network, meters, **options):
    with pytest.raises(NotObservableError) as caught:
        check_observable(network, meters, **options)
    return caught.value


def test_enough_measurements_do_not_help_a_bus_that_none_of_them_sees(chain):
    network = chain(5)
    meters = [Meter(Kind.VM, b) for b in (1, 2, 3, 4)] + [Meter(Kind.VA, b) for b in (2, 3, 4)]
    meters += [m for b in (1, 2, 3) for m in (*pq(b, f"{b}-{b + 1}"), *pq(b + 1, f"{b}-{b + 1}"), *pq(b))]
    assert len(meters) > 2 * (2 * 5 - 1)
    error = gap_of(network, meters)
    assert error.buses == (5,)
    assert "P and Q flow of branch 4-5 at bus 4" in error.cures
    assert "bus 5" in str(error)


def test_exactly_as_many_measurements_as_state_variables_can_be_too_few(chain):
    network = chain(3)
    doubled = [Meter(Kind.VM, 1), *pq(1, "1-2"), *pq(2, "1-2")]
    assert gap_of(network, doubled).buses == (3,)
    check_observable(network, [Meter(Kind.VM, 1), *pq(1, "1-2"), *pq(2, "2-3")])


def test_no_meter_at_all_names_every_bus(chain):
    error = gap_of(chain(40), [])
    assert error.buses == tuple(range(1, 41))
    assert error.cures == ()
    assert "no single added meter" in str(error)


def test_without_a_voltmeter_every_bus_is_open_and_one_voltmeter_cures_it(meshed, meters_of):
    """Charging and shunts do not replace a voltmeter, though they bind Q to the voltage."""
    error = gap_of(meshed, meters_of(meshed, P_FLOW, Q_FLOW, P_INJECTION, Q_INJECTION))
    assert set(error.buses) == {bus.id for bus in meshed.buses}
    assert error.cures[0] == "voltage magnitude at bus 10"


def test_active_power_alone_leaves_the_magnitudes_open(chain):
    """Unbalanced: P but no Q."""
    network = chain(4)
    meters = [Meter(Kind.VM, 1), *(Meter(P_FLOW, b, f"{b}-{b + 1}") for b in (1, 2, 3))]
    assert gap_of(network, meters).buses == (2, 3, 4)


def test_a_missing_q_is_asked_for_alone_and_no_existing_meter_is_suggested_again(chain):
    network = chain(3)
    meters = [Meter(Kind.VM, 1), *pq(1, "1-2"), Meter(P_FLOW, 2, "2-3")]
    error = gap_of(network, meters)
    assert "Q flow of branch 2-3 at bus 2" in error.cures
    for cure in error.cures:
        assert not {m.id for m in meters_named(cure)} & {m.id for m in meters}
        check_observable(network, [*meters, *meters_named(cure)])


def test_current_magnitudes_do_not_make_a_network_observable(chain):
    network = chain(3)
    meters = [Meter(Kind.VM, 1), *pq(1, "1-2"), Meter(Kind.CURRENT, 2, "2-3"), Meter(Kind.CURRENT, 3, "2-3")]
    assert gap_of(network, meters).buses == (3,)


def test_two_islands_of_measurements_need_a_phasor_or_a_flow_between_them(chain):
    network = chain(4)
    islands = [Meter(Kind.VM, 1), Meter(Kind.VM, 4), *pq(1, "1-2"), *pq(3, "3-4")]
    error = gap_of(network, islands)
    assert error.buses == (3, 4)
    assert "P and Q flow of branch 2-3 at bus 2" in error.cures
    check_observable(network, [*islands, Meter(Kind.VA, 3)])
    check_observable(network, [*islands, *pq(2, "2-3")])


def test_a_zero_injection_closes_a_gap(chain):
    network = chain(3)
    meters = [Meter(Kind.VM, 1), *pq(1, "1-2")]
    assert gap_of(network, meters).buses == (3,)
    check_observable(network, [*meters, *pq(2, source=Source.VIRTUAL)])


def test_the_angle_of_the_reference_is_given_and_the_reference_can_be_any_bus(chain):
    network = chain(3)
    meters = [Meter(Kind.VM, 2), *pq(1, "1-2"), *pq(2, "2-3")]
    for reference in (None, 1, 2, 3):
        check_observable(network, meters, reference=reference)
    with pytest.raises(InvalidInputError, match="reference, bus 9"):
        check_observable(network, meters, reference=9)


def test_meters_that_do_not_fit_are_rejected_before_the_analysis(meshed):
    with pytest.raises(InvalidInputError) as caught:
        check_observable(meshed, [Meter(Kind.VM, 99), Meter(P_FLOW, 6, "6-2")])
    assert len(caught.value.problems) == 2


@pytest.mark.parametrize("short", [(), (5,), (5, 9, 20), range(1, 33)])
def test_impedances_near_zero_do_not_look_like_a_gap(chain, short):
    network = chain(33, short=short)
    check_observable(network, [Meter(Kind.VM, 1), *(m for b in range(2, 34) for m in pq(b))])
    check_observable(network, [Meter(Kind.VM, 33), *(m for b in range(1, 33) for m in pq(b, f"{b}-{b + 1}"))])


def test_impedances_near_zero_do_not_hide_a_gap(chain):
    network = chain(33, short=(5, 9, 20))
    error = gap_of(network, [Meter(Kind.VM, 1), *(m for b in range(2, 33) if b != 20 for m in pq(b))])
    assert {21, 33} <= set(error.buses)


@pytest.mark.parametrize("by", ["flows", "injections"])
def test_a_feeder_of_5000_buses_is_checked_sparsely(chain, by):
    network = chain(5000)
    meters = [Meter(Kind.VM, 1)]
    for bus in range(2, 5001):
        meters += pq(bus, f"{bus - 1}-{bus}") if by == "flows" else pq(bus)
    tracemalloc.start()
    check_observable(network, meters)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6  # one dense 10,000 x 10,000 matrix takes 800 MB


@pytest.mark.slow
def test_the_gap_in_a_feeder_of_5000_buses_is_named_with_its_cure(chain):
    network = chain(5000)
    meters = [Meter(Kind.VM, 1)]
    for bus in range(2, 5001):
        if bus != 3000:
            meters += pq(bus, f"{bus - 1}-{bus}")
    error = gap_of(network, meters)
    assert error.buses == tuple(range(3000, 5001))
    assert "P and Q flow of branch 2999-3000 at bus 2999" in error.cures


@st.composite
def measured_grids(draw):
    """A random tree of up to 12 buses with a few extra branches, and a random selection of its meters."""
    n = draw(st.integers(2, 12))
    ends = [(draw(st.integers(1, i - 1)), i) for i in range(2, n + 1)]
    ends += draw(st.lists(st.tuples(st.integers(1, n), st.integers(1, n)).filter(lambda e: e[0] < e[1]), max_size=2))
    ohm = st.floats(0.01, 0.5)
    branches = tuple(
        Branch(f"b{k}", f, t, draw(ohm), draw(ohm), b=0.01, shift=draw(st.sampled_from([0.0, 0.5])))
        for k, (f, t) in enumerate(ends)
    )
    network = Network(
        "random", 1.0, tuple(Bus(i, 10.0) for i in range(1, n + 1)), branches, (Generator(1, Control.SLACK),)
    )
    pool = [[Meter(k, b)] for b in range(1, n + 1) for k in (Kind.VM, Kind.VA)]
    pool += [pq(b) for b in range(1, n + 1)] + [pq(b.from_bus, b.id) for b in branches]
    pool += [[Meter(Q_FLOW, b.to_bus, b.id)] for b in branches]
    chosen = draw(st.lists(st.sampled_from(range(len(pool))), unique=True, min_size=n // 2, max_size=2 * n))
    return network, [meter for k in chosen for meter in pool[k]]


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(measured_grids())
def test_the_verdict_is_the_rank_and_every_named_meter_really_cures(grid):
    network, meters = grid
    n = len(network.buses)
    vm, va = flat_start(network, 1)
    model = build_measurement_model(network, build_admittance(network, with_shunts=False), meters)
    H = np.delete(model.jacobian(np.r_[va, vm]).toarray(), 0, axis=1)
    kernel = np.linalg.svd(H)[2][np.linalg.matrix_rank(H, tol=1e-7) if len(H) else 0 :] if len(H) else np.eye(2 * n - 1)
    if len(kernel) == 0:
        check_observable(network, meters)
        return
    error = gap_of(network, meters)
    loose = np.insert(np.linalg.norm(kernel, axis=0) > 1e-5, 0, False)
    assert error.buses == tuple(b.id for k, b in enumerate(network.buses) if loose[k] or loose[n + k])
    for cure in error.cures:
        check_observable(network, [*meters, *meters_named(cure)])


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(measured_grids())
def test_a_meter_is_indispensable_when_the_others_do_not_determine_the_state(grid):
    network, chosen = grid
    meters = [Meter(Kind.VM, 1), *(m for m in chosen if m.id != "vm@1"), Meter(Kind.CURRENT, 1, "b0")]
    flows = [m for b in network.branches for m in pq(b.from_bus, b.id) if m.id not in {meter.id for meter in meters}]
    meters += flows[: len(flows) // 2]
    try:
        check_observable(network, meters)
    except NotObservableError:
        return
    needed = set()
    for k, meter in enumerate(meters):
        try:
            check_observable(network, meters[:k] + meters[k + 1 :])
        except NotObservableError:
            needed.add(meter.id)
    found = find_indispensable_rows(network, meters, reference=1)
    assert {meters[k].id for k in np.flatnonzero(found)} == needed


@pytest.mark.slow
@pytest.mark.parametrize("short", [(), (5, 20)])
def test_indispensable_meters_of_a_feeder_of_5000_buses_are_distinguished_from_hardly_checked_ones(
    chain, short, backend
):
    """With injections alone nothing can be spared; a second voltmeter at the far end checks every one of them."""
    network = chain(5000 if not short else 500, short=short)
    n = len(network.buses)
    meters = [Meter(Kind.VM, 1), *(m for b in range(2, n + 1) for m in pq(b))]
    assert build_estimation_plan(network, meters, backend=backend).indispensable.all()
    assert not build_estimation_plan(network, [*meters, Meter(Kind.VM, n)], backend=backend).indispensable.any()
