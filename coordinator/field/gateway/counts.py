"""Counts of a source's readings: used, superseded, and rejected by reason and address, with occasional log lines."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from agents.messages.checks import should_log
from dsse_core.printable import shortened

log = logging.getLogger(__name__)
MOST_NAMED = 50  # addresses of each reason
MOST_REASONS = 50
OTHER = "other"
LONGEST_DETAIL = 300  # characters
UNKNOWN, BAD_TYPE, NOT_FINITE, WRONG_UNIT = "unknown address", "bad type", "not finite", "wrong unit"
OUT_OF_RANGE, AHEAD, BAD_TIME, TWICE = "out of range", "ahead of time", "bad time", "two values for one time"
OLDER, INVALID, DROPPED, MALFORMED = "older than the last", "marked invalid", "dropped", "malformed"


@dataclass
class Rejected:
    """Rejected readings of one reason: their count, counts by address (of MOST_NAMED), and the last one in words."""

    count: int = 0
    addresses: Counter[str] = field(default_factory=Counter)
    last: str = ""


@dataclass
class Counts:
    """Each of the ``received`` readings is ``used``, ``superseded``, rejected, or still waiting.
    A superseded reading repeats the last one, or a newer reading came before it could be published.
    ``invalid``: readings that are not rejected and that their source marks as invalid.

    ``warn``: called with a sentence when a reason occurs for the first, 10th, 100th, ... time.
    """

    received: int = 0
    used: int = 0
    superseded: int = 0
    invalid: int = 0
    messages: int = 0
    rejected: dict[str, Rejected] = field(default_factory=dict)
    warn: Callable[[str], None] = log.warning

    def reject(self, reason: str, address: str, detail: str) -> None:
        """Count a reading that is not used. Reasons beyond MOST_REASONS, such as a source may give, count as OTHER."""
        if reason not in self.rejected and len(self.rejected) >= MOST_REASONS:
            reason = OTHER
        found = self.rejected.setdefault(shortened(reason, 80), Rejected())
        found.count += 1
        found.last = shortened(detail, LONGEST_DETAIL)
        if address and (address in found.addresses or len(found.addresses) < MOST_NAMED):
            found.addresses[shortened(address, LONGEST_DETAIL)] += 1
        if should_log(found.count):
            self.warn(f"not used, {reason} ({found.count} so far): {found.last}")

    def as_json(self) -> dict[str, Any]:
        """All counts, by name."""
        return {
            "received": self.received,
            "used": self.used,
            "superseded": self.superseded,
            "marked_invalid": self.invalid,
            "messages": self.messages,
            "rejected": {
                reason: {"count": found.count, "addresses": dict(found.addresses), "last": found.last}
                for reason, found in sorted(self.rejected.items())
            },
        }

    def describe(self) -> str:
        """The counts in one line."""
        rejected = ", ".join(f"{found.count} {reason}" for reason, found in sorted(self.rejected.items()))
        return (
            f"{self.received} readings received, {self.used} used, {self.superseded} superseded by newer ones, "
            f"{self.messages} messages" + (f"; not used: {rejected}" if rejected else "")
        )
