"""Variances of quantities of conductors where branches have phases: readings of perfect meters at all ports.

A branch of several phases has no admittance by which the voltage of one end would follow from the other end, so both
are read. A current follows from the power and the voltage at its own port. The loss of a conductor is read as
``(v_f - v_t) conj(i_f) + v_t conj(i_f + i_t)``: no term is a difference of large numbers, however short the branch.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from dsse_core.estimation.result import EstimationResult
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.loads import GROUND
from dsse_core.grid.measurement import MeasurementKind
from dsse_core.grid.measurement_model import build_model_of_rows
from dsse_core.grid.meter_table import KINDS
from dsse_core.results.deviations.branch_variances import differentiate_magnitude
from dsse_core.results.deviations.sparse import find_metered_injections
from dsse_core.results.flows import differentiate_shunt_powers
from dsse_core.results.state import GridState
from dsse_core.results.totals import Division, find_shares

FLOWS = MeasurementKind.P_FLOW, MeasurementKind.Q_FLOW


class PortDeviations:
    """Variances at the state of ``result``."""

    def __init__(self, result: EstimationResult, state: GridState) -> None:
        self._state, branches, n = state, state.branches, len(result.vm)
        network = result.network
        self._n_port, self._node = len(network.table.ports), network.table.port_node
        self._metered = find_metered_injections(result)
        self._unmetered = np.argwhere(np.isnan(self._metered))
        self._through = np.flatnonzero((branches.from_port >= 0) & (branches.to_port >= 0))  # conductors with two ends
        at_from, at_to = (n + of_end[self._through] for of_end in (branches.from_port, branches.to_port))
        f, t = branches.f[self._through], branches.t[self._through]
        stacked = build_admittance(network).stacked
        groups = (  # rows of ``stacked`` whose sum is the current; nodes of the voltage, and to where it counts
            ([n + np.arange(self._n_port)], self._node, np.full(self._n_port, GROUND)),
            ([at_from], f, t),
            ([at_from, at_to], t, np.full(len(t), GROUND)),
        )
        parts = [_Part(stacked, *group) for group in groups for _ in FLOWS]
        kinds = [KINDS.index(kind) for kind in FLOWS] * len(groups)
        of_parts = [np.full(len(part.node), kind) for part, kind in zip(parts, kinds, strict=True)]
        at = self._unmetered[:, 1]
        parts.append(_Part(stacked, [at], at, np.full(len(at), GROUND)))
        of_parts.append(np.array([KINDS.index(kind) for kind in FLOWS])[self._unmetered[:, 0]])
        node, other = (np.concatenate([vars(part)[end] for part in parts]) for end in ("node", "other"))
        y = sp.csr_array(sp.vstack([part.y for part in parts]))
        read = build_model_of_rows(y, np.arange(len(node)), np.concatenate(of_parts), node, other)
        first = 2 * n + np.cumsum([0, *map(len, of_parts)])
        self._p, self._q, *self._of_loss, self._injections = (np.arange(a, b) for a, b in pairwise(first.tolist()))
        self._vm, self._size = n + np.arange(n), int(first[-1])
        self._covariance = result.linear.read_by_pieces(result.x, read)

    def of_branches_and_injections(self) -> tuple[np.ndarray, np.ndarray]:
        """Variances of P, Q, I at the from end, of P, Q, I at the to end, and of the loss, P and Q, (8, n_row); and of
        P and Q that the nodes inject, (2, n_nodes); p.u. 0 out of service and where a conductor has no such end.
        """
        p, q, vm, (a_p, a_q, b_p, b_q) = self._p, self._q, self._vm[self._node], self._of_loss
        pairs = [(p, p), (p, q), (p, vm), (q, q), (q, vm), (vm, vm)]
        pairs += [(a_p, a_p), (b_p, b_p), (a_p, b_p), (a_q, a_q), (b_q, b_q), (a_q, b_q), (self._injections,) * 2]
        found = self._covariance.entries(*map(np.concatenate, zip(*pairs, strict=True)))
        *of_ports, a, b, ab, c, d, cd, injected = np.split(found, np.cumsum([len(one) for one, _ in pairs])[:-1])
        at_ports = np.append(self._find_of_ports(of_ports), np.zeros((3, 1)), axis=1)  # the last one for no port
        branches = self._state.branches
        at_ends = at_ports[:, branches.from_port], at_ports[:, branches.to_port]
        losses = (at_ends[0] + at_ends[1])[:2]  # of a conductor with one end its power there
        losses[:, self._through] = a + b + 2 * ab, c + d + 2 * cd
        injections = self._metered.copy()
        injections[self._unmetered[:, 0], self._unmetered[:, 1]] = injected
        return np.maximum(np.concatenate([*at_ends, losses]), 0.0), np.maximum(injections, 0.0)

    def _find_of_ports(self, entries: list[np.ndarray]) -> np.ndarray:
        """Variances of P, Q and I, (3, n_port), by the upper triangles of the covariances of P, Q and vm there."""
        u, (s, i) = self._state.vm[self._node], self._state.branches.list_ports(self._state.flows)
        s, i = s[:-1], s[:-1].conj() / u
        C = np.empty((self._n_port, 3, 3))
        for (a, b), part in zip([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)], entries, strict=True):
            C[:, a, b] = C[:, b, a] = part
        g = differentiate_magnitude(i, np.stack([1 / u, -1j / u, -i / u], axis=-1))
        return np.stack([C[:, 0, 0], C[:, 1, 1], np.einsum("ki,kij,kj->k", g, C, g)])

    def of_totals(self, division: Division) -> np.ndarray:
        """Variances of P of TOTALS of all areas, then of Q, (8 n_area,); nan where that would take too long."""
        state, rows = self._state, []
        branches, shunt = state.branches, differentiate_shunt_powers(state.network, state.vm, state.va)
        for part, at_port in ((np.real, self._p), (np.imag, self._q)):
            shares = find_shares(state, division, part(state.injection))
            found = self._select(sp.csr_array(shares.of_shunt @ part(shunt)), np.arange(2 * len(state.vm)))
            for share, port in ((shares.at_from, branches.from_port), (shares.at_to, branches.to_port)):
                found = found + self._select(share, at_port[port])
            rows.append(found)
        return self._covariance.of_sums(sp.csr_array(sp.vstack(rows)))

    def _select(self, by: sp.csr_array, columns: np.ndarray) -> sp.csr_array:
        """``by`` with each column moved to the variable that ``columns`` names."""
        return sp.csr_array((by.data, columns[by.indices], by.indptr), shape=(by.shape[0], self._size))


class _Part:
    """Rows ``y`` of admittances, with an entry for the own ``node``; ``other``: the node to which voltages count."""

    def __init__(self, stacked: sp.csr_array, summed: list[np.ndarray], node: np.ndarray, other: np.ndarray) -> None:
        own = np.arange(len(node)), node
        parts = [sp.coo_array(stacked[rows]) for rows in summed]
        row, column = (np.concatenate([*(p.coords[k] for p in parts), own[k]]) for k in (0, 1))
        values = np.concatenate([*(p.data for p in parts), np.zeros(len(node))])
        self.y = sp.coo_array((values, (row, column)), shape=(len(node), stacked.shape[1])).tocsr()
        self.node, self.other = node, other
