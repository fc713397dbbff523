"""Bus and branch admittances of a network (MATPOWER ``makeYbus``), sparse, p.u."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dsse_core.errors import InvalidInputError
from dsse_core.grid.gauge import NEGLIGIBLE, PIN, project_charging
from dsse_core.grid.network import Network
from dsse_core.grid.network_table import NetworkTable
from dsse_core.grid.nodes import PHASE_ANGLE
from dsse_core.printable import listed

GROUNDED = 1e-13  # share of a node's admittance, below ten times of which a pivot is rounding: without path to ground


@dataclass(frozen=True)
class Admittance:
    """Admittances. ``stacked`` (n + n_port, n): ``ybus`` (n, n), and below it a row for each port.

    For voltages ``v`` of the nodes ``stacked v`` are the currents into the network at each node, then into each port.
    Rows follow ``nodes.py``: in a balanced network ``ybus`` the buses, ports the from ends, then the to ends, of
    ``network.active_branches``. Every row stores an entry, be it zero, for its own node.
    """

    stacked: sp.csr_array

    @cached_property
    def ybus(self) -> sp.csr_array:
        return sp.csr_array(self.stacked[: self.stacked.shape[1]])


def build_admittance(network: Network, *, with_shunts: bool = True) -> Admittance:
    """Builds ``[A' Yp A + diag(shunt); Yp A]``: Yp the admittances of branches over their ports, A the nodes of ports.

    ``with_shunts=False`` leaves out shunts and charging, all that draws current without load.
    """
    table, n = network.table, network.n_nodes
    y, node, (row, column) = find_primitives(network, with_shunts), table.port_node, table.of_ports
    of_shunts, at, other = find_shunts(network)
    parts = [(y, node[row], node[column]), (of_shunts * with_shunts, at, other), (y, n + row, node[column])]
    parts += list(_find_pins(network, with_shunts))
    entries, row, column = (np.concatenate(of) for of in zip(*parts, strict=True))
    return Admittance(sp.coo_array((entries, (row, column)), shape=(n + len(table.ports), n)).tocsr())


def find_shunts(network: Network) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``NetworkTable.of_shunts``; those of a bus without ground draw no common current of its phases."""
    of_shunts = network.table.of_shunts
    if not network.gauge.ungrounded:
        return of_shunts
    y, row, column = of_shunts
    whole, parts = sp.csr_array((y, (row, column)), shape=(network.n_nodes,) * 2), [of_shunts]
    for at in map(network.live_nodes_at, network.gauge.ungrounded):
        of_bus = whole[at][:, at].toarray()
        without = project_charging(of_bus, [np.arange(len(at))]) - of_bus
        parts.append((without.ravel(), np.repeat(at, len(at)), np.tile(at, len(at))))
    y, row, column = (np.concatenate(of) for of in zip(*parts, strict=True))
    return y, row, column


def find_primitives(network: Network, with_shunts: bool) -> np.ndarray:
    """The entries of Yp of the branches in service, (nnz,), in the order of ``NetworkTable.of_ports``."""
    table = network.table
    if table.nodes.is_balanced:
        return np.concatenate(find_two_ports(table, table.active, with_shunts))
    ungrounded, matrices = set(network.gauge.ungrounded), [np.zeros(0)]
    ends = table.from_bus[table.active].tolist(), table.to_bus[table.active].tolist()
    for place, (p, *buses) in enumerate(zip(table.carrying, *ends, strict=True)):
        y = p.y if with_shunts else p.y - p.charging
        if with_shunts and not ungrounded.isdisjoint(buses):
            y = p.y - p.charging + project_charging(p.charging, _find_ungrounded_ports(table, place, buses, ungrounded))
        matrices.append(y.ravel())
    return np.concatenate(matrices)


def _find_ungrounded_ports(
    table: NetworkTable, place: int, buses: Sequence[int], ungrounded: Collection[int]
) -> Iterator[np.ndarray]:
    """The live ports at each end of a branch in service that is at one of the buses ``ungrounded``."""
    at_ends = [table.ports.at(place), table.ports.at(len(table.active) + place)]
    ends = np.repeat([0, 1], list(map(len, at_ends)))
    lives = ~table.is_dead[table.port_node[np.concatenate(at_ends)]]
    for end, bus in enumerate(buses):
        if bus in ungrounded:
            yield np.flatnonzero(lives & (ends == end))


def _find_pins(network: Network, with_shunts: bool) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Entries, rows and columns of the gauge's own shunts."""
    shares = {(bus, phase): complex(*parts) for bus, phase, *parts in network.gauge.shares}
    for bus in network.gauge.pinned:
        at = network.live_nodes_at(bus)
        if len(at) and (not with_shunts or bus in network.gauge.ungrounded):
            of_phases = [shares.get(network.nodes[node], 1 / len(at)) for node in at.tolist()]
            yield np.tile(of_phases, len(at)) * (PIN / len(at)), np.repeat(at, len(at)), np.tile(at, len(at))


def find_two_ports(
    table: NetworkTable, branches: np.ndarray, with_shunts: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """yff, yft, ytf, ytt of the ``branches``, by rows, (k,), of a balanced network.

    A branch with tap ``t = tap * exp(j shift)`` at its from side has ``yff = (ys + (g + j b) / 2) / |t|^2``,
    ``yft = -ys / conj(t)``, ``ytf = -ys / t``, ``ytt = ys + (g + j b) / 2``.
    """
    ys, ratio = 1 / table.series[branches], table.tap[branches] * np.exp(1j * table.shift[branches])
    ytt = ys + 0.5 * table.charging[branches] * with_shunts
    return ytt / abs(ratio) ** 2, -ys / ratio.conj(), -ys / ratio, ytt


def flat_start(
    network: Network, reference: int, held: Mapping[int, float] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """``find_no_load`` with angles within half a turn."""
    vm, va = find_no_load(network, reference, held)
    return vm, np.angle(np.exp(1j * va))


def find_no_load(
    network: Network,
    reference: int,
    held: Mapping[int, float] | None = None,
    angles: Mapping[int, float] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The voltages (vm, va) of the unloaded network, p.u. and rad; angles may be beyond half a turn.

    ``held``: bus -> the magnitude there, p.u.; 1 p.u. at ``reference`` unless it is given. ``angles``: bus -> the angle
    there, rad; 0 rad at ``reference`` unless it is given.
    On a tree a walk from the reference follows tap ratios and phase shifts. Where loops close with another voltage than
    they began with, or further buses hold theirs, magnitudes and angles balance, each for themselves:

        sum |ys| (vm_f / tap - vm_t)^2 -> min,    sum |ys| (va_f - shift - va_t)^2 -> min

    In a meshed network taps follow the loads, and along a walk they add up to voltages that no bus has. Parts of a
    network that share one bus can each be balanced alone. With phases no current flows at any node but those of the
    reference, which are a symmetrical source; there alone voltages can be given.
    """
    if not network.table.nodes.is_balanced:
        return _find_idle(network, reference, (held or {}).get(reference, 1.0), (angles or {}).get(reference, 0.0))
    table, held = network.table, {reference: 1.0} | dict(held or {})
    angles = {reference: 0.0} | dict(angles or {})
    n, active = len(table.bus_id), table.active
    tap, shift = table.tap[active], table.shift[active]
    vm, va, is_given = np.ones(n), np.zeros(n), np.zeros(n, dtype=bool)
    turns, transforms = bool((shift != 0.0).any()), bool((tap != 1.0).any())
    if turns or transforms:
        vm, va = _walk(network, reference, tap, shift)
    vm, va = vm * held[reference], va + angles[reference]
    for bus, angle in angles.items():
        va[network.row[bus]], is_given[network.row[bus]] = angle, True
    has_loops = len(active) > n - table.island.max() - 1
    if (turns and has_loops) or len(angles) > 1:
        va = _balance(table, np.ones(len(active)), shift, is_given, va)
    is_given[:] = False
    for bus, magnitude in held.items():
        vm[network.row[bus]], is_given[network.row[bus]] = magnitude, True
    if (transforms and has_loops) or len(held) > 1:
        vm = _balance(table, 1 / tap, np.zeros(len(active)), is_given, vm)
    return vm, va


def _find_idle(network: Network, reference: int, vm: float, va: float) -> tuple[np.ndarray, np.ndarray]:
    """vm and va of the nodes where no current flows; nodes out of reach have those of the source.

    Raises:
        InvalidInputError: phases that nothing joins to the source or to ground, as behind a delta winding, or that
            shunts hold at a voltage of 0, where an angle means nothing.
    """
    table, ybus = network.table, build_admittance(network, with_shunts=False).ybus
    source = vm * np.exp(1j * (va + PHASE_ANGLE[table.nodes.phase]))
    given = network.nodes_at(reference)
    is_reached = np.isin(table.node_island, table.node_island[given])
    free = np.setdiff1d(np.flatnonzero(is_reached), given)
    if len(free):
        y = ybus[free][:, free].tocsc()
        try:
            lu = spla.splu(y)
        except RuntimeError:  # SuperLU: exactly singular
            lu = spla.splu(y + GROUNDED * sp.diags_array(abs(y.diagonal()), format="csc"))
        loose = abs(lu.U.diagonal())[lu.perm_c] <= 10 * GROUNDED * abs(y.diagonal())
        if loose.any():
            names = ", ".join(map(str, np.unique(table.bus_id[table.nodes.item[free[loose]]]).tolist()))
            cure = "ground a winding of their bank, or feed all its phases"
            problem = f"nothing joins phases of bus {names} to the source or to ground; {cure}"
            raise InvalidInputError(f"network {network.name!r}", [problem])
        source[free] = lu.solve(-(ybus[free][:, given] @ source[given]))
        dark = free[abs(source[free]) < NEGLIGIBLE].tolist()
        if grounded := [node for node in dark if network.node_buses[node] not in network.gauge.ungrounded]:
            names = listed([network.node_names[node] for node in grounded])
            cure = "give their other phases shunts to ground, too, or none of them"
            problem = f"shunts to ground hold {names} at a voltage of 0, which has no angle; {cure}"
            raise InvalidInputError(f"network {network.name!r}", [problem])
    return abs(source), np.angle(source)


def carry_currents(network: Network, held: np.ndarray) -> np.ndarray:
    """The currents (n_held, n_nodes) into the network at nodes of given voltage for a load of current 1 at each node.

    With the voltages of the ``held`` nodes given, and i the others, ``-Yhi Yii^-1``, and 1 at held nodes themselves. A
    part without path to ground or to held nodes has currents that sum to zero: GROUNDED carries none of them.
    """
    ybus, n = build_admittance(network, with_shunts=False).ybus, network.n_nodes
    free = np.setdiff1d(np.arange(n), held)
    carried = np.zeros((len(held), n), dtype=complex)
    carried[np.arange(len(held)), held] = 1.0
    if len(free):
        y = ybus[free][:, free].tocsc()
        size = abs(y.diagonal())
        size[size == 0] = 1.0  # of a node with open branches only
        grounded = (y + GROUNDED * sp.diags_array(size, format="csc")).tocsc()
        carried[:, free] = -spla.splu(grounded).solve(ybus[held][:, free].T.toarray(), trans="T").T
    return carried


def _walk(network: Network, reference: int, tap: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """vm and va along a tree of branches from 1 p.u., 0 rad, (n_bus,); buses out of reach keep 1 p.u., 0 rad."""
    from scipy.sparse.csgraph import breadth_first_order

    table = network.table
    n, start = len(table.bus_id), network.row[reference]
    _, above = breadth_first_order(table.graph, start, directed=False)
    gain, turn = np.ones(n), np.zeros(n)  # from the bus above; observability names buses out of reach
    for here, there, factor, angle in ((table.t, table.f, tap, shift), (table.f, table.t, 1 / tap, -shift)):
        walked = np.flatnonzero(above[there] == here)[::-1]  # of parallel branches the first
        gain[there[walked]], turn[there[walked]] = factor[walked], angle[walked]
    above = np.where(above < 0, np.arange(n), above)
    return follow(above, gain, np.multiply), follow(above, turn, np.add)


def _balance(
    table: NetworkTable, gain: np.ndarray, offset: np.ndarray, is_given: np.ndarray, values: np.ndarray
) -> np.ndarray:
    """The ``values`` (n_bus,) that minimise sum |ys| (gain v_f - offset - v_t)^2; the given values stay.

    ``gain``, ``offset``: (n_branch,). Buses that no branch joins to a given one keep their value.
    """
    n, branch, weight = len(values), np.arange(len(gain)), np.sqrt(abs(table.ys))
    A = sp.csr_array(
        (np.r_[weight * gain, -weight], (np.r_[branch, branch], np.r_[table.f, table.t])), shape=(len(branch), n)
    )
    free = np.flatnonzero(~is_given & np.isin(table.island, table.island[is_given]))
    values = values.copy()
    values[free] = 0.0
    if len(free):
        A_free = A[:, free]
        values[free] = spla.splu((A_free.T @ A_free).tocsc()).solve(A_free.T @ (weight * offset - A @ values))
    return values


def follow(above: np.ndarray, own: np.ndarray, join: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """``own`` of each bus joined with those of all buses above it, (n_bus,), in log2(depth) steps.

    ``above`` (n_bus,): the next bus on the way to the top, there the bus itself, whose ``own`` changes nothing.
    """
    while True:
        further = above[above]
        own = join(own, own[above])
        if (further == above).all():
            return own
        above = further
