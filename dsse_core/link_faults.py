"""Faults of a directed link between two areas, as numbers: the words that scenarios and agents share."""

from __future__ import annotations

from dataclasses import dataclass

Window = tuple[float, float]
"""Beginning and end, s since the start of the run; a run starts when all its areas are on the bus."""


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """The faults of one directed link; probabilities are per message, powers and magnitudes p.u., angles rad.

    Args:
        loss: probability that a message is lost, outside bursts.
        burst_enter, burst_leave: probabilities that a burst begins at a message, or has ended at it (Gilbert-Elliott).
        burst_loss: probability that a message within a burst is lost.
        delay_s, jitter_s: a message is held back ``delay_s`` plus a uniform part of ``jitter_s``; jitter reorders.
        duplicate: probability that a message is sent twice, each time with a delay of its own.
        corrupt: probability that the bytes of a message are damaged, flipped or cut short.
        load_p, load_q: added to the load in a load message. load_scale: multiplies it. load_frozen: every load message
            repeats the first.
        lie_p, lie_q, lie_vm, lie_va, lie_scale: messages state ``lie_scale`` y plus these in place of y = (p, q, vm,
            va) at the boundary.
        lie_objective: multiplies J in totals. lie_areas: number of areas that totals count, none of them silent or
            stale, and the side complete; 0 changes nothing. lie_worst: the meter that totals name as the worst; empty
            changes nothing. Verdicts follow from the totals that are sent. lie_verdict: stated in place of a verdict.
        until_s: the time at which these faults end, s since the start of the run; None is never.
        cuts: windows in which no message passes.
    """

    loss: float = 0.0
    burst_enter: float = 0.0
    burst_leave: float = 1.0
    burst_loss: float = 1.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0
    load_p: float = 0.0
    load_q: float = 0.0
    load_scale: float = 1.0
    load_frozen: bool = False
    lie_p: float = 0.0
    lie_q: float = 0.0
    lie_vm: float = 0.0
    lie_va: float = 0.0
    lie_scale: float = 1.0
    lie_objective: float = 1.0
    lie_areas: int = 0
    lie_worst: str = ""
    lie_verdict: str = ""
    until_s: float | None = None
    cuts: tuple[Window, ...] = ()

    @property
    def has_windows(self) -> bool:
        """True where the faults depend on how long the run has lasted."""
        return self.until_s is not None or bool(self.cuts)

    @property
    def lie_offset(self) -> tuple[float, float, float, float]:
        """The offset added to ``lie_scale`` y = (p, q, vm, va), p.u. and rad."""
        return self.lie_p, self.lie_q, self.lie_vm, self.lie_va

    @property
    def lies_of_boundary(self) -> bool:
        """True where messages state another y than the sender has."""
        return any(self.lie_offset) or self.lie_scale != 1.0

    @property
    def lies_of_totals(self) -> bool:
        """True where messages state other totals than the sender has."""
        return self.lie_objective != 1.0 or bool(self.lie_areas or self.lie_worst)

    @property
    def changes_loads(self) -> bool:
        """True where load messages may be changed."""
        return self.load_frozen or (self.load_p, self.load_q, self.load_scale) != (0.0, 0.0, 1.0)
