"""Every message survives the wire unchanged, and nothing malformed gets through."""

import json
import math
from dataclasses import fields, replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.messages.boundary_variables import ONE_PHASE
from agents.messages.checks import LONGEST_NAME, LONGEST_NOTE, MOST_NOTES, MessageError, limit_notes
from agents.messages.packing import (
    MESSAGE_TYPES,
    WIRE_VERSION,
    AdmmMessage,
    BoundaryMessage,
    ClockMessage,
    DownMessage,
    Header,
    HeartbeatMessage,
    Incarnation,
    LoadMessage,
    StateMessage,
    TelemetryMessage,
    UpMessage,
    decode,
    encode,
    seal,
)
from agents.messages.triangle import read_triangle, write_triangle
from dsse_core.estimation.verdict import Totals

HEADER = Header("run-1", "area1", Incarnation(1_795_200_000_000, 2**32 - 1), 7, 3, 1_795_200_000.25)
STATE = StateMessage(
    header=HEADER,
    buses=(1, 2),
    vm=(1.0, 0.99),
    va=(0.0, -0.01),
    sigma_vm=(0.001, 0.002),
    sigma_va=(0.0, 0.001),
    referenced=True,
    objective=12.5,
    degrees_of_freedom=20,
    removed=("p_flow@1:1-2",),
    critical=("vm@1",),
    checked=True,
    sent={"area2": (1, 4)},
    received={"area2": (1, 3)},
    messages=12,
    bytes=800,
    lost=2,
    rejected={"malformed": 1},
    notes=("no load message from area2 yet",),
    faults={"lost": 2, "delayed": 7},
    quality="degraded",
    telemetry_age=0.25,
    ages={"area2": 1.5},
    scans={"area2": 6},
    old_sides=("area3",),
)
UP = UpMessage(
    HEADER,
    bus=6,
    revision=1,
    k=3,
    receives=True,
    answers=1.7e9,
    received=(0, 2),
    R=tuple(map(float, range(10))),
    z=(0.1, 0.2, 0.3, 0.4),
    no_load=(),
    power=(0.1, 0.2),
    totals=Totals(12.5, -2, 1e-3, 2e-3, 3, (("vm@1", 4.5),), 2, True, ("area4",), (), ("7", "9-12"), ()),
)


def fields_of(message):
    return {field.name: getattr(message, field.name) for field in fields(message)}


MESSAGES = [
    LoadMessage(HEADER, 6, 0.25, -0.1, 0.01),
    BoundaryMessage(HEADER, 6, 0.95, -0.02, True),
    AdmmMessage(HEADER, 6, 3, (0.1, 0.0, 1.0, -0.1), (0.2, 0.0, 1.0, -0.1), (1e4, 1e4, 1e5, 1e5), True, True),
    HeartbeatMessage(HEADER, 6, 1, 3, True, 1.7e9, (3, 0), True, False, (0.1, 0.2, 1.0, -0.1)),
    UP,
    DownMessage(
        **{f.name: getattr(UP, f.name) for f in fields(UP)} | {"power": ()},
        verdict="evaluate",
        decider="area1",
        incarnation=(1, 2),
    ),
    TelemetryMessage(HEADER, "area1", ("vm@1",), (1.0,), (0.002,), (1.7952e9,), (False,)),
    ClockMessage(HEADER, 12.5),
    STATE,
]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.kind)
def test_a_message_survives_the_wire_unchanged(message):
    assert decode(encode(message)) == message


def test_a_boundary_message_fits_in_200_bytes_even_with_long_names():
    header = Header("r" * 32, "a" * 32, HEADER.incarnation, 2**31, 2**31, 1.8e9)
    assert len(encode(BoundaryMessage(header, 2**31, 0.95, -0.02, True))) <= 200


def places_of(message):
    return list(msgspec.msgpack.decode(encode(message)[:-4]))


def changed(*path, to):
    """A change of the place of a message that ``path`` leads to."""

    def change(places):
        for step in path[:-1]:
            places = places[step]
        places[path[-1]] = to

    return change


HEADER_PLACE, VM, REFERENCED = 2, 4, 6  # of a boundary message


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (changed(0, to=WIRE_VERSION + 1), "wire version"),
        (changed(0, to="2"), "malformed"),
        (changed(1, to="gossip"), "malformed"),
        (changed(1, to=["load"]), "malformed"),
        (changed(HEADER_PLACE, to=5), "malformed"),
        (changed(HEADER_PLACE, 0, to=5), "malformed"),
        (changed(HEADER_PLACE, 2, to=[1]), "malformed"),
        (changed(HEADER_PLACE, 3, to=-1), "malformed"),
        (changed(HEADER_PLACE, 4, to=True), "malformed"),
        (changed(HEADER_PLACE, 5, to=math.inf), "not finite"),
        (changed(VM, to=math.nan), "not finite"),
        (changed(VM, to=-math.inf), "not finite"),
        (changed(VM, to="0.95"), "malformed"),
        (changed(VM, to=None), "malformed"),
        (changed(REFERENCED, to=1), "malformed"),
        (lambda places: places.append(0), "malformed"),
        (lambda places: places.pop(), "malformed"),
        (lambda places: places[HEADER_PLACE].append(0), "malformed"),
    ],
)
def test_a_changed_place_is_rejected_with_its_reason(change, reason):
    places = places_of(BoundaryMessage(HEADER, 6, 0.95, -0.02, True))
    change(places)
    with pytest.raises(MessageError) as caught:
        decode(seal(msgspec.msgpack.encode(places)))
    assert caught.value.reason == reason


def test_a_whole_number_may_stand_for_a_number():
    places = places_of(BoundaryMessage(HEADER, 6, 0.95, -0.02, True))
    places[VM] = 2**64 - 1
    assert decode(seal(msgspec.msgpack.encode(places))).vm == float(2**64 - 1)


@pytest.mark.parametrize("kind", sorted(MESSAGE_TYPES))
def test_recorded_bytes_of_wire_version_1_are_rejected_by_name(kind):
    recorded = json.loads((Path(__file__).parent / "wire_version_1.json").read_text())
    with pytest.raises(
        MessageError, match="speaks wire version 1, this is version 2: upgrade the other side"
    ) as caught:
        decode(bytes.fromhex(recorded[kind]))
    assert caught.value.reason == "wire version"


def test_a_later_wire_version_asks_for_an_upgrade_of_this_program():
    with pytest.raises(MessageError, match="speaks wire version 3, this is version 2: upgrade this program"):
        decode(seal(msgspec.msgpack.encode([3, {"kind": "load"}])))


def test_the_field_that_is_wrong_is_named():
    places = places_of(UP)
    places[2 + [f.name for f in fields(UP)].index("z")][3] = "0.4"
    with pytest.raises(MessageError, match=r"z\[3\]: Expected `float`, got `str`"):
        decode(seal(msgspec.msgpack.encode(places)))


def test_arrays_of_a_state_must_have_one_length():
    with pytest.raises(MessageError, match="differ in length"):
        decode(encode(replace(STATE, vm=(1.0,))))


def test_a_key_given_twice_is_rejected():
    places = places_of(STATE)
    places[2 + [f.name for f in fields(STATE)].index("rejected")] = [["malformed", 1], ["malformed", 2]]
    with pytest.raises(MessageError, match="given twice"):
        decode(seal(msgspec.msgpack.encode(places)))


THREE_PHASES = tuple(f"{kind}.{phase}" for kind in ("p", "q", "vm", "va") for phase in "abc")
SPEAK_OF_BOUNDARIES = [UP, *(m for m in MESSAGES if m.kind in ("down", "admm", "heartbeat"))]


def with_variables(message, variables):
    """``message`` about a boundary with ``variables``, all arrays as long as they then are."""
    d = len(variables)
    numbers = tuple(0.1 * k for k in range(d * (d + 1) // 2))
    match message.kind:
        case "heartbeat":
            return replace(message, variables=variables, y=numbers[:d])
        case "admm":
            return replace(message, variables=variables, **dict.fromkeys(("r", "r_before", "weight"), numbers[:d]))
    powers = sum(name[0] in "pq" for name in variables)
    return replace(message, variables=variables, R=numbers, z=numbers[:d], no_load=numbers, power=numbers[:powers])


@pytest.mark.parametrize("message", SPEAK_OF_BOUNDARIES, ids=lambda m: m.kind)
@pytest.mark.parametrize("variables", [THREE_PHASES, ("p.a", "q.a", "vm.a", "va.a"), ("p@6", "q@6", "vm@7", "va@7")])
def test_a_boundary_may_have_any_number_of_variables(message, variables):
    sent = with_variables(message, variables)
    assert decode(encode(sent)) == sent


@pytest.mark.parametrize("message", SPEAK_OF_BOUNDARIES, ids=lambda m: m.kind)
@pytest.mark.parametrize("variables", [THREE_PHASES, ONE_PHASE])
def test_no_array_about_a_boundary_has_another_length_than_its_variables_ask_for(message, variables):
    sent = with_variables(message, variables)
    for name in {"R", "z", "no_load", "power", "y", "r", "r_before", "weight"} & {f.name for f in fields(sent)}:
        for wrong in (getattr(sent, name)[:-1], (*getattr(sent, name), 0.0)):
            with pytest.raises(MessageError, match=f"{name} has {len(wrong)} numbers, not .* with {len(variables)}"):
                decode(encode(replace(sent, **{name: wrong})))


@pytest.mark.parametrize("variables", [(), ("p", "p", "vm", "va"), ("p", "q", "vm", "VA"), ("p", "q", "vm", "va.")])
def test_variables_that_no_boundary_has_are_rejected(variables):
    with pytest.raises(MessageError, match="variable"):
        decode(encode(with_variables(UP, variables)))


def test_information_with_three_phases_survives_as_a_matrix():
    R = np.triu(np.arange(1.0, 145.0).reshape(12, 12))
    sent = replace(with_variables(UP, THREE_PHASES), R=write_triangle(R))
    np.testing.assert_array_equal(read_triangle(decode(encode(sent)).R), R)


@pytest.mark.parametrize("place", ["removed", "old_sides", "quality", "rejected", "sent", "run", "sender"])
def test_a_name_longer_than_any_name_is_rejected(place):
    longest = "a" * LONGEST_NAME
    for name, passes in ((longest, True), (longest + "a", False)):
        values = {"rejected": {name: 1}, "sent": {name: (1, 1)}, "quality": name}
        if place in ("run", "sender"):
            state = replace(STATE, header=replace(HEADER, **{place: name}))
        else:
            state = replace(STATE, **{place: values.get(place, (name,))})
        if passes:
            assert decode(encode(state)) == state
        else:
            with pytest.raises(MessageError, match="malformed"):
                decode(encode(state))


@pytest.mark.parametrize(
    ("notes", "passes"),
    [
        (("n" * LONGEST_NOTE,) * MOST_NOTES, True),
        (("n" * (LONGEST_NOTE + 1),), False),
        (("n",) * (MOST_NOTES + 1), False),
    ],
)
def test_notes_are_few_and_short(notes, passes):
    state = replace(STATE, notes=notes)
    if passes:
        assert decode(encode(state)) == state
    else:
        with pytest.raises(MessageError, match="malformed"):
            decode(encode(state))


def test_an_area_with_much_to_note_is_not_rejected_for_it():
    notes = [f"neighbour area{k} is gone" for k in range(200)] + ["no estimate: bus " + ", ".join(map(str, range(999)))]
    kept = limit_notes(notes[-1:] + notes)
    assert decode(encode(replace(STATE, notes=kept))).notes == kept
    assert (len(kept), len(kept[0]), kept[0][-3:], kept[-1]) == (MOST_NOTES, LONGEST_NOTE, "...", "and 153 more")


def test_an_oversized_payload_is_rejected_unread():
    with pytest.raises(MessageError) as caught:
        decode(bytes(8 * 1024 * 1024 + 1))
    assert caught.value.reason == "too large"


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.kind)
def test_a_single_flipped_bit_is_noticed(message):
    payload = encode(message)
    for bit in range(8 * len(payload)):
        damaged = bytearray(payload)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(MessageError, match="damaged"):
            decode(bytes(damaged))


def array_around(value):
    """A load message at whose ``p`` stands ``value``."""
    places = places_of(MESSAGES[0])
    places[4] = "here"
    return msgspec.msgpack.encode(places).replace(b"\xa4here", value)


@pytest.mark.parametrize(
    ("packed", "reason"),
    [
        (b"", "not MessagePack"),
        (b"\xc1", "not MessagePack"),
        (b"\xdd\xff\xff\xff\xff", "not MessagePack"),  # an array that says it has four thousand million items
        (b"\x91" * 100_000, "malformed"),
        (b"\x92\x02" + b"\x91" * 100_000, "not MessagePack"),
        (array_around(b"\x91" * 900 + b"\xc0"), "malformed"),  # deeper than Python prints
        (array_around(b"\xd9\xff" + b"\xff" * 255), "malformed"),  # not UTF-8
        (array_around(b"\xdb\x00\x10\x00\x00" + b"x" * 2**20), "malformed"),  # a long text
        (array_around(b"\xd4\x01x"), "malformed"),  # an extension type
        (array_around(b"\xc4\x01x"), "malformed"),  # binary
        (array_around(b"\x82\xa1a\x01\xa1a\x02"), "malformed"),  # a map
        (b"\xdd\x00\x40\x00\x00" + b"\x80" * 2**22, "malformed"),  # four million empty maps
        (array_around(b"\xc3"), "malformed"),
    ],
)
def test_what_could_exhaust_or_confuse_the_reader_is_rejected_shortly(packed, reason):
    with pytest.raises(MessageError) as caught:
        decode(seal(packed))
    assert caught.value.reason == reason
    assert len(str(caught.value)) < 300
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("text", [b"\xd9\xff" + b"\xff" * 255, b"\xdb\x00\x10\x00\x00" + b"x" * 2**20])
def test_a_name_that_is_not_utf_8_or_a_mebibyte_long_is_rejected(text):
    packed = msgspec.msgpack.encode(places_of(MESSAGES[0])).replace(b"\xa5run-1", text)
    with pytest.raises(MessageError) as caught:
        decode(seal(packed))
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("place", [3, 4])
def test_a_count_is_below_two_to_the_53(place):
    places = places_of(MESSAGES[0])
    places[HEADER_PLACE][place] = 2**53 - 1
    decode(seal(msgspec.msgpack.encode(places)))
    places[HEADER_PLACE][place] = 2**53
    with pytest.raises(MessageError, match="malformed"):
        decode(seal(msgspec.msgpack.encode(places)))


TOTALS_PLACE = 2 + [f.name for f in fields(UP)].index("totals")


def totals_read(change):
    """The totals of ``UP`` after a ``change`` of their list."""
    places = places_of(UP)
    change(places[TOTALS_PLACE])
    return decode(seal(msgspec.msgpack.encode(places))).totals


def test_totals_that_say_nothing_are_left_out():
    assert places_of(replace(UP, totals=Totals(objective=2.0, areas=1)))[TOTALS_PLACE] == [
        ["J", 2.0],
        ["n", 1],
    ]
    assert totals_read(lambda parts: parts.pop(0)) == replace(UP.totals, objective=0.0)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda parts: parts.append(["losses", 1.0]), "unknown kind 'losses'"),
        (lambda parts: parts.append(parts[-1]), "out of order or twice"),
        (lambda parts: parts.reverse(), "out of order or twice"),
        (lambda parts: parts[0].__setitem__(1, math.nan), "not finite"),
        (lambda parts: parts[0].__setitem__(1, "12"), "malformed"),
        (lambda parts: parts[0].append(1), "malformed"),
    ],
)
def test_totals_that_a_verdict_could_not_follow_from_are_rejected(change, why):
    with pytest.raises(MessageError, match=why):
        totals_read(change)


def test_totals_of_an_unknown_kind_that_is_optional_are_passed_over():
    assert totals_read(lambda parts: parts.insert(3, ["losses?", 1.0])) == UP.totals


def rejection_of(payload):
    """The reason for which ``payload`` is rejected, None if it is a message; any other exception is a defect."""
    try:
        decode(payload)
    except MessageError as error:
        return error.reason
    return None


@settings(max_examples=100)
@given(st.binary(max_size=300))
def test_any_bytes_decode_or_are_rejected(payload):
    assert rejection_of(payload) != ""
    assert rejection_of(seal(payload)) != ""


@settings(max_examples=100)
@given(st.sampled_from(MESSAGES), st.data())
def test_a_message_with_flipped_bytes_decodes_or_is_rejected(message, data):
    payload = bytearray(encode(message))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(payload[: data.draw(st.integers(0, len(payload)))])
    assert rejection_of(cut) != ""
    assert rejection_of(seal(cut)) != ""  # damaged before it was sealed


def test_a_restarted_area_is_newer_than_its_past_whatever_the_sequence():
    old = Header("r", "a", Incarnation(1000, 5), 1, 99, 0.0)
    new = Header("r", "a", Incarnation(2000, 1), 1, 1, 0.0)
    assert new.order > old.order


@pytest.mark.parametrize("kind", sorted(MESSAGE_TYPES))
def test_the_documentation_gives_every_message_as_it_is_packed(kind):
    page = (Path(__file__).parents[4] / "docs" / "reference" / "messages.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith(f"| `{kind}` | ") and line.count("|") == 3)
    names = [field.name for field in fields(MESSAGE_TYPES[kind])]
    assert row == f"| `{kind}` | {', '.join(names[1:])} |"
    assert names[0] == "header"
