"""Network files with phases: matrices, banks and legs in per unit, IEEE 13, round trips, every mistake by its key."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.loads import Load
from dsse_core.grid.network import Branch, Network
from dsse_core.grid.primitives import Side, build_bank, build_centre_tapped, build_line, connect
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.files.network_file import load_case, load_network
from scenarios.files.saved_network import save_network
from tests.support.ieee_feeders import load_feeder, load_voltages

GOOD = """
name = "three"
data_source = "made up"
base_mva = 6.0
bus = [
    { id = 1, base_kv = 12.0, phases = "abc", b_shunt_mvar = 0.3 },
    { id = 2, base_kv = 12.0, phases = "abc" },
    { id = 3, base_kv = 12.0, phases = "ac", b_shunt_mvar = 0.2 },
    { id = 4, base_kv = 4.0, phases = "abc" },
]
branch = [
    { from = 1, to = 2, phases = "abc", r_ohm = 2.4, x_ohm = 4.8, b_us = 3.0, rating_a = 100.0 },
    { from = 2, to = 3, phases = "ac", r_ohm = [[2.4], [0.6, 3.6]], x_ohm = [[4.8], [1.2, 6.0]], rating_mva = 2.0 },
]
load = [
    { bus = 3, phases = "ca,a", p_kw = [200.0, 20.0], q_kvar = [100.0, 0.0] },
    { bus = 4, phases = "a,b,c", q_kvar = [-50.0, -50.0, -50.0], exponents = [2.0, 2.0], kv = 2.0 },
]
shunt = [
    { bus = 3, phases = "a", b_kvar = [100.0] },
    { bus = 4, phases = "ab,c", g_kw = [6.0, 0.0], b_kvar = [60.0, 40.0] },
]
source = [{ bus = 1, kind = "slack", vm_pu = 1.0 }, { bus = 3, kind = "power", p_mw = 0.4, q_mvar = 0.2 }]
[[transformer]]
id = "bank"
kva = 3000.0
r_percent = 1.0
x_percent = 6.0
no_load_percent = 0.4
magnetising_percent = 2.0
windings = [
    { bus = 2, phases = "abc", kv = 12.0, connection = "delta" },
    { bus = 4, phases = "abc", kv = 4.0, connection = "grounded wye", taps = [1.0, 1.02, 1.05] },
]
"""
Z = np.array([[0.1 + 0.2j, 0.025 + 0.05j], [0.025 + 0.05j, 0.15 + 0.25j]])  # of the line 2-3, base 24 ohm


def load(tmp_path: Path, text: str) -> Network:
    path = tmp_path / "grid.toml"
    path.write_text(text, encoding="utf-8")
    return load_network(path)


def changed(*pairs: tuple[str, str]) -> str:
    text = GOOD
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new, 1)
    return text


def problems_of(tmp_path: Path, *pairs: tuple[str, str]) -> tuple[str, ...]:
    with pytest.raises(InvalidInputError) as caught:
        load(tmp_path, changed(*pairs))
    assert "grid.toml" in caught.value.what
    return caught.value.problems


def test_matrices_banks_and_legs_become_per_unit_of_a_third_of_the_power_base(tmp_path: Path) -> None:
    network = load(tmp_path, GOOD)
    assert network.n_nodes == 11
    expected = {
        "1-2": build_line("abc", (0.1 + 0.2j) * np.eye(3), 3e-6j * 24 * np.eye(3)),
        "2-3": build_line("ac", Z),
        "bank": build_bank(
            connect("abc", "delta reversed"),
            connect("abc", "grounded", (1.0, 1.02, 1.05)),
            0.5 / (0.01 + 0.06j),
            0.002 - 0.01j,
        ),
    }
    for name, primitive in expected.items():
        assert network.branch(name).primitive.y == pytest.approx(primitive.y, rel=1e-14)
        assert network.branch(name).primitive.charging == pytest.approx(primitive.charging, rel=1e-14)
    across = 4 / 3**0.5 / 2
    capacitors = [Load(4, phase, pytest.approx(-0.025j * across**2), (2.0, 2.0)) for phase in "abc"]
    assert network.loads == (Load(3, "ca", pytest.approx(0.1 + 0.05j)), Load(3, "a", pytest.approx(0.01)), *capacitors)
    assert [bus.b_shunt for bus in network.buses] == pytest.approx([0.05, 0, 0.05, 0])  # of three phases, of two
    assert (network.generators[1].p, network.generators[1].q) == pytest.approx((0.1, 0.05))
    assert network.branch("1-2").i_max == pytest.approx(100 * 3**0.5 * 12 / 6000)
    assert network.branch("2-3").s_max == pytest.approx(2 / 4)


def test_shunts_stand_at_the_phases_that_they_name(tmp_path: Path) -> None:
    network = load(tmp_path, GOOD)
    plain = replace(network, shunts=())
    added = build_admittance(network).ybus - build_admittance(plain).ybus
    between = (0.003 + 0.03j) / 3
    expected = np.diag([0.05j, between, between, 0.02j]).astype(complex)
    rows = [network.node(*place) for place in ((3, "a"), (4, "a"), (4, "b"), (4, "c"))]
    expected[1, 2] = expected[2, 1] = -between
    assert added.toarray()[np.ix_(rows, rows)] == pytest.approx(expected, abs=1e-14)
    assert abs(added).sum() == pytest.approx(abs(expected).sum(), abs=1e-13)
    no_load = [build_admittance(one, with_shunts=False).ybus for one in (network, plain)]
    assert abs(no_load[0] - no_load[1]).max() == 0


def test_the_clock_of_a_bank_is_the_lag_of_its_low_side(tmp_path: Path) -> None:
    for clock in (1, 5, 7, 11):
        network = load(
            tmp_path, changed(("x_percent", f"clock = {clock}\nx_percent"), (", taps = [1.0, 1.02, 1.05]", ""))
        )
        idle = Network("idle", 6.0, network.buses, network.branches, network.generators[:1])
        turn = np.degrees(solve_power_flow(idle).va[idle.node(4, "a")])
        assert (turn + 30 * clock + 180) % 360 - 180 == pytest.approx(0, abs=2)
    low = changed(('"delta"', '"wye"'), ('"grounded wye"', '"delta"'))
    assert load(tmp_path, low).branch("bank").primitive.y == pytest.approx(
        build_bank(
            connect("abc", "wye"), connect("abc", "delta", (1.0, 1.02, 1.05)), 0.5 / (0.01 + 0.06j), 0.002 - 0.01j
        ).y
    )


@pytest.mark.parametrize(
    ("name", "high", "low", "kv", "kva"),
    [
        ("dy", "delta", "grounded wye", 12.47, 6000.0),
        ("yd", "wye", "delta", 12.47, 6000.0),
        ("grdyd", "grounded wye", "delta", 12.47, 6000.0),
        ("yy", "grounded wye", "grounded wye", 12.47, 6000.0),
        ("oyod", "a,b", "ab,bc", 7.2 * 3**0.5, 4000.0),
    ],
)
def test_banks_by_their_parameters_have_the_matrices_of_opendss(
    tmp_path: Path, name: str, high: str, low: str, kv: float, kva: float
) -> None:
    at_from = f'{{ bus = 2, phases = "{"ab" if name == "oyod" else "abc"}", kv = {kv}, connection = "{high}" }}'
    bank = f"""[[transformer]]
        kva = {kva}
        r_percent = 1.0
        x_percent = 6.0
        windings = [{at_from}, {{ bus = 4, phases = "abc", kv = 4.16, connection = "{low}" }}]"""
    lines = GOOD.split("[[transformer]]")[0].replace("12.0", "12.47").replace("base_kv = 4.0", "base_kv = 4.16")
    found = matrix_of([load(tmp_path, lines + bank).branch("2-4")])
    converted = [b for b in load_feeder(f"4bus-{name}").branches if (b.from_bus, b.to_bus) == (2, 3)]
    assert found == pytest.approx(matrix_of(converted), rel=1e-12, abs=1e-12)


def matrix_of(branches: Sequence[Branch]) -> np.ndarray:
    """The admittances of parallel branches over phases a, b, c at both ends."""
    Y = np.zeros((6, 6), dtype=complex)
    for branch in branches:
        primitive = branch.primitive
        assert primitive is not None
        ports = [*("abc".index(p) for p in primitive.from_phases), *(3 + "abc".index(p) for p in primitive.to_phases)]
        Y[np.ix_(ports, ports)] += primitive.y
    return Y


def test_the_zero_sequence_of_a_line_couples_its_phases(tmp_path: Path) -> None:
    coupled = load(tmp_path, changed(("x_ohm = 4.8", "x_ohm = 4.8, r0_ohm = 7.2, x0_ohm = 14.4, b0_us = 1.5")))
    z = (0.1 + 0.2j) * (np.eye(3) + 2 / 3 * np.ones((3, 3)))
    charging = 3e-6j * 24 * (np.eye(3) - np.ones((3, 3)) / 6)
    assert coupled.branch("1-2").primitive.y == pytest.approx(build_line("abc", z, charging).y)


def test_windings_may_stand_anywhere(tmp_path: Path) -> None:
    opened = changed(
        ('phases = "abc", kv = 12.0, connection = "delta"', 'phases = "ab", kv = 12.0, connection = "a,b"'),
        ('connection = "grounded wye", taps = [1.0, 1.02, 1.05]', 'connection = "ab,bc"'),
    )
    bank = load(tmp_path, opened).branch("bank").primitive
    assert (bank.from_phases, bank.to_phases) == ("ab", "abc")
    a, b = 1, np.exp(-2j * np.pi / 3)
    assert (bank.y - bank.charging) @ [a, b, 0, -(3**0.5) * a, -(3**0.5) * (a + b)] == pytest.approx(
        np.zeros(5), abs=1e-12
    )


@pytest.mark.parametrize(
    ("leg", "kv"), [("ab", 0.208), ("b", 0.208 / 3**0.5), ("s1", 0.208 / 3**0.5), ("s1s2", 0.416 / 3**0.5)]
)
def test_a_load_rated_at_the_nominal_voltage_across_it_draws_what_one_without_rating_draws(
    tmp_path: Path, leg: str, kv: float
) -> None:
    phases = "s1s2" if "s" in leg else "abc"
    bus = f'{{ id = 5, base_kv = 0.208, phases = "{phases}" }}, ]'
    loads = (
        f'{{ bus = 5, phases = "{leg}", p_kw = [8.0], exponents = [2.0, 1.0]{rated} }},'
        for rated in ("", f", kv = {kv}")
    )
    by_both = [
        load(tmp_path, changed(("]\nbranch", f"{bus}\nbranch"), ("load = [", f"load = [ {one}"))) for one in loads
    ]
    assert by_both[1].loads[0].s == pytest.approx(by_both[0].loads[0].s, rel=1e-12)


def test_each_leg_of_a_load_may_have_exponents_of_its_own(tmp_path: Path) -> None:
    one = '{ bus = 3, phases = "ca,a", p_kw = [200.0, 20.0], q_kvar = [100.0, 0.0], kv = 10.0'
    apart = "".join(
        f'{{ bus = 3, phases = "{leg}", p_kw = [{p}], q_kvar = [{q}], kv = 10.0, exponents = {of} }}, '
        for leg, p, q, of in (("ca", 200.0, 100.0, [1.0, 2.0]), ("a", 20.0, 0.0, [0.0, 0.5]))
    )
    given = '{ bus = 3, phases = "ca,a", p_kw = [200.0, 20.0], q_kvar = [100.0, 0.0] },'
    by_both = [
        load(tmp_path, changed((given, text))).loads
        for text in (f"{one}, exponents = [[1.0, 2.0], [0.0, 0.5]] }},", apart)
    ]
    assert by_both[0] == by_both[1]


def test_centre_tapped_units_feed_two_halves(tmp_path: Path) -> None:
    house = '{ id = 5, base_kv = 0.208, phases = "s1s2" }, ]'
    unit = """[[transformer]]
        kva = 25.0
        r_percent = 1.2
        x_percent = 1.7
        windings = [
            { bus = 2, phases = "b", kv = 12.0, connection = "b" },
            { bus = 5, phases = "s1s2", kv = 0.208, connection = "centre-tapped" },
        ]
        [[transformer]]"""
    text = changed(("]\nbranch", f"{house}\nbranch"), ("[[transformer]]", unit))
    with_loads = text.replace("load = [", 'load = [ { bus = 5, phases = "s1,s2,s1s2", p_kw = [2.0, 1.0, 8.0] },')
    bank = load(tmp_path, text).branch("2-5").primitive
    assert bank is not None
    assert bank.y == pytest.approx(
        build_centre_tapped(Side("b", ("b",), (1.0,)), Side("s1s2", ("s1",), (1.0,)), (0.012 + 0.017j) * 80).y
    )
    network = load(tmp_path, with_loads)
    found = solve_power_flow(network)
    s1, s2, b = (network.node(*place) for place in ((5, "s1"), (5, "s2"), (2, "b")))
    in_halves, whole = np.array([6.0, 5.0]) / 25, 11.0 / 25  # currents, of the unit's rated one
    drop = whole * (0.006 + 0.0136j) + in_halves * (0.012 + 0.0068j)
    assert found.vm[b] - found.vm[[s1, s2]] == pytest.approx(drop.real, abs=1e-4)
    turn = np.exp(1j * (found.va[b] - found.va[[s1, s2]] + [0, np.pi]))
    assert np.angle(turn) == pytest.approx(drop.imag, abs=1e-4)


def list_branches(tmp_path: Path, **changes: Any) -> Path:
    """GOOD as JSON whose branches are lists by key, with ``changes``."""
    tables = tomllib.loads(GOOD)
    keys = dict.fromkeys(key for table in tables["branch"] for key in table)
    tables["branch"] = {key: [table.get(key) for table in tables["branch"]] for key in keys} | changes
    path = tmp_path / "lists.json"
    path.write_text(json.dumps(tables), encoding="utf-8")
    return path


def test_branches_with_phases_may_be_lists(tmp_path: Path) -> None:
    by_lists, by_tables = load_network(list_branches(tmp_path)), load(tmp_path, GOOD)
    assert by_lists.branches == by_tables.branches
    for changes, text in (
        ({"phases": ["abc"]}, "branch: the lists need as many values each; from has 2, to has 2, phases has 1"),
        ({"r_omh": [1, 2], "x_ohm": 3}, "branch: unknown key 'r_omh'; allowed: from, to, "),
        ({"phases": [None, "ac"]}, "branch[1].phases: missing; in a network with phases each branch says those"),
        ({"r_ohm": [2.4, None]}, "branch[2]: has no complete impedance; give r_ohm and x_ohm"),
    ):
        with pytest.raises(InvalidInputError) as caught:
            load_network(list_branches(tmp_path, **changes))
        assert caught.value.problems[0].startswith(text)


@pytest.mark.parametrize("suffix", ["toml", "json"])
@pytest.mark.parametrize("name", ["ieee13", "grid"])
def test_a_network_with_phases_is_read_back_as_it_was_written(tmp_path: Path, suffix: str, name: str) -> None:
    network = load_case(name) if name == "ieee13" else load(tmp_path, GOOD)
    save_network(tmp_path / f"written.{suffix}", network, "a test")
    again = load_network(tmp_path / f"written.{suffix}")
    assert [(b.id, b.from_bus, b.to_bus, b.in_service) for b in again.branches] == [
        (b.id, b.from_bus, b.to_bus, b.in_service) for b in network.branches
    ]
    for one, other in zip(again.branches, network.branches, strict=True):
        assert one.primitive is not None
        assert other.primitive is not None
        assert one.primitive.y == pytest.approx(other.primitive.y, rel=1e-14)
        assert one.primitive.charging == pytest.approx(other.primitive.charging, rel=1e-14)
        assert (one.r, one.x, one.i_max, one.s_max) == pytest.approx((other.r, other.x, other.i_max, other.s_max))
    assert [(x.bus, x.phases, x.exponents) for x in again.loads] == [
        (x.bus, x.phases, x.exponents) for x in network.loads
    ]
    assert [x.s for x in again.loads] == pytest.approx([x.s for x in network.loads], rel=1e-14)
    assert [(x.bus, x.phases) for x in again.shunts] == [(x.bus, x.phases) for x in network.shunts]
    assert [x.y for x in again.shunts] == pytest.approx([x.y for x in network.shunts], rel=1e-14)
    assert again.buses == network.buses
    assert again.generators == network.generators


def test_ieee13_has_the_matrix_and_the_voltages_of_opendss() -> None:
    network, converted = load_case("ieee13"), load_feeder("ieee13")
    names = [node.replace("1000.", "2.").replace("1001.", "1.") for node in converted.node_names]
    of = [network.node_names.index(node) for node in names]
    assert sorted(of) == list(range(network.n_nodes))
    Y = build_admittance(network).ybus.toarray()[np.ix_(of, of)]
    due = build_admittance(converted).ybus.toarray()
    assert (abs(Y - due) < 1e-9 * abs(due).max(axis=1)).all()
    found = solve_power_flow(network, tolerance=1e-12)
    v = (found.vm * np.exp(1j * found.va))[of]
    assert np.nanmax(abs(v - load_voltages("ieee13"))) < 1e-9
    assert 1000 / 3 * network.base_mva * found.losses.real == pytest.approx(110.7, abs=0.1)


@pytest.mark.parametrize(
    ("pair", "text"),
    [
        (('phases = "ac", b_shunt', "b_shunt"), "bus 3 has no phases, and others have; give each bus its phases"),
        (
            ('phases = "ac", b_shunt', 'phases = "acn", b_shunt'),
            "bus 3: phases is 'acn'; give some of a, b, c, s1, s2, in this order; a neutral is no node: "
            "leave it out, and reduce impedances to those of the phases",
        ),
        (('phases = "ac", r_ohm', 'phases = "ca", r_ohm'), "branch[2].phases: is 'ca'; give some of a, b, c, s1"),
        (
            ('phases = "ac", r_ohm = [[2.4], [0.6, 3.6]]', 'phases = "bc", r_ohm = [[2.4], [0.6, 3.6]]'),
            "branch 2-3 has phase b at bus 3, which lacks it; leave it out of the branch, or add it to the bus",
        ),
        (
            ('phases = "ac", r_ohm', "r_ohm"),
            "branch[2].phases: missing; in a network with phases each branch says those",
        ),
        (
            ("[[2.4], [0.6, 3.6]]", "[[2.4], [0.6, 3.6], [0, 0, 1]]"),
            "branch[2].r_ohm: its rows have 1, 2, 3 numbers; the lower triangle of phases ac has rows of 1, 2",
        ),
        (("[0.6, 3.6]", "[6.0, 3.6]"), "branch[2].r_ohm: the matrix is not positive, a line of it would produce power"),
        (
            ("[[2.4], [0.6, 3.6]], x_ohm = [[4.8], [1.2, 6.0]]", "0.0, x_ohm = 0.0"),
            "branch[2].x_ohm: with r the impedances are singular; correct them",
        ),
        (("[[2.4], [0.6, 3.6]]", "[[2.4], [0.6, 1e300]]"), "branch[2].r_ohm is 4.16667e+298 p.u.; it must lie between"),
        (
            ("r_ohm = 2.4", "tap_ratio = 1.1, r_ohm = 2.4"),
            "branch[1].tap_ratio: a branch with phases is a line; give a",
        ),
        (
            ("r_ohm = 2.4", "estimate_tap = true, r_ohm = 2.4"),
            "branch[1].estimate_tap: taps of networks with phases are not estimated; leave it out",
        ),
        (
            ("r_ohm = 2.4, x_ohm = 4.8, b_us = 3.0", "r0_ohm = 1.1, r_pu = 1, x_pu = 1"),
            "branch[1]: mixes ohm and microsiemens with",
        ),
        (
            ("r_ohm = 2.4", "g_ports_pu = [[1.0]], r_ohm = 2.4"),
            "branch[1]: has g_ports_pu; g_ports_pu and b_ports_pu stand together",
        ),
        (("b_us = 3.0", "b0_us = 3.0"), "branch[1].b0_us: stands beside b_us, which is missing; give it"),
        (
            ("from = 2, to = 3", "from = 4, to = 3"),
            "branch[2].r_ohm: the line joins bus 4 of 4.0 kV and bus 3 of 12.0 kV",
        ),
        (
            (
                'from = 1, to = 2, phases = "abc", r_ohm = 2.4, x_ohm = 4.8, b_us = 3.0, rating_a = 100.0',
                'from = 1, to = 4, phases = "abc", r_pu = 0.1, x_pu = 0.1',
            ),
            "branch[1].r_pu: the line joins bus 1 of 12.0 kV and bus 4 of 4.0 kV; give a [[transformer]]",
        ),
        (('"ca,a"', '"ca,b"'), "load[1].phases: bus 3 has no phase b; it has a, c"),
        (
            ('"ca,a"', '"cac,a"'),
            "load[1].phases: 'cac' is no leg; name one phase, of a leg to ground or neutral, or two, such",
        ),
        (("p_kw = [200.0, 20.0]", "p_kw = [200.0]"), "load[1].p_kw: is [200.0]; give a number for each leg of 'ca,a'"),
        (("p_kw = [200.0, 20.0]", "p_kw = [1e12, 20.0]"), "load at bus 3, ca: active power is 1e+09 MW; it must lie"),
        (
            ("exponents = [2.0, 2.0]", "exponents = [2.0, 200.0]"),
            "load[2].exponents is 200; it must lie between -10 and 10",
        ),
        (
            ("exponents = [2.0, 2.0]", "exponents = [[2.0, 2.0], [0.0, 0.0]]"),
            "load[2].exponents: is [[2.0, 2.0], [0.0, 0.0]]; give one pair, or a pair for each leg of 'a,b,c'",
        ),
        (('{ bus = 3, phases = "ca,a"', '{ bus = 9, phases = "ca,a"'), "load[1].bus: bus 9 is not defined"),
        (
            ('bus = 3, phases = "a", b', 'bus = 3, phases = "b", b'),
            "shunt[1].phases: bus 3 has no phase b; it has a, c",
        ),
        ((", b_kvar = [100.0]", ""), "shunt[1]: has no power; give g_kw or b_kvar"),
        (("[60.0, 40.0]", "[60.0]"), "shunt[2].b_kvar: is [60.0]; give a number for each leg of 'ab,c'"),
        (("b_kvar = [100.0]", "b_kvar = [1e13]"), "shunt at bus 3, a: susceptance is 5e+09 p.u.; it must lie"),
        (
            ("magnetising_percent = 2.0", "magnetising_percent = 2e9"),
            "transformer[1].magnetising_percent is 2e+09 %; it must lie between 0 and 100 %",
        ),
        (("x_percent = 6.0", "x_percent = -6.0"), "transformer[1].x_percent is -6 %; it must lie between 0 and 100 %"),
        (
            ("taps = [1.0, 1.02, 1.05]", "taps = [1, 3, 5]"),
            "transformer[1].windings[2].taps is 3 times the nominal turns; it must lie between 0.5 and 2",
        ),
        (("p_kw = [200.0, 20.0]", "p_kw = [9e6, 20.0]"), "load at bus 3, ca: current at 12 kV is 1.29904e+06 A; it"),
        (("exponents = [2.0, 2.0]", "exponents = [2.0]"), "load[2].exponents: must have at least 2 items, found [2.0]"),
        (
            ('from = 2, to = 3, phases = "ac"', 'from = 2, to = 3, phases = "an"'),
            "branch[2].phases: is 'an'; give some of a, b, c, s1, s2, in this order; a neutral is no node: leave",
        ),
        (
            ('connection = "delta"', 'connection = "star"'),
            "transformer[1].windings[1].connection: 'star' is no winding; give 'grounded wye', 'wye'",
        ),
        (
            ("taps = [1.0, 1.02, 1.05]", "taps = [1.0, 1.02]"),
            "transformer[1].windings[2].taps: is [1.0, 1.02]; give one number, or one for each of the w",
        ),
        (
            ("x_percent = 6.0", "x_percent = 6.0\nclock = 0"),
            "transformer[1].clock: is 0; of 'delta' to 'grounded wye' it is 1 or 5 or",
        ),
        (
            ("r_percent = 1.0\nx_percent = 6.0", "r_percent = 0.0\nx_percent = 0.0"),
            "transformer[1].x_percent: the impedance of a unit is 0 p.u.; it must lie between 1e-09",
        ),
        (
            ('bus = 4, phases = "abc", kv = 4.0', 'bus = 4, phases = "abc", kv = 2.3'),
            "transformer[1].windings[2].kv: is 2.3, and bus 4 has base_kv 4; both are between lines, correct one",
        ),
        (
            ('{ bus = 1, kind = "slack"', '{ bus = 3, kind = "slack"'),
            "source[1].bus: the substation holds phase a, c of bus 3 only, and the network has 1.b; give a bus with",
        ),
        (
            ('id = "bank"', 'id = "2-3"'),
            "branch 2-3: the branch between bus 2 and bus 4 has this id; give it another, or",
        ),
        (("b_shunt_mvar = 0.2", "b_shunt_mvar = 3e6"), "bus 3: susceptance of the shunt is 3e+06 Mvar; it must"),
        (("p_mw = 0.4", "p_mw = 2e6"), "source at bus 3: active power is 2e+06 MW; it must"),
        (("rating_mva = 2.0", "rating_mva = 2e9"), "branch 2-3: rating is 2e+09 MVA; it must"),
        (
            ('kind = "power"', 'kind = "voltage", vm_pu = 1.0'),
            "source[2].kind: no source but the slack holds the voltage",
        ),
        (("kva = 3000.0", "kva = 1e300"), "transformer[1].kva is 1e+297 MVA; it must lie between"),
        (("kv = 2.0", "kv = 1e-300"), "load[2].kv is 1e-300 kV; it must lie between"),
        (
            (
                "taps = [1.0, 1.02, 1.05] },",
                'taps = [1.0, 1.02, 1.05] }, { bus = 3, phases = "ac", kv = 12.0, connection = "a,c" },',
            ),
            "transformer[1].windings: 3 windings at bus 2, 4, 3; a bank has two, and no element joins three buses; "
            "give a bank from bus 2 to each other one",
        ),
        (
            ("id = 2, base_kv = 12.0,", "id = 2, base_kv = 12.0, p_load_mw = 1.0,"),
            "bus 2 has phases, and a load of its own; state the load by its legs",
        ),
    ],
)
def test_a_mistake_is_named_with_its_key_and_cure(tmp_path: Path, pair: tuple[str, str], text: str) -> None:
    problems = problems_of(tmp_path, pair)
    assert any(problem.startswith(text) for problem in problems), problems


def test_all_mistakes_are_named_at_once(tmp_path: Path) -> None:
    pairs = (("[0.6, 3.6]", "[6.0, 3.6]"), ('"ca,a"', '"ca,b"'), ('"delta"', '"star"'), ("to = 3", "to = 9"))
    assert [problem.split(":")[0] for problem in problems_of(tmp_path, *pairs)] == [
        "branch[2].r_ohm",
        "transformer[1].windings[1].connection",
        "load[1].phases",
        "branch 2-9 ends at bus 9, which is not defined",
    ]


def test_what_stands_at_a_bus_whose_phases_are_refused_is_no_further_mistake(tmp_path: Path) -> None:
    (problem,) = problems_of(tmp_path, ('phases = "ac", b_shunt', 'phases = "acn", b_shunt'))
    assert problem.startswith("bus 3")


def test_a_phase_that_coupling_alone_reaches_has_no_supply(tmp_path: Path) -> None:
    """Phase b of bus 3 and of bus 5 behind it: their line is coupled to a and c, which have supply."""
    further = '{ id = 5, base_kv = 12.0, phases = "abc" },'
    line = '{ from = 3, to = 5, phases = "abc", r_ohm = [[2], [1, 2], [1, 1, 2]], x_ohm = [[4], [2, 4], [2, 2, 4]] },'
    beyond = (("]\nbranch", f"{further}]\nbranch"), ("]\nload", f"{line}]\nload"))
    network = load(tmp_path, changed(('phases = "ac", b_shunt', 'phases = "abc", b_shunt'), *beyond))
    (problem,) = network.find_supply_problems()
    assert problem == (
        "no path of branches in service joins phase b of bus 3, phase b of bus 5 to the substation; feed the phase, or "
        "leave it out of the bus"
    )
    assert load(tmp_path, GOOD).find_supply_problems() == load_case("ieee13").find_supply_problems() == []


def test_parts_with_phases_are_refused_where_no_bus_has_phases(tmp_path: Path) -> None:
    text = GOOD.split("load = [")[0] + 'source = [{ bus = 1, kind = "slack", vm_pu = 1.0 }]'
    text = (
        text.replace('phases = "abc", b_shunt', "b_shunt")
        .replace('phases = "ac", b', "b")
        .replace(', phases = "abc" }', " }")
    )
    with pytest.raises(
        InvalidInputError, match=r"bus: branch\[1\], branch\[2\] has phases, and no bus has; give each bus"
    ):
        load(tmp_path, text)
