"""Every message survives the wire unchanged, and nothing malformed gets through."""

import json
import math
from dataclasses import fields, replace
from pathlib import Path

import msgspec
import pytest

from agents.messages.checks import LONGEST_NAME, LONGEST_NOTE, MOST_NOTES, MessageError, limit_notes
from agents.messages.packing import (
    MESSAGE_TYPES,
    WIRE_VERSION,
    Header,
    Incarnation,
    decode,
    decode_recorded,
    encode,
    seal,
)
from agents.strategies.angle_offset import BoundaryMessage
from tests.support.sample_messages import HEADER, HEADER_PLACE, MESSAGES, REFERENCED, STATE, UP, VM, places_of


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.kind)
def test_a_message_survives_the_wire_unchanged(message):
    assert decode(encode(message)) == message


def test_a_boundary_message_fits_in_200_bytes_even_with_long_names():
    header = Header("r" * 32, "a" * 32, HEADER.incarnation, 2**31, 2**31, 1.8e9)
    assert len(encode(BoundaryMessage(header, 2**31, 0.95, -0.02, True))) <= 200


def changed(*path, to):
    """A change of the place of a message that ``path`` leads to."""

    def change(places):
        for step in path[:-1]:
            places = places[step]
        places[path[-1]] = to

    return change


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


RECORDED = {
    version: json.loads((Path(__file__).parent / f"wire_version_{version}.json").read_text()) for version in (1, 2)
}


@pytest.mark.parametrize(("version", "kind"), [(v, kind) for v, kinds in RECORDED.items() for kind in sorted(kinds)])
def test_recorded_bytes_of_an_earlier_wire_version_are_rejected_by_name(version, kind):
    with pytest.raises(
        MessageError, match=f"speaks wire version {version}, this is version 3: upgrade the other side"
    ) as caught:
        decode(bytes.fromhex(RECORDED[version][kind]))
    assert caught.value.reason == "wire version"


@pytest.mark.parametrize("kind", ["state", "readings", "command"])
def test_a_log_of_wire_version_2_is_read_and_what_it_lacks_has_its_default(kind):
    (expected,) = (message for message in MESSAGES if message.kind == kind)
    assert decode_recorded(bytes.fromhex(RECORDED[2][kind])) == expected
    assert decode_recorded(encode(expected)) == expected


@pytest.mark.parametrize("lacking", [1, 2])
def test_a_log_of_this_wire_version_from_before_the_last_fields_is_read(lacking):
    short = seal(msgspec.msgpack.encode(places_of(STATE)[:-lacking]))
    assert decode_recorded(short) == STATE
    with pytest.raises(MessageError, match="malformed"):
        decode(short)


def test_a_recorded_message_that_lacks_more_than_defaults_is_rejected():
    places = msgspec.msgpack.decode(bytes.fromhex(RECORDED[2]["state"])[:-4])
    for short in (places[:2], places[:10], ["2", "state"], [2, "state"]):
        with pytest.raises(MessageError, match="malformed"):
            decode_recorded(seal(msgspec.msgpack.encode(short)))


def test_a_later_wire_version_asks_for_an_upgrade_of_this_program():
    with pytest.raises(MessageError, match="speaks wire version 4, this is version 3: upgrade this program"):
        decode(seal(msgspec.msgpack.encode([4, {"kind": "load"}])))


def test_the_field_that_is_wrong_is_named():
    places = places_of(UP)
    places[2 + [f.name for f in fields(UP)].index("z")][3] = "0.4"
    with pytest.raises(MessageError, match=r"z\[3\]: Expected `float`, got `str`"):
        decode(seal(msgspec.msgpack.encode(places)))


def test_arrays_of_a_state_must_have_one_length():
    with pytest.raises(MessageError, match="differ in length"):
        decode(encode(replace(STATE, vm=(1.0,))))


@pytest.mark.parametrize(
    ("phases", "misfit"), [(("a",), "differ in length"), (("a", "a"), "given twice"), (("a", "b"), "")]
)
def test_a_state_of_a_bus_with_phases_has_each_of_them_once(phases, misfit):
    state = replace(STATE, buses=(1, 1), phases=phases)
    if misfit:
        with pytest.raises(MessageError, match=misfit):
            decode(encode(state))
    else:
        assert decode(encode(state)) == state
        assert (state.nodes, state.row_of(1, "b"), state.phases_at(2)) == (((1, "a"), (1, "b")), 1, ())


def test_a_key_given_twice_is_rejected():
    places = places_of(STATE)
    places[2 + [f.name for f in fields(STATE)].index("rejected")] = [["malformed", 1], ["malformed", 2]]
    with pytest.raises(MessageError, match="given twice"):
        decode(seal(msgspec.msgpack.encode(places)))


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


def test_a_restarted_area_is_newer_than_its_past_whatever_the_sequence():
    old = Header("r", "a", Incarnation(1000, 5), 1, 99, 0.0)
    new = Header("r", "a", Incarnation(2000, 1), 1, 1, 0.0)
    assert new.order > old.order


@pytest.mark.parametrize("kind", sorted({message.kind for message in MESSAGES}))
def test_the_documentation_gives_every_message_as_it_is_packed(kind):
    page = (Path(__file__).parents[4] / "docs" / "reference" / "messages.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith(f"| `{kind}` | ") and line.count("|") == 3)
    names = [field.name for field in sorted(fields(MESSAGE_TYPES[kind]), key=lambda f: "is_last" in f.metadata)]
    assert row == f"| `{kind}` | {', '.join(names[1:])} |"
    assert names[0] == "header"
