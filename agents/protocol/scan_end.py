"""Findings at the end of a scan, for the log: an area leaves a term with them, or has been in the term for long.

Findings that pass in between show the exchange at work: a neighbour is not yet at the end, a newer estimate is under
way. They are not logged, however often they are shown.
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
    """Estimate and findings of an area in ``term``, as watchers see them; ``is_end``: no more are to come in it."""

    term: Term
    is_end: bool
    estimate: Estimate | None
    findings: Sequence[Finding]


class ScanEnd:
    """Takes each set of findings of an area, and keeps those to be logged.

    Args:
        patience_s: time in a term after which findings count as permanent, whether the term ends or not.
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
        """Notes the findings in ``term`` now. The last ones of a term count; after a while those at heartbeats, too."""
        self._leave(term)
        if self._last is None:
            self._since = now
        self._last = _Standing(term, is_end, estimate, findings)
        if is_heartbeat and now >= self._since + self._patience_s:
            self._ended.append(_conclude(self._last))

    def take(self, term: Term, *, is_over: bool = False) -> Iterator[Conclude]:
        """Yields what is to be logged; ``term``: of the area now. ``is_over``: the protocol ends."""
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
    """Returns the line for the log, with its facts without figures, as figures change from scan to scan."""
    estimate, assessment = standing.estimate, assess(standing.findings)
    what = "no estimate" if estimate is None else "estimates" if estimate.referenced else "estimates, angles relative"
    removed = estimate.removed if estimate else ()
    parts = [what, *([f"removed as bad data: {', '.join(removed)}"] if removed else []), *assessment.notes]
    facts = {(what, ""), *(("removed as bad data", meter) for meter in removed)}
    facts |= {(finding.about or finding.note, who) for finding in standing.findings for who in finding.whom or ("",)}
    return Conclude(standing.term[0], "; ".join(parts), frozenset(facts))
