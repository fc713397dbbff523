"""What the radial back end needs to know of a radial network and its meters: found once, used for every scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from dsse_core import compiling
from dsse_core.errors import InvalidInputError
from dsse_core.grid.measurement import MeasurementKind, Meter, find_meter_problems
from dsse_core.grid.meter_table import KINDS, NO_BRANCH, tabulate_meters
from dsse_core.grid.network import Network
from dsse_core.grid.radial_order import find_tree
from dsse_core.observability import check_observable, find_reference

# Columns of the readings of a bus: its own, then those of the branch to its parent, at the parent's end and its own.
SLOTS_AT_BUS = {
    MeasurementKind.VA: 0,
    MeasurementKind.VM: 1,
    MeasurementKind.P_INJECTION: 2,
    MeasurementKind.Q_INJECTION: 3,
}
SLOTS_AT_PARENT = {MeasurementKind.P_FLOW: 4, MeasurementKind.Q_FLOW: 5, MeasurementKind.CURRENT: 6}
SLOTS_AT_CHILD = {MeasurementKind.P_FLOW: 7, MeasurementKind.Q_FLOW: 8, MeasurementKind.CURRENT: 9}
_COLUMNS = tuple(
    np.array([slots.get(kind, -1) for kind in KINDS]) for slots in (SLOTS_AT_BUS, SLOTS_AT_PARENT, SLOTS_AT_CHILD)
)
N_SLOT = 10
# Of the pivots at no load with all sigmas 1, against the largest entry of their column. On 500 random grids, impedances
# over up to four decades, it was at most 2e-16 where something is not determined and at least 1.5e-9 elsewhere.
LEAST_PIVOT_RATIO = 1e-12


@dataclass(frozen=True, repr=False)
class RadialPlan:
    """A tree of buses, numbered from the root (the reference bus) so that every parent precedes its children.

    ``order`` (n_bus,): network row of each bus of the tree. ``parent`` (n_bus,): number of its parent; the root's is 0.
    ``admittance`` (n_bus, 8) complex: see ``stack_admittances``; ``no_load_admittance``: without shunts and charging.
    ``slot`` (n_meas,): place of each meter's reading in an array (n_bus, N_SLOT), flattened. ``start`` (n_bus,) complex
    and ``start_va`` (n_bus,): the flat start in tree order, with the angle that is given at the root. ``level``
    (n_bus,): number of branches to the root. ``spaces``: memory of iterations that nobody uses at the moment.
    """

    network: Network
    meters: Sequence[Meter]
    reference: int
    order: np.ndarray
    parent: np.ndarray
    admittance: np.ndarray
    no_load_admittance: np.ndarray
    slot: np.ndarray
    start: np.ndarray
    start_va: np.ndarray
    level: np.ndarray
    spaces: list[np.ndarray] = field(default_factory=list, compare=False)

    def __repr__(self) -> str:
        buses, meters = len(self.order), len(self.meters)
        return f"<RadialPlan of {self.network.name!r}: {buses} buses, {meters} meters, root bus {self.reference}>"

    def take_space(self) -> np.ndarray:
        """Memory of an iteration; put it back into ``spaces``."""
        try:
            return self.spaces.pop()
        except IndexError:
            from dsse_core.radial.iteration import make_space

            return make_space(len(self.order))

    @cached_property
    def has_currents(self) -> bool:
        column = self.slot % N_SLOT
        return bool(((column == 6) | (column == 9)).any())


@dataclass(frozen=True)
class RadialLayout:
    """A tree of buses, numbered from the root so that every parent precedes its children.

    ``order`` (n_bus,): network row of each bus of the tree. ``number`` (n_bus,): place in the tree of each network
    row. ``parent`` (n_bus,): number of its parent; the root's is 0. ``child`` (n_branch,): number of the bus below each
    branch in service; ``from_parent`` (n_branch,): whether its from side is above.
    """

    order: np.ndarray
    number: np.ndarray
    parent: np.ndarray
    child: np.ndarray
    from_parent: np.ndarray


def lay_out_radial(network: Network, root: int) -> RadialLayout | str:
    """The tree of ``network`` with bus ``root`` on top, or, as text, why the compiled passes cannot serve it."""
    if (obstacle := compiling.find_obstacle()) is not None:
        return obstacle
    from dsse_core.radial.walk import walk_tree  # numba

    if isinstance(tree := find_tree(network, root, walk_tree), str):
        return tree
    number = np.empty(len(tree.order), dtype=np.int64)
    number[tree.order] = np.arange(len(tree.order))
    parent = number[tree.upstream[tree.order]]
    from_parent = tree.upstream[tree.t] == tree.f
    return RadialLayout(tree.order, number, parent, number[np.where(from_parent, tree.t, tree.f)], from_parent)


def build_radial_plan(network: Network, meters: Sequence[Meter], *, reference: int | None = None) -> RadialPlan | str:
    """The plan for ``meters`` in ``network``, or, as text, why the radial back end cannot serve them.

    Args:
        reference: bus whose angle is given, the root of the tree; the slack bus by default.

    Raises:
        InvalidInputError: listing every meter that does not fit the network, or an unknown reference.
        NotObservableError: the meters do not determine the state.
    """
    reference = find_reference(network, reference)
    if isinstance(layout := lay_out_radial(network, reference), str):
        return layout
    ys, ends, ratio = read_branches(network)
    shunts = read_shunts(network, layout)
    gain = np.ones(len(layout.order), dtype=complex)
    gain[layout.child] = np.where(layout.from_parent, 1 / ratio, ratio)
    start = _follow(layout.parent, gain)
    angle = network.slack.va if network.slack and network.slack.bus == reference else 0.0
    plan = RadialPlan(
        network=network,
        meters=meters,
        reference=reference,
        order=layout.order,
        parent=layout.parent,
        admittance=stack_admittances(ys, ends, ratio, shunts, layout),
        no_load_admittance=stack_admittances(ys, 0 * ends, ratio, 0 * shunts, layout),
        slot=find_slots(network, meters, layout),
        start=start * np.exp(1j * angle),
        start_va=np.angle(start) + angle,
        level=find_levels(layout.parent),
    )
    return _check_determined(plan)


def drop_meters(plan: RadialPlan, rows: Sequence[int]) -> RadialPlan | str:
    """The plan without the meters at the positions ``rows``. Returns and raises as ``build_radial_plan``."""
    kept = np.delete(np.arange(len(plan.meters)), rows)
    meters = tuple(plan.meters[k] for k in kept.tolist())
    return _check_determined(replace(plan, meters=meters, slot=plan.slot[kept]))


def _check_determined(plan: RadialPlan) -> RadialPlan | str:
    if (stuck := _find_stuck_bus(plan)) is None:
        return plan
    check_observable(plan.network, plan.meters, reference=plan.reference)
    bus = plan.network.buses[plan.order[stuck]].id
    return f"the power through the branch above bus {bus} is not determined by the meters below and at that branch"


def read_branches(network: Network) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the branches in service: series admittance ys, admittance at each end, complex tap ratio, (n_branch,) each."""
    table = network.table
    return table.ys, table.ends, table.ratio


def read_shunts(network: Network, layout: RadialLayout) -> np.ndarray:
    """Shunt admittances in tree order, shape (n_bus,)."""
    in_tree_order: np.ndarray = network.table.shunt[layout.order]
    return in_tree_order


def orient_branches(
    ys: np.ndarray, ends: np.ndarray, ratio: np.ndarray, layout: RadialLayout
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """``ycc, ycp, ypp, ypc`` of the branches, c the child's end and p the parent's; see ``build_admittance``."""
    ytt = ys + ends
    yff, yft, ytf = ytt / abs(ratio) ** 2, -ys / ratio.conj(), -ys / ratio
    down = layout.from_parent
    return np.where(down, ytt, yff), np.where(down, ytf, yft), np.where(down, yff, ytt), np.where(down, yft, ytf)


def stack_admittances(
    ys: np.ndarray, ends: np.ndarray, ratio: np.ndarray, shunts: np.ndarray, layout: RadialLayout
) -> np.ndarray:
    """What the compiled passes need of the branch above each bus and of its shunt, shape (n_bus, 8), complex.

    Conjugates of ``ycc, ycp, ypp, ypc, ypp / ypc, 1 / ypc, ycp / conj(ypc)`` and of the shunt.
    """
    ycc, ycp, ypp, ypc = orient_branches(ys, ends, ratio, layout)
    stacked = np.zeros((len(shunts), 8), dtype=complex)
    stacked[layout.child, :7] = np.stack([ycc, ycp, ypp, ypc, ypp / ypc, 1 / ypc, ycp / ypc.conj()], axis=1).conj()
    stacked[:, 7] = shunts.conj()
    return stacked


def find_slots(network: Network, meters: Sequence[Meter], layout: RadialLayout) -> np.ndarray:
    """``slot`` of a plan."""
    number, parent, child = layout.number, layout.parent, layout.child
    table = tabulate_meters(network, meters)
    at = np.where(table.bus < 0, -1, number[table.bus])
    below = np.where(table.branch < 0, -2, np.append(child, -2)[np.maximum(table.branch, -1)])
    at_bus, at_parent, at_child = (columns[table.kind] for columns in _COLUMNS)
    above = np.where(below < 0, -2, parent[np.maximum(below, 0)])
    column = np.where(at_bus >= 0, at_bus, np.where(at == above, at_parent, at_child))
    of_branch = at_bus < 0
    fits = (at >= 0) & np.where(of_branch, (at == above) | (at == below), table.branch == NO_BRANCH)
    slot: np.ndarray = np.where(of_branch, below, at) * N_SLOT + column
    if not fits.all() or np.bincount(slot, minlength=1).max() > 1:
        raise InvalidInputError(f"meters of network {network.name!r}", list(find_meter_problems(network, meters)))
    return slot


def _follow(parent: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """No-load voltages: 1 p.u. at the root, multiplied by ``gain`` on the way down; in log2(depth) steps."""
    v, ancestor = gain.copy(), parent.copy()
    while ancestor.any():
        v, ancestor = v * v[ancestor], ancestor[ancestor]
    return v


def find_levels(parent: np.ndarray) -> np.ndarray:
    """How many branches are between each bus and the root, shape (n_bus,); in log2(depth) steps."""
    level, ancestor = (np.arange(len(parent)) > 0).astype(np.int64), parent
    while ancestor.any():
        level, ancestor = level + level[ancestor], ancestor[ancestor]
    return level


def _find_stuck_bus(plan: RadialPlan) -> int | None:
    """The first bus whose block is singular at no load, without shunts, charging and currents; all sigmas 1."""
    from dsse_core.radial import kernel as radial_kernel

    n = len(plan.order)
    readings = np.zeros((n, N_SLOT))
    weights = radial_kernel.absent(n)
    weights.ravel()[plan.slot] = 1.0
    weights[:, [6, 9]] = 0.0
    work = radial_kernel.Work.of(n)
    at = plan.parent, plan.no_load_admittance, readings, weights, plan.start, plan.start_va
    ratio, bus, _ = radial_kernel.eliminate(*at, False, radial_kernel.CHECK, *work)
    return int(bus) if not ratio > LEAST_PIVOT_RATIO else None
