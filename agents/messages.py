"""What crosses the bus: message types and their MessagePack encoding.

Every message is a fixed-order array ``[wire version, kind, run, sender, [start time, random], scan,
sequence, time, ...body]``: absolute, idempotent, and strictly checked when decoded.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, ClassVar

import msgpack

from agents.wire_checks import (
    CHECKS,
    LONGEST_NOTE,
    MessageError,
    check_count,
    check_integer,
    check_name,
    check_number,
    shown,
    tuple_of,
)
from dsse_core.boundary_load import NetLoad
from dsse_core.verdict import Totals

WIRE_VERSION = 1
MAX_BYTES = 8 * 1024 * 1024
MAX_NEIGHBOUR_BYTES = 256 * 1024  # of what neighbours say; only telemetry and states grow with the area
MOST_MAPS = 16  # in one message; a state has three
Integer = int  # may be negative; an int in a message is a count
Notes = tuple[str, ...]  # sentences; other texts in a message are names
UNNUMBERED = {"header", "fresh", "quality", "telemetry_age", "ages", "scans", "old_sides", "refused"}  # see content_of


@dataclass(frozen=True, slots=True, order=True)
class Incarnation:
    """One life of a process: a restarted one is newer than its past."""

    start_ms: int
    random: int

    def __str__(self) -> str:
        """As in the key of its presence token."""
        return f"{self.start_ms:x}-{self.random:08x}"


@dataclass(frozen=True, slots=True)
class Header:
    """Who says it, in which life, about which scan. ``sequence`` grows with every changed content."""

    run: str
    sender: str
    incarnation: Incarnation
    scan: int
    sequence: int
    time: float  # s since 1970; refused from the future, and of two messages of one order the later one counts

    @property
    def order(self) -> tuple[Incarnation, int]:
        """What makes one message of a sender newer than another."""
        return (self.incarnation, self.sequence)


@dataclass(frozen=True, slots=True)
class LoadMessage:
    """The net load, p.u., of everything on the sender's side of a boundary bus (thesis eqs. 5.1, 5.2).

    ``sigma``: standard deviation of ``p`` and ``q`` that comes from the meters among what is summed.
    """

    kind: ClassVar[str] = "load"
    header: Header
    bus: int
    p: float
    q: float
    sigma: float

    @property
    def load(self) -> NetLoad:
        return NetLoad(complex(self.p, self.q), self.sigma * self.sigma)


@dataclass(frozen=True, slots=True)
class BoundaryMessage:
    """The sender's corrected state at a boundary bus, p.u. and rad.

    ``referenced``: its angle counts from the substation. ``fresh``, in every boundary message: all that the sender's
    side rests on is of its scan and was heard lately (agents/freshness.py). Alone of the body it holds since
    ``header.time``, and may differ between two messages of one sequence number.
    """

    kind: ClassVar[str] = "boundary"
    header: Header
    bus: int
    vm: float
    va: float
    referenced: bool
    fresh: bool = False


@dataclass(frozen=True, slots=True)
class AdmmMessage:
    """What the sender tells in its ``iteration`` at a boundary: ``r = 2 y - z`` of ``y = (p, q, vm, va)``.

    ``r_before``: that of the iteration before, should its message have been lost. ``weight``: the sender's own
    information about each of y, which the penalty is a multiple of. ``referenced``: the sender's side knows the
    substation's angle.
    """

    kind: ClassVar[str] = "admm"
    header: Header
    bus: int
    iteration: int
    r: tuple[float, ...]
    r_before: tuple[float, ...]
    weight: tuple[float, ...]
    unsettled: bool
    referenced: bool
    fresh: bool = False


@dataclass(frozen=True, slots=True)
class HeartbeatMessage:
    """Where the sender stands: in (scan, ``revision``) it has come to round ``k``, and whether that is ``final``.

    ``hears``: it hears the receiver. ``answers``: send time of the receiver's newest message plus the time it has lain
    here, from which the receiver finds the round trip; 0 without one. ``received``: round of the receiver's newest
    message of this term, -1 without one. ``complete``: at rest, its side is heard and fresh. ``y``: at rest, (p, q,
    vm, va) at the boundary in its final state.
    """

    kind: ClassVar[str] = "heartbeat"
    header: Header
    bus: int
    revision: int
    k: int
    hears: bool
    answers: float
    received: Integer
    final: bool
    complete: bool
    y: tuple[float, ...]


@dataclass(frozen=True)
class RoundMessage:
    """One side's part in round ``k`` of the term (scan, ``revision``): all that the sender's side knows at x_k.

    ``hears``, ``answers``, ``received``: as in a heartbeat. ``R``, ``z``: the side's cost-to-go at the boundary bus,
    ``1/2 |R y - z|^2`` of ``y = (p, q, vm, va)``, R the upper triangle of a (4, 4) matrix row by row; empty where no
    step is to come. ``no_load``: R of the no-load model in round 0, of (p, q) / vm_b^2, dvm / vm_b and dva, vm_b being
    the sender's no-load voltage; empty where something is missing. ``power``: (p, q) at the boundary, from a child.
    """

    header: Header
    bus: int
    revision: int
    k: int
    hears: bool
    answers: float
    received: Integer
    R: tuple[float, ...]
    z: tuple[float, ...]
    no_load: tuple[float, ...]
    power: tuple[float, ...]
    totals: Totals


@dataclass(frozen=True)
class UpMessage(RoundMessage):
    """Towards the hub; the totals are those of the sender's side."""

    kind: ClassVar[str] = "up"


@dataclass(frozen=True)
class DownMessage(RoundMessage):
    """From the side of the hub; the totals are those of all areas, on which ``decider`` in its ``life`` decided.

    ``verdict``: what follows from them, which the receiver finds out for itself, too.
    """

    kind: ClassVar[str] = "down"
    verdict: str
    decider: str
    life: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class TelemetryMessage:
    """One scan of an area's meters: ids, values and sigmas, p.u. and rad."""

    kind: ClassVar[str] = "telemetry"
    header: Header
    area: str
    meters: tuple[str, ...]
    values: tuple[float, ...]
    sigmas: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ClockMessage:
    """How long the run has lasted since all areas were there, s; windows of injected faults count from then."""

    kind: ClassVar[str] = "clock"
    header: Header
    elapsed_s: float


@dataclass(frozen=True, slots=True)
class StateMessage:
    """What an area knows and on what it rests, for whoever watches.

    ``buses``, ``vm``, ``va``, ``sigma_vm``, ``sigma_va``: the estimate (empty before the first), p.u. and rad.
    ``referenced``: angles count from the substation. ``removed``: meters taken out as bad data.
    ``critical``: meters that cannot be spared, whatever they read. ``checked``: bad data have been looked for.
    ``sent``, ``heard``: per neighbour the last sequence numbers of load messages and of boundary messages or those of
    rounds; 0 before any.
    ``messages``, ``bytes``, ``lost``: totals handed to the bus, ``lost`` of them dropped by the links; ``faults``:
    what the links have done to them, by kind. ``refused``: received payloads by reason of refusal. ``notes``: in
    words, what is missing.
    ``quality``: what the state is worth (docs/quality.md). ``telemetry_age``: s since telemetry was last heard;
    ``ages``, ``scans``: neighbour -> s since its boundary message was last heard, and the scan of the newest;
    ``old_sides``: neighbours that say that their side rests on something old. All these hold at ``header.time`` and
    may differ between two states of one sequence number.
    """

    kind: ClassVar[str] = "state"
    header: Header
    buses: tuple[int, ...]
    vm: tuple[float, ...]
    va: tuple[float, ...]
    sigma_vm: tuple[float, ...]
    sigma_va: tuple[float, ...]
    referenced: bool
    objective: float
    degrees_of_freedom: Integer
    removed: tuple[str, ...]
    critical: tuple[str, ...]
    checked: bool
    sent: dict[str, tuple[int, int]]
    heard: dict[str, tuple[int, int]]
    messages: int
    bytes: int
    lost: int
    refused: dict[str, int]
    notes: Notes
    faults: dict[str, int]
    quality: str
    telemetry_age: float
    ages: dict[str, float]
    scans: dict[str, int]
    old_sides: tuple[str, ...]


BoundaryNews = BoundaryMessage | AdmmMessage
Message = (
    LoadMessage
    | BoundaryNews
    | HeartbeatMessage
    | UpMessage
    | DownMessage
    | TelemetryMessage
    | ClockMessage
    | StateMessage
)

MESSAGE_TYPES: Mapping[str, type[Any]] = {
    cls.kind: cls
    for cls in (
        LoadMessage,
        BoundaryMessage,
        AdmmMessage,
        HeartbeatMessage,
        UpMessage,
        DownMessage,
        TelemetryMessage,
        ClockMessage,
        StateMessage,
    )
}


def content_of(message: LoadMessage | BoundaryNews | StateMessage) -> tuple[Any, ...]:
    """What a sequence number stands for: all but the header and what may differ between two messages of one number."""
    content: tuple[Any, ...] = _CONTENT[message.kind](message)
    return content


def _check_of(annotation: str) -> Callable[[str, object], Any]:
    return (lambda name, value: _check_totals(name, value)) if annotation == "Totals" else CHECKS[annotation]


_CONTENT: Mapping[str, Callable[[Any], Any]] = {
    kind: attrgetter(*(field.name for field in dataclasses.fields(cls) if field.name not in UNNUMBERED))
    for kind, cls in MESSAGE_TYPES.items()
}
_PLACES: Mapping[str, tuple[tuple[str, Callable[[str, object], Any]], ...]] = {  # behind the header: name and check
    kind: tuple((field.name, _check_of(str(field.type))) for field in dataclasses.fields(cls)[1:])
    for kind, cls in MESSAGE_TYPES.items()
}
_check_incarnation = tuple_of(check_count, 2)


def encode(message: Message) -> bytes:
    """The payload of ``message``: MessagePack, then its CRC-32; a boundary message takes well under 200 bytes."""
    h = message.header
    head = [WIRE_VERSION, message.kind, h.run, h.sender, [h.incarnation.start_ms, h.incarnation.random]]
    body = [getattr(message, name) for name, _ in _PLACES[message.kind]]
    return seal(msgpack.packb([*head, h.scan, h.sequence, h.time, *body], default=_unfold))


def _unfold(value: object) -> list[Any]:
    """Totals as an array of their fields, in order."""
    if not isinstance(value, Totals):
        raise TypeError(f"{type(value).__name__} has no place in a message")
    return [getattr(value, name) for name, _ in _TOTALS]


def _check_totals(name: str, value: object) -> Totals:
    if not isinstance(value, tuple) or len(value) != len(_TOTALS):
        raise MessageError("malformed", f"{name} is {shown(value)}, not an array of {len(_TOTALS)}")
    found = {field: check(f"{name}.{field}", item) for (field, check), item in zip(_TOTALS, value, strict=True)}
    return Totals(**found)


def _check_named(name: str, value: object) -> tuple[tuple[str, float], ...]:
    """(text, number) pairs."""
    pairs = tuple_of(lambda _, item: item)(name, value)
    for pair in pairs:
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise MessageError("malformed", f"{name} has {shown(pair)}, not a name and a number")
    return tuple((check_name(name, text), check_number(name, number)) for text, number in pairs)


_TOTALS_CHECKS = dict(CHECKS) | {"tuple[tuple[str, float], ...]": _check_named, "int": check_integer}
_TOTALS = tuple((f.name, _TOTALS_CHECKS[str(f.type)]) for f in dataclasses.fields(Totals))


def seal(packed: bytes) -> bytes:
    """``packed`` with its checksum, without which damaged numbers could not be told from others."""
    return packed + zlib.crc32(packed).to_bytes(4, "big")


def decode(payload: bytes, largest: int = MAX_BYTES) -> Message:
    """The message in ``payload``, which may have ``largest`` bytes.

    Raises:
        MessageError: anything that is not a well-formed message of this wire version.
    """
    fields = _unpack(payload, largest)
    if not isinstance(fields, tuple) or len(fields) < 8:
        raise MessageError("malformed", "not an array with a header of 8 fields")
    if type(fields[0]) is not int or fields[0] != WIRE_VERSION:
        raise MessageError("wire version", f"{shown(fields[0])}, this program speaks {WIRE_VERSION}")
    message_type = MESSAGE_TYPES.get(fields[1]) if isinstance(fields[1], str) else None
    if message_type is None:
        raise MessageError("malformed", f"unknown kind {shown(fields[1])}")
    header = Header(
        run=check_name("run", fields[2]),
        sender=check_name("sender", fields[3]),
        incarnation=Incarnation(*_check_incarnation("incarnation", fields[4])),
        scan=check_count("scan", fields[5]),
        sequence=check_count("sequence", fields[6]),
        time=check_number("time", fields[7]),
    )
    places = _PLACES[message_type.kind]
    if len(fields) != 8 + len(places):
        raise MessageError("malformed", f"{message_type.kind} has {len(fields)} fields, not {8 + len(places)}")
    body = {name: check(name, value) for (name, check), value in zip(places, fields[8:], strict=True)}
    _check_lengths(message_type, body)
    message: Message = message_type(header=header, **body)
    return message


def _unpack(payload: bytes, largest: int) -> object:
    """What ``payload`` packs, in at most a few times its size of memory."""
    if len(payload) > largest:
        raise MessageError("too large", f"{len(payload)} bytes, the limit is {largest}")
    packed, checksum = payload[:-4], payload[-4:]
    if zlib.crc32(packed).to_bytes(4, "big") != checksum:
        raise MessageError("damaged", "the checksum does not fit")
    maps = 0

    def read_map(pairs: list[tuple[str, object]]) -> dict[str, object]:
        nonlocal maps
        maps += 1
        content = dict(pairs)
        if len(content) < len(pairs) or maps > MOST_MAPS:
            raise MessageError("malformed", f"a key given twice, or more than {MOST_MAPS} maps")
        return content

    limits = {"max_str_len": 4 * LONGEST_NOTE, "max_bin_len": 0, "max_ext_len": 0}
    try:
        return msgpack.unpackb(packed, use_list=False, raw=False, object_pairs_hook=read_map, **limits)
    except MessageError:
        raise
    except Exception as error:
        raise MessageError("not MessagePack", f"{type(error).__name__}: {error}"[:200]) from None


_EQUALLY_LONG = (
    ("buses", "vm", "va", "sigma_vm", "sigma_va"),
    ("meters", "values", "sigmas"),
)


def _check_lengths(message_type: type[Any], body: Mapping[str, Any]) -> None:
    if message_type is AdmmMessage and {len(body[name]) for name in ("r", "r_before", "weight")} != {4}:
        raise MessageError("malformed", "r, r_before and weight do not have 4 numbers each")
    if issubclass(message_type, RoundMessage):
        lengths = tuple(len(body[name]) for name in ("R", "z", "no_load", "power"))
        if lengths[:2] not in ((0, 0), (10, 4)) or lengths[2] not in (0, 10) or lengths[3] not in (0, 2):
            raise MessageError("malformed", f"R, z, no_load and power have {lengths} numbers")
    if message_type is HeartbeatMessage and len(body["y"]) not in (0, 4):
        raise MessageError("malformed", f"y has {len(body['y'])} numbers, not 4 or none")
    for group in _EQUALLY_LONG:
        if group[0] in body and len({len(body[name]) for name in group}) != 1:
            raise MessageError("malformed", f"{', '.join(group)} differ in length")
