"""Injections that need no reading: nodes that inject exactly nothing, and buses with legs between phases alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dsse_core.grid.loads import GROUND
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import list_phases


@dataclass(frozen=True)
class Injections:
    """Loads and sources of ``network``, node by node; a shunt is part of the network, not an injection."""

    network: Network

    @cached_property
    def is_fed(self) -> np.ndarray:
        """True for each node with a source, (n_nodes,)."""
        is_fed = np.zeros(self.network.n_nodes, dtype=bool)
        for generator in self.network.generators:
            is_fed[self.network.nodes_at(generator.bus)] = True
        return is_fed

    @cached_property
    def is_idle(self) -> np.ndarray:
        """True for each node without load and source, (n_nodes,)."""
        is_idle = ~self.is_fed
        is_idle[self._ends[self._ends != GROUND]] = False
        return is_idle

    @cached_property
    def _ends(self) -> np.ndarray:
        """The nodes between which legs draw power, (2, n_leg); the second is GROUND for legs to the ground."""
        legs = self.network.legs
        draws = legs.s != 0
        return np.stack([legs.node[draws], legs.other[draws]])

    @cached_property
    def pairs(self) -> np.ndarray:
        """The pairs of nodes with legs between them, each once, the one with the lower row first, (2, n_pair)."""
        between = self._ends[:, self._ends[1] != GROUND]
        pairs: np.ndarray = np.unique(np.sort(between, axis=0), axis=1) if between.size else between
        return pairs

    @cached_property
    def is_alone(self) -> np.ndarray:
        """True for each end of ``pairs`` where nothing else draws or feeds power, (2, n_pair).

        The current of that node is the current of the legs, so that a meter can read their power there.
        """
        to_ground, n = self._ends[0, self._ends[1] == GROUND], self.network.n_nodes
        degree = np.bincount(self.pairs.ravel(), minlength=n) + np.bincount(to_ground, minlength=n) + self.is_fed
        is_alone: np.ndarray = degree[self.pairs] == 1
        return is_alone

    @cached_property
    def legs(self) -> np.ndarray:
        """The pairs whose power a meter can read, (2, n_leg): first the node where it reads it."""
        can_be = self.is_alone.any(axis=0)
        pairs: np.ndarray = self.pairs[:, can_be]
        return np.where(self.is_alone[0, can_be], pairs, pairs[::-1])

    def can_read(self, node: int, other: int) -> bool | None:
        """True where a meter at ``node`` can read the power between two nodes; None where no legs stand there."""
        at = (self.pairs[0] == min(node, other)) & (self.pairs[1] == max(node, other))
        return bool(self.is_alone[int(node > other), at].any()) if at.any() else None

    def find_problem_of_leg(self, bus: int, phases: str) -> tuple[str, str]:
        """The problem of a meter of the power between two ``phases`` that stand at ``bus``, and its cure, as text.

        Empty where it can read that power.
        """
        one, two = list_phases(phases)
        first, other = (self.network.node(bus, phase) for phase in (one, two))
        if can_read := self.can_read(first, other):
            return "", ""
        if can_read is None:
            return f"no load of bus {bus} stands between {one} and {two}", "name one phase"
        cure = f"name the leg '{bus}.{two}{one}'" if self.can_read(other, first) else "meter each phase"
        return f"other loads of bus {bus} draw at {one}, and a meter reads the current there", cure

    @cached_property
    def sums_to_zero(self) -> np.ndarray:
        """True for each bus with loads, all of them between phases, and no source: its currents sum to 0; (n_bus,)."""
        item, n = self.network.table.nodes.item, len(self.network.table.bus_id)
        to_ground = item[self._ends[0, self._ends[1] == GROUND]], item[self.is_fed]
        drawn = np.bincount(item[self.pairs[0]], minlength=n) > 0
        for buses in to_ground:
            drawn[buses] = False
        return drawn

    def list_by_leg(self, is_bound: np.ndarray) -> np.ndarray:
        """Those of ``legs`` at the buses of ``is_bound`` (n_bus,) where they are all pairs, (2, n)."""
        if not is_bound.any():
            return self.pairs[:, :0]
        item, n = self.network.table.nodes.item, len(is_bound)
        at_bus = item[self.legs[0]]
        is_whole = np.bincount(item[self.pairs[0]], minlength=n) == np.bincount(at_bus, minlength=n)
        legs: np.ndarray = self.legs[:, (is_whole & is_bound)[at_bus]]
        return legs
