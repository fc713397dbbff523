"""Areas of networks with phases: their estimate is the centre's, and so is their way to it."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import NotObservableError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.estimation.decision import add_totals
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement, Meter, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Network
from dsse_core.linear.area_model import build_area_model
from dsse_core.linear.dense import DenseRows
from dsse_core.linear.sparse import SparseRows
from tests.support.centre import GAP, assert_goes_the_centres_way, assert_is_the_centres, trace_centre
from tests.support.levels import further, many_more
from tests.support.phases import AREAS, DEEP, KIND, RING, TIE, make_feeder, read_meters, run_rounds, solve
from tests.support.random_phases import make_random_feeder, make_wrong, read_random_meters

TWO = {"head": [650, 632, 671, 684, 611, 692, 675], "two": AREAS["two"]}


@pytest.mark.parametrize("areas", [TWO, AREAS, DEEP, RING], ids=["two areas", "four", "six", "ring"])
def test_areas_with_phases_go_the_centres_way_to_its_estimate(areas: dict[str, list[int]]) -> None:
    assert_all_go_the_centres_way(make_feeder(*([TIE] if areas is RING else [])), areas)


THREE_LEGS = {645: ("bc",), 671: ("ab", "bc", "ac"), 675: ("ab",), 692: ("ab", "bc", "ac")}
ONE_LEG = {646: ("bc",), 671: ("ab",), 684: ("ac",), 692: ("bc", "ab")}


AT_LEGS = [(THREE_LEGS, TWO), (THREE_LEGS, RING), (ONE_LEG, DEEP), (ONE_LEG, RING)]


@pytest.mark.parametrize("case", [(THREE_LEGS, DEEP), (ONE_LEG, AREAS), *further(*AT_LEGS)])
def test_areas_meet_at_buses_with_legs_between_phases_and_go_the_centres_way(
    case: tuple[dict[int, tuple[str, ...]], dict[str, list[int]]],
) -> None:
    """Legs at boundaries of three phases, of which the children have two and three, next to them and behind a bank."""
    legs, areas = case
    assert_all_go_the_centres_way(make_feeder(*([TIE] if areas is RING else []), between=legs), areas)


def assert_all_go_the_centres_way(network: Network, areas: dict[str, list[int]]) -> None:
    """With many meters and few, and sigmas over decades, x_k and the end are the centre's."""
    partition, gaps = build_partition(network, areas), list[float]()
    for is_rich, decades in itertools.product((True, False), (0.0, 1.0, 3.0)):
        gaps += assert_goes_the_centres_way(partition, read_meters(network, 2, decades, is_rich=is_rich))
    assert np.quantile(gaps, 0.95) < GAP


@pytest.mark.parametrize("areas", [AREAS, *further(DEEP)], ids=["four", "six"])
def test_areas_count_totals_as_the_centre_does_and_a_total_at_a_boundary_with_the_powers_beyond(
    areas: dict[str, list[int]],
) -> None:
    """Totals in place of the readings of phases, at boundaries of two phases and of three, and one wrong of them."""
    network = make_feeder()
    partition, x = build_partition(network, areas), solve(network)
    places = [(650, "reg"), (645, "645-632"), (671, "671-692"), (692, "692-675")]
    totals = [Meter(kind, *place) for place in places for kind in (KIND.P_FLOW, KIND.Q_FLOW)]
    totals += [Meter(kind, bus) for bus in (671, 646) for kind in (KIND.P_INJECTION, KIND.Q_INJECTION)]
    read = build_measurement_model(network, build_admittance(network), totals).predict(x)
    read[5] += 0.2
    replaced = {f"{kind}_injection@671.{phase}" for kind in "pq" for phase in "ab"}
    readings = [m for m in read_meters(network, 4, 0.5, is_rich=False) if m.meter.id not in replaced]
    readings += [Measurement(m, value, 1e-3) for m, value in zip(totals, read.tolist(), strict=True)]
    report, verdicts, _ = trace_centre(network, readings)
    assert [removed.measurement.meter for removed in report.removed] == [totals[5]]
    rounds = run_rounds(partition, readings)
    assert [
        verdict for verdict in rounds.verdicts if verdict != "anew"
    ] == verdicts  # a removal: in the centre a new plan
    assert_is_the_centres(rounds, partition, report)


@pytest.mark.parametrize("wrong", ["p_flow@632.b:645-632", "vm@684.c", "q_injection@675.a"])
def test_areas_take_out_the_wrong_reading_of_a_phase_that_the_centre_takes_out(wrong: str) -> None:
    network = make_feeder()
    readings = read_meters(network, 3, 0.5, is_rich=True)
    readings = [replace(m, value=m.value + 0.1) if m.meter.id == wrong else m for m in readings]
    partition, report = build_partition(network, DEEP), process_bad_data(network, readings)
    assert [removed.measurement.meter.id for removed in report.removed] == [wrong]
    assert_is_the_centres(run_rounds(partition, readings), partition, report)


UNMETERED = {
    "one phase of a lateral": (
        {"vm@646.b", *(f"{kind}_injection@{bus}.b" for kind in "pq" for bus in (645, 646))},
        "P and Q flow of branch 645-646 at bus 645.b",
    ),
    "the end of a lateral": (
        {"vm@611.c", *(f"{kind}_injection@{bus}.c" for kind in "pq" for bus in (611, 684))},
        "voltage magnitude and voltage angle at bus 611.c",
    ),
    "all phases behind a bank": (
        {f"{kind}@{bus}.{p}" for kind in ("vm", "p_injection", "q_injection") for bus in (675, 692) for p in "abc"}
        | {f"{kind}@692.{p}:692-675" for kind in ("p_flow", "q_flow", "current") for p in "abc"},
        "P and Q injection at bus 675.a, 675.b, 675.c",
    ),
}


@pytest.mark.parametrize("out", UNMETERED)
def test_areas_name_the_phases_of_buses_that_the_centre_names_with_a_cure(out: str) -> None:
    network, (ids, cure) = make_feeder(), UNMETERED[out]
    readings = [m for m in read_meters(network, 2, 0.0, is_rich=True) if m.meter.id not in ids]
    with pytest.raises(NotObservableError) as caught:
        process_bad_data(network, readings)
    rounds = run_rounds(build_partition(network, DEEP), readings)
    assert rounds.verdicts[-1] == "final unobservable"
    named = add_totals([side.totals() for side in rounds.estimations.values()]).unobservable
    assert sorted(named) == sorted(map(str, caught.value.buses))
    assert cure in caught.value.cures


RANDOM_SIGMA = 1e-9  # p.u. and rad: of voltages that exact readings determine, which areas hold with EXACT_SIGMA


@pytest.mark.parametrize("seed", [0, 1, *further(*range(2, 30)), *many_more(*range(30, 300))])
def test_areas_of_random_feeders_of_mixed_phases_go_the_centres_way(seed: int) -> None:
    """With legs between phases, banks, regulators, totals and currents, sigmas over up to three decades."""
    rng = np.random.default_rng(seed)
    network, areas = make_random_feeder(rng)
    readings = read_random_meters(rng, network, float(rng.choice([0, 1, 3])))
    assert_goes_the_centres_way(build_partition(network, areas), readings, least=RANDOM_SIGMA)


@pytest.mark.parametrize("seed", [1000, *further(*range(1001, 1010)), *many_more(*range(1010, 1100))])
def test_areas_of_random_feeders_take_out_what_the_centre_takes_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    network, areas = make_random_feeder(rng)
    readings = make_wrong(rng, read_random_meters(rng, network, 0.5))
    partition, report = build_partition(network, areas), process_bad_data(network, readings)
    assert_is_the_centres(run_rounds(partition, readings), partition, report, least=RANDOM_SIGMA)


@pytest.mark.parametrize("gone", ["two", "west", "one"])
def test_a_child_that_falls_silent_counts_as_it_was(gone: str) -> None:
    network = make_feeder()
    readings = read_meters(network, 2, 0.0, is_rich=True)
    partition = build_partition(network, AREAS | ({"west": [671, 684], "one": [684, 611]} if gone == "one" else {}))
    first = run_rounds(partition, readings)
    before = {name: side.x for name, side in first.estimations.items()}
    for name, side in run_rounds(partition, readings, first, gone).estimations.items():
        assert side.x == pytest.approx(before[name], abs=1e-3)


def test_rows_beside_powers_into_children_have_the_derivatives_of_their_readings() -> None:
    """Powers between phases, totals and currents of buses, at buses with an area beyond, by dense and sparse rows."""
    area = build_partition(make_feeder(), DEEP).area("head")
    powers, currents = (KIND.P_INJECTION, KIND.Q_INJECTION), (KIND.I_REAL, KIND.I_IMAG)
    meters = [Meter(kind, bus, source=Source.VIRTUAL) for bus in (632, 671) for kind in currents]
    meters += [Meter(kind, 671, phases=phases) for phases in ("", "a", "ab", "ca") for kind in powers]
    model = build_area_model(area, [Measurement(m, 0.0, 0.01) for m in meters], 650)
    n, rng = model.n_nodes, np.random.default_rng(3)
    vm, va = area.find_no_load()
    x = np.r_[va + 0.05 * rng.normal(size=n), vm + 0.05 * rng.normal(size=n), rng.normal(size=model.size - 2 * n)]
    for rows in (DenseRows(model), SparseRows(model)):
        H, steps = rows.jacobian(x), 1e-6 * np.eye(len(x))
        numeric = np.transpose([(rows.predict(x + d) - rows.predict(x - d)) / 2e-6 for d in steps])
        assert (H.toarray() if isinstance(rows, SparseRows) else H) == pytest.approx(numeric, abs=1e-7)
