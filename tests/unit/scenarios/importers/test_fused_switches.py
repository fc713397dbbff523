"""Switches of networks with phases: their buses become one, which has the phases, legs and shunts of both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.grid.loads import Load, Shunt
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.primitives import build_bank, build_line, connect, find_size
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.files.zero_impedances import find_zero_impedance_problems
from scenarios.importers.fused_branches import fuse_zero_impedances

Z = np.array([[0.05, 0.02, 0.01], [0.02, 0.06, 0.02], [0.01, 0.02, 0.05]]) * (0.3 + 1j)
SMALL = 1e-6


def line(ends: tuple[int, int], phases: str = "abc", size: float = 1.0) -> Branch:
    chosen = ["abc".index(phase) for phase in phases]
    primitive = build_line(phases, size * Z[np.ix_(chosen, chosen)], 1e-3j * size * np.eye(len(chosen)))
    z = find_size(primitive)
    return Branch(f"{ends[0]}-{ends[1]}", *ends, z.real, z.imag, primitive=primitive)


@pytest.fixture
def feeder() -> Network:
    """A regulator of the size of a switch, and two switches, one of them to a lateral of a single phase."""
    regulator = build_bank(connect("abc", "grounded"), connect("abc", "grounded", (1.01, 1.0, 1.02)), 1e6 - 1e6j)
    z = find_size(regulator)
    branches = (
        Branch("reg", 1, 2, z.real, z.imag, primitive=regulator), line((2, 3)), line((9, 3), size=SMALL),
        line((9, 4)), line((4, 5), "b", SMALL), line((5, 6), "b"),
    )  # fmt: skip
    buses = (
        *(Bus(bus, 4.8, phases="abc") for bus in (1, 2, 3, 9, 4)),
        Bus(5, 4.8, phases="b", b_shunt=0.02), Bus(6, 4.8, phases="b"),
    )  # fmt: skip
    loads = Load(9, "ab", 0.2 + 0.1j), Load(5, "b", 0.1 + 0.1j, (1.0, 1.0)), Load(6, "b", 0.1 + 0.05j)
    return Network("switches", 3.0, buses, branches, (Generator(1, Control.SLACK),), loads)


def test_the_power_flow_of_fused_switches_is_that_of_short_lines(feeder: Network) -> None:
    fused, remarks = fuse_zero_impedances(feeder)
    assert [bus.id for bus in fused.buses] == [1, 2, 3, 4, 6]
    assert [branch.id for branch in fused.branches] == ["1-2", "2-3", "3-4", "4-6"]  # the regulator stays
    assert fused.bus(4).phases == "abc"
    assert fused.shunts == (Shunt(4, "b", 0.02j),)
    assert "bus 9 into bus 3, joined by branch 9-3" in remarks[0].text
    assert remarks[-1].text == "branch 9-3, 4-5: its charging, as it has no impedance"
    whole, one = solve_power_flow(feeder), solve_power_flow(fused)
    of = [feeder.node_names.index(node) for node in fused.node_names]
    assert abs(whole.vm[of] - one.vm).max() < 1e-6
    assert abs(whole.va[of] - one.va).max() < 1e-6


def test_files_refuse_switches_by_their_share_and_not_regulators(feeder: Network) -> None:
    problems = list(find_zero_impedance_problems(feeder))
    assert [problem.split()[1] for problem in problems] == ["9-3", "4-5"]
    assert all("with less than 0.0001 of the median no estimate is exact: merge" in problem for problem in problems)


def test_a_jumper_of_one_of_three_phases_is_refused_with_the_phases_apart(feeder: Network) -> None:
    jumper = replace(line((2, 4), "a", SMALL), id="jumper")
    branches = *feeder.branches[:2], line((9, 3)), line((9, 4)), line((4, 5), "b"), line((5, 6), "b"), jumper
    with pytest.raises(InvalidInputError, match=r"branch jumper: .* it leaves their phases b, c apart"):
        fuse_zero_impedances(replace(feeder, branches=branches))
