"""Events that one area's protocol takes in, and actions that it returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from agents.messages.packing import Message
from agents.protocol.configuration import Configuration


@dataclass(frozen=True, slots=True)
class Received:
    """A decoded message; ``key_sender``: the area that its key belongs to, empty for telemetry."""

    message: Message
    key_sender: str


@dataclass(frozen=True, slots=True)
class Rejected:
    """Payloads that the filter before the inbox rejected for ``reason``; ``count``: number of them so far.

    ``sender``: the neighbour or gateway on whose key the last one came, ``at_field``: the field that is wrong, and its
    fault; both empty where no field is known.
    """

    reason: str
    count: int
    sender: str = ""
    at_field: str = ""


@dataclass(frozen=True, slots=True)
class PresenceChanged:
    """A neighbour came or went. ``leave_reason``: of its leave message; empty if it died or was cut off."""

    area: str
    alive: bool
    leave_reason: str = ""


@dataclass(frozen=True, slots=True)
class ClockSet:
    """The host's clock has been set; ``offset``: from monotonic to wall-clock time, s, from now on."""

    offset: float


@dataclass(frozen=True, slots=True)
class Ordered:
    """A recorded command of the operator, which the area follows.

    ``order``: start in ms, random number and sequence number; ``meters_off``: all meters of the area that are off.
    ``scan``: the area takes the newest readings at once. ``switches``: all switches of the area that the operator has
    set -> True where closed.
    """

    order: tuple[int, int, int]
    meters_off: tuple[str, ...]
    scan: bool = False
    switches: Mapping[str, bool] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Offered:
    """The configuration of the next split lies ready beside the one in use; None: no longer."""

    configuration: Configuration | None


@dataclass(frozen=True, slots=True)
class StopRequested:
    reason: str


Event = Received | Rejected | PresenceChanged | ClockSet | Ordered | Offered | StopRequested


@dataclass(frozen=True, slots=True)
class Publish:
    """Sends ``message`` to neighbour ``to``, or shows it to watchers (None)."""

    message: Message
    to: str | None


@dataclass(frozen=True, slots=True)
class Finish:
    reason: str


@dataclass(frozen=True, slots=True)
class GoOver:
    """The area works on ``configuration`` from now on: a protocol made from it goes on, as a new incarnation.

    Later actions of the former protocol are not carried out.
    """

    configuration: Configuration


@dataclass(frozen=True, slots=True)
class Conclude:
    """Logs ``text``, if it is new: the findings at the end of ``scan``, or findings that have held for long.

    ``facts``: statements of the text without figures, each with the meter or area that it concerns, empty without one.
    """

    scan: int
    text: str
    facts: frozenset[tuple[str, str]]


Action = Publish | Finish | GoOver | Conclude
