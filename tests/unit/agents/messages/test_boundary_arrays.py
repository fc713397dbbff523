"""Messages about a boundary may have any number of variables, and no array of another length."""

from dataclasses import fields, replace

import msgspec
import numpy as np
import pytest

from agents.messages.boundary_arrays import read_triangle, write_triangle
from agents.messages.checks import MessageError
from agents.messages.packing import decode, encode, seal
from agents.messages.types import PlaceMessage, VariablesMessage
from dsse_core.grid.boundary import Boundary, boundary_at
from tests.support.sample_messages import MESSAGES, UP, places_of

ONE_PHASE = boundary_at((6,), "area2").names
THREE_PHASES = ("s@6.abc>area2", "v@6.abc")
SEVERAL = [THREE_PHASES, ("s@6.s1s2>b", "v@6.s1s2"), ("s@6>b", "s@6>c", "s@-7>b", "v@6", "v@-7")]
OF_BOUNDARIES = [UP, *(m for m in MESSAGES if m.kind in ("down", "admm", "heartbeat"))]


def with_variables(message, variables):
    """``message`` about a boundary with ``variables``, all arrays as long as they then are."""
    boundary = Boundary(variables)
    d, powers = boundary.d, boundary.n_powers
    numbers = tuple(0.1 * k for k in range(d * (d + 1) // 2))
    match message.kind:
        case "heartbeat":
            return replace(message, variables=variables, y=numbers[:d])
        case "admm":
            return replace(message, variables=variables, **dict.fromkeys(("r", "r_before", "weight"), numbers[:d]))
    return replace(message, variables=variables, R=numbers, z=numbers[:d], no_load=numbers, power=numbers[:powers])


@pytest.mark.parametrize("message", OF_BOUNDARIES, ids=lambda m: m.kind)
@pytest.mark.parametrize("variables", SEVERAL)
def test_a_boundary_may_have_any_number_of_variables(message, variables):
    sent = with_variables(message, variables)
    assert decode(encode(sent)) == sent


@pytest.mark.parametrize("message", OF_BOUNDARIES, ids=lambda m: m.kind)
@pytest.mark.parametrize("variables", [THREE_PHASES, ONE_PHASE])
def test_no_array_about_a_boundary_has_another_length_than_its_variables_ask_for(message, variables):
    sent, d = with_variables(message, variables), Boundary(variables).d
    for name in {"R", "z", "no_load", "power", "y", "r", "r_before", "weight"} & {f.name for f in fields(sent)}:
        for wrong in (getattr(sent, name)[:-1], (*getattr(sent, name), 0.0)):
            with pytest.raises(MessageError, match=f"{name} has {len(wrong)} numbers, not .* with {d} variables"):
                decode(encode(replace(sent, **{name: wrong})))


@pytest.mark.parametrize(
    "powers",
    [
        (),
        ("p", "q", "vm", "va"),  # of versions before
        ("s@6",),
        ("s@6>",),
        ("s@06>b",),
        ("S@6>b",),
        ("s@6.d>b",),
        ("s@6.>b",),
        ("s@6.aba>b",),
        ("s@6.ba>b",),
        ("s@6>b", "s@6>b"),
        ("s@6>b", "v@6"),  # a voltage, which follows
        ("v@6",),
        tuple(f"s@{bus}>b" for bus in range(251)),
    ],
)
def test_powers_that_no_boundary_has_are_rejected(powers):
    places = places_of(UP)
    places[2 + [f.name for f in fields(UP)].index("variables")] = powers
    with pytest.raises(MessageError, match="variable"):
        decode(seal(msgspec.msgpack.encode(places)))


def test_information_with_three_phases_survives_as_a_matrix():
    R = np.triu(np.arange(1.0, 145.0).reshape(12, 12))
    sent = replace(with_variables(UP, THREE_PHASES), R=write_triangle(R))
    np.testing.assert_array_equal(read_triangle(decode(encode(sent)).R), R)


@pytest.mark.parametrize("message_type", [VariablesMessage, PlaceMessage])
def test_a_message_that_does_not_state_its_lengths_cannot_be_made(message_type):
    class Forgetful(message_type):
        """No ``lengths``."""

    with pytest.raises(TypeError, match="lengths"):
        Forgetful(*[None] * (len(fields(message_type)) - 1), variables=ONE_PHASE)
