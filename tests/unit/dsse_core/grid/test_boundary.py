"""Names of the variables of a boundary, and what follows from them."""

import numpy as np
import pytest

from dsse_core.grid.boundary import Boundary, Kind, boundary_at, find_wrong_name


def test_a_name_says_kind_bus_phase_and_the_area_into_which_a_power_flows():
    boundary = Boundary(("s@6.a>b", "s@6.s1s2>c", "v@6.as1s2"))
    assert not find_wrong_name(boundary.names)
    found = [(v.kind, v.bus, v.phase, v.area) for v in boundary.variables]
    assert found == [
        *[("p", 6, "a", "b"), ("q", 6, "a", "b")],  # two areas at one bus are told apart
        *[("p", 6, "s1", "c"), ("q", 6, "s1", "c"), ("p", 6, "s2", "c"), ("q", 6, "s2", "c")],
        *[(kind, 6, phase, "") for phase in ("a", "s1", "s2") for kind in ("vm", "va")],
    ]


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        (("s@6>b",), "other voltages than v@6"),
        (("v@6",), "other voltages than none"),
        (("s@6.ab>b", "s@6.bc>c", "v@6.ab"), "other voltages than v@6.abc"),
        (("s@6>b", "s@9>b", "v@9", "v@6"), "other voltages than v@6, v@9"),
        (("v@6", "s@6>b"), "other voltages than v@6"),
        (("s@6>b", "v@6", "v@6"), "given twice"),
        (("s@6.ba>b", "v@6.ab"), "variable 's@6.ba>b'"),
        ((), "0 variables"),
    ],
)
def test_voltages_that_do_not_follow_from_the_powers_are_named(names: tuple[str, ...], problem: str):
    assert problem in find_wrong_name(names)


def test_numbers_degrees_and_places_follow_from_the_names():
    boundary = boundary_at((6, 9), "b")
    assert boundary.names == ("s@6>b", "s@9>b", "v@6", "v@9")
    assert (boundary.d, boundary.n_powers, boundary.buses) == (8, 4, (6, 9))
    np.testing.assert_array_equal(boundary.degrees, [2, 2, 2, 2, 1, 0, 1, 0])
    np.testing.assert_array_equal(boundary.places[Kind.VA], [5, 7])
    np.testing.assert_array_equal(boundary.per_kind(1.0, 2.0, 3.0, 4.0), [1, 2, 1, 2, 3, 4, 3, 4])


def test_one_bus_and_one_phase_are_four_variables():
    assert [variable.kind for variable in boundary_at((6,), "b").variables] == ["p", "q", "vm", "va"]
