"""Packing of messages, and rejection of payloads that are none: an array in MessagePack, then its CRC-32.

``[wire version, kind, header, ...body]``: the fields of ``agents/messages/types.py`` in their order, dataclasses as
arrays of their fields, maps as arrays of pairs. msgpack packs. The type of this array follows from the class. msgspec
checks all of the array while it reads, so a payload never turns into a value that a message may not hold.
"""

from __future__ import annotations

import dataclasses
import re
import typing
import zlib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from operator import attrgetter
from typing import Any

import msgpack
import msgspec
import numpy as np

from agents.messages.boundary_arrays import OfRound, Variables
from agents.messages.checks import BusId, Count, Integer, MessageError, Name, Number, Numbers, PerPhase, shown
from agents.messages.totals_list import WireSplit, WireTotals, list_split, list_totals, read_split, read_totals
from agents.messages.types import (
    NO_INCARNATION,
    BoundaryUpdate,
    ClockMessage,
    CommandMessage,
    DownMessage,
    Header,
    HeartbeatMessage,
    Incarnation,
    LoadMessage,
    ReadingsMessage,
    RoundMessage,
    StateMessage,
    TelemetryMessage,
    UpMessage,
)
from dsse_core.estimation.decision import Totals
from dsse_core.grid.boundary import add_voltages, select_powers
from dsse_core.split_identity import SplitIdentity

__all__ = [
    "NO_INCARNATION",
    "BoundaryUpdate",
    "ClockMessage",
    "CommandMessage",
    "DownMessage",
    "Header",
    "HeartbeatMessage",
    "Incarnation",
    "LoadMessage",
    "ReadingsMessage",
    "RoundMessage",
    "StateMessage",
    "TelemetryMessage",
    "UpMessage",
]

WIRE_VERSION = 3
RECORDED_VERSIONS = (2, WIRE_VERSION)  # versions that logs of recordings may hold
MAX_BYTES = 8 * 1024 * 1024
MAX_NEIGHBOUR_BYTES = 256 * 1024  # of a message from a neighbour; only telemetry and states grow with the area
LONG_ARRAY = 0xDC  # first byte of an array of 16 places or more
KIND = re.compile(r"[a-z0-9_-]{1,32}")  # a part of keys
UNNUMBERED = {
    "header",
    "quality",
    "notes",
    "telemetry_age",
    "ages",
    "scans",
    "old_sides",
    "rejected",
    "clock_skews",
    "oldest_reading",
}

ExchangeMessage = UpMessage | DownMessage | BoundaryUpdate  # of a strategy
LinkMessage = HeartbeatMessage | ExchangeMessage  # states the condition of its link, see HeartbeatMessage
Message = LoadMessage | LinkMessage | TelemetryMessage | ReadingsMessage | CommandMessage | ClockMessage | StateMessage
MESSAGE_TYPES: dict[str, type[Any]] = {
    cls.kind: cls for cls in typing.get_args(Message) if cls is not BoundaryUpdate
}  # and those that strategies add


def content_of(message: StateMessage) -> tuple[Any, ...]:
    """Content that a sequence number stands for: all fields but those that may differ between two states of one number.

    The header is not part of it.
    """
    content: tuple[Any, ...] = _CONTENT[message.kind](message)
    return content


_CONTENT: Mapping[str, Callable[[Any], Any]] = {
    kind: attrgetter(*(field.name for field in dataclasses.fields(cls) if field.name not in UNNUMBERED))
    for kind, cls in MESSAGE_TYPES.items()
}

# Packing


def _pack_incarnation(incarnation: Incarnation) -> tuple[int, int]:
    return incarnation.start_ms, incarnation.random


def _read_incarnation(places: tuple[int, int]) -> Incarnation:
    return Incarnation(*places)


def _pack_header(h: Header) -> tuple[Any, ...]:
    return h.run, h.sender, _pack_incarnation(h.incarnation), h.scan, h.sequence, h.time


def _read_header(places: tuple[Any, ...]) -> Header:
    run, sender, incarnation, scan, sequence, time = places
    return Header(run, sender, _read_incarnation(incarnation), scan, sequence, time)


def _read_map(pairs: tuple[tuple[str, Any], ...]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        raise MessageError("malformed", "a key given twice")
    return content


_PACK: Mapping[Any, Callable[[Any], Any]] = {
    Header: _pack_header,
    Incarnation: _pack_incarnation,
    Totals: list_totals,
    SplitIdentity: list_split,
    dict: lambda m: list(m.items()),
    PerPhase: lambda numbers: numbers[0] if len(numbers) == 1 else numbers,
    OfRound: lambda numbers: [number or 0 for number in numbers],
    Variables: select_powers,
}
_READ: Mapping[Any, Callable[[Any], Any]] = {
    Header: _read_header,
    Incarnation: _read_incarnation,
    Totals: read_totals,
    SplitIdentity: read_split,
    dict: _read_map,
    PerPhase: lambda found: found if isinstance(found, tuple) else (found,),
    OfRound: lambda found: found,
    Variables: add_voltages,
}


def _form_of(hint: Any) -> Any:
    """Key of ``_PACK`` for a type that needs more than msgspec; None for all other types."""
    form = hint if hint in _PACK else typing.get_origin(hint) or hint
    return form if form in _PACK else None


def _array_type(hint: Any) -> Any:
    """The type of the plain value that a message carries for a value of type ``hint``."""
    if hint is Totals:
        return WireTotals
    if hint is SplitIdentity:
        return WireSplit
    if hint == PerPhase:
        return Number | Numbers
    if dataclasses.is_dataclass(hint):
        return tuple[tuple(_array_type(place) for place in _hints_of(hint).values())]  # type: ignore[misc]
    if typing.get_origin(hint) is dict:
        return tuple[tuple[typing.get_args(hint)], ...]  # type: ignore[misc]
    return hint


def _hints_of(cls: Any) -> dict[str, Any]:
    """Field -> its type, in the order of a message."""
    hints = typing.get_type_hints(cls, include_extras=True)
    fields = sorted(dataclasses.fields(cls), key=lambda field: "is_last" in field.metadata)
    return {field.name: hints[field.name] for field in fields}


class _Packing:
    """Packing and reading of the messages of one class."""

    def __init__(self, cls: type[Any]) -> None:
        hints = _hints_of(cls)
        self.cls = cls
        self.names = tuple(hints)
        self.values = attrgetter(*self.names)
        self.forms = [(k, form) for k, hint in enumerate(hints.values()) if (form := _form_of(hint))]
        places = (int, str, *map(_array_type, hints.values()))
        self.decoder = msgspec.msgpack.Decoder(tuple[places])  # type: ignore[valid-type]
        self.has_misfits = hasattr(cls, "find_misfit")

    def complete(self, packed: bytes) -> bytes:
        """A message of an earlier version, which may lack the last fields, as one of this version."""
        places = _raw_places.decode(packed)
        forms = {self.names[k]: form for k, form in self.forms}
        known = {field.name: field for field in fields(self.cls)}
        for name in self.names[max(0, len(places) - 2) :]:
            default, factory = known[name].default, known[name].default_factory
            if default is MISSING and factory is MISSING:
                break  # the message lacks more than the added fields
            value = default if factory is MISSING else factory()
            places.append(msgspec.Raw(msgspec.msgpack.encode(_PACK[forms[name]](value) if name in forms else value)))
        return msgspec.msgpack.encode([WIRE_VERSION, *places[1:]])


_raw_places = msgspec.msgpack.Decoder(list[msgspec.Raw])
_PACKINGS = {kind: _Packing(cls) for kind, cls in MESSAGE_TYPES.items()}


def _plain(number: object) -> Any:
    """A number of numpy's as one of Python's."""
    if isinstance(number, np.generic):
        return number.item()
    raise TypeError(f"{type(number).__name__} has no place in a message")


def encode(message: Message) -> bytes:
    """The payload of ``message``."""
    packing = _PACKINGS[message.kind]
    places = [WIRE_VERSION, message.kind, *packing.values(message)]
    for k, form in packing.forms:
        places[2 + k] = _PACK[form](places[2 + k])
    return seal(msgpack.packb(places, default=_plain))


def seal(packed: bytes) -> bytes:
    """``packed`` with its checksum; without it damaged numbers could not be distinguished from sound ones."""
    return packed + zlib.crc32(packed).to_bytes(4, "big")


# Reading


class _Beginning(msgspec.Struct, array_like=True):
    """Beginning of every message of any version; the places after it are skipped."""

    version: int
    kind: msgspec.Raw


_beginning = msgspec.msgpack.Decoder(_Beginning)
_BY_KIND = {msgpack.packb(kind): packing for kind, packing in _PACKINGS.items()}


def add_message_type(cls: type[BoundaryUpdate]) -> None:
    """Have messages of ``cls``, a strategy's, encoded and decoded like all others; a known class changes nothing.

    Raises:
        ValueError: its kind has no place in a key or is that of another class, or a field has a type that is not
            checked in full.
    """
    kind = getattr(cls, "kind", None)
    if not (isinstance(kind, str) and KIND.fullmatch(kind)):
        raise ValueError(f"message {cls.__name__}: kind is {kind!r}; it must be of a-z, 0-9, _ and -, 32 at most")
    if (known := MESSAGE_TYPES.get(kind, cls)) is not cls:
        other = f"{known.__module__}.{known.__qualname__}"
        raise ValueError(f"message {cls.__name__}: kind {kind!r} is that of {other}; choose another")
    if kind in _PACKINGS:
        return
    if not dataclasses.is_dataclass(cls):
        raise ValueError(f"message {cls.__name__} is no dataclass")
    for name, hint in _hints_of(cls).items():
        if name != "header" and not _is_bounded(hint):
            found = getattr(hint, "__name__", str(hint))
            raise ValueError(
                f"message {cls.__name__}: field {name} has the type {found}; it must be of the bounded types "
                "BusId, Count, Integer, Number, Name, Variables and bool, or tuples of them (agents/messages)"
            )
    MESSAGE_TYPES[kind] = cls
    _PACKINGS[kind] = _BY_KIND[msgpack.packb(kind)] = _Packing(cls)


def _is_bounded(hint: Any) -> bool:
    """True where a field of this type is checked in full: a plain ``float`` may be nan, a plain ``str`` too long."""
    if typing.get_origin(hint) is tuple:
        return all(place is Ellipsis or _is_bounded(place) for place in typing.get_args(hint))
    return hint in (BusId, Count, Integer, Number, Name, Variables, bool)


def decode(payload: bytes, largest: int = MAX_BYTES) -> Message:
    """The message in ``payload``, which may have ``largest`` bytes.

    Raises:
        MessageError: anything that is not a well-formed message of this wire version.
    """
    return _decode(payload, largest, (WIRE_VERSION,))


def decode_recorded(payload: bytes) -> Message:
    """The message in ``payload`` from the log of a recording, which an earlier version or program may have written.

    Fields that it lacks stand last in the message, and take their defaults.

    Raises:
        MessageError: anything that is not a well-formed message of one of ``RECORDED_VERSIONS``.
    """
    return _decode(payload, MAX_BYTES, RECORDED_VERSIONS)


def _decode(payload: bytes, largest: int, versions: tuple[int, ...]) -> Message:
    if len(payload) > largest:
        raise MessageError("too large", f"{len(payload)} bytes, the limit is {largest}")
    packed, checksum = payload[:-4], payload[-4:]
    if zlib.crc32(packed).to_bytes(4, "big") != checksum:
        raise MessageError("damaged", "the checksum does not fit")
    packing = None
    try:
        beginning = _beginning.decode(packed)
        if beginning.version not in versions:
            raise MessageError("wire version", describe_other_version(beginning.version))
        packing = _BY_KIND.get(bytes(beginning.kind))
        if packing is None:
            raise MessageError("malformed", f"unknown kind {shown(bytes(beginning.kind)[:80])}")
        if beginning.version != WIRE_VERSION or (len(versions) > 1 and _count_places(packed) < len(packing.names) + 2):
            packed = packing.complete(packed)
        return _build(packing, packing.decoder.decode(packed))
    except msgspec.ValidationError as error:
        raise _rejection_of(error, packing) from None
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise MessageError("not MessagePack", shown(str(error))) from None


def _count_places(packed: bytes) -> int:
    """The places of an array in MessagePack, by its first bytes; a short array has their number in its first one."""
    return int.from_bytes(packed[1:3], "big") if packed[0] == LONG_ARRAY else packed[0] & 0x0F


def describe_other_version(version: int, who: str = "it speaks") -> str:
    """Sentence about a sender of another wire version, with the side to upgrade; ``who``: the sender and the verb."""
    older = "the other side" if version < WIRE_VERSION else "this program"
    return f"{who} wire version {version:.6g}, this is version {WIRE_VERSION}: upgrade {older}"


def _build(packing: _Packing, places: tuple[Any, ...]) -> Message:
    values = list(places[2:])
    for k, form in packing.forms:
        try:
            values[k] = _READ[form](values[k])
        except MessageError as error:
            raise MessageError(error.reason, f"{packing.names[k]}: {error.at_field}") from None
    message: Any = packing.cls(**dict(zip(packing.names, values, strict=True)))
    if packing.has_misfits and (misfit := message.find_misfit()):
        raise MessageError("malformed", misfit)
    found: Message = message
    return found


_INFINITE = re.compile(r"Expected `float` [<>]=")  # finiteness is the only bound that a number has
_PLACE = re.compile(r"^(.*) - at `\$\[([0-9]+)\](.*)`$", re.DOTALL)


def _rejection_of(error: msgspec.ValidationError, packing: _Packing | None) -> MessageError:
    """``error`` with the name of the field in which it is."""
    text = str(error)
    if packing is not None and (found := _PLACE.match(text)) and int(found[2]) >= 2:
        text = f"{packing.names[int(found[2]) - 2]}{found[3]}: {found[1]}"
    return MessageError("not finite" if _INFINITE.search(text) else "malformed", ascii(text)[1:-1][:200])
