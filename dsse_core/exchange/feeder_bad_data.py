"""Part of an area in the tests of the whole feeder: J, degrees of freedom, observability, critical meters at no load.

At the end of the exact exchange the areas' J and degrees of freedom add up to those of the centralised estimate, and
their normalised residuals are the same. So a sum and a maximum along the tree lead to the same verdicts (``decision``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.admittance import flat_start
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.meter_table import OF_VOLTAGE
from dsse_core.grid.partition import Area, Neighbour
from dsse_core.grid.quantities import Quantity
from dsse_core.linear import NoLoadSolver
from dsse_core.linear.area_model import AreaModel, build_area_model
from dsse_core.linear.boundary_information import BoundaryInformation
from dsse_core.matrices.augmented import reciprocal_root, reciprocal_row_lengths, scale_rows
from dsse_core.observability import ROUND_OFF, NoLoadFit, find_touched, find_touched_nodes

# Entry of R for a power, in units of the own powers, or for a voltage, below which a message holds nothing.
# NO_LOAD_NOT_YET alone gives 1e-9, rounding 1e-7. A voltage known through the smallest impedances in a row has more.
NOTHING_AT_NO_LOAD = 1e-6


def find_objective(model: AreaModel, x: np.ndarray) -> float:
    """J of the area's own measurements; virtual ones do not count."""
    own = model.contribution(model.predict(x))
    return float(model.real_part(own.weight) @ own.residual**2)


def count_freedom(model: AreaModel) -> int:
    """The area's part of the degrees of freedom."""
    return len(model.meters) - model.area.n_unknown


@dataclass(frozen=True)
class NoLoadModel:
    """The area's meters but currents, at no load, to find indispensable ones; sigma of powers: the median admittance.

    ``find_indispensable`` of ``observability`` decides by the same rows for the whole grid. Areas send each other the
    cost-to-go of this model, once up and once down the tree. It is a function of the relative numbers (p, q) / vm_b^2,
    dvm / vm_b and dva. Behind a transformer an area has another no-load voltage, but the rows of relative numbers are
    the same in all areas.
    """

    model: AreaModel
    linear: NoLoadSolver
    x: np.ndarray
    ids: tuple[str, ...]
    typical: float  # the median admittance

    def information_for(self, neighbour: Neighbour, received: Mapping[str, BoundaryInformation]) -> BoundaryInformation:
        information = self.linear.information(self.x, neighbour, self._at_own_voltage(received))
        boundary = self.model.boundary_of(neighbour)
        R = _keep_something(information.R, boundary.n_powers, self.typical) * self._voltage_of(neighbour)
        return BoundaryInformation(R, np.zeros(boundary.d))

    def examine(self, received: Mapping[str, BoundaryInformation]) -> tuple[tuple[int, ...], frozenset[str]]:
        """The unobservable nodes, by rows, and the ids of indispensable meters, virtual ones included.

        Neither the area's meters nor the information of neighbours determines the voltage of an unobservable node.
        Without any one of the indispensable meters the state is not observable.
        """
        fit = self._fit(self._at_own_voltage(received))
        model, undetermined = self.model, np.zeros(self.model.size, dtype=bool)
        undetermined[model.free] = find_touched(fit.find_null_vectors())
        nodes = np.flatnonzero(find_touched_nodes(model.area.network, undetermined[~model.are_powers]))
        unchecked = fit.find_unchecked()[: len(self.ids)]
        return (
            tuple(nodes.tolist()),
            frozenset(self.ids[k] for k in np.flatnonzero(unchecked).tolist()),
        )

    def _fit(self, received: Mapping[str, BoundaryInformation]) -> NoLoadFit:
        """Fit of the own rows, of length 1, and of the rows ``received``, where NOTHING_AT_NO_LOAD counts as ROUND_OFF.

        A power is in units of its largest part in a row, so that it moves by no more than the voltages on which it
        depends.
        """
        model = self.model
        of_power = model.are_powers
        H = self.linear.stack(self.x, received)[0]
        H = sp.csr_array(H @ sp.diags_array(np.where(of_power, self.typical, 1.0)))
        to_one = reciprocal_row_lengths(H)
        A = scale_rows(H, to_one)
        unit = reciprocal_root(np.bincount(A.indices, A.data**2, A.shape[1]))
        A = sp.csr_array(A @ sp.diags_array(np.where(of_power, unit, 1.0)))
        weight = ROUND_OFF / NOTHING_AT_NO_LOAD / np.maximum(to_one, 1.0)
        weight[: len(self.ids)] = 1.0
        return NoLoadFit(scale_rows(A, weight)[:, model.free])

    def _at_own_voltage(self, received: Mapping[str, BoundaryInformation]) -> dict[str, BoundaryInformation]:
        """The neighbours' information about relative numbers, as information about y."""
        return {
            n.area: replace(received[n.area], R=received[n.area].R / self._voltage_of(n))
            for n in self.model.area.neighbours
            if n.area in received
        }

    def _voltage_of(self, neighbour: Neighbour) -> np.ndarray:
        """Factors from relative numbers to y, shape (d,)."""
        network, boundary = self.model.area.network, self.model.boundary_of(neighbour)
        vm = self.x[[network.n_nodes + network.node(v.bus, v.phase) for v in boundary.variables]]
        return np.array([size ** int(degree) for size, degree in zip(vm.tolist(), boundary.degrees, strict=True)])


def _keep_something(R: np.ndarray, n: int, typical: float) -> np.ndarray:
    """The rows of R, shape (d, d), that hold information: of n powers given the voltages, then of the voltages.

    Reflections can leave information about voltages in the rows of powers. Rows of powers that hold none of powers
    count as rows of voltages.
    """
    U, size, _ = np.linalg.svd(R[:n, :n])
    of_powers, is_something = U.T @ R[:n], size * typical >= NOTHING_AT_NO_LOAD
    of_voltages = np.concatenate([of_powers[~is_something, n:], R[n:, n:]])
    U, size, _ = np.linalg.svd(of_voltages, full_matrices=False)
    of_voltages = (U.T @ of_voltages)[size >= NOTHING_AT_NO_LOAD]
    found = np.zeros_like(R)
    for first, rows in ((0, of_powers[is_something]), (n, np.pad(of_voltages, ((0, 0), (n, 0))))):
        found[first : first + len(rows), first:] = np.linalg.qr(rows[:, first:], mode="r")
    return found


def build_no_load_model(area: Area, measurements: Sequence[Measurement], reference: int | None) -> NoLoadModel:
    """The no-load model of ``area``; ``reference``: bus of the grid's angle reference, if the area sees it."""
    but_currents = [m for m in measurements if m.meter.kind.quantity is not Quantity.CURRENT]
    model = build_area_model(area, but_currents, reference, with_shunts=False)
    start = area.slack_bus if reference is None else reference
    vm, va = area.find_no_load() if area.no_load else flat_start(area.network, start)
    x = area.join_state(vm, va)
    of_power = ~OF_VOLTAGE[model.kinds]
    typical = np.median([1 / abs(complex(b.r, b.x)) for b in area.network.active_branches] or [1.0])
    model = replace(model, z=model.predict(x), sigma=np.where(of_power, typical, 1.0))
    return NoLoadModel(model, NoLoadSolver(model, float(typical)), x, model.ids, float(typical))
