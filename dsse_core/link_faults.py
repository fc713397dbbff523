"""Faults of a directed link between two areas, as numbers: the words that scenarios and agents share."""

from __future__ import annotations

from dataclasses import dataclass

from dsse_core.limits import Moment, NotNegative, Positive, Probability

Window = tuple[NotNegative, NotNegative]
"""Beginning and end, s since the start of the run; a run starts when all its areas are on the bus."""


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """The faults of one directed link; probabilities are per message, powers and magnitudes p.u., angles rad."""

    loss: Probability = 0.0
    """Probability of the loss of a message, outside bursts."""
    burst_enter: Probability = 0.0
    """Probability of a burst to begin at a message (Gilbert-Elliott)."""
    burst_leave: Probability = 1.0
    """Probability of a burst to have ended at a message."""
    burst_loss: Probability = 1.0
    """Probability of the loss of a message within a burst."""
    delay_s: Moment = 0.0
    """Time for which each message is held back."""
    jitter_s: Moment = 0.0
    """A uniform part of it is added to the delay of each message, so that messages overtake each other."""
    duplicate: Probability = 0.0
    """Probability of a message to be sent twice, each time with a delay of its own."""
    corrupt: Probability = 0.0
    """Probability of damage to the bytes of a message, flipped or cut short."""
    load_p: float = 0.0
    """Added to the load in a load message."""
    load_q: float = 0.0
    """The same of reactive power."""
    load_scale: float = 1.0
    """Multiplies the load in a load message."""
    load_frozen: bool = False
    """Every load message repeats the first."""
    lie_p: float = 0.0
    """Messages state ``lie_scale`` y plus this and the next three in place of y = (p, q, vm, va) at the boundary."""
    lie_q: float = 0.0
    lie_vm: float = 0.0
    lie_va: float = 0.0
    lie_scale: Positive = 1.0
    lie_objective: float = 1.0
    """Multiplies J in totals; verdicts follow from the totals that are sent."""
    lie_areas: int = 0
    """Number of areas that totals count, none of them silent or stale, and the side complete; 0 changes nothing."""
    lie_worst: str = ""
    """Meter that totals name as the worst; empty changes nothing."""
    lie_verdict: str = ""
    """Stated in place of a verdict; empty changes nothing."""
    until_s: float | None = None
    """Time at which these faults end, s since the start of the run; None is never."""
    cuts: tuple[Window, ...] = ()
    """Windows in which no message passes."""

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
