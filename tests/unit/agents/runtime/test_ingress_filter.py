"""The ingress filter lets in what belongs here, counts the rest, and does not grow."""

import logging
from dataclasses import replace
from types import SimpleNamespace

import pytest

from agents.messages.packing import MAX_NEIGHBOUR_BYTES, Header, Incarnation, LoadMessage, TelemetryMessage, encode
from agents.peers.rejections import find_rejection
from agents.protocol.configuration import Configuration
from agents.protocol.events import Received, Rejected
from agents.runtime.inbox import Inbox
from agents.runtime.ingress_filter import MOST_GATEWAYS, IngressFilter
from dsse_core.limits import LARGEST_BUS

KEY, TELEMETRY = "dsse/v3/r/area/area2/load/area1", "dsse/v3/r/telemetry/area1/plant"
LOAD = LoadMessage(Header("r", "area2", Incarnation(1, 1), 1, 1, 0.0), 6, (0.1,), (0.0,), (0.01,))


@pytest.fixture
def door():
    inbox = Inbox()
    return IngressFilter({KEY}, "r", "area1", ["plant"], inbox), inbox


def test_a_message_on_a_known_key_is_let_in_with_the_owner_of_the_key(door):
    ingress_filter, inbox = door
    ingress_filter.take(KEY, encode(LOAD))
    assert inbox.take(0.0) == [Received(LOAD, "area2")]


def test_repeats_are_let_in_and_what_is_new_or_damaged_is_not_taken_for_one(door):
    ingress_filter, inbox = door
    newer = replace(LOAD, header=replace(LOAD.header, sequence=2))
    for message in (LOAD, LOAD, newer, LOAD, LOAD):
        ingress_filter.take(KEY, encode(message))
        assert inbox.take(0.0) == [Received(message, "area2")]
    ingress_filter.take(KEY, encode(LOAD)[:-1] + b"?")
    assert inbox.take(0.0) == [Rejected("damaged", 1)]
    ingress_filter.take(KEY, encode(LOAD))
    assert inbox.take(0.0) == [Received(LOAD, "area2")]


def test_the_rejection_of_a_malformed_payload_names_its_sender_and_its_field(door):
    ingress_filter, inbox = door
    ingress_filter.take(KEY, encode(replace(LOAD, bus=LARGEST_BUS + 1)))
    (rejected,) = inbox.take(0.0)
    assert (rejected.reason, rejected.sender) == ("malformed", "area2")
    assert rejected.at_field.startswith("bus: ")


def test_telemetry_with_two_readings_of_a_meter_is_rejected(door):
    ingress_filter, inbox = door
    pair = (1.0, 1.0)
    doubled = TelemetryMessage(replace(LOAD.header, sender="plant"), "area1", ("vm@1",) * 2, *[pair] * 3, (True, True))
    ingress_filter.take(TELEMETRY, encode(doubled))
    assert inbox.take(0.0) == [Rejected("meter given twice", 1)]


@pytest.mark.parametrize(("named", "is_shared"), [(("vm@1", "vm@2"), True), (("vm@2", "vm@1"), False), ((), False)])
def test_telemetry_of_all_meters_does_not_bring_a_second_text_of_each(named: tuple[str, ...], is_shared: bool):
    inbox, meters = Inbox(), ("vm@1", "vm@2")
    ingress_filter = IngressFilter({KEY}, "r", "area1", ["plant"], inbox, meters)
    numbers, header = (1.0,) * len(named), replace(LOAD.header, sender="plant")
    telemetry = TelemetryMessage(header, "area1", named, numbers, numbers, numbers, (True,) * len(named))
    ingress_filter.take(TELEMETRY, encode(telemetry))
    (received,) = inbox.take(0.0)
    assert received == Received(telemetry, "")
    assert (received.message.meters is meters) == is_shared


class Unread(tuple):
    """Names that nobody may look through."""

    def __iter__(self):
        raise AssertionError("the meters of a repeated message are looked through")


def test_the_meters_of_telemetry_are_not_compared_with_one_another_at_each_repeat():
    content = Configuration("r", SimpleNamespace(name="area1"), (), "information", ())
    header = replace(LOAD.header, sender="plant")
    message = TelemetryMessage(header, "area1", Unread(["vm@1"]), (1.0,), (0.1,), (0.0,), (True,))
    assert find_rejection(message, "", content, 0.0) == ""


def test_strangers_take_one_slot_however_many_keys_they_have(door, caplog):
    ingress_filter, inbox = door
    with caplog.at_level(logging.WARNING):
        for k in range(12_345):
            ingress_filter.take(f"dsse/v3/r/area/stranger{k}/load/area1", encode(LOAD))
    assert inbox.take(0.0) == [Rejected("unknown sender", 12_345)]
    assert len(caplog.records) == 5  # number 1, 10, 100, 1000, 10000


def test_a_known_neighbour_cannot_invent_kinds_either(door):
    ingress_filter, inbox = door
    ingress_filter.take("dsse/v3/r/area/area2/gossip/area1", encode(LOAD))
    assert inbox.take(0.0) == [Rejected("unknown sender", 1)]


def test_neighbours_have_less_room_than_telemetry(door):
    ingress_filter, inbox = door
    payload = bytes(MAX_NEIGHBOUR_BYTES + 1)
    ingress_filter.take(KEY, payload)
    ingress_filter.take(TELEMETRY, payload)
    assert inbox.take(0.0) == [Rejected("too large", 1), Rejected("damaged", 1)]


def test_rejections_do_not_push_out_what_has_been_let_in(door):
    ingress_filter, inbox = door
    ingress_filter.take(KEY, encode(LOAD))
    for _ in range(100):
        ingress_filter.take(KEY, encode(LOAD)[:-1])
    assert inbox.take(0.0) == [Received(LOAD, "area2"), Rejected("damaged", 100)]


def telemetry_of(gateway: str) -> TelemetryMessage:
    return TelemetryMessage(Header("r", gateway, Incarnation(1, 1), 1, 1, 0.0), "area1", (), (), (), (), ())


def test_a_gateway_publishes_on_its_own_key_only(door):
    ingress_filter, inbox = door
    ingress_filter.take(TELEMETRY, encode(telemetry_of("feeder")))
    ingress_filter.take("dsse/v3/r/telemetry/area1/feeder", encode(telemetry_of("feeder")))
    ingress_filter.take("dsse/v3/r/telemetry/area2/plant", encode(telemetry_of("plant")))
    assert inbox.take(0.0) == [Rejected("sender does not own the key", 1), Rejected("unknown sender", 2)]
    ingress_filter.take(TELEMETRY, encode(telemetry_of("plant")))
    assert inbox.take(0.0) == [Received(telemetry_of("plant"), "")]


def test_where_any_gateway_may_speak_strangers_take_a_bounded_number_of_slots():
    inbox = Inbox()
    ingress_filter = IngressFilter({KEY}, "r", "area1", ["*"], inbox)
    for k in range(3 * MOST_GATEWAYS):
        ingress_filter.take(f"dsse/v3/r/telemetry/area1/g{k}", encode(telemetry_of(f"g{k}")))
    *received, rejected = inbox.take(0.0)
    assert [r.message.header.sender for r in received] == [f"g{k}" for k in range(MOST_GATEWAYS)]
    assert rejected == Rejected("unknown sender", 2 * MOST_GATEWAYS)
