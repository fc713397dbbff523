"""Totals in a message: what says nothing is left out; what no verdict could follow from is rejected."""

import math
from dataclasses import fields, replace

import msgspec
import pytest

from agents.messages.checks import MessageError
from agents.messages.packing import decode, encode, seal
from agents.messages.totals_list import list_split
from dsse_core.estimation.decision import Totals
from dsse_core.split_identity import SplitIdentity, SplitUse
from tests.support.sample_messages import UP, places_of

TOTALS_PLACE = 2 + [f.name for f in fields(UP)].index("totals")


def totals_read(change):
    """The totals of ``UP`` after a ``change`` of their list."""
    places = places_of(UP)
    change(places[TOTALS_PLACE])
    return decode(seal(msgspec.msgpack.encode(places))).totals


def test_totals_that_say_nothing_are_left_out():
    assert places_of(replace(UP, totals=Totals(objective=2.0, areas=1)))[TOTALS_PLACE] == [
        *("J", 2.0),
        *("n", 1),
    ]
    assert totals_read(lambda parts: parts.__delitem__(slice(2))) == replace(UP.totals, objective=0.0)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda parts: parts.extend(["losses", 1.0]), "unknown kind 'losses'"),
        (lambda parts: parts.extend(parts[-2:]), "out of order or twice"),
        (lambda parts: parts.extend(parts[:2]), "out of order or twice"),
        (lambda parts: parts.__setitem__(1, math.nan), "not finite"),
        (lambda parts: parts.__setitem__(1, "12"), "malformed"),
        (lambda parts: parts.__setitem__(0, 1), "malformed"),
        (lambda parts: parts.append("next"), "a kind of totals without its value"),
    ],
)
def test_totals_that_a_verdict_could_not_follow_from_are_rejected(change, why):
    with pytest.raises(MessageError, match=why):
        totals_read(change)


def test_splits_in_use_and_splits_that_lie_ready_are_read_as_they_were_written():
    one, other = SplitIdentity("1a2b3c4d5e6f7081", 1.7e9), SplitIdentity("9f8e7d6c5b4a3928", 1.8e9, "55aa66bb77cc88dd")
    totals = Totals(areas=3, splits=(SplitUse(one), SplitUse(other, ("area2",))), held=((one, 1), (other, 2)))
    read = decode(encode(replace(UP, totals=totals))).totals
    assert read == totals
    assert [split.time for split, _ in read.held] == [1.7e9, 1.8e9]
    assert totals_read(lambda parts: parts.extend(["next", [[list_split(one), 2]]])).held == ((one, 2),)


@pytest.mark.parametrize("count", [-1, 1.5, "2"])
def test_splits_that_lie_ready_in_no_number_of_areas_are_rejected(count):
    with pytest.raises(MessageError, match="malformed"):
        totals_read(lambda parts: parts.extend(["next", [[["1a2b3c4d5e6f7081", 0.0, ""], count]]]))


def test_totals_of_an_unknown_kind_that_is_optional_are_passed_over():
    assert totals_read(lambda parts: parts.__setitem__(slice(6, 6), ["losses?", 1.0])) == UP.totals
