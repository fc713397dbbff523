"""Observability: which state variables do the meters determine, and which added meter would cure a gap?

Decided by numerical rank, never by counting: the null space of the Jacobian at the no-load state (weights
and loading play no part) is found by block inverse iteration on one sparse factorisation. Current
magnitudes do not count: their derivative does not exist without load.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dsse_core.admittance import build_admittance, flat_start
from dsse_core.errors import NotObservableError
from dsse_core.measurement import MeasurementKind, Meter
from dsse_core.measurement_model import build_measurement_model
from dsse_core.network import Network

NULL_SINGULAR_VALUE = 1e-7  # of the Jacobian with rows scaled to length 1
SHIFT = 1e-15
MAX_CURES = 4


def check_observable(network: Network, meters: Sequence[Meter], *, reference: int | None = None) -> None:
    """Check that ``meters`` determine every voltage, the angle of bus ``reference`` being given.

    Raises:
        NotObservableError: naming every unobservable bus and, where one exists, a single added meter
            (a voltmeter, or a power meter that reads P and Q) that would cure it.
    """
    null = find_null_space(network, meters, reference=reference)
    if null.shape[1] == 0:
        return
    n = len(network.buses)
    undetermined = np.linalg.norm(null, axis=1) > 1e-6
    buses = [bus.id for row, bus in enumerate(network.buses) if undetermined[row] or undetermined[n + row]]
    raise NotObservableError(buses, list(_find_cures(network, buses, null, reference)))


def find_null_space(network: Network, meters: Sequence[Meter], *, reference: int | None = None) -> np.ndarray:
    """Orthonormal basis, shape (2 n_bus, k), of the state changes [va; vm] that no meter sees; k = 0 if observable."""
    reference = _reference_of(network, reference)
    n = len(network.buses)
    free = np.delete(np.arange(2 * n), network.row[reference])
    A = _scaled_jacobian(network, meters, reference)[:, free]
    size = len(free)
    K = sp.block_array([[sp.eye_array(A.shape[0]), A], [A.T, -SHIFT * sp.eye_array(size)]], format="csc")
    factor = spla.splu(K)
    generator = np.random.default_rng(0)
    width = 0
    while True:
        width = min(size, 2 * width or 4)
        X = np.linalg.qr(generator.standard_normal((size, width)))[0]
        for _ in range(3):
            X = np.linalg.qr(factor.solve(np.vstack([np.zeros((A.shape[0], width)), X]))[A.shape[0] :])[0]
        _, singular, right = np.linalg.svd(A @ X, full_matrices=True)
        singular = np.pad(singular, (0, width - len(singular)))
        null = X @ right.T[:, singular < NULL_SINGULAR_VALUE]
        if null.shape[1] < width or width == size:
            break
    basis = np.zeros((2 * n, null.shape[1]))
    basis[free] = null
    return basis


def _reference_of(network: Network, reference: int | None) -> int:
    if reference is not None:
        return reference
    return network.slack.bus if network.slack else network.buses[0].id


def _scaled_jacobian(network: Network, meters: Sequence[Meter], reference: int) -> sp.csr_array:
    """Rows of H at no load, each scaled to length 1, without current magnitudes."""
    meters = [meter for meter in meters if meter.kind is not MeasurementKind.CURRENT]
    vm, va = flat_start(network, reference)
    H = build_measurement_model(network, build_admittance(network), meters).jacobian(np.r_[va, vm])
    length = np.sqrt(np.asarray(H.multiply(H).sum(axis=1)).ravel())
    return sp.csr_array(sp.diags_array(1 / np.where(length > 0, length, 1.0)) @ H)


def _find_cures(network: Network, buses: Sequence[int], null: np.ndarray, reference: int | None) -> Iterator[str]:
    """Single meters whose rows see every direction of the null space."""
    found = 0
    for text, meters in _candidates(network, buses):
        rows = _scaled_jacobian(network, meters, _reference_of(network, reference)) @ null
        if np.linalg.matrix_rank(rows, tol=1e-6) == null.shape[1]:
            yield text
            found += 1
            if found == MAX_CURES:
                return


def _candidates(network: Network, buses: Sequence[int]) -> Iterator[tuple[str, list[Meter]]]:
    kind = MeasurementKind
    for bus in buses:
        yield f"voltage magnitude at bus {bus}", [Meter(kind.VM, bus)]
    seen = set()
    for bus in buses:
        for branch in network.branches_at[bus]:
            if branch.id not in seen:
                seen.add(branch.id)
                place = f"P and Q flow of branch {branch.id} at bus {branch.from_bus}"
                yield place, [Meter(k, branch.from_bus, branch.id) for k in (kind.P_FLOW, kind.Q_FLOW)]
    for bus in buses:
        yield f"P and Q injection at bus {bus}", [Meter(k, bus) for k in (kind.P_INJECTION, kind.Q_INJECTION)]
    for bus in buses:
        yield f"voltage magnitude and angle at bus {bus}", [Meter(k, bus) for k in (kind.VM, kind.VA)]
