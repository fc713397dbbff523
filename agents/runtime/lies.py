"""Messages of a lying area: the same false boundary, totals or verdict in all of them.

A lie that contradicts itself is detected at once. So every number about y, the variables of the boundary, is changed
as if y were another one. A verdict follows from the false totals that are sent, unless the lie is about the verdict
itself.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from agents.messages.boundary_arrays import read_triangle, write_triangle
from agents.messages.packing import (
    BoundaryUpdate,
    DownMessage,
    HeartbeatMessage,
    Message,
    RoundMessage,
    UpMessage,
)
from dsse_core.estimation.decision import Memory, Totals, decide
from dsse_core.grid.boundary import Boundary, boundary_at, boundary_of
from dsse_core.link_faults import LinkFaults

WORST = 1e3  # the normalised residual that a lie about the worst meter states


class Liar:
    """Falsifies the messages of one directed link, in the order of their rounds; repeats may come in between."""

    def __init__(self, faults: LinkFaults) -> None:
        self._faults = faults
        self._memories: dict[tuple[object, int, int, int], Memory] = {}  # basis of the verdicts of a round, as sent

    def falsify(self, message: Message) -> Message:
        """``message`` as the lying link sends it."""
        match message:
            case UpMessage() | DownMessage():
                return self._falsify_round(message)
            case HeartbeatMessage():
                y = self._falsify_y(message.boundary, message.y)
                return replace(message, y=y, complete=message.complete or self._faults.lie_areas > 0)
            case BoundaryUpdate():
                names = getattr(message, "variables", None)
                boundary = boundary_of(names) if names else boundary_at((message.bus,), message.header.sender)
                return message.falsified(partial(self._falsify_y, boundary))
        return message

    def _falsify_y(self, boundary: Boundary, y: tuple[float, ...]) -> tuple[float, ...]:
        """The false y for ``y``, which holds all of it, its first numbers, or none."""
        if not self._faults.lies_of_boundary:
            return y
        false = self._faults.lie_scale * np.array(y) + self._offset_of(boundary)[: len(y)]
        return tuple(false.tolist())

    def _offset_of(self, boundary: Boundary) -> np.ndarray:
        return boundary.per_kind(*self._faults.lie_offset)

    def _falsify_round(self, message: UpMessage | DownMessage) -> UpMessage | DownMessage:
        message = self._falsify_information(message)
        totals = self._falsify_totals(message)
        if isinstance(message, UpMessage):
            return replace(message, totals=totals)
        return replace(message, totals=totals, verdict=self._faults.lie_verdict or self._find_verdict(message, totals))

    def _falsify_information(self, message: UpMessage | DownMessage) -> UpMessage | DownMessage:
        """|R y - z| of the true y is |R' y' - z'| of the false one: R' = R / scale, z' = z + R' offset."""
        power = self._falsify_y(message.boundary, message.power)
        if not message.R:
            return replace(message, power=power)
        R = read_triangle(message.R) / self._faults.lie_scale
        z = np.array(message.z) + R @ self._offset_of(message.boundary)
        return replace(message, R=write_triangle(R), z=tuple(z.tolist()), power=power)

    def _falsify_totals(self, message: RoundMessage) -> Totals:
        f, totals = self._faults, message.totals
        if f.lie_objective != 1.0:
            totals = replace(totals, objective=f.lie_objective * totals.objective)
        if f.lie_areas:
            totals = replace(totals, areas=f.lie_areas, silent=(), stale=())
        if f.lie_worst:
            totals = replace(totals, worst=((f.lie_worst, WORST),))
        return totals

    def _find_verdict(self, message: DownMessage, totals: Totals) -> str:
        """Verdict that follows from ``totals`` and from all totals sent before in this term.

        The true verdict where the lie is not about totals, or where the beginning of the term was not sent.
        """
        if not self._faults.lies_of_totals:
            return message.verdict
        header = message.header
        term = (header.incarnation, header.scan, message.revision)
        if (memory := Memory() if message.k == 0 else self._memories.get((*term, message.k))) is None:
            return message.verdict  # the beginning of the term was not sent
        if message.k == 0:
            self._memories = {}
        self._memories[*term, message.k + 1], verdict = decide(memory, totals)
        return str(verdict)
