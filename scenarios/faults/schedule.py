"""Schedule of the faults of a run: times at which processes are killed, paused, restarted or silenced."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from scenarios.faults.faults import FaultEvent

UNDO = {"pause": "resume", "cut": "heal", "silent": "speak"}
LATER = UNDO | {"switch": "status"}
SWITCHING = ("switch", "status")  # after which the plant reads something else


@dataclass(frozen=True, slots=True)
class Step:
    """A step ``at_s`` seconds after the start: an event of the scenario, or the end of an event that lasts."""

    at_s: float
    kind: str
    names: tuple[str, ...]


@dataclass
class FaultSchedule:
    """The steps still to come, in order, and the count of steps carried out by kind; ``dead``: killed processes."""

    steps: list[Step]
    counts: Counter[str] = field(default_factory=Counter)
    dead: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, events: Sequence[FaultEvent]) -> FaultSchedule:
        steps = [Step(event.at_s, event.kind, event.names) for event in events]
        lasting = [event for event in events if event.kind in UNDO or event.for_s]
        steps += [Step(event.over_s, LATER[event.kind], event.names) for event in lasting]
        # at equal times ends come first: a pause that begins when another ends must last
        return cls(sorted(steps, key=lambda step: (step.at_s, step.kind not in UNDO.values())))

    @property
    def next_at(self) -> float:
        """Time of the next step, s after the start; infinity if none is left."""
        return self.steps[0].at_s if self.steps else math.inf

    def carry_out(self, elapsed_s: float, do: Callable[[Step], None]) -> Iterator[Step]:
        """Calls ``do`` with each step that is due ``elapsed_s`` after the start, and yields it afterwards."""
        while self.steps and self.steps[0].at_s <= elapsed_s:
            step = self.steps.pop(0)
            do(step)
            self.counts[step.kind] += 1
            if step.kind == "kill":
                self.dead.add(step.names[0])
            elif step.kind == "restart":
                self.dead.discard(step.names[0])
            yield step

    def describe_obstacles(self) -> tuple[str, ...]:
        """The next step in words, and a dead plant; each keeps the run from consensus.

        A dead plant is an obstacle by itself. Its last readings are on their way when it is killed, and the kill itself
        takes a while on a busy machine: areas that receive these readings after the fault are `good` for three
        heartbeats. Two heartbeats without a change were enough for consensus, and the run ended with exit code 0.
        """
        steps = [
            f"still to come: {step.kind} {' and '.join(step.names)} {step.at_s:g} s after the start"
            for step in self.steps[:1]
        ]
        return (*steps, *(["the plant is dead"] if "plant" in self.dead else []))
