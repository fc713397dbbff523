"""Observability: the state variables that the meters determine, and the added meters that make a bus observable.

Numerical rank decides, never counting: null vectors of the Jacobian at the no-load state (weights, loading, charging
and shunts play no part) are found by block inverse iteration on one sparse factorisation. Current magnitudes do not
count: their derivative does not exist without load. A fit to random readings on the same factorisation shows which
meters cannot be spared. The centre and the areas decide both alike (``NoLoadFit``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import scipy.sparse as sp

from dsse_core.errors import InvalidInputError, NotObservableError
from dsse_core.grid.admittance import build_admittance, flat_start
from dsse_core.grid.columns import Records, take_items
from dsse_core.grid.measurement import MeasurementKind, Meter, find_meter_problems
from dsse_core.grid.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.grid.meter_table import QUANTITY, each_fits, number_kinds, number_meters
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import list_phases, name_node
from dsse_core.grid.quantities import Quantity
from dsse_core.grid.radial_order import order_tableau
from dsse_core.matrices.augmented import AugmentedPattern, reciprocal_row_lengths, scale_rows

# Singular value of rows of length 1, and residual of readings of size 1, below which they are none. A feeder of 5,000
# buses in a row with injection meters alone has a singular value of 1e-7, and an impedance of 1e-5 p.u. among ordinary
# ones takes another 1e-3. A voltmeter that only the sum of these injections checks keeps a residual of 1e-6.
ROUND_OFF = 1e-11
TABLEAU_SCALE = 1e-8  # singular values are distinguished down to sqrt(TABLEAU_SCALE * 1e-16)
# A shift keeps the factorisation from being exactly singular; where rounding swallows it, the next one is tried. The
# largest still distinguishes singular values of sqrt(TABLEAU_SCALE * 1e-14) = 1e-11.
SHIFTS = (1e-20, 1e-18, 1e-16, 1e-14)
WIDTH = 4  # null vectors sought: of one phase a meter cures at most 2, and 4 random ones touch all that is undetermined
TOUCHED = 1e-6  # entry of a null vector from which on a variable counts as undetermined
MAX_CURES = 4


def check_observable(network: Network, meters: Sequence[Meter], *, reference: int | None = None) -> None:
    """Check that ``meters`` determine every voltage, the angle of bus ``reference`` being given.

    Raises:
        InvalidInputError: listing every meter that does not fit the network.
        NotObservableError: naming every unobservable bus and, where one exists, a single added meter
            (of voltage, or of power, which reads P and Q) that would cure it.
    """
    find_indispensable_rows(network, meters, reference=reference)


def find_indispensable_rows(network: Network, meters: Sequence[Meter], *, reference: int | None = None) -> np.ndarray:
    """True for each meter, virtual ones included, without which ``meters`` do not determine the state, (n_meas,).

    The network has no load and current magnitudes do not count: losses and currents may check such a meter a little,
    but could not replace it. Raises as ``check_observable``.
    """
    if not _all_fit(network, meters) and (problems := list(find_meter_problems(network, meters))):
        raise InvalidInputError(f"meters of network {network.name!r}", problems)
    reference = find_reference(network, reference)
    model, n, width = _no_load_model(network, meters), network.n_nodes, 2 + 2 * _most_phases(network)
    size, free = 2 * n + len(network.taps), network.find_unknown(reference)
    order = order_tableau(network, reference, model, free)
    fit = NoLoadFit(_scaled_jacobian(network, model, reference)[:, free], None if order.fills_in else order.rows, width)
    unseen = fit.find_null_vectors()
    if unseen.shape[1] == 0:
        found: np.ndarray = QUANTITY[number_kinds(meters)] != Quantity.CURRENT
        found[found] = fit.find_unchecked()
        return found
    null = np.zeros((size, unseen.shape[1]))
    null[free] = unseen
    rows = np.flatnonzero(find_touched_nodes(network, find_touched(null)))
    places, present = [network.nodes[row] for row in rows.tolist()], {meter.id for meter in meters}
    cures, together = _find_cures(network, places, present, null, reference) if null.shape[1] < width else ([], [])
    nodes = [name_node(*place) if place[1] else place[0] for place in places]
    raise NotObservableError(nodes, cures, together=together)


def _most_phases(network: Network) -> int:
    return int(np.bitwise_count(network.table.nodes.sets).max())


def _all_fit(network: Network, meters: Sequence[Meter]) -> bool:
    """True where ``meters`` are columns that have no problem, found without visiting each meter."""
    if not (isinstance(meters, Records) and each_fits(network, meters)):
        return False
    return len(np.unique(number_meters(network, meters))) == len(meters)


def find_reference(network: Network, reference: int | None) -> int:
    """The bus whose angle is given: ``reference``, else the slack bus, else the first bus.

    Raises:
        InvalidInputError: ``reference`` is not a bus of the network.
    """
    if reference is None:
        return network.slack.bus if network.slack else int(network.table.bus_id[0])
    if network.table.rows.row_of(reference) < 0:
        raise InvalidInputError(f"network {network.name!r}", [f"the reference, bus {reference}, is not in it"])
    return reference


class NoLoadFit:
    """Fit of random readings at no load, by one factor: the changes that no row sees, and the rows that none checks.

    The centre asks it about the meters of the grid, an area about its own and the information of its neighbours.

    ``A`` (n_rows, n_free): rows of meters at no load, of length 1 at most. ``order``: order of elimination of the
    tableau, see ``AugmentedPattern``. ``width``: number of changes sought at once.

    Raises:
        InvalidInputError: no factor is found.
    """

    def __init__(self, A: sp.csr_array, order: np.ndarray | None = None, width: int = WIDTH) -> None:
        self._width = width
        self._A, self._pattern = A, AugmentedPattern(A, order=order)
        n_rows, n_free = A.shape
        for shift in SHIFTS:
            above, below = np.full(n_rows, TABLEAU_SCALE), np.full(n_free, -shift)
            try:
                self._factor = self._pattern.factor_by_superlu(self._pattern.fill(above, A.data, below), exact=True)
                return
            except RuntimeError:  # exactly singular
                continue
        problem = (
            "the Jacobian at no load is singular beyond what unobservable buses explain; look for absurd impedances"
        )
        raise InvalidInputError("observability analysis", [problem])

    def find_null_vectors(self) -> np.ndarray:
        """Changes that no row sees: orthonormal columns, shape (n_free, k).

        They are complete if k < width. With k = width there may be more changes, of which these are a random choice.
        """
        n_rows, n_free = self._A.shape
        width = min(self._width, n_free)
        X = np.random.default_rng(0).standard_normal((n_free, width))
        for _ in range(2):  # each pass multiplies the changes that no row sees by 1e6 and more
            X = np.linalg.qr(self._solve(np.zeros((n_rows, width)), X)[1])[0]
        at_least_square = np.vstack([self._A @ X, np.zeros((width, width))])
        _, singular, right = np.linalg.svd(at_least_square, full_matrices=False)
        return np.asarray(X @ right.T[:, singular < ROUND_OFF])

    def find_unchecked(self) -> np.ndarray:
        """True for each row that no other row checks, (n_rows,): its random readings leave no residual."""
        n_rows, n_free = self._A.shape
        readings = np.random.default_rng(0).standard_normal((n_rows, WIDTH))
        residual = TABLEAU_SCALE * self._solve(readings, np.zeros((n_free, WIDTH)))[0]
        return np.asarray(abs(residual).max(axis=1, initial=0.0) < ROUND_OFF)

    def _solve(self, above: np.ndarray, below: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """s and dx of ``TABLEAU_SCALE s + A dx = above``, ``A's - shift dx = below``."""
        solved = self._factor.solve(self._pattern.permute(np.vstack([above, below])))
        s, dx = np.split(self._pattern.permute_back(solved), [len(above)])
        return s, dx


def find_touched(null: np.ndarray) -> np.ndarray:
    """True for each variable that one of the null vectors changes, (n,), from ``null`` (n, k)."""
    return np.asarray(np.linalg.norm(null, axis=1) > TOUCHED)


def find_touched_nodes(network: Network, touched: np.ndarray) -> np.ndarray:
    """True for nodes with a voltage that is ``touched`` (2 n_nodes + n_tap,) or with such a tap beside, (n_nodes,)."""
    n = network.n_nodes
    found = np.asarray(touched[: 2 * n].reshape(2, n).any(axis=0))
    taps = np.array([*network.estimated_taps.values()], dtype=int)[touched[2 * n :]]
    found[network.table.f[taps]] = found[network.table.t[taps]] = True
    return found


def _no_load_model(network: Network, meters: Sequence[Meter]) -> MeasurementModel:
    """The measurement model of ``meters`` without current magnitudes, in the network without charging and shunts."""
    meters = take_items(meters, np.flatnonzero(QUANTITY[number_kinds(meters)] != Quantity.CURRENT))
    admittance = build_admittance(network, with_shunts=False)
    return build_measurement_model(network, admittance, meters, first_tap=2 * network.n_nodes)


def _scaled_jacobian(network: Network, model: MeasurementModel, reference: int) -> sp.csr_array:
    """Rows of H at the flat start, each scaled to length 1."""
    vm, va = flat_start(network, reference)
    H = model.jacobian(np.r_[va, vm, network.taps])
    return scale_rows(H, reciprocal_row_lengths(H))


def _find_cures(
    network: Network, places: Sequence[tuple[int, str]], present: set[str], null: np.ndarray, reference: int
) -> tuple[list[str], list[str]]:
    """Single meters, or those of all phases of one place, whose rows see every null vector, as text; where there are
    none, a few that do so together.
    """
    candidates = [
        missing
        for candidate in _candidates(network, places)
        if (missing := [meter for meter in candidate if meter.id not in present])
    ]
    model = _no_load_model(network, [meter for candidate in candidates for meter in candidate])
    seen = _split(_scaled_jacobian(network, model, reference) @ null, [len(c) for c in candidates])
    cures = []
    for candidate, rows in zip(candidates, seen, strict=True):
        if np.linalg.matrix_rank(rows, tol=TOUCHED) == null.shape[1]:
            cures.append(_describe(candidate))
            if len(cures) == MAX_CURES:
                break
    return cures, [] if cures else [_describe(candidates[k]) for k in _choose_together(seen, null.shape[1])]


def _choose_together(seen: Sequence[np.ndarray], n: int) -> list[int]:
    """The places in ``seen``, rows of n columns each, of a few whose rows together have rank n, the most useful first;
    none where all together have less.
    """
    chosen: list[int] = []
    rows, rank = np.zeros((0, n)), 0
    while rank < n:
        ranks = [int(np.linalg.matrix_rank(np.vstack([rows, more]), tol=TOUCHED)) for more in seen]
        if not ranks or max(ranks) == rank:
            return []
        rank = max(ranks)
        chosen.append(ranks.index(rank))
        rows = np.vstack([rows, seen[chosen[-1]]])
    return chosen


def _split(rows: np.ndarray, lengths: Sequence[int]) -> list[np.ndarray]:
    return np.split(rows, np.cumsum(lengths)[:-1])


def _candidates(network: Network, places: Sequence[tuple[int, str]]) -> Iterator[list[Meter]]:
    """Meters at single nodes and ports, then at all phases of a place that are not determined."""
    kind, lacking = MeasurementKind, dict[int, list[str]]()
    for bus, phase in places:
        lacking.setdefault(bus, []).append(phase)

    def at(bus: int, phases: Sequence[str], *kinds: MeasurementKind, branch: str | None = None) -> list[Meter]:
        return [Meter(k, bus, branch, phases=phase) for phase in phases for k in kinds]

    yield from (at(bus, [phase], kind.VM) for bus, phase in places)
    ends = {}
    for branch in dict.fromkeys(branch for bus in lacking for branch in network.branches_at[bus]):
        there = list_phases(branch.primitive.from_phases if branch.primitive else "")
        wanted = [p for p in there if p in (*lacking.get(branch.from_bus, ()), *lacking.get(branch.to_bus, ()))]
        ends[branch] = wanted or there
        yield from (at(branch.from_bus, [p], kind.P_FLOW, kind.Q_FLOW, branch=branch.id) for p in there)
    yield from (at(bus, [phase], kind.P_INJECTION, kind.Q_INJECTION) for bus, phase in places)
    yield from (at(bus, [phase], kind.VM, kind.VA) for bus, phase in places)
    if all(len(phases) < 2 for phases in lacking.values()):
        return
    for branch, phases in ends.items():
        yield at(branch.from_bus, phases, kind.P_FLOW, kind.Q_FLOW, branch=branch.id)
    yield from (at(bus, phases, kind.P_INJECTION, kind.Q_INJECTION) for bus, phases in lacking.items())
    yield from (at(bus, phases, kind.VM, kind.VA) for bus, phases in lacking.items())


def _describe(meters: Sequence[Meter]) -> str:
    """E.g. "P and Q flow of branch 3-4 at bus 3", "voltage magnitude at bus 2", of two phases "... at bus 2.a, 2.b"."""
    what = " and ".join(dict.fromkeys(meter.kind.quantity.words for meter in meters))
    bus, branch = ", ".join(dict.fromkeys(meter.at for meter in meters)), meters[0].branch
    if branch:
        return f"{what} flow of branch {branch} at bus {bus}"
    return f"{what} injection at bus {bus}" if meters[0].kind.of_injection else f"{what} at bus {bus}"
