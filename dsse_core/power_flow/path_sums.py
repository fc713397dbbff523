"""Power flow of radial networks by backward and forward sweeps, each a handful of operations on whole arrays.

In the order of a walk from the root a subtree is one piece, so that the sum over it is a difference of two sums from
the root on. Along the tour that enters and leaves every bus, the sum over the buses entered and not left yet is the sum
over the path from the root.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dsse_core.grid.admittance import follow
from dsse_core.grid.network import Network
from dsse_core.grid.radial_order import find_tree

SMALLEST_CHANGE = 1e-13  # p.u., of any voltage's parts, by the sweep to come; sweeps gain a digit or more each
MOST_SWEEPS = 50  # where more are needed Newton's method does better


@dataclass(frozen=True)
class TreePaths:
    """A radial network in the order of a walk from its root, shape (n_bus,) each, relative to its no-load voltages v0.

    ``order``: network row of each bus. ``parent``: the place of the next bus on the way to the root; the root's is 0.
    ``end``: the place after the last bus of its subtree. ``enter``, ``leave``: the steps at which the tour enters and
    leaves it. ``z``: series impedance of the branch above it, at the child's side of its tap, divided by ``|v0|^2`` of
    the child; 0 at the root. ``y``: shunts and charging at the bus, times ``|v0|^2``.
    """

    order: np.ndarray
    parent: np.ndarray
    end: np.ndarray
    enter: np.ndarray
    leave: np.ndarray
    z: np.ndarray
    y: np.ndarray


def lay_out_paths(network: Network, root: int, vm: np.ndarray) -> TreePaths | str:
    """The tree with bus ``root`` on top, or, as text, why the network is no tree.

    ``vm`` (n_bus,): voltage magnitudes without load, p.u., network order.
    """
    tree = find_tree(network, root)
    if isinstance(tree, str):
        return tree
    order, table, n = tree.order, network.table, len(tree.order)
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    parent, f, t = place[tree.upstream[order]], place[tree.f], place[tree.t]
    depth = follow(parent, np.minimum(np.arange(n), 1), np.add)
    end = _find_ends(parent)
    square, squared_tap = vm[order] ** 2, table.tap[table.active] ** 2
    z, y = np.zeros(n, dtype=complex), table.shunt[order]
    np.add.at(y, f, table.ends / squared_tap)
    np.add.at(y, t, table.ends)
    z[np.maximum(f, t)] = np.where(f < t, 1.0, squared_tap) / table.ys
    enter = 2 * np.arange(n) - depth
    return TreePaths(order, parent, end, enter, 2 * end - depth - 1, z / square, y * square)


def _find_ends(parent: np.ndarray) -> np.ndarray:
    """``end`` of buses in the order of a walk: where the next child of the parent is, else where the parent's is."""
    n = len(parent)
    children = 1 + np.argsort(parent[1:], kind="stable")
    is_last = np.append(np.diff(parent[children]) != 0, True)[: n - 1]
    end, ends_with = np.full(n, n), np.arange(n)
    end[children[:-1]] = children[1:]
    last = children[is_last]
    ends_with[last] = parent[last]
    while True:
        further = ends_with[ends_with]
        if (further == ends_with).all():
            break
        ends_with = further
    end[0] = n
    found: np.ndarray = end[ends_with]
    return found


def sweep_paths(paths: TreePaths, scheduled: np.ndarray) -> tuple[np.ndarray, np.ndarray, int] | None:
    """The voltages divided by the voltages without load, complex, the powers that the buses inject, complex, p.u., and
    the number of sweeps; None where sweeps do not converge.

    ``scheduled`` injections are complex, p.u., (n_bus,), in network order as the results. With the voltages u = v / v0
    and ``J = conj(v0) i``, the current that a branch carries and its tap does not change, from the leaves to the root
    ``J = sum of conj(s / u) - y u over the subtree``, and on the way back ``u = 1 + sum of z J over the path``.
    """
    n, s = len(paths.order), scheduled[paths.order].conj()
    has_shunts, before = bool(paths.y.any()), 1.0
    sums, tour, path = np.zeros(n + 1, dtype=complex), np.empty(2 * n, dtype=complex), np.empty(2 * n, dtype=complex)
    J, following, u = sums[1:], np.empty(n, dtype=complex), np.ones(n, dtype=complex)
    with np.errstate(all="ignore"):
        for sweep in range(1, MOST_SWEEPS + 1):
            np.divide(s, np.conj(u, out=following), out=J)
            if has_shunts:
                J -= np.multiply(paths.y, u, out=following)
            J.cumsum(out=J)
            drop = sums.take(paths.end, out=following, mode="clip")
            drop -= sums[:n]
            drop *= paths.z
            tour[paths.enter] = drop
            tour[paths.leave] = np.negative(drop, out=drop)
            tour.cumsum(out=path).take(paths.enter, out=following, mode="clip")
            following += 1.0
            u -= following
            change = float(np.abs(u.view(float)).max())
            u, following = following, u
            if not change < np.inf:
                return None
            if change * change < SMALLEST_CHANGE * before:
                found = np.empty((2, n), dtype=complex)
                found[:, paths.order] = u, _find_injections(paths, u)
                return found[0], found[1], sweep
            before = change
    return None


def _find_injections(paths: TreePaths, u: np.ndarray) -> np.ndarray:
    """The powers that buses at voltages ``u`` inject, complex, p.u.; (n_bus,) each, in the order of the walk."""
    n, parent = len(u), paths.parent[1:]
    into = (u[parent] - u[1:]) / paths.z[1:]
    J = paths.y * u
    J[1:] -= into
    J.real += np.bincount(parent, into.real, n)
    J.imag += np.bincount(parent, into.imag, n)
    injection: np.ndarray = u * J.conj()
    return injection
