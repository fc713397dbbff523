"""Radial networks: their buses from the root outwards; and an order of elimination that fills in nothing, or little."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.sparse import csgraph

from dsse_core.grid.measurement_model import MeasurementModel
from dsse_core.grid.meter_table import OF_BRANCH
from dsse_core.grid.network import Network


@dataclass(frozen=True)
class Tree:
    """A radial network by rows, not ids. ``order`` (n_bus,): from the root, a subtree in one piece. ``upstream``
    (n_bus,): the row next on the way to the root; the root's is its own. ``f``, ``t``: ends of the branches in service.
    """

    order: np.ndarray
    upstream: np.ndarray
    f: np.ndarray
    t: np.ndarray


def walk_graph(graph: sp.csr_array, top: int) -> tuple[np.ndarray, np.ndarray]:
    """The rows of ``graph`` (n, n) that its edges join to ``top``: from the top, a subtree in one piece; and for each
    row the next row on the way to the top, (n,), at the top its own.
    """
    order, upstream = csgraph.depth_first_order(graph, top, directed=False, return_predecessors=True)
    upstream = upstream.astype(np.int64)
    upstream[top] = top
    return order.astype(np.int64), upstream


def find_tree(network: Network, root: int) -> Tree | str:
    """The tree of the network below bus ``root``, or, as text, why the network is no tree."""
    table = network.table
    f, t, n = table.f, table.t, len(table.bus_id)
    order, upstream = walk_graph(table.graph, table.rows.row_of(root))
    return describe_no_tree(n, len(f), len(order), root) or Tree(order, upstream, f, t)


def describe_no_tree(n_bus: int, n_branch: int, reached: int, root: int) -> str:
    """The reason why ``n_branch`` branches are no tree of ``n_bus`` buses, as text; empty if they are.

    ``reached``: number of buses that the branches join to bus ``root``, itself included.
    """
    if n_branch != n_bus - 1:
        return f"the network is not radial: {n_bus} buses, {n_branch} branches in service"
    if reached != n_bus:
        return f"the network is not radial: {n_bus - reached} buses are out of reach of bus {root}"
    return ""


@dataclass(frozen=True)
class TableauOrder:
    """An order of elimination. ``rows`` (n_row + n_column,): the tableau's rows in that order. ``fills_in``: whether
    the factor is fuller than the tableau, so that pivots must not be moved far. ``blocks`` (n_row + n_column,): the
    place of the bus that each of these rows belongs to, in a tree; None with loops.
    """

    rows: np.ndarray
    fills_in: bool
    blocks: np.ndarray | None


def order_tableau(
    network: Network,
    root: int,
    model: MeasurementModel,
    free: np.ndarray,
    *,
    powers: Sequence[int] = (),
    others: sp.csr_array | None = None,
    read: MeasurementModel | None = None,
) -> TableauOrder:
    """The order of the tableau [meters, other rows, read meters; columns ``free``, readings of the read meters].

    Buses come one after another: from the leaves of a tree to ``root``; with loops as ``order_buses`` says. Inside a
    bus: its injections, the other meters there and on branches to buses that follow, then its voltage.
    An injection joins the multipliers of a bus to the voltages of its neighbours and no others, so that the tableau, in
    blocks of a bus, has the pattern of the network: a tree is eliminated from the leaves to the root.

    Args:
        free: positions in x = [va; vm; powers; taps] of the columns.
        powers: the nodes of these powers.
        others: further rows in the columns ``free``; each comes just before the last of its columns.
        read: meters whose readings are further columns, beside the voltages of their bus.
    """
    tree, n = find_tree(network, root), len(network.table.bus_id)
    if has_loops := isinstance(tree, str):
        place = order_buses(network)
    else:
        place = np.empty(n, dtype=np.int64)
        place[tree.order[::-1]] = np.arange(n)
    place = place[network.table.nodes.item]
    of_voltages = 3 * place + 2
    at_taps = network.table.f[[*network.estimated_taps.values()]]
    further = of_voltages[np.concatenate([np.array(powers, dtype=int), at_taps])]
    of_columns = np.concatenate([of_voltages, of_voltages, further])[free]
    of_rows = [_place_meters(place, model)]
    owners = [_find_owners(place, model, of_rows[0])]
    if others is not None:
        of_rows.append(_place_others(others, of_columns))
        owners.append(of_rows[-1] // 3)
    if read is not None:
        of_rows.append(_place_meters(place, read))
        owners.append(_find_owners(place, read, of_rows[-1]))
        of_columns = np.concatenate([of_columns, 3 * owners[-1] + 2])
    rows = np.argsort(np.concatenate([*of_rows, of_columns]), kind="stable")
    blocks = None if has_loops else np.concatenate([*owners, of_columns // 3])[rows]
    return TableauOrder(rows, has_loops, blocks)


def _place_meters(place: np.ndarray, model: MeasurementModel) -> np.ndarray:
    """The place of each meter, (n_meas,), where the voltages of nodes have 3 ``place`` + 2."""
    at_branches, first = OF_BRANCH[model.kinds], model.first_rows
    outermost = np.minimum.reduceat(place[model.y.indices], model.y.indptr[first]) if len(first) else first
    return np.where(at_branches, 3 * outermost + 1, 3 * place[model.node[first]])


def _find_owners(place: np.ndarray, model: MeasurementModel, of_meter: np.ndarray) -> np.ndarray:
    """The place of the bus that each meter belongs to, (n_meas,): on a branch the bus that comes first."""
    at_branch = OF_BRANCH[model.kinds]
    return np.where(at_branch, of_meter // 3, place[model.node[model.first_rows]])


def _place_others(others: sp.csr_array, of_columns: np.ndarray) -> np.ndarray:
    found, is_given = np.zeros(others.shape[0], dtype=np.int64), np.diff(others.indptr) > 0
    if is_given.any():
        found[is_given] = np.maximum.reduceat(of_columns[others.indices], others.indptr[:-1][is_given]) - 1
    return found


def order_buses(network: Network) -> np.ndarray:
    """The place of each bus, by rows, in an order of elimination that fills in little, (n_bus,).

    By minimum degree (J. W. H. Liu, ACM Trans. Math. Softw. 11 (1985) 141), as SuperLU has it.
    """
    table = network.table
    n, f, t = len(table.bus_id), table.f, table.t
    joined = sp.coo_array((np.ones(2 * len(f)), (np.concatenate([f, t]), np.concatenate([t, f]))), shape=(n, n))
    dominant = sp.csc_array(joined + sp.diags_array(1.0 + np.asarray(joined.sum(axis=1)).ravel()))
    place: np.ndarray = spla.splu(dominant, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).perm_c
    return place.astype(np.int64)
