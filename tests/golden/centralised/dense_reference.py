"""Estimate and bad data once more, dense and in extended precision: shares h and H with the product, nothing else.

What is estimated is defined in docs/explanation/theory.md (Weighted least squares, Observability, Bad data);
how, is chosen here for being short and exact, not fast. Each step solves the dense tableau

    [R  0  H] [s ]   [z - h]
    [0  0  C] [t ] = [ - c ]          H real meters, C virtual ones, R = diag(sigma^2)
    [H' C' 0] [dx]   [  0  ]

by LU in double precision, refined with residuals in ``np.longdouble``. On a platform where that is no more than
double, the reference loses digits where impedances and sigmas are spread over decades.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.special import gammaincinv

from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.measurement import Measurement, MeasurementKind, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Network

EXTENDED = np.longdouble
PI = 4 * np.arctan(EXTENDED(1))
LAST_STEP = 1e-13  # p.u. and rad
CURRENTS_AFTER = 1e-4  # p.u. and rad; current magnitudes wait for a step below it
PLAIN_STEPS = 10  # later ones are halved, which ends swinging
MOST_STEPS = 300
MOST_REFINEMENTS = 30
LONGEST_DVM, LONGEST_DVA = 0.2, 1.0  # p.u., rad; a longer step is shortened
LEFT = 1e6  # p.u. and rad; such a step has left every state of interest
MISSED = 1e-8  # p.u.; an exact injection is met to rounding, 4e-9 beside a branch of 1e-6
CONFIDENCE, SUSPECT = 0.99, 3.0
NO_REDUNDANCY = 1e-12  # Omega_ii / R_ii
EQUAL = 1e-6
NOT_SEEN = 1e-11  # singular value at no load, rows of length 1
DEAD = 0.5  # p.u.; what the product does about such voltmeters is not repeated here
COLUMNS = 400  # right-hand sides at once


class NoReferenceError(Exception):
    """Why there is no dense answer."""


@dataclass(frozen=True)
class DenseAnswer:
    """``vm``, ``va``, ``sigma_vm``, ``sigma_va`` (n_bus,) in network order, p.u. and rad; ``removed``: ids in order;
    ``objective``: J without them."""

    vm: np.ndarray
    va: np.ndarray
    sigma_vm: np.ndarray
    sigma_va: np.ndarray
    objective: float
    removed: tuple[str, ...]


def estimate_densely(network: Network, measurements: Sequence[Measurement]) -> DenseAnswer:
    """The state without the meters that the largest normalised residual has taken out.

    Raises:
        NoReferenceError: not observable, divergence, or a voltmeter below DEAD.
    """
    left = list(measurements)
    if any(m.meter.kind is MeasurementKind.VM and m.value < DEAD for m in left):
        raise NoReferenceError(f"a voltmeter reads less than {DEAD} p.u.")
    if not _determine(network, left):
        raise NoReferenceError("not observable")
    fit = _Fit(network, left)
    removed: list[str] = []
    while fit.objective >= fit.limit() and (worst := _choose(network, left, fit.normalized_residuals())):
        left = [m for m in left if m.meter.id != worst]
        removed.append(worst)
        fit = _Fit(network, left)
    return DenseAnswer(fit.vm, fit.va, *fit.state_sigma(), fit.objective, tuple(removed))


def objective_of(network: Network, measurements: Sequence[Measurement], vm: np.ndarray, va: np.ndarray) -> float:
    """J of a state, which rounding in h does not blur; inf where an exact injection is missed."""
    rows = _Rows(network, measurements)
    r = rows.subtract(np.concatenate([va, vm]).astype(EXTENDED))
    missed = abs(r[rows.is_virtual]).max(initial=0.0) > MISSED
    return np.inf if missed else rows.objective(r)


def _choose(network: Network, left: Sequence[Measurement], normalized: Mapping[str, float]) -> str | None:
    """The meter to take out; None where none is suspected that can be spared."""
    suspects = {meter: value for meter, value in normalized.items() if value > SUSPECT}
    while suspects:
        largest = max(suspects.values())
        first = min(meter for meter, value in suspects.items() if value >= largest * (1 - EQUAL))
        if _determine(network, [m for m in left if m.meter.id != first]):
            return first
        del suspects[first]
    return None


def _determine(network: Network, measurements: Sequence[Measurement]) -> bool:
    """Whether the meters determine the state at no load, current magnitudes apart."""
    meters = [m.meter for m in measurements if m.meter.kind is not MeasurementKind.CURRENT]
    model = build_measurement_model(network, build_admittance(network, with_shunts=False), meters)
    H = np.delete(model.jacobian(_no_load(network)).toarray(), network.row[_slack(network)], axis=1).astype(float)
    if H.shape[0] < H.shape[1]:
        return False
    lengths = np.linalg.norm(H, axis=1)
    singular = np.linalg.svd(H / np.where(lengths > 0, lengths, 1.0)[:, None], compute_uv=False)
    return bool(singular.min(initial=1.0) >= NOT_SEEN)


def _slack(network: Network) -> int:
    assert network.slack is not None
    return network.slack.bus


def _no_load(network: Network) -> np.ndarray:
    """x = [va; vm] of the unloaded network with 1 p.u. at the slack bus, (2 n_bus,): over a spanning tree."""
    va, vm = {_slack(network): EXTENDED(0)}, {_slack(network): EXTENDED(1)}
    frontier = [_slack(network)]
    while frontier:
        here = frontier.pop()
        for branch in network.branches_at[here]:
            forwards = here == branch.from_bus
            there = branch.to_bus if forwards else branch.from_bus
            if there not in vm:
                sign = -1 if forwards else 1
                va[there], vm[there] = va[here] + sign * EXTENDED(branch.shift), vm[here] * EXTENDED(branch.tap) ** sign
                frontier.append(there)
    buses = [bus.id for bus in network.buses]
    return np.array([va[bus] for bus in buses] + [vm[bus] for bus in buses], dtype=EXTENDED)


class _Rows:
    """What some readings say about a state x = [va; vm]."""

    def __init__(self, network: Network, measurements: Sequence[Measurement]) -> None:
        kinds = [m.meter.kind for m in measurements]
        self.model = build_measurement_model(network, build_admittance(network), [m.meter for m in measurements])
        self.is_current = np.array([kind is MeasurementKind.CURRENT for kind in kinds])
        self.is_virtual = np.array([m.meter.source is Source.VIRTUAL for m in measurements])
        self.sigma = np.where(self.is_virtual, 0.0, [m.sigma for m in measurements])
        self._z = np.array([m.value for m in measurements], dtype=EXTENDED)
        self._is_angle = np.array([kind is MeasurementKind.VA for kind in kinds])

    def subtract(self, x: np.ndarray) -> np.ndarray:
        """z - h(x), differences of angles within half a turn."""
        r = self._z - self.model.predict(x)
        r[self._is_angle] -= 2 * PI * np.round(r[self._is_angle] / (2 * PI))
        return np.asarray(r)

    def objective(self, r: np.ndarray) -> float:
        real = ~self.is_virtual
        return float(((r[real] / self.sigma[real]) ** 2).sum())


class _Fit:
    """The weighted-least-squares fit of some readings."""

    def __init__(self, network: Network, measurements: Sequence[Measurement]) -> None:
        self._ids = [m.meter.id for m in measurements]
        self._rows = _Rows(network, measurements)
        self._n = len(network.buses)
        self._free = np.delete(np.arange(2 * self._n), network.row[_slack(network)])
        x = _no_load(network)
        x[: self._n] += network.slack.va if network.slack else 0.0
        self._x = self._iterate(x)
        self._residual = self._rows.subtract(self._x)
        self.objective = self._rows.objective(self._residual)
        self.va, self.vm = np.split(self._x.astype(float), 2)

    def limit(self) -> float:
        """Of J, by chi-square."""
        freedom = len(self._ids) - len(self._free)
        return 2 * float(gammaincinv(freedom / 2, CONFIDENCE)) if freedom > 0 else np.inf

    def _iterate(self, x: np.ndarray) -> np.ndarray:
        used = ~self._rows.is_current
        for count in range(MOST_STEPS):
            dx = self._tableau(x, used).step(self._rows.subtract(x)[used])
            largest = float(abs(dx).max())
            x = x.copy()
            x[self._free] += dx / self._shortening(dx, swings=count >= PLAIN_STEPS and largest >= LAST_STEP)
            if largest < LAST_STEP and used.all():
                return x
            if largest < CURRENTS_AFTER:
                used = np.ones(len(used), dtype=bool)
        raise NoReferenceError(f"no end after {MOST_STEPS} steps, the last of {largest}")

    def _shortening(self, dx: np.ndarray, *, swings: bool) -> float:
        if not abs(dx).max() < LEFT:
            raise NoReferenceError(f"diverged: a step of {abs(dx).max()}")
        of_angle = self._free < self._n
        dva, dvm = (float(abs(part).max(initial=0.0)) for part in (dx[of_angle], dx[~of_angle]))
        return max(2.0 if swings else 1.0, dva / LONGEST_DVA, dvm / LONGEST_DVM)

    def _tableau(self, x: np.ndarray, used: np.ndarray) -> _Tableau:
        H = sp.csr_array(self._rows.model.jacobian(x))[np.flatnonzero(used)][:, self._free]
        return _Tableau(sp.csr_array(H), self._rows.sigma[used])

    @cached_property
    def _at_end(self) -> _Tableau:
        return self._tableau(self._x, np.ones(len(self._ids), dtype=bool))

    def normalized_residuals(self) -> dict[str, float]:
        """Meter id -> |r| / sqrt(Omega_ii), of real meters with redundancy."""
        redundancy = self._at_end.redundancy()
        telling = np.flatnonzero(~self._rows.is_virtual & (redundancy > NO_REDUNDANCY))
        normalized = abs(self._residual[telling]) / self._rows.sigma[telling] / np.sqrt(redundancy[telling])
        return dict(zip([self._ids[k] for k in telling], normalized.astype(float).tolist(), strict=True))

    def state_sigma(self) -> tuple[np.ndarray, np.ndarray]:
        """(sigma_vm, sigma_va)."""
        variance = np.zeros(2 * self._n)
        variance[self._free] = self._at_end.state_variance()
        sigma_va, sigma_vm = np.split(np.sqrt(np.maximum(variance, 0.0)), 2)
        return sigma_vm, sigma_va


class _Tableau:
    """[R H; H' 0] with rows of length 1 and columns of size 1; ``H`` (m, n) extended, ``sigma`` (m,), 0: exact."""

    def __init__(self, H: sp.csr_array, sigma: np.ndarray) -> None:
        self._m, self._n = H.shape
        lengths = np.sqrt((H.multiply(H)).sum(axis=1)).astype(float)
        self._row = 1 / np.where(lengths > 0, lengths, 1.0)
        columns = abs(sp.diags_array(self._row) @ H).max(axis=0).toarray().ravel().astype(float)
        self._column = 1 / np.where(columns > 0, columns, 1.0)
        self._H = sp.csr_array(
            sp.diags_array(self._row.astype(EXTENDED)) @ H @ sp.diags_array(self._column.astype(EXTENDED))
        )
        self._transposed = sp.csr_array(self._H.T)
        variance = (sigma * self._row) ** 2
        self._scale = 1 / np.median(variance[variance > 0])
        self._variance = (self._scale * variance).astype(EXTENDED)
        dense = self._H.toarray().astype(float)
        K = np.block([[np.diag(self._variance.astype(float)), dense], [dense.T, np.zeros((self._n, self._n))]])
        self._lu = scipy.linalg.lu_factor(K, overwrite_a=True, check_finite=False)

    def _solve(self, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Refined until corrections shrink no more; ``right`` (m + n, k). The solution and the last correction."""
        found = np.zeros(right.shape, dtype=EXTENDED)
        smallest = np.inf
        for _ in range(MOST_REFINEMENTS):
            s, x = found[: self._m], found[self._m :]
            rest = right - np.vstack([self._variance[:, None] * s + self._H @ x, self._transposed @ s])
            correction = scipy.linalg.lu_solve(self._lu, rest.astype(float), check_finite=False)
            found += correction
            size = float(abs(correction).max())
            if not 0 < size < 0.5 * smallest:
                break
            smallest = size
        return found, correction

    def step(self, r: np.ndarray) -> np.ndarray:
        right = np.concatenate([r * self._row, np.zeros(self._n)]).astype(EXTENDED)
        found, correction = (part[self._m :, 0] * self._column for part in self._solve(right[:, None]))
        if not abs(correction).max() <= max(LAST_STEP, 1e-9 * abs(found).max()):
            raise NoReferenceError("the tableau is too ill-conditioned")
        return np.asarray(found)

    def redundancy(self) -> np.ndarray:
        """Omega_ii / R_ii, (m,); 0 of what is exact."""
        return (self._variance * self._diagonal(0, self._m)).astype(float)

    def state_variance(self) -> np.ndarray:
        return (-self._diagonal(self._m, self._m + self._n) * self._column**2 / self._scale).astype(float)

    def _diagonal(self, first: int, end: int) -> np.ndarray:
        """Entries ``first`` to ``end`` of the diagonal of the inverse."""
        parts = []
        for begin in range(first, end, COLUMNS):
            rows = np.arange(begin, min(begin + COLUMNS, end))
            unit = np.zeros((self._m + self._n, len(rows)))
            unit[rows, np.arange(len(rows))] = 1.0
            parts.append(self._solve(unit)[0][rows, np.arange(len(rows))])
        return np.concatenate(parts)
