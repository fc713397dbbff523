"""The power flow of networks with phases: round trips, derivatives, and the 4-bus feeders of OpenDSS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError, PowerFlowDivergedError
from dsse_core.grid.loads import Load, find_nominal
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import Primitive
from dsse_core.grid.primitives import Connection, Side, build_bank, build_line, connect
from dsse_core.power_flow.batch import solve_power_flow_batch
from dsse_core.power_flow.exact_readings import read_exactly
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.power_flow.plan import build_power_flow_plan

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
    due = produced - feeder.legs.draw(v, find_nominal(feeder.table.nodes))
    assert found.method == "newton"
    assert found.iterations <= 6
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
    kind = MeasurementKind
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


def test_what_a_power_flow_with_phases_cannot_serve_is_refused_by_name(feeder: Network) -> None:
    floating = replace(feeder, buses=(*feeder.buses[:3], Bus(4, 4.16, phases="abc"), feeder.buses[4]))
    with pytest.raises(InvalidInputError, match="joins phase a of bus 4 to the slack bus 1; feed the phase"):
        solve_power_flow(floating)
    holding = replace(feeder, generators=(*feeder.generators, Generator(3, Control.VOLTAGE)))
    with pytest.raises(InvalidInputError, match="a generator holds the voltage of bus 3, which has phases"):
        solve_power_flow(holding)
    with pytest.raises(InvalidInputError, match="sweeps cannot serve: buses have phases"):
        solve_power_flow(feeder, method="sweep")
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


# The 4-bus feeders of github dss-extensions/electricdss-tst: 4Bus-DY-Bal, 4Bus-YY-Bal, and their voltages by OpenDSS 9
# (opendssdirect.py 0.9.4, tolerance 1e-11, ppm 0): buses n2, n3, n4, phases a, b, c, p.u. to ground and degrees.
OPENDSS = {
    "DY": (
        [[0.987654513, 0.990799426, 0.989193561], [-0.2884391, -120.3553508, 119.5879746]],
        [[0.936541041, 0.942158741, 0.940627976], [-33.7276384, -153.4165938, 86.3668331]],
        [[0.799184737, 0.855176925, 0.82688766], [-39.069217, -158.3117582, 80.8519618]],
    ),
    "YY": (
        [[0.987052313, 0.991660907, 0.989028261], [-0.3406072, -120.3452815, 119.6273016]],
        [[0.935697942, 0.944483583, 0.939215429], [-3.6959838, -123.4773119, 116.3930332]],
        [[0.798438311, 0.858193606, 0.824673402], [-9.075673, -128.3174248, 110.8543025]],
    ),
}
FOOT, MILE, OMEGA, MU, EPSILON = 0.3048, 1609.344, 2 * np.pi * 60, 4e-7 * np.pi, 8.854187817e-12


def four_wires(length: float) -> tuple[np.ndarray, np.ndarray]:
    """Series impedances, ohm, and charging, siemens, of the feeders' lines: Carson's equations, earth of 100 ohm m."""
    x, h = FOOT * np.array([-4, -1.5, 3, 0]), FOOT * np.array([28, 28, 28, 24])
    r, gmr = np.array([0.306] * 3 + [0.592]) / MILE, FOOT * np.array([0.0244] * 3 + [0.00814])
    radius = FOOT / 24 * np.array([0.721] * 3 + [0.563])
    beside = np.subtract.outer(x, x)
    apart, image = np.hypot(beside, np.subtract.outer(h, h)), np.hypot(beside, np.add.outer(h, h))
    depth = 658.5 * np.sqrt(100 / 60)
    z = np.diag(r) + OMEGA * MU / 8 + 1j * OMEGA * MU / (2 * np.pi) * np.log(depth / (apart + np.diag(gmr)))
    potential = np.log(image / (apart + np.diag(radius))) / (2 * np.pi * EPSILON)

    def without_neutral(m: np.ndarray) -> np.ndarray:
        return np.asarray(m[:3, :3] - np.outer(m[:3, 3], m[3, :3]) / m[3, 3])

    return length * without_neutral(z), 1j * OMEGA * length * np.linalg.inv(without_neutral(potential))


def source_impedance(kv: float, mva3: float, mva1: float) -> np.ndarray:
    """Ohm, of short-circuit powers of three phases and of one: x = 4 r, of the zero sequence x = 3 r."""
    z1 = kv**2 / mva3 * (1 + 4j) / np.sqrt(17)
    r0 = np.roots([10, 4 * (z1.real + 3 * z1.imag), 4 * abs(z1) ** 2 - (3 * kv**2 / mva1) ** 2]).max()
    return np.asarray(z1 * np.eye(3) + (r0 * (1 + 3j) - z1) / 3)


def four_buses(bank: Primitive) -> Network:
    """An ideal source of 200,000 MVA, 2,000 ft of line, the bank, 2,500 ft of line, 5.4 MW at power factor 0.9."""

    def of_line(kv: float, feet: float) -> Primitive:
        z, charging = four_wires(feet * FOOT)
        base = kv**2 / 6.0
        return build_line("abc", z / base, charging * base)

    source = build_line("abc", source_impedance(12.47, 200_000, 200_000) * 6.0 / 12.47**2)
    buses = tuple(Bus(k, kv, phases="abc") for k, kv in enumerate((12.47, 12.47, 12.47, 4.16, 4.16)))
    pairs = ((0, 1, source), (1, 2, of_line(12.47, 2000)), (2, 3, bank), (3, 4, of_line(4.16, 2500)))
    loads = tuple(Load(4, phase, 0.9 + 0.9j * np.tan(np.arccos(0.9))) for phase in "abc")
    lines = tuple(branch(*pair) for pair in pairs)
    return Network("4 buses", 6.0, buses, lines, (Generator(0, Control.SLACK),), loads)


@pytest.mark.parametrize(("name", "high"), [("DY", "delta reversed"), ("YY", "grounded")])
def test_four_bus_feeders_have_the_voltages_of_opendss(name: str, high: Connection) -> None:
    bank = build_bank(connect("abc", high), connect("abc", "grounded"), 1 / (0.01 + 0.06j))
    found = solve_power_flow(four_buses(bank))
    vm, va = np.array(OPENDSS[name]).transpose(1, 0, 2).reshape(2, -1)
    v = (found.vm * np.exp(1j * found.va))[6:]
    assert abs(v - vm * np.exp(1j * np.radians(va))).max() < 1e-8


# IEEE 13 of the same repository, 13Bus/IEEE13Nodeckt.dss, with the published taps 10, 8, 11: bus -> p.u. and degrees.
IEEE13 = {
    650: ([0.999911493, 0.999972023, 0.999931676], [-0.0111586, -120.0106408, 119.9863192]),
    60: ([1.062282851, 1.049885629, 1.068547918], [-0.0131177, -120.0127164, 119.9839802]),
    632: ([1.020781792, 1.041885984, 1.017472202], [-2.5010087, -121.7365305, 117.8127807]),
    633: ([1.017752083, 1.03999137, 1.014860332], [-2.5656265, -121.7819083, 117.8087195]),
    634: ([0.993772264, 1.021634829, 0.996030177], [-3.2420336, -122.238126, 117.3291857]),
    645: ([1.032714334, 1.015495646], [-121.9162434, 117.8399638]),
    646: ([1.030976826, 1.0134354], [-121.9919077, 117.8852493]),
    670: ([1.010507612, 1.044888872, 1.003301432], [-3.4155426, -121.9478285, 117.1651191]),
    671: ([0.989375723, 1.053415378, 0.978921459], [-5.3079115, -122.3611248, 116.0746993]),
    692: ([0.989375713, 1.053415377, 0.978921452], [-5.3079114, -122.361125, 116.0746993]),
    675: ([0.98291251, 1.055768147, 0.977080794], [-5.553842, -122.5375283, 116.0885722]),
    680: ([0.989375735, 1.053415393, 0.978921473], [-5.3079118, -122.3611249, 116.074699]),
    684: ([0.987433013, 0.976910375], [-5.3308345, 115.9734006]),
    611: ([0.974913172], [115.8274732]),
    652: ([0.981856377], [-5.2561789]),
}
# Line codes: r, x, ohm per mile, lower triangles row by row, and capacitances, nF per mile: own and between conductors.
CODES = {
    601: (
        [0.3465, 0.1560, 0.3375, 0.1580, 0.1535, 0.3414], [1.0179, 0.5017, 1.0478, 0.4236, 0.3849, 1.0348], 2.8, -0.6,
    ),
    602: (
        [0.7526, 0.1580, 0.7475, 0.1560, 0.1535, 0.7436], [1.1814, 0.4236, 1.1983, 0.5017, 0.3849, 1.2112], 2.8, -0.6,
    ),
    603: ([1.3294, 0.2066, 1.3238], [1.3471, 0.4591, 1.3569], 2.8, -0.6),
    604: ([1.3238, 0.2066, 1.3294], [1.3569, 0.4591, 1.3471], 2.8, -0.6),
    605: ([1.3292], [1.3475], 2.8, 0.0),
    606: (
        [0.791721, 0.318476, 0.781649, 0.28345, 0.318476, 0.791721],
        [0.438352, 0.0276838, 0.396697, -0.0184204, 0.0276838, 0.438352], 383.948, 0.0,
    ),
    607: ([1.3425], [0.5124], 236.0, 0.0),
}  # fmt: skip
LINES = [  # from, to, phases, code, feet
    (60, 632, "abc", 601, 2000), (632, 670, "abc", 601, 667), (670, 671, "abc", 601, 1333),
    (671, 680, "abc", 601, 1000), (632, 633, "abc", 602, 500), (632, 645, "bc", 603, 500), (645, 646, "bc", 603, 300),
    (692, 675, "abc", 606, 500), (671, 684, "ac", 604, 300), (684, 611, "c", 605, 300), (684, 652, "a", 607, 800),
]  # fmt: skip
LOADS = [  # bus, leg, kW and kvar at kV, exponent; capacitors among them
    *((671, leg, 385 + 220j, 4.16, 0) for leg in ("ab", "bc", "ca")), (634, "a", 160 + 110j, 0.277, 0),
    (634, "b", 120 + 90j, 0.277, 0), (634, "c", 120 + 90j, 0.277, 0), (645, "b", 170 + 125j, 2.4, 0),
    (646, "bc", 230 + 132j, 4.16, 2), (692, "ca", 170 + 151j, 4.16, 1), (675, "a", 485 + 190j, 2.4, 0),
    (675, "b", 68 + 60j, 2.4, 0), (675, "c", 290 + 212j, 2.4, 0), (611, "c", 170 + 80j, 2.4, 1),
    (652, "a", 128 + 86j, 2.4, 2), (670, "a", 17 + 10j, 2.4, 0), (670, "b", 66 + 38j, 2.4, 0),
    (670, "c", 117 + 68j, 2.4, 0), *((675, phase, -200j, 4.16 / np.sqrt(3), 2) for phase in "abc"),
    (611, "c", -100j, 2.4, 2),
]  # fmt: skip


def ieee13() -> Network:
    base, phases = 5.0, {0: "abc", 1: "abc", 645: "bc", 646: "bc", 684: "ac", 611: "c", 652: "a"}
    kv = {0: 115.0, 1: 115.0, 634: 0.48}
    buses = tuple(Bus(bus, kv.get(bus, 4.16), phases=phases.get(bus, "abc")) for bus in (0, 1, *IEEE13))
    branches = [branch(0, 1, build_line("abc", source_impedance(115.0, 20_000, 21_000) * base / 115**2))]
    substation = build_bank(connect("abc", "delta reversed"), connect("abc", "grounded"), 1 / (1e-5 + 8e-5j))
    branches.append(branch(1, 650, substation))
    of_regulator = 2.4 * np.sqrt(3) / 4.16
    sides = [connect("abc", "grounded", of_regulator * np.array(tap)) for tap in ((1, 1, 1), (1.0625, 1.05, 1.06875))]
    branches.append(branch(650, 60, build_bank(sides[0], sides[1], 1.666 / (base / 3) / (1e-4 + 1e-4j))))
    bank = build_bank(connect("abc", "grounded"), connect("abc", "grounded"), 0.5 / base / (0.011 + 0.02j))
    branches += [branch(633, 634, bank), branch(671, 692, build_line("abc", 1e-7 * np.eye(3) * base / 4.16**2))]
    for from_bus, to_bus, of_line, code, feet in LINES:
        r, x, own, between = CODES[code]
        k = len(of_line)
        z = np.zeros((k, k), dtype=complex)
        z[np.tril_indices(k)] = np.array(r) + 1j * np.array(x)
        z = z + np.tril(z, -1).T
        charging = 1e-9j * OMEGA * (np.full((k, k), between) + np.eye(k) * (own - between))
        miles, of_base = feet / 5280, base / 4.16**2
        branches.append(branch(from_bus, to_bus, build_line(of_line, z * miles * of_base, charging * miles / of_base)))
    loads = []
    for bus, leg, kva, rated, exponent in LOADS:
        nominal = kv.get(bus, 4.16) / (np.sqrt(3) if len(leg) == 1 else 1)
        s = complex(kva / 1000 / (base / 3) * (nominal / rated) ** exponent)
        loads.append(Load(bus, leg, s, (float(exponent), float(exponent))))
    source = Generator(0, Control.SLACK, vm=1.0001, va=np.radians(30))
    return Network("ieee13", base, buses, tuple(branches), (source,), tuple(loads))


def test_ieee13_with_regulators_and_loads_of_all_kinds_has_the_voltages_of_opendss() -> None:
    network = ieee13()
    found = solve_power_flow(network)
    vm, va = np.concatenate([np.array(both) for both in IEEE13.values()], axis=1)
    v = (found.vm * np.exp(1j * found.va))[6:]
    assert abs(v - vm * np.exp(1j * np.radians(va))).max() < 1e-8
