"""Many scans of the same meters at once: one compiled loop over rows, on all processors, an end for each row."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from dsse_core.compiling import find_obstacle
from dsse_core.errors import EstimationDivergedError, InvalidInputError, NotObservableError
from dsse_core.estimation.divergence import explain_magnitudes
from dsse_core.estimation.estimator import estimate_with_plan
from dsse_core.estimation.plan import EstimationPlan
from dsse_core.estimation.residuals import CONFIDENCE, chi_square_limit
from dsse_core.gauss_newton import LAST_STEP, MOST_STEPS, REST
from dsse_core.grid.measurement import are_usable, check_readings, read_numbers
from dsse_core.radial.plan import RadialPlan
from dsse_core.row_threads import find_threads, share_out

Start = tuple[np.ndarray, np.ndarray]
# Part of the cache that processors share. Beyond it threads wait for memory, and for each other: 24 rows of 10,000
# buses, 47 MB a thread, took 55 ms on one thread and 94 ms on two; 1,000 buses, 5 MB, take two thirds of the time on
# two.
CACHE_BYTES = 32_000_000


class FailureCode(StrEnum):
    """Reasons why a row has no estimate: unusable readings, too few readings, or an iteration without end."""

    INVALID = "invalid"
    UNOBSERVABLE = "unobservable"
    DIVERGED = "diverged"


@dataclass(frozen=True, slots=True)
class RowFailure:
    """Failure of one row. ``text``: that of the error which ``estimate_with_plan`` raises for the row's readings."""

    code: FailureCode
    text: str


_CODE_OF = {
    InvalidInputError: FailureCode.INVALID,
    NotObservableError: FailureCode.UNOBSERVABLE,
    EstimationDivergedError: FailureCode.DIVERGED,
}


def describe_failure(error: InvalidInputError | NotObservableError | EstimationDivergedError) -> RowFailure:
    """Failure of the row whose readings have raised ``error``."""
    return RowFailure(_CODE_OF[type(error)], str(error))


@dataclass(frozen=True, repr=False)
class BatchResult:
    """The estimate of each row of readings. ``vm`` p.u., ``va`` rad: shape (n_row, n_nodes), network order.

    ``objective`` J(x), ``iterations`` and ``degrees_of_freedom``: (n_row,). ``failures``: row -> why it has no
    estimate; the numbers of such a row are NaN, its iterations 0.
    """

    plan: EstimationPlan
    vm: np.ndarray
    va: np.ndarray
    objective: np.ndarray
    iterations: np.ndarray
    degrees_of_freedom: np.ndarray
    failures: Mapping[int, RowFailure]

    def __repr__(self) -> str:
        rows, buses = self.vm.shape
        return f"<BatchResult of {self.plan.network.name!r}: {rows} rows, {buses} buses, {len(self.failures)} failures>"


def estimate_batch(
    plan: EstimationPlan,
    values: np.ndarray,
    sigmas: np.ndarray,
    *,
    start: Start | None = None,
    tolerance: float = LAST_STEP,
    threads: int | None = None,
) -> BatchResult:
    """The estimates that ``estimate_with_plan`` finds for each row of ``values``.

    With the radial back end the rows are done in compiled code that no lock of the interpreter holds up.

    Args:
        values: (n_row, n_meas), p.u. and rad. A reading that is NaN or masked is missing: its row is estimated as with
            ``plan.without`` that meter, and fails where the others do not determine the state.
        sigmas: (n_row, n_meas), or (n_meas,) for all rows.
        start: (vm, va), each (n_row, n_nodes), or (n_nodes,) for all rows; by default the flat start.
        tolerance: see ``estimate_with_plan``.
        threads: the most threads that are used; all processors by default. Rows side by side use fewer where the
            memory that they work in does not fit into CACHE_BYTES. The numbers do not depend on it.

    >>> import consensus_dsse as dsse, numpy as np
    >>> scan = dsse.estimate("ieee33").report.result
    >>> batch = dsse.estimate_batch(scan.plan, np.stack([scan.values, scan.values]), scan.sigmas)
    >>> batch.vm.shape, batch.failures
    ((2, 33), {})

    Raises:
        InvalidInputError: shapes that do not fit, or unusable sigmas for all rows. Errors of single rows are in
            ``failures``.
    """
    rows = _Rows.of(plan, values, sigmas, start, tolerance)
    threads = find_threads(threads)
    is_compiled = not isinstance(plan.radial, str) and find_obstacle("batch") is None
    if is_compiled:
        from dsse_core.radial.lanes import LANES

        share_out(len(rows.values), rows.fit_threads(threads), rows.compiled, together=LANES)
        rows.put_back_spaces()
    else:
        share_out(len(rows.values), threads, rows.alone)
    failures = {k: rows.failures[k] for k in sorted(rows.failures)}
    return BatchResult(plan, rows.vm, rows.va, rows.objective, rows.iterations, rows.degrees_of_freedom, failures)


@dataclass(frozen=True)
class _Rows:
    """Input and output arrays of a batch; ``starts`` (n_row, 1 or 0, 2, n_nodes), ``limits`` of J (n_row,).

    ``spaces``: memory that threads have taken from the radial plan.
    """

    plan: EstimationPlan
    values: np.ndarray
    sigmas: np.ndarray
    starts: np.ndarray
    tolerance: float
    degrees_of_freedom: np.ndarray
    limits: np.ndarray
    vm: np.ndarray
    va: np.ndarray
    objective: np.ndarray
    iterations: np.ndarray
    failures: dict[int, RowFailure]
    plans: dict[bytes, EstimationPlan]
    spaces: list[np.ndarray]

    @classmethod
    def of(
        cls, plan: EstimationPlan, values: np.ndarray, sigmas: np.ndarray, start: Start | None, tolerance: float
    ) -> _Rows:
        n, n_meas = plan.network.n_nodes, len(plan.meters)
        values = np.ascontiguousarray(read_numbers("values", values))
        sigmas = np.array(read_numbers("sigmas", sigmas), order="C")
        n_row = len(values) if values.ndim else 0
        problems = []
        if values.shape != (n_row, n_meas):
            problems.append(f"values have shape {values.shape}; the plan's meters want (number of rows, {n_meas})")
        if sigmas.shape not in ((n_meas,), (n_row, n_meas)):
            problems.append(f"sigmas have shape {sigmas.shape}; give ({n_meas},) or {(n_row, n_meas)}")
        starts = np.empty((0, 2, n))
        if start is not None:
            vm, va = (read_numbers("the start", part) for part in start)
            if vm.shape != va.shape or vm.shape not in ((n,), (n_row, n)):
                problems.append(f"the start has shapes {vm.shape} and {va.shape}; give ({n},) or {(n_row, n)} twice")
            else:
                starts = np.ascontiguousarray(np.stack([vm, va], axis=-2).reshape(-1, 2, n))
        if problems:
            raise InvalidInputError(f"readings of network {plan.network.name!r}", problems)
        of_all = sigmas.ndim == 1
        sigmas = np.atleast_2d(sigmas)
        sigmas[:, plan.virtual] = 0.0
        if of_all and not (plan.virtual | are_usable(sigmas[0])).all():
            check_readings(plan.network, plan.meters, np.zeros(n_meas), sigmas[0])
        vm, va = np.full((2, n_row, n), np.nan)
        objective, iterations = np.full(n_row, np.nan), np.zeros(n_row, dtype=np.int64)
        left = plan.degrees_of_freedom - np.isnan(values).sum(axis=1)
        numbers, place = np.unique(left, return_inverse=True)
        limits = np.array([chi_square_limit(number, CONFIDENCE) for number in numbers.tolist()])[place]
        found = vm, va, objective, iterations
        return cls(plan, values, sigmas, starts, tolerance, left, limits, *found, {}, {}, [])

    def fit_threads(self, threads: int) -> int:
        """Number of threads to use: for rows side by side at most as many as fit into CACHE_BYTES, one at least."""
        from dsse_core.radial.together import count_bytes

        n = len(self.plan.network.buses)
        return max(1, min(threads, CACHE_BYTES // count_bytes(n))) if self._go_together() else threads

    def _go_together(self) -> bool:
        """True where rows are done side by side."""
        from dsse_core.radial.lanes import LANES
        from dsse_core.radial.together import MOST_BUSES

        plan = self.plan.radial
        alike = len(self.sigmas) == 1 and isinstance(plan, RadialPlan) and not plan.has_currents
        return alike and len(self.values) >= LANES and len(self.plan.network.buses) <= MOST_BUSES

    def compiled(self) -> Callable[[int, int], None]:
        """Function that estimates rows in compiled code, and alone those that fail there; with memory of its own, until
        ``put_back_spaces``.
        """
        from dsse_core.radial import rows as radial_rows  # numba, loaded when the plan was built

        plan = self.plan.radial
        assert isinstance(plan, RadialPlan)
        space, lanes = plan.take_space(), self._lanes(plan)
        self.spaces.append(space)
        of_plan = plan.parent, plan.level, plan.admittance, plan.no_load_admittance, plan.order, plan.meter
        options = plan.has_currents, float(self.tolerance), MOST_STEPS

        def do(first: int, end: int) -> None:
            here = slice(first, end)
            succeeded = np.empty(end - first, dtype=bool)
            radial_rows.estimate_rows(
                *of_plan, self.plan.virtual, plan.start, plan.start_va, _rows_of(self.starts, here), *options,
                self.limits[here], self.values[here], _rows_of(self.sigmas, here), space, lanes,
                self.vm[here], self.va[here], self.objective[here], self.iterations[here], succeeded,
            )  # fmt: skip
            for k in np.flatnonzero(~succeeded | (self.vm[here] <= REST).any(axis=1)).tolist():
                self._do_alone(first + k)

        return do

    def put_back_spaces(self) -> None:
        """Puts the memory of all threads, which have ended, back into the radial plan for the next scans."""
        plan = self.plan.radial
        assert isinstance(plan, RadialPlan)
        plan.spaces.extend(self.spaces)

    def _lanes(self, plan: RadialPlan) -> np.ndarray:
        """Memory of rows side by side; empty where each row is done by itself."""
        from dsse_core.radial.together import make_space

        return make_space(len(plan.order) if self._go_together() else 0)

    def alone(self) -> Callable[[int, int], None]:
        """Function that estimates row after row by ``estimate_with_plan``."""

        def do(first: int, end: int) -> None:
            for k in range(first, end):
                self._do_alone(k)

        return do

    def _do_alone(self, k: int) -> None:
        values, sigmas = self.values[k], _rows_of(self.sigmas, slice(k, k + 1))[0]
        start = _rows_of(self.starts, slice(k, k + 1))
        missing = np.isnan(values)
        try:
            found = estimate_with_plan(
                self._plan_without(missing),
                values[~missing],
                sigmas[~missing],
                start=(start[0, 0], start[0, 1]) if len(start) else None,
                tolerance=self.tolerance,
            )
            if cause := explain_magnitudes(found.network, found.x):
                raise EstimationDivergedError(found.iterations, 0.0, cause)
        except (InvalidInputError, NotObservableError, EstimationDivergedError) as error:
            self.failures[k] = describe_failure(error)
            self.vm[k] = self.va[k] = self.objective[k] = np.nan
            self.iterations[k] = 0
        else:
            self.vm[k], self.va[k], self.objective[k] = found.vm, found.va, found.objective
            self.iterations[k] = found.iterations

    def _plan_without(self, missing: np.ndarray) -> EstimationPlan:
        if not missing.any():
            return self.plan
        pattern = missing.tobytes()
        if pattern not in self.plans:
            self.plans[pattern] = self.plan.without(np.flatnonzero(missing).tolist())
        return self.plans[pattern]


def _rows_of(array: np.ndarray, here: slice) -> np.ndarray:
    """The rows ``here`` of ``array``, or its only row, which serves all scans."""
    return array if len(array) <= 1 else array[here]
