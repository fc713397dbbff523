"""Observability: the state variables that the meters determine, and the added meters that make a bus observable.

Numerical rank decides, never counting: null vectors of the Jacobian at the no-load state (weights, loading, charging
and shunts play no part) are found by block inverse iteration on one sparse factorisation. Current magnitudes do not
count: their derivative does not exist without load. A fit to random readings on another factorisation shows which
meters cannot be spared.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dsse_core.errors import InvalidInputError, NotObservableError
from dsse_core.grid.admittance import build_admittance, flat_start
from dsse_core.grid.columns import Records, take_items
from dsse_core.grid.measurement import MeasurementKind, Meter, find_meter_problems
from dsse_core.grid.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.grid.meter_table import KINDS, each_fits, number_kinds, number_meters
from dsse_core.grid.network import Network
from dsse_core.grid.radial_order import order_tableau
from dsse_core.matrices.augmented import AugmentedFactor, AugmentedPattern, reciprocal_row_lengths, scale_rows

# Of the Jacobian with rows scaled to length 1. A feeder of 5,000 buses in a row with injection meters alone
# has 1e-7, an impedance of 1e-5 p.u. among ordinary ones takes another 1e-3, round-off is 1e-15.
NULL_SINGULAR_VALUE = 1e-11
TABLEAU_SCALE = 1e-8  # singular values are distinguished down to sqrt(TABLEAU_SCALE * 1e-16)
# A shift keeps the factorisation from being exactly singular; where rounding swallows it, the next one is tried. The
# largest still distinguishes singular values of sqrt(TABLEAU_SCALE * 1e-14) = 1e-11.
SHIFTS = (1e-20, 1e-18, 1e-16, 1e-14)
WIDTH = 4  # null vectors sought: one meter cures at most 2, and 4 random ones touch every undetermined variable
TOUCHED = 1e-6  # entry of a null vector from which on a variable counts as undetermined
MAX_CURES = 4
# Residual of random readings of size 1. A voltmeter that only the sum of 5,000 injections checks keeps 1e-6,
# an indispensable meter 1e-14.
NO_RESIDUAL = 1e-10

_CURRENT = KINDS.index(MeasurementKind.CURRENT)
_QUANTITY = {
    MeasurementKind.VM: "voltage magnitude",
    MeasurementKind.VA: "voltage angle",
    MeasurementKind.P_FLOW: "P",
    MeasurementKind.Q_FLOW: "Q",
    MeasurementKind.P_INJECTION: "P",
    MeasurementKind.Q_INJECTION: "Q",
}


def check_observable(network: Network, meters: Sequence[Meter], *, reference: int | None = None) -> None:
    """Check that ``meters`` determine every voltage, the angle of bus ``reference`` being given.

    Raises:
        InvalidInputError: listing every meter that does not fit the network.
        NotObservableError: naming every unobservable bus and, where one exists, a single added meter
            (of voltage, or of power, which reads P and Q) that would cure it.
    """
    if not _all_fit(network, meters) and (problems := list(find_meter_problems(network, meters))):
        raise InvalidInputError(f"meters of network {network.name!r}", problems)
    reference = find_reference(network, reference)
    null = find_null_vectors(network, meters, reference)
    if null.shape[1] == 0:
        return
    n = len(network.buses)
    undetermined = np.linalg.norm(null, axis=1) > TOUCHED
    buses = [bus.id for row, bus in enumerate(network.buses) if undetermined[row] or undetermined[n + row]]
    present = {meter.id for meter in meters}
    raise NotObservableError(buses, _find_cures(network, buses, present, null, reference))


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


def find_indispensable(network: Network, meters: Sequence[Meter], reference: int) -> set[str]:
    """Ids of the meters of ``find_indispensable_rows``."""
    return {meters[row].id for row in np.flatnonzero(find_indispensable_rows(network, meters, reference)).tolist()}


def find_indispensable_rows(network: Network, meters: Sequence[Meter], reference: int) -> np.ndarray:
    """True for each meter, virtual ones included, without which ``meters`` do not determine the state, (n_meas,).

    The network has no load and current magnitudes do not count, as in ``check_observable``: losses and currents may
    check such a meter a little, but could not replace it. In a fit to random readings an indispensable meter has no
    residual. ``meters`` must determine the state.
    """
    n = len(network.buses)
    free = np.delete(np.arange(2 * n), network.row[reference])
    model = _no_load_model(network, meters)
    A = _scaled_jacobian(network, model, reference)[:, free]
    order = order_tableau(network, reference, model, free)
    pattern = AugmentedPattern(A, order.rows, fills_in=order.fills_in, blocks=order.blocks)
    count = A.shape[0]
    readings = np.random.default_rng(0).standard_normal((count, WIDTH))
    residual, _ = AugmentedFactor(A, np.ones(count), pattern=pattern).solve(readings, np.zeros((len(free), WIDTH)))
    found: np.ndarray = number_kinds(meters) != _CURRENT
    found[found] = abs(residual).max(axis=1) < NO_RESIDUAL
    return found


def find_null_vectors(network: Network, meters: Sequence[Meter], reference: int) -> np.ndarray:
    """State changes [va; vm] that no meter sees: orthonormal columns, shape (2 n_bus, k).

    They are complete if k < WIDTH. With k = WIDTH there may be more state changes, of which these are a random choice.
    """
    n = len(network.buses)
    free = np.delete(np.arange(2 * n), network.row[reference])
    model = _no_load_model(network, meters)
    A = _scaled_jacobian(network, model, reference)[:, free]
    n_meas, n_free = A.shape
    order = order_tableau(network, reference, model, free)
    pattern = AugmentedPattern(A, None if order.fills_in else order.rows)
    factor = _factor_shifted(A, pattern)
    width = min(WIDTH, n_free)
    X = np.random.default_rng(0).standard_normal((n_free, width))
    for _ in range(3):  # each pass multiplies the state changes that no meter sees by 1e6 and more
        right = pattern.permute(np.vstack([np.zeros((n_meas, width)), X]))
        X = np.linalg.qr(pattern.permute_back(factor.solve(right))[n_meas:])[0]
    at_least_square = np.vstack([A @ X, np.zeros((width, width))])
    _, singular, right = np.linalg.svd(at_least_square, full_matrices=False)
    unseen = X @ right.T[:, singular < NULL_SINGULAR_VALUE]
    null = np.zeros((2 * n, unseen.shape[1]))
    null[free] = unseen
    return null


def _factor_shifted(A: sp.csr_array, pattern: AugmentedPattern) -> spla.SuperLU:
    n_meas, n_free = A.shape
    for shift in SHIFTS:
        try:
            return pattern.factor_by_superlu(
                pattern.fill(np.full(n_meas, TABLEAU_SCALE), A.data, np.full(n_free, -shift)), exact=True
            )
        except RuntimeError:  # exactly singular
            continue
    problem = "the Jacobian at no load is singular beyond what unobservable buses explain; look for absurd impedances"
    raise InvalidInputError("observability analysis", [problem])


def _no_load_model(network: Network, meters: Sequence[Meter]) -> MeasurementModel:
    """The measurement model of ``meters`` without current magnitudes, in the network without charging and shunts."""
    meters = take_items(meters, np.flatnonzero(number_kinds(meters) != _CURRENT))
    return build_measurement_model(network, build_admittance(network, with_shunts=False), meters)


def _scaled_jacobian(network: Network, model: MeasurementModel, reference: int) -> sp.csr_array:
    """Rows of H at the flat start, each scaled to length 1."""
    vm, va = flat_start(network, reference)
    H = model.jacobian(np.r_[va, vm])
    return scale_rows(H, reciprocal_row_lengths(H))


def _find_cures(
    network: Network, buses: Sequence[int], present: set[str], null: np.ndarray, reference: int
) -> list[str]:
    """Single meters whose rows see every null vector, as text."""
    if null.shape[1] == WIDTH:
        return []
    candidates = [
        missing
        for candidate in _candidates(network, buses)
        if (missing := [meter for meter in candidate if meter.id not in present])
    ]
    model = _no_load_model(network, [meter for candidate in candidates for meter in candidate])
    seen = _scaled_jacobian(network, model, reference) @ null
    cures = []
    for candidate, rows in zip(candidates, _split(seen, [len(c) for c in candidates]), strict=True):
        if np.linalg.matrix_rank(rows, tol=TOUCHED) == null.shape[1]:
            cures.append(_describe(candidate))
            if len(cures) == MAX_CURES:
                break
    return cures


def _split(rows: np.ndarray, lengths: Sequence[int]) -> list[np.ndarray]:
    return np.split(rows, np.cumsum(lengths)[:-1])


def _candidates(network: Network, buses: Sequence[int]) -> Iterator[list[Meter]]:
    kind = MeasurementKind
    for bus in buses:
        yield [Meter(kind.VM, bus)]
    for branch in dict.fromkeys(branch for bus in buses for branch in network.branches_at[bus]):
        yield [Meter(k, branch.from_bus, branch.id) for k in (kind.P_FLOW, kind.Q_FLOW)]
    for bus in buses:
        yield [Meter(k, bus) for k in (kind.P_INJECTION, kind.Q_INJECTION)]
    for bus in buses:
        yield [Meter(k, bus) for k in (kind.VM, kind.VA)]


def _describe(meters: Sequence[Meter]) -> str:
    """E.g. "P and Q flow of branch 3-4 at bus 3", "voltage magnitude at bus 2"."""
    what = " and ".join(_QUANTITY[meter.kind] for meter in meters)
    bus, branch = meters[0].bus, meters[0].branch
    if branch:
        return f"{what} flow of branch {branch} at bus {bus}"
    return f"{what} injection at bus {bus}" if meters[0].kind.of_injection else f"{what} at bus {bus}"
