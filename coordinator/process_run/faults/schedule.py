"""When which process of a run is killed, frozen, started again or silenced."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from scenarios.faults.faults import FaultEvent

UNDO = {"pause": "resume", "cut": "heal", "silent": "speak"}


@dataclass(frozen=True, slots=True)
class Step:
    """What happens at ``at_s`` after the start: an event of the scenario, or the end of one that lasts."""

    at_s: float
    kind: str
    names: tuple[str, ...]


@dataclass
class FaultSchedule:
    """The steps still to come, in order, and how many of each kind have been done."""

    steps: list[Step]
    counts: Counter[str] = field(default_factory=Counter)

    @classmethod
    def of(cls, events: Sequence[FaultEvent]) -> FaultSchedule:
        steps = [Step(event.at_s, event.kind, event.names) for event in events]
        steps += [Step(event.over_s, UNDO[event.kind], event.names) for event in events if event.kind in UNDO]
        # what ends ends first: a pause that begins at that moment shall last
        return cls(sorted(steps, key=lambda step: (step.at_s, step.kind not in UNDO.values())))

    @property
    def next_at(self) -> float:
        """When the next step is due, s after the start; infinity if none is left."""
        return self.steps[0].at_s if self.steps else math.inf

    def carry_out(self, elapsed_s: float, do: Callable[[Step], None]) -> Iterator[Step]:
        """``do`` all that is due ``elapsed_s`` after the start; each step as it is done."""
        while self.steps and self.steps[0].at_s <= elapsed_s:
            step = self.steps.pop(0)
            do(step)
            self.counts[step.kind] += 1
            yield step

    def describe_next(self) -> tuple[str, ...]:
        """What is still to come, in words; empty if nothing is."""
        return tuple(
            f"still to come: {step.kind} {' and '.join(step.names)} {step.at_s:g} s after the start"
            for step in self.steps[:1]
        )
