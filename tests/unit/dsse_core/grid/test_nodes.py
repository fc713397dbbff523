"""Nodes and ports: networks whose buses have phases, built in memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError, NotObservableError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.estimation.batch import estimate_batch
from dsse_core.estimation.estimator import estimate_state
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.grid.admittance import build_admittance, flat_start
from dsse_core.grid.division import build_partition
from dsse_core.grid.loads import Load
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source, read_meter_id
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.meter_table import find_places
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import PhaseRows, Primitive
from dsse_core.power_flow.exact_readings import read_exactly
from dsse_core.power_flow.newton_raphson import solve_power_flow
from tests.support.phases import DEEP, coupled_line, make_feeder


@pytest.fixture
def feeder() -> Network:
    """A source, a coupled line of three phases, and a lateral of two."""
    buses = tuple(Bus(k, 4.16, phases=phases) for k, phases in ((650, "abc"), (632, "abc"), (645, "bc")))
    lines = coupled_line("650-632", (650, 632), "abc", 0.4), coupled_line("632-645", (632, 645), "bc", 0.1)
    return Network("feeder", 5.0, buses, lines, (Generator(650, Control.SLACK),))


def test_a_bus_has_a_node_for_each_phase_and_a_branch_a_port_at_each_of_them(feeder: Network) -> None:
    table = feeder.table
    assert feeder.n_nodes == 8
    assert [feeder.node(645, phase) for phase in ("a", "b", "c")] == [-1, 6, 7]
    assert feeder.nodes_at(632).tolist() == [3, 4, 5]
    assert table.port_node.tolist() == [0, 1, 2, 4, 5, 3, 4, 5, 6, 7]


def test_items_without_rows_are_found_nowhere() -> None:
    for sets, expected in (([], [-1, -1]), ([0b011], [-1, -1])):
        assert PhaseRows(np.array(sets, dtype=np.int64)).find(np.array([-1, -1]), 1).tolist() == expected
    assert PhaseRows(np.array([0b011, 0b110])).find(np.array([-1, 1, 0, 0]), 1).tolist() == [-1, 2, 1, 1]


def test_a_phase_that_no_branch_joins_to_the_source_has_the_voltage_of_the_source(feeder: Network) -> None:
    network = replace(feeder, branches=(feeder.branches[0], coupled_line("632-645", (632, 645), "b", 0.1)))
    vm, va = flat_start(network, 650)
    assert vm == pytest.approx(np.ones(8), abs=1e-12)
    assert np.degrees(va[6:]) == pytest.approx([-120, 120], abs=1e-9)


def test_currents_at_nodes_are_the_sums_of_the_currents_into_their_ports(feeder: Network) -> None:
    rng = np.random.default_rng(3)
    v, stacked = rng.normal(size=8) + 1j * rng.normal(size=8), build_admittance(feeder).stacked
    i = stacked @ v
    expected = np.zeros(8, dtype=complex)
    np.add.at(expected, feeder.table.port_node, i[8:])
    assert i[:8] == pytest.approx(expected, rel=1e-12)
    first = feeder.branches[0].primitive
    assert first is not None
    assert i[8:][[0, 1, 2, 5, 6, 7]] == pytest.approx(first.y @ v[:6], rel=1e-12)


def test_without_load_no_current_flows_and_the_phases_are_a_third_of_a_turn_apart(feeder: Network) -> None:
    vm, va = flat_start(feeder, 650)
    assert vm == pytest.approx(np.ones(8), abs=1e-12)
    assert np.degrees(va) == pytest.approx([0, -120, 120, 0, -120, 120, -120, 120], abs=1e-9)
    assert abs(build_admittance(feeder, with_shunts=False).ybus @ (vm * np.exp(1j * va))).max() < 1e-12


def test_a_balanced_network_has_one_node_per_bus_in_the_same_order(meshed: Network) -> None:
    table = meshed.table
    assert table.nodes.item.tolist() == list(range(len(table.bus_id)))
    assert table.port_node.tolist() == [*table.f.tolist(), *table.t.tolist()]


@pytest.mark.parametrize(
    ("phases", "line", "problem"),
    [
        ("", "abc", "bus 645 has no phases, and others have"),
        ("xy", "bc", "bus 645: phases is 'xy'; give some of a, b, c, s1, s2"),
        ("cb", "bc", "bus 645: phases is 'cb'"),
        (
            "b",
            "bc",
            "branch 632-645 has phase c at bus 645, which lacks it; leave it out of the branch, or add it to the bus",
        ),
        ("bc", "", "branch 632-645 joins buses with phases; give it admittances over its ports"),
    ],
)
def test_phases_that_do_not_fit_are_refused_by_name(feeder: Network, phases: str, line: str, problem: str) -> None:
    bus = replace(feeder.buses[2], phases=phases)
    branch = coupled_line("632-645", (632, 645), line) if line else replace(feeder.branches[1], primitive=None)
    with pytest.raises(InvalidInputError, match=problem):
        replace(feeder, buses=(*feeder.buses[:2], bus), branches=(feeder.branches[0], branch))


KIND = MeasurementKind


def every_meter(network: Network) -> list[Meter]:
    """Meters of all kinds at every node, between phases, at every port, and of totals."""
    at_nodes = (KIND.VM, KIND.VA, KIND.P_INJECTION, KIND.Q_INJECTION)
    meters = [Meter(kind, bus.id, phases=phase) for bus in network.buses for phase in bus.phases for kind in at_nodes]
    meters += [
        Meter(kind, bus.id, phases="bc") for bus in network.buses for kind in (KIND.VM, KIND.VA, KIND.P_INJECTION)
    ]
    flows = (KIND.P_FLOW, KIND.Q_FLOW, KIND.CURRENT)
    for branch in network.branches:
        assert branch.primitive is not None
        ends = ((branch.from_bus, branch.primitive.from_phases), (branch.to_bus, branch.primitive.to_phases))
        meters += [Meter(kind, bus, branch.id, phases=p) for bus, phases in ends for p in phases for kind in flows]
        meters += [Meter(kind, bus, branch.id) for bus, _ in ends for kind in flows[:2]]
    return meters + [Meter(kind, bus.id) for bus in network.buses for kind in at_nodes[2:]]


def every_row(network: Network) -> list[Meter]:
    """``every_meter``, and the currents of buses."""
    currents = (KIND.I_REAL, KIND.I_IMAG)
    return every_meter(network) + [Meter(k, b.id, source=Source.VIRTUAL) for b in network.buses for k in currents]


@pytest.fixture
def state(feeder: Network) -> np.ndarray:
    """An unbalanced state x = [va; vm] under load; the angles at the source are those of the flat start."""
    vm, va = flat_start(feeder, 650)
    drop = np.array([0, 0, 0, 0.02, 0.03, 0.015, 0.04, 0.02])
    return np.r_[va - drop * [1, 1, 1, 1, -0.5, 0.7, 0.9, 0.6], vm - drop]


def test_meters_of_phases_have_the_derivatives_of_their_readings(feeder: Network, state: np.ndarray) -> None:
    model = build_measurement_model(feeder, build_admittance(feeder), every_row(feeder))
    step = 1e-6 * np.eye(len(state))
    numeric = np.transpose([model.subtract(model.predict(state + d), model.predict(state - d)) / 2e-6 for d in step])
    assert model.jacobian(state).toarray() == pytest.approx(numeric, abs=2e-7)


def test_compiled_code_finds_the_same_derivatives_of_totals(feeder: Network, state: np.ndarray) -> None:
    pytest.importorskip("numba")
    model = build_measurement_model(feeder, build_admittance(feeder), every_row(feeder))
    for found, expected in zip(model.linearize_compiled(state), model.linearize_entries(state), strict=True):
        assert found == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_a_total_reads_the_mean_of_the_phases_that_its_bus_or_its_end_of_the_branch_has(
    feeder: Network, state: np.ndarray
) -> None:
    """Of balanced phases it reads in p.u. what each phase reads."""
    at_branch = [Meter(KIND.P_FLOW, 632, "632-645"), Meter(KIND.Q_FLOW, 632, "632-645")]
    totals = [*at_branch, Meter(KIND.P_INJECTION, 632), Meter(KIND.Q_INJECTION, 645)]
    of_phases = [replace(m, phases=p) for m in totals for p in ("abc" if m.kind is KIND.P_INJECTION else "bc")]
    admittance = build_admittance(feeder)
    read = build_measurement_model(feeder, admittance, of_phases).predict(state)
    expected = [read[:2].mean(), read[2:4].mean(), read[4:7].mean(), read[7:].mean()]
    assert build_measurement_model(feeder, admittance, totals).predict(state) == pytest.approx(expected, rel=1e-12)
    found, places = find_places(feeder, [*of_phases, *totals], totals), len(of_phases) + np.arange(len(totals))
    assert found.tolist() == places.tolist()


def test_readings_of_totals_are_made_of_a_power_flow_as_the_estimate_reads_them() -> None:
    network = make_feeder()
    power_flow = solve_power_flow(network)
    meters = [m for m in every_meter(network) if not m.phases]
    read, sizes = read_exactly(power_flow, meters)
    x = np.concatenate([power_flow.va, power_flow.vm])
    assert read == pytest.approx(build_measurement_model(network, power_flow.admittance, meters).predict(x), abs=1e-12)
    of_p = sizes[[m.kind is KIND.P_FLOW for m in meters]]
    assert of_p == pytest.approx(np.hypot(*(read[[m.kind is k for m in meters]] for k in (KIND.P_FLOW, KIND.Q_FLOW))))


def test_meters_of_phases_read_what_the_circuit_has(feeder: Network, state: np.ndarray) -> None:
    v, stacked = state[8:] * np.exp(1j * state[:8]), build_admittance(feeder).stacked
    meters = [Meter(KIND.VM, 645, phases="bc"), Meter(KIND.P_INJECTION, 632, phases="ab")]
    meters += [Meter(KIND.Q_FLOW, 645, "632-645", phases="c"), Meter(KIND.CURRENT, 650, "650-632", phases="b")]
    b, c = feeder.node(645, "b"), feeder.node(645, "c")
    i = stacked @ v
    power = (v[3] - v[4]) * i[3].conj(), v[c] * i[8 + 9].conj()
    expected = [abs(v[b] - v[c]), power[0].real, power[1].imag, abs(i[8 + 1])]
    read = build_measurement_model(feeder, build_admittance(feeder), meters).predict(state)
    assert read == pytest.approx(expected, rel=1e-12)


def test_exact_readings_of_phases_give_back_the_state_in_the_centre(feeder: Network, state: np.ndarray) -> None:
    at_nodes = (KIND.VM, KIND.P_INJECTION, KIND.Q_INJECTION)
    meters = [Meter(kind, bus.id, phases=phase) for bus in feeder.buses for phase in bus.phases for kind in at_nodes]
    meters += [Meter(KIND.P_FLOW, 632, "632-645", phases="b"), Meter(KIND.VM, 645, phases="bc")]
    meters += [Meter(KIND.CURRENT, 650, "650-632", phases="a"), Meter(KIND.P_FLOW, 650, "650-632")]
    meters += [Meter(KIND.Q_INJECTION, 645), Meter(KIND.Q_FLOW, 632, "632-645")]
    model = build_measurement_model(feeder, build_admittance(feeder), meters)
    readings = [Measurement(m, z, 0.01) for m, z in zip(meters, model.predict(state).tolist(), strict=True)]
    found = estimate_state(feeder, readings)
    assert found.backend == "sparse"
    assert found.degrees_of_freedom == len(meters) - (2 * 8 - 3)
    assert np.r_[found.va, found.vm] == pytest.approx(state, abs=1e-10)
    sigma_vm, sigma_va = found.state_sigma()
    assert (sigma_vm > 0).all()
    assert (sigma_va > 0).tolist() == [False] * 3 + [True] * 5
    H, held = model.jacobian(state).toarray(), np.arange(16) >= 3
    covariance = np.linalg.inv(H[:, held].T @ H[:, held] / 0.01**2)
    assert np.r_[sigma_va[3:], sigma_vm] == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-6)


def test_an_unmetered_phase_is_named_with_its_bus_and_a_cure(feeder: Network) -> None:
    seen = [m for m in every_meter(feeder) if m.branch == "650-632" or m.id in ("vm@645.b", "va@645.b")]
    seen += [Meter(KIND.VM, 650, phases=phase) for phase in "abc"]
    cure = r"P and Q flow of branch 632-645 at bus 632\.b"
    with pytest.raises(NotObservableError, match=rf"the state of bus 645\.c; .*{cure}"):
        estimate_state(feeder, [Measurement(m, 1.0, 0.01) for m in seen])


@pytest.mark.parametrize(
    ("meter", "problem"),
    [
        (Meter(KIND.I_REAL, 632), "i_real@632: no meter reads i_real; it is 0 by the legs of a bus, and virtual"),
        (Meter(KIND.I_IMAG, 632, phases="a", source=Source.VIRTUAL), r"i_imag@632\.a: i_imag is that of all phases"),
        (Meter(KIND.CURRENT, 632, "632-645"), "current@632:632-645: name one phase of bus 632"),
        (Meter(KIND.VM, 645), "vm@645: name one phase, or two of bus 645, which has b, c"),
        (Meter(KIND.VM, 645, phases="a"), r"vm@645\.a: phase a is not there, only b, c"),
        (Meter(KIND.P_FLOW, 632, "632-645", phases="a"), r"p_flow@632\.a:632-645: phase a is not there, only b, c"),
        (Meter(KIND.P_FLOW, 632, "632-645", phases="bc"), "name one phase of bus 632"),
    ],
)
def test_a_meter_on_phases_that_are_not_there_is_refused_by_name(feeder: Network, meter: Meter, problem: str) -> None:
    with pytest.raises(InvalidInputError, match=problem):
        estimate_state(feeder, [Measurement(meter, 1.0, 0.01)])


def test_the_compiled_tree_declines_phases_by_name(feeder: Network) -> None:
    with pytest.raises(InvalidInputError, match="the radial back end cannot serve: buses have phases"):
        estimate_state(feeder, [], backend="radial")


def test_a_balanced_bus_has_no_virtual_current(meshed: Network) -> None:
    meter = Meter(KIND.I_REAL, meshed.buses[0].id, source=Source.VIRTUAL)
    with pytest.raises(InvalidInputError, match="has no phases, and so no legs between them"):
        estimate_state(meshed, [Measurement(meter, 0.0, 0.0)])


def test_the_currents_of_a_bus_with_legs_between_phases_add_up_to_nothing(feeder: Network, state: np.ndarray) -> None:
    """So say its virtual currents at the voltages of the power flow, and no others."""
    legs = tuple(Load(632, phases, 0.1 + 0.02j * k) for k, phases in enumerate(("ab", "bc", "ac")))
    power_flow = solve_power_flow(replace(feeder, loads=(*legs, Load(645, "b", 0.1 + 0.05j))))
    meters = [Meter(kind, bus, source=Source.VIRTUAL) for bus in (632, 645) for kind in (KIND.I_REAL, KIND.I_IMAG)]
    read = read_exactly(power_flow, meters)[0]
    v = power_flow.vm * np.exp(1j * power_flow.va)
    drawn = (0.1 + 0.05j) / v[feeder.node(645, "b")]
    assert read == pytest.approx([0, 0, -drawn.real / 2, drawn.imag / 2], abs=1e-10)  # the mean of two phases


@pytest.mark.parametrize("text", ["vm@645.b", "va@645.bc", "p_flow@632.s1:632-645", "q_injection@4", "current@3:3.a-6"])
def test_an_id_is_read_as_it_is_written(text: str) -> None:
    meter = read_meter_id(text)
    assert meter is not None
    assert meter.id == text


@pytest.mark.parametrize("text", ["vm@", "vm@645.", "vm@645.d", "vm@x", "volt@1", "vm", "vm@1.a.b"])
def test_what_is_no_id_is_no_meter(text: str) -> None:
    assert read_meter_id(text) is None


# Kersting's 4-bus feeder, wye-wye: ohm per mile of its four-wire lines, and the voltages of OpenDSS at the ends of its
# low-voltage line of 2,500 ft (p.u. to ground, degrees), with a load of 1,800 kW at power factor 0.9 in each phase.
OHM = [[0.4576 + 1.0780j, 0.1559 + 0.5017j, 0.1535 + 0.3849j], [0, 0.4666 + 1.0482j, 0.1580 + 0.4236j]]
OHM = np.triu([*OHM, [0, 0, 0.4615 + 1.0651j]])
VM = [0.935697942, 0.944483583, 0.939215429, 0.798438311, 0.858193606, 0.824673402]
VA = [-3.6959838, -123.4773119, 116.3930332, -9.075673, -128.3174248, 110.8543025]


def test_voltages_of_opendss_carry_the_load_of_the_four_bus_feeder() -> None:
    """To 2e-4: the published impedances have four digits, 5e-5 of their size, and differ by the same from phase to
    phase; OpenDSS finds its own from the geometry of the wires."""
    base = 6.0
    yi = np.linalg.inv((OHM + np.triu(OHM, 1).T) * 2500 / 5280) * 4.16**2 / base
    primitive = Primitive("abc", "abc", np.kron([[1, -1], [-1, 1]], yi), np.zeros((6, 6)))
    buses = Bus(3, 4.16, phases="abc"), Bus(4, 4.16, phases="abc")
    network = Network("4 buses", base, buses, (Branch("3-4", 3, 4, 0.1, 0.2, primitive=primitive),))
    meters = [Meter(kind, 4, phases=phase) for kind in (KIND.P_INJECTION, KIND.Q_INJECTION) for phase in "abc"]
    model = build_measurement_model(network, build_admittance(network), meters)
    p, q = np.split(-model.predict(np.r_[np.radians(VA), VM]) * base / 3, 2)
    assert p + 1j * q == pytest.approx(np.full(3, 1.8 + 1.8j * np.tan(np.arccos(0.9))), rel=2e-4)


def test_legs_draw_by_their_exponents_and_a_leg_between_phases_takes_its_current_from_both(feeder: Network) -> None:
    loads = Load(632, "a", 0.3 + 0.1j), Load(632, "b", 0.2 + 0.1j, (1.0, 2.0)), Load(645, "bc", 0.3 + 0.2j, (2.0, 2.0))
    network = replace(feeder, loads=loads)
    rng = np.random.default_rng(5)
    nominal = network.legs.nominal
    v = nominal * (1 - 0.1 * rng.random(8)) * np.exp(0.1j * rng.random(8))
    drawn = network.legs.draw(v)
    assert drawn[:3] == pytest.approx(0)
    size = abs(v[4])
    assert drawn[3:6] == pytest.approx([0.3 + 0.1j, 0.2 * size + 0.1j * size**2, 0], rel=1e-12)
    b, c = v[6], v[7]
    assert drawn[6:].sum() == pytest.approx((0.3 + 0.2j) * abs(b - c) ** 2 / 3, rel=1e-12)
    assert (drawn[6] / b + drawn[7] / c) == pytest.approx(0, abs=1e-12)
    assert network.scheduled[3:6] == pytest.approx([-0.3 - 0.1j, -0.2 - 0.1j, 0], rel=1e-12)


def test_the_load_of_a_balanced_bus_is_one_leg_of_constant_power(meshed: Network) -> None:
    legs = meshed.legs
    assert legs.s.tolist() == meshed.table.load.tolist()
    assert legs.draw(0.9 * legs.nominal) == pytest.approx(legs.s)


@pytest.mark.parametrize(
    ("load", "problem"),
    [
        (Load(7, "a", 0.1), "a load with phases a stands at bus 7, which has none"),
        (Load(645, "a", 0.1), "a load at bus 645: phases is 'a'; name one or two of b, c"),
        (Load(632, "a", complex("nan")), "a load at bus 632: s or an exponent is not a finite number"),
    ],
)
def test_a_load_that_does_not_fit_is_refused_by_name(feeder: Network, load: Load, problem: str) -> None:
    with pytest.raises(InvalidInputError, match=problem):
        replace(feeder, loads=(load,))


@pytest.mark.parametrize("wrong", ["p_flow@632.b:632-645", "vm@645.c", "vm@632.bc"])
def test_a_wrong_reading_of_a_phase_is_found_and_the_others_give_the_state(
    feeder: Network, state: np.ndarray, wrong: str
) -> None:
    meters = [m for m in every_meter(feeder) if m.kind is not KIND.VA]
    z = build_measurement_model(feeder, build_admittance(feeder), meters).predict(state)
    z[[m.id for m in meters].index(wrong)] += 0.3
    readings = [Measurement(m, value, 0.01) for m, value in zip(meters, z.tolist(), strict=True)]
    report = process_bad_data(feeder, readings)
    assert [removed.measurement.meter.id for removed in report.removed] == [wrong]
    assert np.r_[report.result.va, report.result.vm] == pytest.approx(state, abs=1e-9)


def test_a_dead_voltmeter_of_a_phase_is_taken_out_and_rows_of_a_batch_have_all_nodes(
    feeder: Network, state: np.ndarray
) -> None:
    meters = [m for m in every_meter(feeder) if m.kind is not KIND.VA]
    z = build_measurement_model(feeder, build_admittance(feeder), meters).predict(state)
    plan = build_estimation_plan(feeder, meters)
    found = estimate_batch(plan, np.stack([z, z]), np.full(len(z), 0.01))
    assert found.vm == pytest.approx(np.stack([state[8:]] * 2), abs=1e-9)
    z[[m.id for m in meters].index("vm@632.c")] = 0.0
    report = process_bad_data(feeder, [Measurement(m, v, 0.01) for m, v in zip(meters, z.tolist(), strict=True)])
    assert [removed.measurement.meter.id for removed in report.removed] == ["vm@632.c"]


def test_a_boundary_has_the_phases_of_the_childs_branches_and_the_child_no_others() -> None:
    partition = build_partition(make_feeder(), DEEP)
    names = {area.name: area.boundaries[area.parent.area].names for area in partition.areas if area.parent}
    assert names == {
        "two": ("s@632.bc>two", "v@632.bc"),
        "west": ("s@671.ac>west", "v@671.ac"),
        "east": ("s@671.abc>east", "v@671.abc"),
        "one": ("s@684.c>one", "v@684.c"),
        "bank": ("s@692.abc>bank", "v@692.abc"),
    }
    assert partition.area("west").network.bus(671).phases == "ac"
    assert partition.area("head").network.bus(671).phases == "abc"
    assert [load.bus for load in partition.area("two").network.loads] == [645, 646, 646]
    assert sum(len(area.network.loads) for area in partition.areas) == len(partition.network.loads)
    assert sum(area.n_unknown for area in partition.areas) == 2 * partition.network.n_nodes - 3


def test_areas_begin_at_the_unloaded_voltages_of_the_whole_behind_regulators_and_delta_windings() -> None:
    network = make_feeder()
    vm, va = flat_start(network, 650)
    assert np.degrees(va[network.nodes_at(675)]) == pytest.approx([30, -90, 150], abs=0.5)
    partition = build_partition(network, DEEP)
    for area in partition.areas:
        rows = partition.rows_of_nodes[area.name]
        assert np.array(area.find_no_load()).tolist() == [vm[rows].tolist(), va[rows].tolist()]
