"""Who stands at the door of an agent: lets in messages on known keys, within their size, and counts the others."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Collection

from agents.messages.checks import MessageError, is_worth_writing
from agents.messages.keys import sender_of
from agents.messages.packing import MAX_BYTES, MAX_NEIGHBOUR_BYTES, decode
from agents.protocol.events import Received, Rejected
from agents.runtime.inbox import Inbox

log = logging.getLogger(__name__)


class IngressFilter:
    """Puts what arrives on the bus' threads into ``inbox``, one slot for each key: strangers do not make it grow.

    Args:
        neighbour_keys: those on which neighbours speak to this area.
        telemetry_key: of this area's telemetry.
    """

    def __init__(self, neighbour_keys: Collection[str], telemetry_key: str, inbox: Inbox) -> None:
        self._largest = dict.fromkeys(neighbour_keys, MAX_NEIGHBOUR_BYTES) | {telemetry_key: MAX_BYTES}
        self._inbox = inbox
        self._last: dict[str, tuple[bytes, Received]] = {}  # of each key; most of what comes repeats it
        self._rejected: Counter[str] = Counter()
        self._lock = threading.Lock()

    def take(self, key: str, payload: bytes) -> None:
        """Let a message in, or count why not."""
        largest = self._largest.get(key)
        if largest is None:
            self._reject("unknown sender", key, "nobody who has a say here speaks on this key")
            return
        last = self._last.get(key)
        if last is not None and last[0] == payload:
            self._inbox.put(key, last[1])
            return
        try:
            message = decode(payload, largest)
        except MessageError as error:
            self._reject(error.reason, key, str(error))
        else:
            received = Received(message, sender_of(key))
            self._last[key] = payload, received
            self._inbox.put(key, received)

    def _reject(self, reason: str, key: str, why: str) -> None:
        with self._lock:
            self._rejected[reason] += 1
            count = self._rejected[reason]
        self._inbox.put(("rejected", reason), Rejected(reason, count))
        if is_worth_writing(count):
            log.warning("rejected payload number %s for this reason, on %.200s: %s", count, ascii(key), why)
