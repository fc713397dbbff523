"""Totals in a message: what says nothing is left out; what no verdict could follow from is rejected."""

import math
from dataclasses import fields, replace

import msgspec
import pytest
from sample_messages import UP, places_of

from agents.messages.checks import MessageError
from agents.messages.packing import (
    decode,
    seal,
)
from dsse_core.estimation.decision import Totals

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
