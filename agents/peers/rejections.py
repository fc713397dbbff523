"""Rejection of well-formed messages: for their sender, their time, or numbers that cannot be."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from agents.messages.packing import (
    BoundaryUpdate,
    ClockMessage,
    CommandMessage,
    DownMessage,
    Header,
    HeartbeatMessage,
    LoadMessage,
    Message,
    ReadingsMessage,
    StateMessage,
    TelemetryMessage,
    UpMessage,
)
from agents.protocol.configuration import Configuration
from dsse_core.linear.boundary_information import BEYOND_REASON, are_within_reason

LONGEST_LEAD_S = 600.0  # by which the sender's clock may be ahead of ours
MOST_COUNTED = 2**51  # scans, revisions, offsets, which never go back: above any time in ms, at most half of what fits
FUTURE = "time in the future"  # a reason of rejection
FAR_SCAN = "scan far ahead of the telemetry"  # another
OTHER_STRATEGY = "other strategy"  # another
OTHER_BUS = "other boundary bus"  # another
BEYOND = "numbers beyond reason"  # another
OTHER_VARIABLES = "other boundary variables"
CONTRADICTION = "contradicts the area file"  # another
FOR_OTHERS = (StateMessage, ReadingsMessage, CommandMessage, ClockMessage)  # kinds that no neighbour sends to an area


class Rejections:
    """Messages that an area has rejected.

    ``ahead``: sender rejected as from the future, "" for the plant -> lead of its clock, s. ``contradictions``:
    neighbour that contradicts this area, in its area file or strategy -> contradiction. ``far_scans``: neighbour in
    whose name a scan far ahead of the telemetry has been announced -> the first such scan that is still ahead.
    ``unreadable``: neighbour or gateway -> the scan in which its last payload that is no message came, and the field.
    """

    def __init__(self) -> None:
        self.ahead: dict[str, float] = {}
        self.contradictions: dict[str, str] = {}
        self.far_scans: dict[str, int] = {}
        self.unreadable: dict[str, tuple[int, str]] = {}
        self._rejected: Counter[str] = Counter()
        self._not_let_in: dict[str, int] = {}

    def reject(self, message: Message, key_sender: str, reason: str, now: float) -> None:
        """Counts a message that is rejected for ``reason`` at ``now``, s since 1970."""
        self.count(reason)
        if reason == FUTURE:
            self.ahead.setdefault(key_sender, find_lead(message.header, now))
        elif reason == FAR_SCAN:
            self.far_scans.setdefault(key_sender, message.header.scan)

    def note_scan(self, scan: int) -> None:
        """Notes that this area works on ``scan`` now: announcements of scans up to this one were true."""
        self.far_scans = {name: far for name, far in self.far_scans.items() if far > scan}

    def note_contradiction(self, name: str, what: str) -> None:
        """Notes the contradiction ``what`` of neighbour ``name`` with this area; empty: it contradicts no more."""
        if what:
            self.contradictions[name] = what
        else:
            self.contradictions.pop(name, None)

    def count(self, reason: str) -> None:
        """Counts one more rejection for ``reason``."""
        self._rejected[reason] += 1

    def note_not_let_in(self, reason: str, count: int) -> None:
        """Notes that the filter before the inbox has rejected ``count`` payloads for ``reason`` so far."""
        self._not_let_in[reason] = max(count, self._not_let_in.get(reason, 0))

    def note_unreadable(self, sender: str, what: str, scan: int) -> None:
        """Notes that a payload of ``sender`` was no message while this area works on ``scan``; ``what``: its fault."""
        self.unreadable[sender] = scan, what

    def unreadable_in(self, scan: int) -> dict[str, str]:
        """Neighbour or gateway whose last payload that is no message came in ``scan`` -> the fault of that payload."""
        return {sender: detail for sender, (at, detail) in self.unreadable.items() if at == scan}

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of rejected messages and payloads, by reason."""
        return self._rejected + Counter(self._not_let_in)


def find_rejection(message: Message, key_sender: str, content: Configuration, now: float) -> str:
    """Returns the reason for which the agent of ``content`` cannot take ``message``, in short; empty if it can.

    ``key_sender``: as in ``events.Received``. ``now``: s since 1970. A time in the past is no reason: order follows
    from incarnation and sequence. A time far in the future is a reason: its incarnation would stay the newest.
    """
    header = message.header
    if header.run != content.run:
        return "other run"
    if find_lead(header, now) > LONGEST_LEAD_S:
        return FUTURE
    if not are_within_reason((header.time, getattr(message, "answers", 0.0), getattr(message, "clock", 0.0))):
        return BEYOND
    if isinstance(message, TelemetryMessage):
        return _find_telemetry_rejection(message, content)
    bus = next((n.bus for n in content.area.neighbours if n.area == header.sender), None)
    if isinstance(message, FOR_OTHERS) or bus is None:
        return "unknown sender"
    if header.sender != key_sender:
        return "sender does not own the key"
    if getattr(message, "bus", bus) != bus:
        return OTHER_BUS
    boundary = content.area.boundaries[header.sender]
    if getattr(message, "variables", boundary.names) != boundary.names:
        return OTHER_VARIABLES
    if isinstance(message, LoadMessage) and len(message.p) != boundary.n_loads:
        return OTHER_VARIABLES
    return find_unreasonable(message)


def find_lead(header: Header, now: float) -> float:
    """Returns the lead, s, of the sender's clock or of the start of its incarnation over ``now``, s since 1970."""
    return max(header.time, header.incarnation.start_ms / 1000) - now


def find_unreasonable(
    message: LoadMessage | BoundaryUpdate | HeartbeatMessage | UpMessage | DownMessage,
) -> str:
    """Returns ``BEYOND`` where no estimate can have the numbers of ``message``, else "".

    Strategies check further numbers in messages of their own.
    """
    match message:
        case LoadMessage():
            possible = are_within_reason((*message.p, *message.q, *message.sigma)) and min(message.sigma) >= 0
        case UpMessage() | DownMessage():
            t = message.totals
            numbers = *message.R, *message.z, *message.no_load, *message.power, t.degrees_of_freedom, t.turn
            numbers = *numbers, *(y for _, *change in t.common for y in change)
            named = [value for _, value in (*t.worst, *t.tied)]
            sizes = t.objective, t.dvm, t.dva, t.square, *named, t.areas, t.held_back
            possible = are_within_reason((*numbers, *sizes)) and min(sizes) >= 0
            possible = possible and max(message.revision, message.header.scan) < MOST_COUNTED
        case HeartbeatMessage():
            counted = message.revision, message.offset, message.header.scan
            possible = are_within_reason((0.0, *message.y)) and max(counted) < MOST_COUNTED
        case _:
            possible = True
    return "" if possible else BEYOND


def _find_telemetry_rejection(message: TelemetryMessage, content: Configuration) -> str:
    if message.area != content.area.name:
        return "telemetry of another area"
    if message.header.scan > MOST_COUNTED // 2:
        return BEYOND
    return ""


def find_reading_rejection(value: float, sigma: float) -> str:
    """Returns the reason for which a reading, p.u. or rad, cannot be used, in short; empty if it can."""
    if sigma <= 0:
        return "sigma not positive"
    weight = 1 / sigma
    most = BEYOND_REASON  # written out, as there are thousands of readings; nan is below no limit
    within = abs(value) < most and sigma < most and weight < most and abs(value * weight) < most
    return "" if within else "reading beyond reason"
