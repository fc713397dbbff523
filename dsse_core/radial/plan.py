"""Plan of the radial back end: the arrays of a radial network and its meters, found once for all scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from types import ModuleType

import numpy as np

from dsse_core import compiling
from dsse_core.errors import InvalidInputError
from dsse_core.grid.measurement import Meter, MeterPlace, find_meter_problems
from dsse_core.grid.meter_table import KINDS, can_be_virtual, tabulate_meters
from dsse_core.grid.network import Network
from dsse_core.grid.quantities import Quantity
from dsse_core.grid.radial_order import describe_no_tree
from dsse_core.observability import check_observable, find_reference

# Columns of the readings of a bus: its own, then those of the branch to its parent, at the parent's end and its own.
SLOTS_AT_BUS = {
    (MeterPlace.BUS, Quantity.VA): 0,
    (MeterPlace.BUS, Quantity.VM): 1,
    (MeterPlace.INJECTION, Quantity.P): 2,
    (MeterPlace.INJECTION, Quantity.Q): 3,
}
SLOTS_AT_PARENT = {(MeterPlace.BRANCH, q): 4 + k for k, q in enumerate((Quantity.P, Quantity.Q, Quantity.CURRENT))}
SLOTS_AT_CHILD = {at: 3 + slot for at, slot in SLOTS_AT_PARENT.items()}
_COLUMNS = np.array(
    [
        [slots.get((kind.place, kind.quantity), -1) for kind in KINDS]
        for slots in (SLOTS_AT_BUS, SLOTS_AT_PARENT, SLOTS_AT_CHILD)
    ]
)
N_SLOT = 10
WITH_PHASES = "buses have phases, and compiled passes know one voltage a bus"
N_VOLTAGE_SLOT = 2  # the first slots of a bus read its voltage: angle, magnitude


@dataclass(frozen=True, repr=False)
class RadialPlan:
    """A tree of buses, numbered from the root (the reference bus) so that every parent precedes its children.

    ``order`` (n_bus,): network row of each bus of the tree. ``parent`` (n_bus,): number of its parent; the root's is 0.
    ``admittance`` (n_bus, 8) complex: see ``layout.stack``; ``no_load_admittance``: without shunts and charging.
    ``slot`` (n_meas,): place of each meter's reading in an array (n_bus, N_SLOT), flattened. ``start`` (n_bus,) complex
    and ``start_va`` (n_bus,): the flat start in tree order, with the angle that is given at the root. ``level``
    (n_bus,): number of branches to the root. ``spaces``: memory that no iteration uses at the moment.
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
    has_currents: bool
    spaces: list[np.ndarray] = field(default_factory=list, compare=False)

    def __repr__(self) -> str:
        buses, meters = len(self.order), len(self.meters)
        return f"<RadialPlan of {self.network.name!r}: {buses} buses, {meters} meters, root bus {self.reference}>"

    @cached_property
    def meter(self) -> np.ndarray:
        """The meter of each slot, -1 without one, shape (n_bus, N_SLOT)."""
        meter = np.full(N_SLOT * len(self.order), -1, dtype=np.int32)
        meter[self.slot] = np.arange(len(self.slot))
        return meter.reshape(-1, N_SLOT)

    @cached_property
    def number(self) -> np.ndarray:
        """Number in the tree of each row of the network, (n_bus,)."""
        number = np.empty(len(self.order), dtype=np.int64)
        number[self.order] = np.arange(len(self.order))
        return number

    def take_space(self) -> np.ndarray:
        """Returns memory of an iteration, which the caller puts back into ``spaces``."""
        try:
            return self.spaces.pop()
        except IndexError:
            from dsse_core.radial.iteration import make_space

            return make_space(len(self.order))


def build_radial_plan(network: Network, meters: Sequence[Meter], *, reference: int | None = None) -> RadialPlan | str:
    """The plan for ``meters`` in ``network``, or, as text, the reason why the radial back end cannot serve them.

    Args:
        reference: bus whose angle is given, the root of the tree; the slack bus by default.

    Raises:
        InvalidInputError: listing every meter that does not fit the network, or an unknown reference.
        NotObservableError: the meters do not determine the state.
    """
    found = plan_tree(network, meters, find_reference(network, reference))
    return found if isinstance(found, str) else _check_determined(*found)


def find_what_lacks_slots(network: Network) -> str:
    """Reason why compiled passes cannot hold ``network``, as text; empty if they can."""
    if not network.table.nodes.is_balanced:
        return WITH_PHASES
    taps = ", ".join(network.estimated_taps)
    return f"compiled passes have no slot for the tap of branch {taps}" if taps else ""


def plan_tree(network: Network, meters: Sequence[Meter], root: int) -> tuple[RadialPlan, int] | str:
    """The plan with bus ``root`` on top, whether or not the meters determine the state, and the bus where they do not.

    That is NOT_STUCK where they do. Returns text and raises as ``build_radial_plan``.
    """
    table = network.table
    if why := find_what_lacks_slots(network):
        return why
    if (obstacle := compiling.find_obstacle(n_bus=len(table.bus_id))) is not None:
        return obstacle
    angle = float(network.slack.va) if network.slack and network.slack.bus == root else 0.0
    columns = table.series, table.charging, table.tap, table.shift, table.shunt
    at, read = (table.end_rows, table.in_service, table.rows.row_of(root), angle), _read_meters(network, meters)
    (n_branch, fit, stuck), found = _load_compiled().plan_tree(*at, *columns, *read, _COLUMNS)
    if why := describe_no_tree(len(table.bus_id), n_branch, len(found[0]), root):
        return why
    if not (fit and can_be_virtual(meters)):
        if problems := list(find_meter_problems(network, meters)):
            raise InvalidInputError(f"meters of network {network.name!r}", problems)
        without = {KINDS[k] for k in np.unique(read[0]).tolist() if (_COLUMNS[:, k] < 0).all()}
        return f"compiled passes have no slot for meters of {', '.join(sorted(without))}"
    return RadialPlan(network, meters, root, *found), stuck


def drop_meters(plan: RadialPlan, rows: Sequence[int]) -> RadialPlan | str:
    """The plan without the meters at the positions ``rows``. Returns and raises as ``build_radial_plan``."""
    kept = np.delete(np.arange(len(plan.meters)), rows)
    meters, slot = tuple(plan.meters[k] for k in kept.tolist()), plan.slot[kept]
    has_currents = bool(np.isin(slot % N_SLOT, (6, 9)).any())
    stuck = _load_compiled().find_stuck_with(plan.parent, plan.no_load_admittance, slot, plan.start, plan.start_va)
    return _check_determined(replace(plan, meters=meters, slot=slot, has_currents=has_currents), stuck)


def _check_determined(plan: RadialPlan, stuck: int) -> RadialPlan | str:
    if stuck == _load_compiled().NOT_STUCK:
        return plan
    check_observable(plan.network, plan.meters, reference=plan.reference)
    bus = plan.network.buses[plan.order[stuck]].id
    return f"the power through the branch above bus {bus} is not determined by the meters below and at that branch"


def _read_meters(network: Network, meters: Sequence[Meter]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Kind, row of the bus and row of the branch, (n_meas,) each, of one type, for which the code is compiled."""
    table = tabulate_meters(network, meters)
    return np.array(table.kind, dtype=np.int64), table.bus, np.asarray(table.branch, dtype=np.int64)


@cache
def _load_compiled() -> ModuleType:
    """Module of compiled code, loaded with numba once; an import statement in each call would take longer."""
    from dsse_core.radial import layout

    return layout
