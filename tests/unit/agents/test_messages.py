"""Every message survives the wire unchanged, and nothing malformed gets through."""

import math
from dataclasses import replace

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.messages import (
    WIRE_VERSION,
    AdmmMessage,
    BoundaryMessage,
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
from agents.wire_checks import LONGEST_NAME, LONGEST_NOTE, MOST_NOTES, MessageError, limit_notes
from dsse_core.verdict import Totals

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
    heard={"area2": (1, 3)},
    messages=12,
    bytes=800,
    lost=2,
    refused={"malformed": 1},
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
    hears=True,
    answers=1.7e9,
    received=2,
    R=tuple(map(float, range(10))),
    z=(0.1, 0.2, 0.3, 0.4),
    no_load=(),
    power=(0.1, 0.2),
    totals=Totals(12.5, -2, 1e-3, 2e-3, 3, (("vm@1", 4.5),), 2, True, ("area4",), (), ("7", "9-12"), ()),
)
MESSAGES = [
    LoadMessage(HEADER, 6, 0.25, -0.1, 0.01),
    BoundaryMessage(HEADER, 6, 0.95, -0.02, True),
    AdmmMessage(HEADER, 6, 3, (0.1, 0.0, 1.0, -0.1), (0.2, 0.0, 1.0, -0.1), (1e4, 1e4, 1e5, 1e5), True, True),
    HeartbeatMessage(HEADER, 6, 1, 3, True, 1.7e9, -1, True, False, (0.1, 0.2, 1.0, -0.1)),
    UP,
    DownMessage(**{**vars(UP), "power": ()}, verdict="judge", decider="area1", life=(1, 2)),
    TelemetryMessage(HEADER, "area1", ("vm@1",), (1.0,), (0.002,)),
    STATE,
]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.kind)
def test_a_message_survives_the_wire_unchanged(message):
    assert decode(encode(message)) == message


def test_a_boundary_message_fits_in_200_bytes_even_with_long_names():
    header = Header("r" * 32, "a" * 32, HEADER.incarnation, 2**31, 2**31, 1.8e9)
    assert len(encode(BoundaryMessage(header, 2**31, 0.95, -0.02, True))) <= 200


def fields_of(message):
    return list(msgpack.unpackb(encode(message)[:-4]))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda f: f.__setitem__(0, WIRE_VERSION + 1), "wire version"),
        (lambda f: f.__setitem__(1, "gossip"), "malformed"),
        (lambda f: f.__setitem__(1, ["load"]), "malformed"),
        (lambda f: f.__setitem__(2, 5), "malformed"),
        (lambda f: f.__setitem__(4, [1]), "malformed"),
        (lambda f: f.__setitem__(5, -1), "malformed"),
        (lambda f: f.__setitem__(6, True), "malformed"),
        (lambda f: f.__setitem__(7, math.inf), "not finite"),
        (lambda f: f.__setitem__(9, math.nan), "not finite"),
        (lambda f: f.__setitem__(9, "0.95"), "malformed"),
        (lambda f: f.__setitem__(9, 2**64 - 1), None),
        (lambda f: f.__setitem__(11, 1), "malformed"),
        (lambda f: f.append(0), "malformed"),
        (lambda f: f.pop(), "malformed"),
    ],
)
def test_a_changed_field_is_refused_with_its_reason(change, reason):
    fields = fields_of(BoundaryMessage(HEADER, 6, 0.95, -0.02, True))
    change(fields)
    if reason is None:
        assert decode(seal(msgpack.packb(fields))).vm == float(2**64 - 1)
        return
    with pytest.raises(MessageError) as caught:
        decode(seal(msgpack.packb(fields)))
    assert caught.value.reason == reason


def test_arrays_of_a_state_must_have_one_length():
    fields = fields_of(STATE)
    fields[9] = [1.0]
    with pytest.raises(MessageError, match="differ in length"):
        decode(seal(msgpack.packb(fields)))


def test_an_admm_message_has_four_numbers_of_each():
    fields = fields_of(next(m for m in MESSAGES if isinstance(m, AdmmMessage)))
    fields[11] = fields[11][:3]
    with pytest.raises(MessageError, match="do not have 4 numbers each"):
        decode(seal(msgpack.packb(fields)))


@pytest.mark.parametrize("place", ["removed", "old_sides", "quality", "refused", "sent", "run", "sender"])
def test_a_name_longer_than_any_name_is_refused(place):
    longest = "a" * LONGEST_NAME
    for name, passes in ((longest, True), (longest + "a", False)):
        values = {"refused": {name: 1}, "sent": {name: (1, 1)}, "quality": name}
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


def test_an_area_with_much_to_note_is_not_refused_for_it():
    notes = [f"neighbour area{k} is gone" for k in range(200)] + ["no estimate: bus " + ", ".join(map(str, range(999)))]
    kept = limit_notes(notes[-1:] + notes)
    assert decode(encode(replace(STATE, notes=kept))).notes == kept
    assert (len(kept), len(kept[0]), kept[0][-3:], kept[-1]) == (MOST_NOTES, LONGEST_NOTE, "...", "and 153 more")


def test_an_oversized_payload_is_refused_unread():
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
    """An array with a header whose kind is ``value``."""
    return b"\x98\x01" + value + b"\x00" * 6


@pytest.mark.parametrize(
    ("packed", "reason"),
    [
        (b"", "not MessagePack"),
        (b"\xc1", "not MessagePack"),
        (b"\xdd\xff\xff\xff\xff", "not MessagePack"),  # an array that says it has four thousand million items
        (b"\x91" * 100_000, "not MessagePack"),
        (array_around(b"\x91" * 900 + b"\xc0"), "malformed"),  # deeper than Python prints
        (array_around(b"\xd9\xff" + b"\xff" * 255), "not MessagePack"),  # not UTF-8
        (array_around(b"\xdb\x00\x10\x00\x00" + b"x" * 2**20), "not MessagePack"),  # a long text
        (array_around(b"\xd4\x01x"), "not MessagePack"),  # an extension type
        (array_around(b"\xc4\x01x"), "not MessagePack"),  # binary
        (array_around(b"\x82\xa1a\x01\xa1a\x02"), "malformed"),  # a key given twice
        (array_around(b"\x81\x01\x01"), "not MessagePack"),  # a key that is no text
        (b"\xdd\x00\x40\x00\x00" + b"\x80" * 2**22, "malformed"),  # four million empty maps
        (array_around(b"\xcf" + b"\xff" * 8), "malformed"),
    ],
)
def test_what_could_exhaust_or_confuse_the_reader_is_refused_shortly(packed, reason):
    with pytest.raises(MessageError) as caught:
        decode(seal(packed))
    assert caught.value.reason == reason
    assert len(str(caught.value)) < 300
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("place", [5, 6])
def test_a_count_is_below_two_to_the_53(place):
    fields = fields_of(MESSAGES[0])
    fields[place] = 2**53 - 1
    decode(seal(msgpack.packb(fields)))
    fields[place] = 2**53
    with pytest.raises(MessageError, match="not a count"):
        decode(seal(msgpack.packb(fields)))


def refusal_of(payload):
    """The reason for which ``payload`` is refused, None if it is a message; any other exception is a defect."""
    try:
        decode(payload)
    except MessageError as error:
        return error.reason
    return None


@settings(max_examples=100)
@given(st.binary(max_size=300))
def test_any_bytes_decode_or_are_refused(payload):
    assert refusal_of(payload) != ""
    assert refusal_of(seal(payload)) != ""


@settings(max_examples=100)
@given(st.sampled_from(MESSAGES), st.data())
def test_a_message_with_flipped_bytes_decodes_or_is_refused(message, data):
    payload = bytearray(encode(message))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(payload[: data.draw(st.integers(0, len(payload)))])
    assert refusal_of(cut) != ""
    assert refusal_of(seal(cut)) != ""  # damaged before it was sealed


def test_a_restarted_area_is_newer_than_its_past_whatever_the_sequence():
    old = Header("r", "a", Incarnation(1000, 5), 1, 99, 0.0)
    new = Header("r", "a", Incarnation(2000, 1), 1, 1, 0.0)
    assert new.order > old.order
