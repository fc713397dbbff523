"""The operator's commands to one process: each is followed once, in their order, and rejected with a reason otherwise.

Without keys on the bus any process may use the operator's name. With keys only the operator can publish on the key of
commands; the commands left to reject are those that another process has received and repeats.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Iterator

from agents.messages.checks import MessageError, should_log
from agents.messages.packing import MAX_NEIGHBOUR_BYTES, CommandMessage, decode
from agents.orders.order_file import Followed, OrderFile
from agents.peers.rejections import LONGEST_LEAD_S, find_lead
from agents.protocol.configuration import Configuration
from agents.protocol.events import Event, Ordered, Rejected, StopRequested
from agents.security.access import OPERATOR
from dsse_core.grid.measurement import Source
from dsse_core.grid.switches import name_statuses
from dsse_core.printable import listed, printable

log = logging.getLogger(__name__)
LONGEST_AGE_S = 60.0  # of a command, by the operator's clock; each repeat has a time of its own
LARGEST_COMMAND = MAX_NEIGHBOUR_BYTES
MOST_NAMED = 12  # meters in a line of the log
BY_OPERATOR = "stopped by the operator"  # leave message
STOPPED_CODE = 4  # exit code of a process that the operator has stopped: systemd does not restart it
REPLAYED = "command of the past"
TOO_OLD, TOO_EARLY = f"command older than {LONGEST_AGE_S:.0f} s", "command from the future"
UNRECORDED = "command that cannot be recorded"


class OrderBook:
    """Record of the operator's commands that process ``name`` of ``run`` has followed.

    Args:
        meters, switches: ids of its own ones; other ids in a command are ignored.
        file: where the record outlives the process; None: the process keeps nothing, as one without meters.
        began_at: s since 1970; older commands are not followed.

    Raises:
        InvalidInputError: ``file`` cannot be read.
    """

    def __init__(
        self,
        name: str,
        run: str,
        meters: Collection[str] = (),
        file: OrderFile | None = None,
        began_at: float = 0.0,
        switches: Collection[str] = (),
    ) -> None:
        self._name = name
        self._run = run
        self._meters, self._switches = frozenset(meters), frozenset(switches)
        self._file = file
        self._began_at = began_at
        self._followed = file.load() if file else Followed()
        self._rejected: Counter[str] = Counter()

    @classmethod
    def of(cls, content: Configuration, file: OrderFile | None = None) -> OrderBook:
        """The order book of the area of ``content``."""
        meters = [meter.id for meter in content.meters if meter.source is not Source.VIRTUAL]
        return cls(content.area.name, content.run, meters, file, switches=content.area.network.switches)

    def go_over(self, content: Configuration) -> OrderBook:
        """The order book of the same area with other meters; the commands followed so far hold."""
        book = OrderBook.of(content)
        book._file, book._followed = self._file, self._followed
        return book

    def begin(self) -> list[Event]:
        """Events of the commands that were followed before the process began, and still hold."""
        if self._followed == Followed():
            return []
        return [self._ordered(scan=False)]

    def take(self, payload: bytes, wall: float) -> Iterator[Event]:
        """Events that follow from a ``payload`` on the key of commands, received at ``wall``, s since 1970."""
        try:
            message = decode(payload, LARGEST_COMMAND)
        except MessageError as error:
            yield self._reject(f"command {error.reason}", str(error))
            return
        reason = self._find_rejection(message, wall) if isinstance(message, CommandMessage) else "no command"
        if reason:
            yield self._reject(reason, f"from {printable(message.header.sender)}")
        elif isinstance(message, CommandMessage) and message.header.order > self._followed.order:
            yield from self._follow(message)

    def _find_rejection(self, message: CommandMessage, wall: float) -> str:
        header = message.header
        if header.run != self._run:
            return "other run"
        if header.sender != OPERATOR:
            return "command of another process than the operator"
        if message.to != self._name:
            return "command to another process"
        if find_lead(header, wall) > LONGEST_LEAD_S:
            return TOO_EARLY
        if header.order < self._followed.order or header.time < self._began_at:
            return REPLAYED
        if header.time < wall - LONGEST_AGE_S and header.order != self._followed.order:
            return TOO_OLD
        return ""

    def _follow(self, message: CommandMessage) -> Iterator[Event]:
        """Record ``message``, then follow it: a command that a restart would forget is not followed."""
        off_now = {*self._followed.meters_off, *message.meters_off} - {*message.meters_on}
        off = tuple(sorted(self._meters & off_now))
        given = {**self._followed.switches} | dict.fromkeys(message.opened, False) | dict.fromkeys(message.closed, True)
        switches = {switch: given[switch] for switch in sorted(given.keys() & self._switches)}
        followed = Followed(message.header.incarnation, message.header.sequence, off, switches)
        try:
            if self._file:
                self._file.save(followed)
        except OSError as error:
            yield self._reject(UNRECORDED, f"{error.filename}: {error.strerror}")
            return
        if off != self._followed.meters_off:
            log.info("the operator has switched off: %s", printable(listed(off, MOST_NAMED)) or "no meter")
        if switches != self._followed.switches:
            statuses = [f"{switch} {status}" for switch, status in name_statuses(switches).items()]
            log.info("switches as the operator has set them: %s", printable(listed(statuses, MOST_NAMED)))
        self._followed = followed
        if message.scan:
            log.info("the operator has asked for a scan")
        yield self._ordered(scan=message.scan)
        if message.stop:
            yield StopRequested(BY_OPERATOR)

    def _ordered(self, *, scan: bool) -> Ordered:
        start, sequence = self._followed.order
        followed = self._followed
        return Ordered((start.start_ms, start.random, sequence), followed.meters_off, scan, followed.switches)

    def _reject(self, reason: str, why: str) -> Rejected:
        self._rejected[reason] += 1
        count = self._rejected[reason]
        if should_log(count):
            log.warning("%s rejects command number %s for this reason, %s: %s", self._name, count, reason, why)
        return Rejected(reason, count)
