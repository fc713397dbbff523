"""Filter of incoming messages by key and size, before the inbox; rejected ones are counted and logged."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Collection
from dataclasses import replace

from agents.messages.checks import MessageError, should_log
from agents.messages.keys import gateway_of, sender_of
from agents.messages.packing import MAX_BYTES, MAX_NEIGHBOUR_BYTES, Message, TelemetryMessage, decode
from agents.protocol.events import Received, Rejected
from agents.runtime.inbox import Inbox

log = logging.getLogger(__name__)
MOST_GATEWAYS = 64  # that have a slot, where any name may publish
ANY_GATEWAY = "*"


class IngressFilter:
    """Puts messages from the bus' threads into ``inbox``, one slot for each known key: strangers do not make it grow.

    Args:
        neighbour_keys: keys on which neighbours send to this area.
        run, area: of the telemetry.
        gateways: names that may send for the area's meters; ``ANY_GATEWAY`` admits the first ``MOST_GATEWAYS`` names.
        meters: ids of the area's meters. Telemetry of exactly these meters shares this tuple, so that thousands of
            equal texts are not kept for each message.
    """

    def __init__(
        self,
        neighbour_keys: Collection[str],
        run: str,
        area: str,
        gateways: Collection[str],
        inbox: Inbox,
        meters: tuple[str, ...] = (),
    ) -> None:
        self._neighbour_keys = frozenset(neighbour_keys)
        self._run, self._area = run, area
        self._gateways = set(gateways) - {ANY_GATEWAY}
        self._room = MOST_GATEWAYS if ANY_GATEWAY in gateways else 0
        self._inbox = inbox
        self._meters = meters
        self._last: dict[str, tuple[bytes, Received]] = {}  # of each key; most payloads repeat it
        self._rejected: Counter[str] = Counter()
        self._lock = threading.Lock()

    def let_in(self, neighbour_keys: Collection[str]) -> None:
        """Let in messages on ``neighbour_keys``, too."""
        self._neighbour_keys |= frozenset(neighbour_keys)

    def take(self, key: str, payload: bytes) -> None:
        """Put a message into the inbox, or count it as rejected."""
        gateway = "" if key in self._neighbour_keys else gateway_of(key, self._run, self._area)
        if not (key in self._neighbour_keys or self._may_publish(gateway)):
            self._reject("unknown sender", key, "no known sender publishes on this key")
            return
        last = self._last.get(key)
        if last is not None and last[0] == payload:
            self._inbox.put(key, last[1])
            return
        try:
            message = decode(payload, MAX_BYTES if gateway else MAX_NEIGHBOUR_BYTES)
            _require_its_own(message, gateway)
        except MessageError as error:
            self._reject(error.reason, key, str(error), gateway or sender_of(key), error.at_field)
        else:
            if isinstance(message, TelemetryMessage) and message.meters == self._meters:
                message = replace(message, meters=self._meters)
            received = Received(message, sender_of(key))
            self._last[key] = payload, received
            self._inbox.put(key, received)

    def _may_publish(self, gateway: str) -> bool:
        with self._lock:
            if gateway and gateway not in self._gateways and self._room:
                self._room -= 1
                self._gateways.add(gateway)
            return gateway in self._gateways

    def _reject(self, reason: str, key: str, why: str, sender: str = "", at_field: str = "") -> None:
        with self._lock:
            self._rejected[reason] += 1
            count = self._rejected[reason]
        self._inbox.put(("rejected", reason), Rejected(reason, count, sender if at_field else "", at_field))
        if should_log(count):
            log.warning("the agent rejects payload number %s for this reason, on %.200s: %s", count, ascii(key), why)


def _require_its_own(message: Message, gateway: str) -> None:
    """Check that a message on a telemetry key of ``gateway`` is telemetry of that gateway.

    Raises:
        MessageError: it is not.
    """
    if gateway and not (isinstance(message, TelemetryMessage) and message.header.sender == gateway):
        raise MessageError("sender does not own the key", f"{gateway} speaks for {message.header.sender}")
