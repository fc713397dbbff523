"""Totals as messages carry them: a list kind, value, kind, value of fields of ``Totals``, in their order.

A kind that is left out is zero, false or empty, which adds nothing to any total. So a later version can add a kind
without a new wire version: its messages leave the kind out where it is empty. A receiver that does not know a kind
rejects the message, because the verdict follows from all totals. The exception is a kind that ends with ``?``: the
verdict may not depend on it, and a receiver that does not know it skips it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_type_hints

import msgspec

from agents.messages.checks import Count, Digest, Integer, MessageError, Name, Names, Number, shown
from dsse_core.estimation.decision import Totals
from dsse_core.grid.gauge import Change
from dsse_core.split_identity import HeldSplits, SplitIdentity, SplitUse

WireSplit = tuple[Digest, Number, Digest]
WireTotals = tuple[msgspec.Raw, ...]
_CHECKED: Mapping[Any, Any] = {
    bool: bool,
    int: Integer,
    float: Number,
    tuple[str, ...]: Names,
    tuple[tuple[str, float], ...]: tuple[tuple[Name, Number], ...],
    tuple[SplitUse, ...]: tuple[tuple[WireSplit, Names], ...],
    HeldSplits: tuple[tuple[WireSplit, Count], ...],
    tuple[Change, ...]: tuple[tuple[Count, Number, Number, Number, Number], ...],
}
SHORT = {
    "objective": "J",
    "degrees_of_freedom": "dof",
    "held_back": "held",
    "areas": "n",
    "referenced": "ref",
    "held": "next",
}
_TYPES = get_type_hints(Totals)
_KINDS = [(SHORT.get(f.name, f.name), f.name, f.default) for f in dataclasses.fields(Totals)]
_READERS = {kind: msgspec.msgpack.Decoder(_CHECKED[_TYPES[name]]) for kind, name, _ in _KINDS}
_PLACES = {kind: (place, name) for place, (kind, name, _) in enumerate(_KINDS)}
_read_kind = msgspec.msgpack.Decoder(Name)


def list_totals(totals: Totals) -> list[Any]:
    """``totals`` as a message carries them."""
    listed = ((kind, name, value) for kind, name, nothing in _KINDS if (value := getattr(totals, name)) != nothing)
    return [place for kind, name, value in listed for place in (kind, _PACK.get(name, _plainly)(value))]


def read_totals(parts: Sequence[msgspec.Raw]) -> Totals:
    """The totals that a message carries.

    Raises:
        MessageError: a kind without a value, not known and not optional, out of order or given twice.
        msgspec.ValidationError: a value of another type than its kind has.
    """
    if len(parts) % 2:
        raise MessageError("malformed", "a kind of totals without its value")
    values: dict[str, Any] = {}
    last = -1
    for packed, value in zip(parts[::2], parts[1::2], strict=True):
        kind = _read_kind.decode(packed)
        if kind not in _PLACES:
            if not kind.endswith("?"):
                raise MessageError("malformed", f"totals of the unknown kind {shown(kind)}")
            continue
        place, name = _PLACES[kind]
        if place <= last:
            raise MessageError("malformed", f"totals of kind {kind} out of order or twice")
        last, values[name] = place, _READERS[kind].decode(value)
    if "splits" in values:
        values["splits"] = tuple(SplitUse(read_split(split), areas) for split, areas in values["splits"])
    if "held" in values:
        values["held"] = tuple((read_split(split), count) for split, count in values["held"])
    return Totals(**values)


def list_uses(uses: Sequence[SplitUse]) -> list[Any]:
    """``uses`` as a message carries them."""
    return [(list_split(use.split), use.areas) for use in uses]


def _list_held(held: HeldSplits) -> list[Any]:
    return [(list_split(split), count) for split, count in held]


def _plainly(value: Any) -> Any:
    return value


_PACK: Mapping[str, Callable[[Any], Any]] = {"splits": list_uses, "held": _list_held}


def list_split(split: SplitIdentity) -> tuple[str, float, str]:
    """``split`` as a message carries it."""
    return split.digest, split.time, split.edited


def read_split(places: tuple[str, float, str]) -> SplitIdentity:
    """The split that a message carries.

    Raises:
        MessageError: its time lies before 1970.
    """
    if places[1] < 0:
        raise MessageError("malformed", "the time of a split lies before 1970")
    return SplitIdentity(*places)
