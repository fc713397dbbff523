"""What holds at the end of a scan, for the log: an area leaves a term with it, or has been in the term for long.

What passes in between is the exchange at work: a neighbour that is not yet at the end, a newer estimate under way. None
of it is logged, however often it is shown.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from agents.peers.peers import Term
from agents.protocol.events import Conclude
from agents.protocol.quality import Finding, assess
from agents.strategies.interface import Estimate


@dataclass(frozen=True, slots=True)
class _Standing:
    """Where an area is in ``term``, as far as watchers see it; ``is_end``: nothing more is to come in it."""

    term: Term
    is_end: bool
    estimate: Estimate | None
    findings: Sequence[Finding]


class ScanEnd:
    """Takes what an area finds again and again, and keeps what is to be logged.

    Args:
        patience_s: after which what holds in a term is permanent, whether the term ends or not.
    """

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._last: _Standing | None = None
        self._since = 0.0  # when its term was first seen
        self._ended: list[Conclude] = []

    def note(
        self,
        term: Term,
        estimate: Estimate | None,
        findings: Sequence[Finding],
        now: float,
        *,
        is_end: bool,
        is_heartbeat: bool,
    ) -> None:
        """What is found in ``term`` now; of one term the last counts, and after a while what holds at a heartbeat."""
        self._leave(term)
        if self._last is None:
            self._since = now
        self._last = _Standing(term, is_end, estimate, findings)
        if is_heartbeat and now >= self._since + self._patience_s:
            self._ended.append(_conclude(self._last))

    def take(self, term: Term, *, is_over: bool = False) -> Iterator[Conclude]:
        """What is to be logged; the area is in ``term`` now. ``is_over``: it ends."""
        self._leave((-1, -1) if is_over else term)
        ended, self._ended = self._ended, []
        yield from ended

    def _leave(self, term: Term) -> None:
        if self._last is None or self._last.term == term:
            return
        if self._last.is_end:
            self._ended.append(_conclude(self._last))
        self._last = None


def _conclude(standing: _Standing) -> Conclude:
    """The line for the log, and the facts in it, without figures, which change from scan to scan."""
    estimate, assessment = standing.estimate, assess(standing.findings)
    what = "no estimate" if estimate is None else "estimates" if estimate.referenced else "estimates, angles relative"
    removed = estimate.removed if estimate else ()
    parts = [what, *([f"removed as bad data: {', '.join(removed)}"] if removed else []), *assessment.notes]
    facts = {(what, ""), *(("removed as bad data", meter) for meter in removed)}
    facts |= {(finding.about or finding.note, who) for finding in standing.findings for who in finding.whom or ("",)}
    return Conclude(standing.term[0], "; ".join(parts), frozenset(facts))
