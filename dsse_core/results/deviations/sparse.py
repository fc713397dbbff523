"""Covariances of quantities that follow from the state, on sparse matrices: readings of perfect meters."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from dsse_core.estimation.residuals import LEAST_REDUCTION
from dsse_core.estimation.result import EstimationResult
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.columns import Records
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.meter_table import KINDS, NO_BRANCH, TOTAL, UNKNOWN, make_meters, tabulate_meters
from dsse_core.grid.network import Network

FLOWS = (MeasurementKind.P_FLOW, MeasurementKind.Q_FLOW)
INJECTIONS = (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)


class SparseDeviations:
    """Covariances at the state of ``result``, of the powers into branches, and of injections that have no meter."""

    def __init__(self, result: EstimationResult) -> None:
        network, n = result.network, len(result.vm)
        self._result, self._active = result, network.table.active
        self._metered = find_metered_injections(result)
        self._unmetered = np.argwhere(np.isnan(self._metered))
        meters, size = _meters_of(network, self._unmetered), len(result.x)
        read = build_measurement_model(network, build_admittance(network), meters, first_tap=2 * n)
        self._of_vm, self._rows_from = n + np.arange(n), network.table.f
        self._of_p = size + np.arange(len(self._active))
        self._first_injection = size + 2 * len(self._active)
        p, q, vm = self._of_ends = self._of_p, self._of_p + len(self._active), self._of_vm[self._rows_from]
        joined = np.concatenate([p, p, q]), np.concatenate([q, vm, vm])
        self._covariance = result.linear.read(result.x, read, joined)

    def of_branches_and_injections(self) -> tuple[np.ndarray, np.ndarray]:
        """Covariance of P, Q and ln vm at the from ends of branches in service, (n_active, 3, 3); and the variances of
        P and Q that the buses inject, (2, n_bus); p.u.
        """
        n_active, vm = len(self._of_p), self._result.vm[self._rows_from]
        y = self._of_ends
        pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
        of_injections = self._first_injection + np.arange(len(self._unmetered))
        entries = self._covariance.entries(
            np.concatenate([*(y[a] for a, _ in pairs), of_injections]),
            np.concatenate([*(y[b] for _, b in pairs), of_injections]),
        )
        covariance = np.empty((n_active, 3, 3))
        scale = np.ones(n_active), np.ones(n_active), 1 / vm
        for k, (a, b) in enumerate(pairs):
            part = entries[k * n_active : (k + 1) * n_active] * scale[a] * scale[b]
            covariance[:, a, b] = covariance[:, b, a] = part
        injections = self._metered.copy()
        injections[self._unmetered[:, 0], self._unmetered[:, 1]] = entries[len(pairs) * n_active :]
        return covariance, injections

    def of_sums(self, by_ends: sp.csr_array, by_buses: sp.csr_array) -> np.ndarray:
        """Variances of sums, (n_sum,), with the derivatives ``by_ends`` (n_sum, 3 n_branch), by P, Q and ln vm at the
        from ends, and ``by_buses`` (n_sum, n_bus), by ln vm. Nan where that would take too long.
        """
        vm = self._result.vm
        columns = np.full((len(self._result.network.branches), 3), -1)
        columns[self._active] = np.stack(self._of_ends, axis=1)
        scale = np.ones(columns.shape)
        scale[self._active, 2] = 1 / vm[self._rows_from]
        n = self._first_injection + len(self._unmetered)
        B = _select(by_ends, columns.ravel(), scale.ravel(), n) + _select(by_buses, self._of_vm, 1 / vm, n)
        return self._covariance.of_sums(sp.csr_array(B))


def _select(by: sp.csr_array, columns: np.ndarray, scale: np.ndarray, n: int) -> sp.csr_array:
    """``by`` with each column scaled by ``scale`` and moved to the column that ``columns`` names, (rows, n)."""
    return sp.csr_array((by.data * scale[by.indices], columns[by.indices], by.indptr), shape=(by.shape[0], n))


def _meters_of(network: Network, unmetered: np.ndarray) -> Records[Meter]:
    """P and Q at the from ends of branches in service, and the injections ``unmetered`` (k, 2): kind and row of bus."""
    table, p, q = network.table, *(KINDS.index(kind) for kind in FLOWS)
    active, kinds = table.active, np.array([KINDS.index(kind) for kind in INJECTIONS])
    kind = np.concatenate([np.full(len(active), p), np.full(len(active), q), kinds[unmetered[:, 0]]])
    bus = np.concatenate([table.from_bus[active], table.from_bus[active], table.bus_id[unmetered[:, 1]]])
    return make_meters(network, kind, bus, np.concatenate([active, active, np.full(len(unmetered), NO_BRANCH)]))


def find_metered_injections(result: EstimationResult) -> np.ndarray:
    """Variances of metered injections, ``R - Omega``, (2, n_nodes); nan where there is no informative meter."""
    found = np.full((2, len(result.vm)), np.nan)
    variance = result.sigmas**2 - result.residual_variance
    table = tabulate_meters(result.network, result.plan.meters)
    is_informative = variance >= LEAST_REDUCTION * result.sigmas**2
    if table.phases is not None:
        is_informative &= (table.phases[0] != TOTAL) & (table.phases[1] == UNKNOWN)
    for row, kind in enumerate(INJECTIONS):
        here = np.flatnonzero(is_informative & (table.kind == KINDS.index(kind)))
        found[row, table.node[here]] = np.maximum(variance[here], 0.0)
    return found
