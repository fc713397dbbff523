"""A network column by column: arrays for all that is computed from all of its buses and branches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from dsse_core.grid.columns import Rows, read_column, read_given
from dsse_core.grid.loads import Shunt
from dsse_core.grid.nodes import BALANCED, PHASES, PhaseRows, Primitive, list_phases, read_phases

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True)
class NetworkTable:
    """Columns of ``Bus``, shape (n_bus,), and of ``Branch``, (n_all_branches,), p.u. and rad.

    ``active`` (n_branch,): rows of the branches in service. Of these, in the order of the rows of the branch
    admittances: ``f``, ``t`` the rows of their ends, ``ys`` their series admittance, ``ends`` the admittance at each
    end, ``ratio`` their complex tap ratio. ``shunt`` (n_bus,) complex. ``phases`` (n_bus,): set of phases of each bus.
    ``primitives``: row of a branch -> its admittances over its ports, of all branches where buses have phases.
    ``shunts``: further ones, of some phases. ``dead``: rows of nodes without supply.
    """

    bus_id: np.ndarray
    base_kv: np.ndarray
    load: np.ndarray
    shunt: np.ndarray
    from_bus: np.ndarray
    to_bus: np.ndarray
    series: np.ndarray
    charging: np.ndarray
    tap: np.ndarray
    shift: np.ndarray
    in_service: np.ndarray
    phases: np.ndarray
    primitives: Mapping[int, Primitive]
    shunts: Sequence[Shunt] = ()
    dead: Sequence[int] = ()

    @cached_property
    def nodes(self) -> PhaseRows:
        """Nodes: the phases of the buses."""
        return PhaseRows(self.phases)

    @cached_property
    def ports(self) -> PhaseRows:
        """Ports: the phases of the from ends, then of the to ends, of the branches in service."""
        return PhaseRows(self.branch_phases[:, self.active].ravel())

    @cached_property
    def branch_phases(self) -> np.ndarray:
        """The sets of phases of the from and of the to ends of all branches, (2, n_all_branches)."""
        if self.nodes.is_balanced:
            return np.full((2, len(self.in_service)), BALANCED)
        primitives = [self.primitives[k] for k in range(len(self.in_service))]
        texts = [*(p.from_phases for p in primitives), *(p.to_phases for p in primitives)]
        return read_phases(texts).reshape(2, -1)

    @cached_property
    def is_dead(self) -> np.ndarray:
        """True for nodes without supply, (n_nodes,)."""
        found = np.zeros(len(self.nodes), dtype=bool)
        found[list(self.dead)] = True
        return found

    @cached_property
    def carrying(self) -> list[Primitive]:
        """The admittances over their ports of the branches in service, with phases, without their dead conductors."""
        found, n = [self.primitives[k] for k in self.active.tolist()], len(self.active)
        is_dead = self.is_dead[self.port_node]
        for k in np.unique(self.ports.item[is_dead] % n).tolist() if self.dead else ():
            found[k] = found[k].without(is_dead[np.concatenate([self.ports.at(k), self.ports.at(n + k)])])
        return found

    @cached_property
    def port_node(self) -> np.ndarray:
        """The node of each port, (n_port,)."""
        bus: np.ndarray = np.concatenate([self.f, self.t])[self.ports.item]
        return self.nodes.find(bus, self.ports.phase)

    @cached_property
    def of_shunts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Entries, rows and columns, both nodes, of the admittances of shunts; the first ones stand at each node.

        A shunt of a bus stands at each of its nodes, one of a leg between the two ends of it, if both live.
        """
        own, nodes = np.arange(len(self.nodes)), self.nodes
        y, row, column = [self.shunt[nodes.item]], [own], [own]
        for shunt in self.shunts:
            phase = np.array([PHASES.index(name) for name in list_phases(shunt.phases)])
            ends = nodes.find(np.full(len(phase), self.rows.row_of(shunt.bus)), phase)
            if self.is_dead[ends].any():
                continue
            sign = np.array([1.0, -1.0])[: len(ends)]
            y.append(shunt.y * np.outer(sign, sign).ravel())
            row.append(np.repeat(ends, len(ends)))
            column.append(np.tile(ends, len(ends)))
        return np.concatenate(y), np.concatenate(row), np.concatenate(column)

    @cached_property
    def of_ports(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns, both ports, of the entries of the admittances of branches, matrix by matrix, of balanced
        ones those of all yff, yft, ytf, ytt.
        """
        ends = len(self.active)
        if self.nodes.is_balanced:
            f, t = np.arange(2 * ends).reshape(2, -1)
            return np.concatenate([f, f, t, t]), np.concatenate([f, t, f, t])
        nothing = np.zeros(0, dtype=np.int64)
        ports = [np.concatenate([self.ports.at(k), self.ports.at(ends + k)]) for k in range(ends)]
        row = np.concatenate([nothing, *(np.repeat(of_branch, len(of_branch)) for of_branch in ports)])
        return row, np.concatenate([nothing, *(np.tile(of_branch, len(of_branch)) for of_branch in ports)])

    @cached_property
    def rows(self) -> Rows:
        return Rows(self.bus_id)

    @cached_property
    def active(self) -> np.ndarray:
        return np.flatnonzero(self.in_service)

    @cached_property
    def end_rows(self) -> np.ndarray:
        """Rows of the from and the to buses of all branches, (2, n_all_branches); -1 where there is no such bus."""
        return self.rows.find(np.concatenate([self.from_bus, self.to_bus])).reshape(2, -1)

    @cached_property
    def f(self) -> np.ndarray:
        f: np.ndarray = self.end_rows[0, self.active]
        return f

    @cached_property
    def t(self) -> np.ndarray:
        t: np.ndarray = self.end_rows[1, self.active]
        return t

    @cached_property
    def ys(self) -> np.ndarray:
        ys: np.ndarray = 1 / self.series[self.active]
        return ys

    @cached_property
    def ends(self) -> np.ndarray:
        ends: np.ndarray = 0.5 * self.charging[self.active]
        return ends

    @cached_property
    def ratio(self) -> np.ndarray:
        ratio: np.ndarray = self.tap[self.active] * np.exp(1j * self.shift[self.active])
        return ratio

    @cached_property
    def active_row(self) -> np.ndarray:
        """The place of each branch among those in service, -1 for the others, shape (n_all_branches,)."""
        row = np.full(len(self.in_service), -1)
        row[self.active] = np.arange(len(self.active))
        return row

    @cached_property
    def graph(self) -> csr_array:
        """An entry for each branch in service, at the buses that it joins, (n_bus, n_bus)."""
        return _build_graph(self.f, self.t, len(self.bus_id))

    @cached_property
    def island(self) -> np.ndarray:
        """A number for each bus, (n_bus,), equal where a path of branches in service joins two."""
        from scipy.sparse.csgraph import connected_components

        number: np.ndarray = connected_components(self.graph, directed=False)[1]
        return number

    @cached_property
    def node_island(self) -> np.ndarray:
        """A number for each node, (n_nodes,), equal where a path of conductors and windings in service joins two."""
        return self.island if self.nodes.is_balanced else self.find_islands()

    def find_islands(self, without: int = -1) -> np.ndarray:
        """``node_island`` where the branch ``without``, by its row, does not count."""
        from scipy.sparse.csgraph import connected_components

        branch, row, column = self.joints
        row, column = row[branch != without], column[branch != without]
        graph = _build_graph(row, column, len(self.nodes))
        number: np.ndarray = connected_components(graph, directed=False)[1]
        return number

    @cached_property
    def joints(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Row of the branch of each conductor and winding in service, and the two nodes that it joins.

        A line joins each phase with itself: its coupling carries no power to a phase that nothing feeds.
        """
        if self.nodes.is_balanced:
            return self.active, self.f, self.t
        joints: list[np.ndarray] = [np.zeros((3, 0), dtype=np.int64)]
        for place, k in enumerate(self.active.tolist()):
            ports = np.concatenate([self.ports.at(place), self.ports.at(len(self.active) + place)])
            ends = self.port_node[ports[self.primitives[k].joined_ports]]
            joints.append(np.vstack([np.full(ends.shape[1], k), ends]))
        branch, row, column = np.hstack(joints)
        return branch, row, column

    def is_possible(self) -> bool:
        """True where values, ids and ends of all buses and branches are possible; ids of branches are not checked."""
        complex_ones = (column.view(float) for column in (self.load, self.shunt, self.series, self.charging))
        numbers = np.concatenate([self.base_kv, self.tap, self.shift, *complex_ones])
        return bool(
            len(self.bus_id) > 0
            and self.rows.are_unique
            and np.isfinite(numbers).all()
            and self.base_kv.min() > 0
            and self.tap.min(initial=1.0) > 0
            and self.series.all()
            and self.end_rows.min(initial=0) >= 0
            and (self.end_rows[0] != self.end_rows[1]).all()
            and (self._have_possible_phases() if self.primitives else self.nodes.is_balanced)
        )

    def _have_possible_phases(self) -> bool:
        """True where each bus has phases, and each branch some of both its buses and finite admittances over them."""
        if len(self.primitives) < len(self.in_service) or not self.phases.all() or (self.phases & BALANCED).any():
            return False
        if not self.branch_phases.all() or (self.branch_phases & ~self.phases[self.end_rows]).any():
            return False
        matrices = [(p.y, p.charging) for p in self.primitives.values()]
        n_ports = np.bitwise_count(self.branch_phases).sum(axis=0).tolist()
        are_square = all(y.shape == c.shape == (n, n) for (y, c), n in zip(matrices, n_ports, strict=True))
        return are_square and bool(np.isfinite(np.concatenate([m.ravel() for both in matrices for m in both])).all())


def _build_graph(f: np.ndarray, t: np.ndarray, n: int) -> csr_array:
    """An entry for each edge from ``f`` to ``t`` (n_edge,), by rows, in order, (n, n)."""
    from scipy.sparse import csr_array  # the import takes 0.1 s, and nothing else of a network needs it

    order = np.lexsort((t, f))
    return csr_array((np.ones(len(f)), t[order], np.searchsorted(f[order], np.arange(n + 1))), shape=(n, n))


def tabulate(
    buses: Sequence[Any], branches: Sequence[Any], shunts: Sequence[Shunt] = (), dead: Sequence[int] = ()
) -> NetworkTable:
    """The columns of all ``Bus`` and ``Branch`` of a network, which are visited once, its further ``shunts``, and the
    rows of its ``dead`` nodes.
    """
    p, q, g_shunt, b_shunt = (read_column(buses, name, float) for name in ("p_load", "q_load", "g_shunt", "b_shunt"))
    r, x, g, b = (read_column(branches, name, float) for name in ("r", "x", "g", "b"))
    return NetworkTable(
        bus_id=read_column(buses, "id", np.int64),
        base_kv=read_column(buses, "base_kv", float),
        load=_complex(p, q),
        shunt=_complex(g_shunt, b_shunt),
        from_bus=read_column(branches, "from_bus", np.int64),
        to_bus=read_column(branches, "to_bus", np.int64),
        series=_complex(r, x),
        charging=_complex(g, b),
        tap=read_column(branches, "tap", float),
        shift=read_column(branches, "shift", float),
        in_service=read_column(branches, "in_service", bool),
        phases=_read_phases(buses),
        primitives=_read_primitives(branches),
        shunts=shunts,
        dead=dead,
    )


def _read_primitives(branches: Sequence[Any]) -> dict[int, Primitive]:
    found = tuple(read_given(branches, "primitive"))
    return {k: primitive for k, primitive in enumerate(found) if primitive} if any(found) else {}


def _read_phases(buses: Sequence[Any]) -> np.ndarray:
    texts = tuple(read_given(buses, "phases"))
    return read_phases(texts) if any(texts) else np.full(len(buses), BALANCED)


def _complex(real: np.ndarray, imag: np.ndarray) -> np.ndarray:
    """``real + 1j * imag``, right for infinite numbers, too."""
    number = real.astype(complex)
    number.imag = imag
    return number
