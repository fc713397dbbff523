"""The estimate of a network's state, with standard deviations, covariances and variances of residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from dsse_core.estimation.decision import Memory
from dsse_core.estimation.plan import Backend, EstimationPlan
from dsse_core.estimation.radial import RadialInverse, find_radial_variances, invert_radial
from dsse_core.estimation.residuals import MeterChecks
from dsse_core.estimation.switches import Gain, find_wrong_switches, weigh_switches
from dsse_core.estimation.taps import find_wrong_taps
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.network import Network
from dsse_core.linear.area_measurements import AreaMeasurements
from dsse_core.linear.whole_grid import GridSolver


@dataclass(frozen=True, repr=False)
class EstimationResult:
    """The estimate. ``vm`` p.u., ``va`` rad: shape (n_nodes,), network order; ``residual`` z - h(x): (n_meas,).

    ``values``, ``sigmas`` (n_meas,): the readings of the plan's meters, sigma 0 where a reading holds exactly.
    ``objective`` is J(x) (eq. 3.9), which under the model's assumptions is chi-square distributed with
    ``degrees_of_freedom`` = measurements + constraints - state variables. Properties are computed on demand, by the
    radial back end where that is chosen and computes them, else by sparse factorisation. ``iterations``: number of
    steps from the last start to the end. ``memory``: the state of the decisions, on which later verdicts rest;
    ``evaluating`` where J has exceeded the chi-square limit. ``taps`` (n_tap,): the
    estimated ones, in the order of ``network.estimated_taps``.
    """

    plan: EstimationPlan
    values: np.ndarray
    sigmas: np.ndarray
    memory: Memory
    vm: np.ndarray
    va: np.ndarray
    residual: np.ndarray
    objective: float
    iterations: int
    taps: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __repr__(self) -> str:
        return (
            f"<EstimationResult of {self.network.name!r}: {len(self.vm)} buses, J = {self.objective:.4g} "
            f"with {self.degrees_of_freedom} degrees of freedom, {self.iterations} iterations, {self.backend!r}>"
        )

    @property
    def backend(self) -> Backend:
        """Back end that found the state; where it is sparse, ``plan.radial`` says why it is not radial."""
        return self.plan.backend

    @cached_property
    def network(self) -> Network:
        """The network, with its estimated taps."""
        names = self.plan.network.estimated_taps
        return self.plan.network.with_taps(dict(zip(names, self.taps.tolist(), strict=True)))

    @property
    def reference(self) -> int:
        """The bus whose angle is given."""
        return self.plan.reference

    @property
    def degrees_of_freedom(self) -> int:
        return self.plan.degrees_of_freedom

    @cached_property
    def measurements(self) -> tuple[Measurement, ...]:
        readings = zip(self.plan.meters, self.values.tolist(), self.sigmas.tolist(), strict=True)
        return tuple(Measurement(meter, value, sigma) for meter, value, sigma in readings)

    @cached_property
    def x(self) -> np.ndarray:
        """The state [va; vm; estimated taps], p.u. and rad."""
        return np.concatenate([self.va, self.vm, self.taps])

    @cached_property
    def linear(self) -> GridSolver:
        """The grid as one area on sparse matrices, with these readings."""
        return self.plan.sparse.with_values(self.values, self.sigmas)

    def state_covariance(self, rows: Sequence[int]) -> np.ndarray:
        """Covariance of the entries ``rows`` of x, shape (k, k); 0 for the reference angle."""
        B = np.zeros((len(rows), len(self.x)))
        B[np.arange(len(rows)), rows] = 1.0
        return self.linear.covariance(self.x, {}, B)

    def state_sigma(self) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations (sigma_vm, sigma_va) of all buses, p.u. and rad; nan where they would take too long."""
        if (of_radial := self._radial_variances) is not None:
            variance = of_radial[0]
        else:
            variance = self.linear.variance_of_state(self.x)
        sigma_va, sigma_vm = np.split(np.sqrt(np.maximum(variance[: 2 * len(self.vm)], 0.0)), 2)
        return sigma_vm, sigma_va

    @cached_property
    def estimated_taps(self) -> dict[str, tuple[float, float]]:
        """Branch -> its estimated tap ratio, and the standard deviation of that; without those that have no supply."""
        network, first = self.plan.network, 2 * len(self.vm)
        if not (alive := np.flatnonzero(~network.are_taps_dead).tolist()):
            return {}
        sigma = np.sqrt(np.diag(self.state_covariance([first + tap for tap in alive])))
        names = [*network.estimated_taps]
        return {names[tap]: (float(self.taps[tap]), of_tap) for tap, of_tap in zip(alive, sigma.tolist(), strict=True)}

    @cached_property
    def residual_variance(self) -> np.ndarray:
        """diag(Omega), ``Omega = R - H G^-1 H'`` (eq. 3.22), shape (n_meas,); 0 for virtual measurements.

        In networks with so many long loops that all variances would take too long, only those of the largest
        |r| / sigma are found, and the others are nan.
        """
        if (of_radial := self._radial_variances) is not None:
            return of_radial[1]
        return self.linear.variance_of_residuals(self.x)

    @cached_property
    def gains(self) -> dict[str, Gain]:
        """Switch -> by how much J is less with its other status, see ``weigh_switches``."""
        if not self.network.switches:  # where the back end is radial, the sparse one is not built
            return {}
        return weigh_switches(self._model, self.x, {}, self.plan.alternatives)

    @property
    def checks(self) -> MeterChecks:
        """Checks of the estimate's meters. Not kept: they ask the estimate, and a cycle of objects would keep both."""
        of_meters = self.residual, self.residual_variance, self.sigmas, ~self.plan.virtual
        return MeterChecks(self.plan.meters, *of_meters, lambda: self.plan.indispensable, lambda: self._others)

    @cached_property
    def _others(self) -> dict[str, float]:
        """Taps and switches that stand out."""
        taps = find_wrong_taps(self._model, self.x, {}) if self.network.with_tap_steps else {}
        return taps | find_wrong_switches(self.gains)

    @property
    def _model(self) -> AreaMeasurements:
        """The grid as one area with these readings; where the back end is radial, the sparse one is built for it."""
        return self.plan.sparse.model.with_values(self.values, self.sigmas)

    @cached_property
    def radial_inverse(self) -> RadialInverse:
        """Selected inverse of the tree, from which all variances follow where the back end is radial."""
        assert not isinstance(self.plan.radial, str), "the back end is sparse"
        return invert_radial(self.plan.radial, self.sigmas, self.vm, self.va)

    @property
    def _radial_variances(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Variances of x and of the residuals where the back end is radial, else None."""
        radial = self.plan.radial
        return None if isinstance(radial, str) else find_radial_variances(radial, self.radial_inverse)
