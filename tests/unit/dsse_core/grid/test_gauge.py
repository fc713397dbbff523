"""Parts without ground: which they are, and that their gauge changes nothing that physics decides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.division import build_partition
from dsse_core.grid.gauge import Gauge
from dsse_core.grid.loads import Load
from dsse_core.grid.measurement import MeasurementKind, Meter, find_meter_problems
from dsse_core.grid.meter_table import KINDS, NO_BRANCH, UNKNOWN, each_fits, make_meters
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import PHASES, Primitive
from dsse_core.grid.primitives import Connection, build_bank, build_line, connect
from dsse_core.power_flow.newton_raphson import solve_power_flow

Z = np.array([[0.05, 0.02, 0.01], [0.02, 0.06, 0.02], [0.01, 0.02, 0.05]]) * (0.3 + 1j)
LEGS = (Load(5, "ab", 0.3 + 0.1j), Load(5, "bc", 0.2 + 0.2j, (1.0, 1.0)), Load(5, "ca", 0.1, (2.0, 2.0)))


def bank(high: Connection, low: Connection, taps: tuple[float, ...] = (1.0, 1.0, 1.0)) -> Primitive:
    return build_bank(connect("abc", high), connect("abc", low, taps), 2 - 12j)


def line(charging: float = 0.0) -> Primitive:
    return build_line("abc", Z, 1j * charging * np.diag([1.0, 1.2, 0.9]))


def feeder(*primitives: Primitive, loads: tuple[Load, ...] = LEGS, shunt: float = 0.0) -> Network:
    """Five buses in a row: a line, what is given, a line, a line."""
    of_lines = [line(), *primitives, line(), line()][:4]
    branches = [Branch(f"{k}-{k + 1}", k, k + 1, 0.02, 0.05, primitive=p) for k, p in enumerate(of_lines, 1)]
    buses = tuple(Bus(k, 4.8, phases="abc", b_shunt=shunt if k == 4 else 0.0) for k in range(1, 6))
    return Network("row", 3.0, buses, tuple(branches), (Generator(1, Control.SLACK),), loads)


@pytest.mark.parametrize(
    ("high", "low", "ungrounded"),
    [
        ("grounded", "delta", (3, 4, 5)),
        ("wye", "delta", (3, 4, 5)),
        ("delta", "wye", (3, 4, 5)),
        ("wye", "grounded", (3, 4, 5)),  # the star point of the other side carries no zero sequence
        ("delta", "grounded", ()),
        ("grounded", "grounded", ()),
    ],
)
def test_buses_behind_a_bank_are_ungrounded_where_no_zero_sequence_can_flow(
    high: Connection, low: Connection, ungrounded: tuple[int, ...]
) -> None:
    network = feeder(bank(high, low))
    assert network.gauge == Gauge(ungrounded, ungrounded[:1])
    assert network.bus(1).id not in network.gauge.ungrounded


def test_a_bus_alone_has_no_path_to_ground() -> None:
    network = feeder(bank("grounded", "grounded"), line(1e-4))
    alone = replace(network.branches[-1], in_service=False)
    opened = replace(network, branches=(*network.branches[:-1], alone))
    assert opened.gauge.ungrounded == (5,)
    assert opened.supplied().dead_places == ("5",)


def test_taps_that_differ_by_phase_ground_a_part_and_equal_ones_do_not() -> None:
    reg, same = bank("grounded", "grounded", (1.05, 1.0, 1.02)), bank("grounded", "grounded", (1.05, 1.05, 1.05))
    assert feeder(bank("grounded", "delta"), same).gauge.ungrounded == (3, 4, 5)
    assert feeder(bank("grounded", "delta"), reg).gauge.ungrounded == ()


@pytest.mark.parametrize("shunt", [0.0, 1e-3])
def test_currents_add_up_to_zero_at_every_ungrounded_bus_and_the_shunt_carries_none(shunt: float) -> None:
    network = feeder(bank("grounded", "delta"), line(1e-4), shunt=shunt)
    found = solve_power_flow(network, tolerance=1e-13)
    v = found.vm * np.exp(1j * found.va)
    i = (build_admittance(network).ybus @ v).reshape(5, 3)
    assert abs(i[2:].sum(axis=1)).max() < 1e-12
    assert abs(v[network.nodes_at(3)].mean()) < 1e-12
    assert abs(v[network.nodes_at(5)]).min() > 0.8


def test_weak_charging_moves_voltages_between_phases_by_next_to_nothing_and_a_large_one_is_a_ground() -> None:
    none, weak, strong = (feeder(bank("grounded", "delta"), line(b)) for b in (0.0, 1e-7, 0.05))
    between = []
    for network in (none, weak):
        found = solve_power_flow(network, tolerance=1e-13)
        v = found.vm * np.exp(1j * found.va)
        between.append(v.reshape(5, 3) - np.roll(v.reshape(5, 3), 1, axis=1))
    assert between[0] == pytest.approx(between[1], abs=1e-6)
    assert (none.gauge, strong.gauge.ungrounded, strong.gauge.pinned) == (Gauge((3, 4, 5), (3,)), (), (3,))
    shares = {(bus, phase): (g, b) for bus, phase, g, b in strong.gauge.shares}
    assert shares == {
        (3, phase): pytest.approx((0.0, b / 3.1)) for phase, b in zip("abc", (1.0, 1.2, 0.9), strict=True)
    }
    found = solve_power_flow(strong, tolerance=1e-13)
    v = found.vm * np.exp(1j * found.va)
    assert abs((build_admittance(strong).ybus @ v)[6:].sum()) < 1e-12
    assert abs(v[6:9].mean()) > 1e-3  # by its capacitances, not by the gauge


def test_powers_to_ground_in_a_part_without_ground_are_refused_all_at_once() -> None:
    network = feeder(bank("grounded", "delta"), loads=(*LEGS, Load(4, "b", 0.1)))
    network = replace(network, generators=(*network.generators, Generator(5, Control.POWER, p=0.1)))
    with pytest.raises(InvalidInputError) as refused:
        solve_power_flow(network, extra_load={3: 0.1})
    for called in ("the load 4.b", "the generator at bus 5", "the extra load at bus 3"):
        assert f"{called} stands between phase and ground in a part without ground" in str(refused.value)
    load, generator = network.find_supply_problems()  # without a power flow, as `dsse check`
    assert load.startswith("the load 4.b stands")
    assert generator.startswith("the generator at bus 5 stands")


def test_areas_know_the_gauge_of_the_whole_and_one_of_them_has_the_shunt() -> None:
    partition = build_partition(feeder(bank("grounded", "delta")), {"up": [1, 2, 3], "mid": [3, 4], "low": [4, 5]})
    assert [area.network.gauge for area in partition.areas] == [Gauge((3,), (3,)), Gauge((3, 4)), Gauge((4, 5))]
    grounded = build_partition(feeder(bank("delta", "grounded")), {"up": [1, 2, 3], "low": [3, 4, 5]})
    assert [area.network.gauge for area in grounded.areas] == [Gauge(), Gauge()]


@pytest.mark.parametrize("kind", [MeasurementKind.VM, MeasurementKind.VA])
def test_a_voltage_to_ground_in_a_part_without_ground_has_no_meter_and_those_between_phases_have(
    kind: MeasurementKind,
) -> None:
    network = feeder(bank("grounded", "delta"))
    for phases, bus, fits in (("a", 2, True), ("a", 4, False), ("bc", 4, True)):
        meters = [Meter(kind, bus, phases=phases)]
        problems = list(find_meter_problems(network, meters))
        columns = make_meters(
            network,
            np.array([KINDS.index(kind)]),
            np.array([bus]),
            np.array([NO_BRANCH]),
            phases=np.array([[PHASES.index(phases[0])], [PHASES.index(phases[1]) if len(phases) > 1 else UNKNOWN]]),
        )
        assert each_fits(network, columns) == fits
        if fits:
            assert problems == []
        else:
            assert problems[0].startswith(f"meter {kind}@4.a: bus 4 stands in a part without ground")
            assert problems[0].endswith(f"meter between two phases, such as {kind}@4.ab")
