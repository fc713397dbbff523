"""The power flow of networks with phases: round trips, derivatives, and the feeders of OpenDSS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError, PowerFlowDivergedError
from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.loads import Load
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import Primitive
from dsse_core.grid.primitives import Side, build_bank, build_line, connect
from dsse_core.grid.switches import take_fed
from dsse_core.power_flow.batch import solve_power_flow_batch
from dsse_core.power_flow.exact_readings import read_exactly
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.power_flow.plan import build_power_flow_plan
from dsse_core.results.deviations.choose import find_deviations
from tests.support.ieee_feeders import NAMES, load_feeder, load_voltages
from tests.support.phases import BUSES, KIND, WYE, bank, coupled_line, make_feeder

Z = np.array([[0.0346 + 0.1018j, 0.0156 + 0.0502j, 0.0158 + 0.0424j], [0, 0.0337 + 0.1048j, 0.0154 + 0.0385j]])
Z = np.triu([*Z, [0, 0, 0.0341 + 0.1035j]]) + np.triu([*Z, [0, 0, 0]], 1).T  # coupled conductors, p.u.


def branch(from_bus: int, to_bus: int, primitive: Primitive) -> Branch:
    return Branch(f"{from_bus}-{to_bus}", from_bus, to_bus, r=0.01, x=0.05, primitive=primitive)


def line(phases: str, length: float) -> Primitive:
    chosen = ["abc".index(phase) for phase in phases]
    k = len(chosen)
    return build_line(phases, length * Z[np.ix_(chosen, chosen)], 2e-3j * (np.eye(k) - 0.1))


@pytest.fixture
def feeder() -> Network:
    """A regulator with a tap per phase, coupled lines of three and two phases, a delta-wye bank, legs of all kinds."""
    phases = {1: "abc", 2: "abc", 3: "abc", 4: "bc", 5: "abc"}
    branches = (
        branch(
            1, 2, build_bank(connect("abc", "grounded"), connect("abc", "grounded", (1.05, 1.03, 1.06)), 500 - 900j)
        ),
        branch(2, 3, line("abc", 0.4)),
        branch(3, 4, line("bc", 0.2)),
        branch(3, 5, build_bank(connect("abc", "delta reversed"), connect("abc", "grounded"), 2 - 12j)),
    )
    loads = (
        Load(3, "a", 0.3 + 0.1j),
        Load(3, "ab", 0.2 + 0.1j),
        Load(3, "bc", 0.1 + 0.15j, (1.0, 1.0)),
        Load(4, "b", 0.2 + 0.1j, (2.0, 2.0)),
        Load(4, "bc", 0.15 + 0.05j, (2.0, 0.7)),
        Load(5, "a", 0.3 + 0.2j),
        Load(5, "c", 0.1 + 0.05j, (1.0, 2.0)),
    )
    buses = tuple(Bus(bus, 4.16, phases=of_bus) for bus, of_bus in phases.items())
    sources = Generator(1, Control.SLACK, vm=1.01, va=0.1), Generator(5, Control.POWER, p=0.05, q=0.01)
    return Network("feeder", 5.0, buses, branches, sources, loads)


def test_the_injections_of_the_solution_are_what_legs_draw_at_its_voltages(feeder: Network) -> None:
    found = solve_power_flow(feeder, tolerance=1e-13)
    v = found.vm * np.exp(1j * found.va)
    produced = np.where(feeder.table.nodes.item == 4, 0.05 + 0.01j, 0)
    due = produced - feeder.legs.draw(v)
    assert found.method == "sweep"
    assert found.injection[3:] == pytest.approx(due[3:], abs=1e-12)
    assert found.vm[:3] == pytest.approx(1.01)
    assert found.va[:3] == pytest.approx(0.1 + np.radians([0, -120, 120]))
    assert abs(found.vm - build_power_flow_plan(feeder).start[14:]).max() > 0.02


def test_derivatives_of_power_flows_with_legs_of_all_kinds_are_those_of_differences(feeder: Network) -> None:
    plan = build_power_flow_plan(feeder)
    x = plan.start - 0.03 * np.random.default_rng(2).random(len(plan.start))
    step = 1e-6 * np.eye(len(x))
    numeric = np.transpose([(plan.find_injections(x + d) - plan.find_injections(x - d)) / 2e-6 for d in step])
    away = np.arange(len(x)) % feeder.n_nodes >= 6  # far from the stiff regulator
    exact = plan.jacobian(x).toarray()
    assert exact[:, away] == pytest.approx(numeric[:, away], abs=1e-7)
    assert exact == pytest.approx(numeric, abs=2e-5)


def test_meters_of_a_solved_feeder_read_what_the_circuit_has(feeder: Network) -> None:
    found = solve_power_flow(feeder)
    kind = KIND
    meters = [Meter(kind.VM, 4, phases="bc"), Meter(kind.P_FLOW, 3, "3-4", phases="b"), Meter(kind.VA, 5, phases="c")]
    meters += [Meter(kind.CURRENT, 5, "3-5", phases="a"), Meter(kind.Q_INJECTION, 3, phases="a")]
    exact, size = read_exactly(found, meters)
    assert exact == pytest.approx(found.read_all(meters), rel=1e-12)
    assert (size >= abs(exact) - 1e-12).all()


def test_rows_of_a_batch_and_extra_loads_count_at_every_node(feeder: Network) -> None:
    more = solve_power_flow(feeder, extra_load={5: 0.02 + 0.01j})
    s = np.stack([feeder.scheduled, feeder.scheduled - np.where(feeder.table.nodes.item == 4, 0.02 + 0.01j, 0)])
    batch = solve_power_flow_batch(feeder, s.real, s.imag, threads=1)
    assert not batch.failures
    assert batch.vm == pytest.approx(np.stack([solve_power_flow(feeder).vm, more.vm]), abs=1e-12)


def test_equal_phases_have_the_voltages_of_the_balanced_network() -> None:
    z, charging, s = 0.02 + 0.06j, 4e-3j, 0.5 + 0.2j
    balanced = Network(
        "one", 1.0, (Bus(1, 20.0), Bus(2, 20.0, p_load=s.real, q_load=s.imag)),
        (Branch("1-2", 1, 2, z.real, z.imag, charging.imag),), (Generator(1, Control.SLACK),),
    )  # fmt: skip
    buses = Bus(1, 20.0, phases="abc"), Bus(2, 20.0, phases="abc")
    primitive = build_line("abc", z * np.eye(3), charging * np.eye(3))
    loads = tuple(Load(2, phase, s) for phase in "abc")
    network = Network("three", 1.0, buses, (branch(1, 2, primitive),), balanced.generators, loads)
    one = solve_power_flow(balanced, method="newton", tolerance=1e-14)
    three = solve_power_flow(network, tolerance=1e-14)
    assert three.vm == pytest.approx(np.repeat(one.vm, 3), abs=1e-13)
    assert three.iterations <= one.iterations


def test_newton_takes_over_where_sweeps_do_not_settle() -> None:
    """Near the most that a feeder carries sweeps creep."""
    network = load_feeder("4bus-dy")
    heavy = replace(network, loads=tuple(replace(load, s=1.3 * load.s) for load in network.loads))
    found = solve_power_flow(heavy, method="sweep")
    assert found.method == "newton"
    assert 0.6 < found.vm.min() < 0.7


def test_what_a_power_flow_with_phases_cannot_serve_is_refused_by_name(feeder: Network) -> None:
    floating = replace(feeder, buses=(*feeder.buses[:3], Bus(4, 4.16, phases="abc"), feeder.buses[4]))
    with pytest.raises(InvalidInputError, match="joins phase a of bus 4 to the slack bus 1; feed the phase"):
        solve_power_flow(floating)
    holding = replace(feeder, generators=(*feeder.generators, Generator(3, Control.VOLTAGE)))
    with pytest.raises(InvalidInputError, match="a generator holds the voltage of bus 3, which has phases"):
        solve_power_flow(holding)
    with pytest.raises(PowerFlowDivergedError, match=r"at bus [35]"):
        solve_power_flow(replace(feeder, loads=(*feeder.loads, Load(5, "a", 9.0))))


def test_phases_that_no_winding_reaches_are_refused_by_name(feeder: Network) -> None:
    bank = branch(3, 5, build_bank(connect("abc", "grounded"), Side("abc", ("ab", "ab", "ab"), (1.7,) * 3), 2 - 12j))
    with pytest.raises(InvalidInputError, match="joins phase c of bus 5 to the slack bus 1"):
        solve_power_flow(
            replace(feeder, branches=(*feeder.branches[:3], bank), loads=(), generators=feeder.generators[:1])
        )


def test_a_delta_reversed_on_the_high_side_makes_the_low_side_lag_by_30_degrees() -> None:
    buses = Bus(1, 12.47, phases="abc"), Bus(2, 4.16, phases="abc")
    bank = build_bank(connect("abc", "delta reversed"), connect("abc", "grounded"), 2 - 12j)
    found = solve_power_flow(Network("idle", 6.0, buses, (branch(1, 2, bank),), (Generator(1, Control.SLACK),)))
    assert found.vm == pytest.approx(np.ones(6), abs=1e-12)
    assert np.degrees(found.va[3:]) == pytest.approx([-30, -150, 90], abs=1e-10)


UNGROUNDED = {"ieee37": 38, "ieee123": 1, "4bus-yd": 2, "4bus-grdyd": 2, "4bus-oyod": 2}  # buses


@pytest.mark.parametrize("name", NAMES)
def test_feeders_have_the_voltages_of_opendss(name: str) -> None:
    network = load_feeder(name)
    found, newton = (solve_power_flow(network, tolerance=1e-12, method=method) for method in ("sweep", "newton"))
    assert (found.method, newton.method) == ("sweep", "newton")
    assert found.vm == pytest.approx(newton.vm, abs=1e-11)
    assert found.va == pytest.approx(newton.va, abs=1e-11)
    assert newton.iterations <= 5
    apart = found.vm * np.exp(1j * found.va) - load_voltages(name)
    assert len(network.gauge.ungrounded) == UNGROUNDED.get(name, 0)
    for bus in network.buses[1:]:  # the first one is the source behind its impedance
        of_bus = apart[network.nodes_at(bus.id)]
        assert abs(of_bus - of_bus[0]).max() < 1e-8
        if bus.id not in network.gauge.ungrounded:
            assert abs(of_bus).max() < 1e-8


def test_phases_without_supply_leave_what_a_network_without_their_conductors_has_in_power_flow_and_estimate() -> None:
    """The oracle has lines of two phases, whose impedances are those of the two: no current flows in the third one."""
    whole = make_feeder()
    lines = [_without_charging(b) for b in whole.branches if b.id not in ("632-671", "692-675")]
    switches = [replace(coupled_line(f"632-671.{p}", (632, 671), p, 0.3), switch=True) for p in "abc"]
    network = replace(whole, branches=(*lines, *switches, bank("692-675", (692, 675), WYE)))
    operated = network.operated({"632-671.c": False})
    live = {**{bus: phases.replace("c", "") for bus, phases in BUSES.items() if bus in (671, 684, 692, 675)}, 611: ""}
    kept = {bus.id: live.get(bus.id, bus.phases) for bus in network.buses}
    fewer = replace(
        network,
        buses=tuple(replace(bus, phases=kept[bus.id]) for bus in network.buses if kept[bus.id]),
        branches=tuple(_without_c(b, kept) for b in operated.active_branches if b.id != "684-611"),
        loads=tuple(load for load in network.loads if load.phases in kept[load.bus]),
        shunts=tuple(shunt for shunt in network.shunts if set(shunt.phases) <= set(kept[shunt.bus])),
    )
    expected, flow = solve_power_flow(fewer), solve_power_flow(operated.supplied())
    rows = [operated.node(*node) for node in fewer.nodes]
    assert flow.vm[rows] == pytest.approx(expected.vm, abs=1e-12)
    assert flow.va[rows] == pytest.approx(expected.va, abs=1e-12)
    dead, powers = ["671.c", "684.c", "611.c", "692.c", "675.c"], (KIND.P_INJECTION, KIND.Q_INJECTION)
    assert sorted(operated.node_names[k] for k in np.flatnonzero(flow.vm == 0)) == sorted(dead)
    meters = [Meter(k, bus.id, phases=p) for bus in network.buses for p in bus.phases for k in powers]
    meters += [Meter(KIND.VM, 650, phases=p) for p in "abc"]
    meters += [Meter(KIND.P_FLOW, 692, "692-675"), Meter(KIND.VM, 671, phases="ac")]
    z = flow.read_all(meters)
    readings = [Measurement(meter, value, 1e-3) for meter, value in zip(meters, z.tolist(), strict=True)]
    found = estimate_state(*take_fed(operated, readings))
    assert abs(found.vm - flow.vm).max() < 1e-9
    assert abs(found.va - flow.va).max() < 1e-9
    assert found.objective < 1e-9
    assert found.degrees_of_freedom == len(meters) - 2 * 5 - 1 - (2 * len(fewer.nodes) - 3)
    assert not find_deviations(found).vm[flow.vm == 0].any()


def _without_charging(branch: Branch) -> Branch:
    p = branch.primitive
    assert p is not None
    return replace(branch, primitive=replace(p, y=p.y - p.charging, charging=0 * p.charging))


def _without_c(branch: Branch, phases: dict[int, str]) -> Branch:
    """``branch`` between the ``phases`` of its ends alone: its impedances, and its windings."""
    p = branch.primitive
    assert p is not None
    kept = "".join(phase for phase in p.from_phases if phase in phases[branch.to_bus])
    if kept == p.from_phases:
        return branch
    at = [p.from_phases.index(phase) for phase in kept]
    z = np.linalg.inv(p.y[: len(p.from_phases), : len(p.from_phases)])[np.ix_(at, at)]
    return replace(branch, primitive=build_line(kept, z))
