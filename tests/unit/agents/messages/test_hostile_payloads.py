"""Payloads that would exhaust or confuse the reader, and any others, are messages or rejected."""

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.messages.checks import MessageError
from agents.messages.packing import (
    decode,
    encode,
    seal,
)
from tests.support.sample_messages import HEADER_PLACE, MESSAGES, places_of


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
