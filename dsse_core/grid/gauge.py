"""Gauge of parts without ground, as behind a delta winding: a shunt fixes their voltages to ground, not physics.

A part is a set of buses whose common voltage, one for all conductors, draws no current: lines carry it on, banks with a
grounded winding end it. A shunt y 11'/n^2 at one of its buses makes the mean of the n voltages there 0. It carries no
current, since the currents of such a part add up to 0. Where line charging and bus shunts alone join a part to ground,
weakly, their share of the zero sequence is left out. There only voltages between phases mean anything. Where they join
it to ground firmly, the shunt stands in for them in the unloaded network, and draws nothing where they draw nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dsse_core.grid.network_table import NetworkTable
from dsse_core.grid.nodes import PHASES, list_phases
from dsse_core.printable import listed

NEGLIGIBLE = 1e-4  # relative: a smaller draw to ground is no ground, a smaller difference of voltages none
PIN = 1.0  # p.u., the admittance of the shunt

Change = tuple[int, float, float, float, float]
"""Part, and real and imaginary part of the change of what it draws at its common voltage, and at the unloaded one."""


@dataclass(frozen=True, slots=True)
class Gauge:
    """Buses, by ids. ``ungrounded``: their voltages to ground are by the gauge, those between phases by physics.

    ``pinned``: buses with the shunt, one of each part. Those that are not ungrounded have a ground by charging and
    bus shunts only, and the shunt stands in for it where these are left out. ``shares``: bus, phase, and real and
    imaginary part of the phase's share in their admittance to ground, by which the shunt weighs its voltage there.
    ``common``: of each bus of such a part, the part's pinned bus, the bus' common voltage where that has 1 p.u., and
    real and imaginary part of what the whole part draws at these.
    """

    ungrounded: tuple[int, ...] = ()
    pinned: tuple[int, ...] = ()
    shares: tuple[tuple[int, str, float, float], ...] = ()
    common: tuple[tuple[int, int, float, float, float], ...] = ()

    def within(self, buses: np.ndarray, owned: np.ndarray) -> Gauge:
        """The gauge of a part of the network with ``buses``, of which it holds the shunts of those ``owned``."""
        there, own = set(buses.tolist()), set(owned.tolist())
        ungrounded, pinned = (b for b in self.ungrounded if b in there), (b for b in self.pinned if b in own)
        shares, common = (s for s in self.shares if s[0] in own), (c for c in self.common if c[0] in there)
        return Gauge(tuple(ungrounded), tuple(pinned), tuple(shares), tuple(common))


def describe_ungrounded(buses: Sequence[int]) -> str:
    """Sentence on ``buses`` whose voltages to ground mean nothing; empty where there are none."""
    if not buses:
        return ""
    one = "has" if len(buses) == 1 else "have"
    return f"Bus {listed(buses)} {one} no path to ground: only voltages between phases mean anything there."


@dataclass(frozen=True)
class _Links:
    """Effects of branches on the common voltages of their ends.

    ``joins``: rows of two buses and the ratio of the common voltage of the second one to the first one's. ``grounded``:
    rows of buses.
    """

    joins: list[tuple[int, int, float]]
    grounded: set[int]


def find_gauge(table: NetworkTable, source: int | None) -> Gauge:
    """The gauge of a whole network with its source at the bus of row ``source``; None: nothing is known of ground."""
    if source is None or table.nodes.is_balanced:
        return Gauge()
    links = _find_links(table)
    ungrounded, pinned, shares, ids = [], [], list[tuple[int, str, float, float]](), table.bus_id.tolist()
    of_buses = list[tuple[int, int, float, float, float]]()
    for common in _find_parts(len(ids), links, source):
        rows = sorted(common)
        pinned.append(ids[max(rows, key=lambda row: (int(table.phases[row]).bit_count(), -row))])
        draws = _find_draws(table, common)
        total, drawn, of_pinned = sum(map(abs, draws.values())), sum(draws.values()), common[ids.index(pinned[-1])]
        shares += [(pinned[-1], phase, (y / total).real, (y / total).imag) for phase, y in draws.items()]
        ungrounded += [] if draws else [ids[row] for row in rows]
        y = drawn / of_pinned**2
        of_buses += [(ids[r], pinned[-1], common[r] / of_pinned, y.real, y.imag) for r in rows if draws]
    return Gauge(tuple(sorted(ungrounded, key=ids.index)), tuple(pinned), tuple(shares), tuple(of_buses))


def project_charging(charging: np.ndarray, ungrounded: Iterable[np.ndarray]) -> np.ndarray:
    """``charging`` over ports without the zero sequence of each of the sets of ports ``ungrounded``."""
    P = np.eye(len(charging))
    for ports in ungrounded:
        P[np.ix_(ports, ports)] -= 1 / max(1, len(ports))
    projected: np.ndarray = P @ charging @ P
    return projected


def _find_links(table: NetworkTable) -> _Links:
    links = _Links([], set())
    for place, free in zip(range(len(table.active)), _find_free(table), strict=True):
        f, t = int(table.f[place]), int(table.t[place])
        if len(free) == 0:
            links.grounded.update((f, t))
        elif len(free) == 1:
            one, other = abs(free[0]).tolist()
            if min(one, other) > NEGLIGIBLE:
                links.joins.append((f, t, other / one))
            else:
                links.grounded.add(t if one > other else f)
    return links


def _find_free(table: NetworkTable) -> list[np.ndarray]:
    """The common voltages of the two ends that draw nothing, of each branch in service, (k, 2)."""
    primitives = [table.primitives[k] for k in table.active.tolist()]
    n_from = np.array([len(list_phases(p.from_phases)) for p in primitives], dtype=int)
    n_port = np.array([len(p.y) for p in primitives], dtype=int)
    found = [np.zeros((0, 2))] * len(primitives)
    for n in np.unique(n_port).tolist():  # all of a size at once
        of_size = np.flatnonzero(n_port == n)
        y = np.array([primitives[k].y - primitives[k].charging for k in of_size.tolist()])
        at_from = np.arange(n) < n_from[of_size, None]
        of_end = np.stack([at_from, ~at_from], axis=-1)
        size = abs(y).sum(axis=2).max(axis=1, initial=1e-300)
        _, s, directions = np.linalg.svd(y @ of_end / size[:, None, None], full_matrices=False)
        for k, is_free, direction in zip(of_size.tolist(), s < NEGLIGIBLE, directions.conj(), strict=True):
            found[k] = direction[is_free]
    return found


def _find_parts(n_bus: int, links: _Links, source: int) -> Iterator[dict[int, float]]:
    """Each part without ground but by shunts and charging: row of a bus -> its common voltage, p.u."""
    beside: list[list[tuple[int, float]]] = [[] for _ in range(n_bus)]
    for f, t, ratio in links.joins:
        beside[f].append((t, ratio))
        beside[t].append((f, 1 / ratio))
    grounded, seen = links.grounded | {source}, set[int]()
    for start in range(n_bus):
        if start in seen:
            continue
        common, has_ground, queue = {start: 1.0}, False, [start]
        for row in queue:  # the queue grows
            has_ground = has_ground or row in grounded
            for other, ratio in beside[row]:
                if other not in common:
                    common[other] = common[row] * ratio
                    queue.append(other)
                elif abs(common[other] - common[row] * ratio) > NEGLIGIBLE * common[other]:
                    has_ground = True  # a loop whose ratios differ
        seen.update(common)
        if not has_ground:
            yield common


def _find_draws(table: NetworkTable, common: dict[int, float]) -> dict[str, complex]:
    """Phase -> what charging and bus shunts draw at the ``common`` voltage of a part; none if next to nothing."""
    of_bus = np.zeros(len(table.bus_id))
    of_bus[list(common)] = list(common.values())
    v = of_bus[table.nodes.item]
    to_ground, size = _draw(table, v)
    within, phase = v != 0, table.nodes.phase
    if abs(to_ground[within]).max() <= NEGLIGIBLE * size[within].max():
        return {}
    drawn = v * to_ground
    return {PHASES[k]: complex(drawn[phase == k].sum()) for k in np.unique(phase[within]).tolist()}


def _draw(table: NetworkTable, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Currents through charging and bus shunts at ``v``, and sizes of the branches' admittances, (n_nodes,)."""
    to_ground, size = np.zeros(len(v), dtype=complex), np.zeros(len(v))
    y, row, column = table.of_shunts
    np.add.at(to_ground, row, y * v[column])
    for place, k in enumerate(table.active.tolist()):
        p, ends = table.primitives[k], (place, len(table.active) + place)
        node = table.port_node[np.concatenate([table.ports.at(end) for end in ends])]
        np.add.at(to_ground, node, p.charging @ v[node])
        np.add.at(size, node, abs(p.y).sum(axis=1))
    return to_ground, size


def _find_common(table: NetworkTable, gauge: Gauge) -> dict[int, np.ndarray]:
    """Part -> its common voltage at the nodes with supply, (n_nodes,), of the parts with buses in ``table``."""
    of_parts: dict[int, np.ndarray] = {}
    for bus, part, ratio, *_ in gauge.common:
        at = table.nodes.item == table.rows.row_of(bus)
        of_parts.setdefault(part, np.zeros(len(at)))[at & ~table.is_dead] = ratio
    return of_parts


def draw_common(table: NetworkTable, gauge: Gauge, v: np.ndarray) -> dict[int, np.ndarray]:
    """Part -> parts of what charging and bus shunts draw at its common voltage and at ``v``, (4,)."""
    live, found = ~table.is_dead, {}
    for part, common in _find_common(table, gauge).items():
        drawn = common @ _draw(table, common)[0], common @ _draw(table, v * live)[0]
        found[part] = np.array([part for y in drawn for part in (y.real, y.imag)])
    return found


def shift_common(table: NetworkTable, gauge: Gauge, v: np.ndarray, changes: Sequence[Change]) -> np.ndarray:
    """Voltages ``v``, at which charging and bus shunts of each part draw no common current, after ``changes`` of what
    they draw: moved by the common voltage at which they draw none again; as they are where nothing is left to draw.
    """
    before = {part: complex(*y) for _, part, _, *y in gauge.common}
    of_parts, moved = _find_common(table, gauge), v.copy()
    for part, a, b, c, d in changes:
        y = before.get(part, 0.0) + complex(a, b)
        if part in of_parts and abs(y) > NEGLIGIBLE * abs(before[part]):
            moved -= complex(c, d) / y * of_parts[part]
    return moved
