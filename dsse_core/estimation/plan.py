"""Plan of an estimate: the facts of a network and its meters, found once for all scans, and the choice of back end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.switches import Alternatives, build_alternatives
from dsse_core.grid.columns import Records, take_items
from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import find_virtual
from dsse_core.grid.network import Network
from dsse_core.grid.supply import find_alternatives
from dsse_core.linear.area_model import build_whole_grid
from dsse_core.linear.whole_grid import GridSolver
from dsse_core.observability import find_indispensable_rows, find_reference
from dsse_core.radial.plan import RadialPlan, build_radial_plan, drop_meters

Backend = Literal["radial", "sparse"]
BackendChoice = Literal["auto", "radial", "sparse"]
# Size of a radial network from which on ``auto`` loads numba. Measured with 500 or 1000 buses, an estimate with all
# normalised residuals takes 1 ms with radial, after 0.3 s for the import, and 0.1 s with sparse: some scans repay it.
FEWEST_BUSES_OF_RADIAL = 500


@dataclass(frozen=True, repr=False)
class EstimationPlan:
    """Plan for scans of ``meters``. ``radial``: plan of the back end of that name, or the reason against it as text."""

    network: Network
    meters: Sequence[Meter]
    reference: int
    radial: RadialPlan | str

    def __repr__(self) -> str:
        return (
            f"<EstimationPlan of {self.network.name!r}: {len(self.network.buses)} buses, {len(self.meters)} meters, "
            f"reference bus {self.reference}, back end {self.backend!r}>"
        )

    @property
    def backend(self) -> Backend:
        return "sparse" if isinstance(self.radial, str) else "radial"

    @cached_property
    def sparse(self) -> GridSolver:
        """The grid as one area on sparse matrices; where the back end is radial, for what that does not compute."""
        return build_whole_grid(self.network, self.meters, self.reference)

    @cached_property
    def alternatives(self) -> Alternatives:
        """The grid with the other status of each switch."""
        model = self.sparse.model
        return build_alternatives(model, find_alternatives(model.area, {}))

    @cached_property
    def virtual(self) -> np.ndarray:
        """True for each reading that holds exactly, shape (n_meas,)."""
        return find_virtual(self.meters)

    @cached_property
    def indispensable(self) -> np.ndarray:
        """True for meters without which the state is undetermined, shape (n_meas,); see ``find_indispensable_rows``."""
        if isinstance(self.radial, str):
            return find_indispensable_rows(self.network, self.meters, reference=self.reference)
        from dsse_core.radial.redundancy import find_radial_indispensable  # numba, loaded when the plan was built

        return find_radial_indispensable(self.radial)

    def without(self, rows: Sequence[int]) -> EstimationPlan:
        """Plan without the meters at the positions ``rows``, on the same back end if that can still serve.

        Raises:
            NotObservableError: names the buses that the others do not determine.
        """
        radial = self.radial if isinstance(self.radial, str) else drop_meters(self.radial, rows)
        meters = take_items(self.meters, np.delete(np.arange(len(self.meters)), rows))
        return _make_plan(self.network, meters, self.reference, radial)

    @property
    def degrees_of_freedom(self) -> int:
        """Measurements + constraints - state variables, estimated taps included."""
        return len(self.meters) - len(self.network.find_unknown(self.reference))


def build_estimation_plan(
    network: Network,
    meters: Sequence[Meter],
    *,
    reference: int | None = None,
    backend: BackendChoice = "auto",
) -> EstimationPlan:
    """Plan for scans of ``meters``, which are checked here and not again.

    Args:
        reference: bus whose nodes have given angles; the slack bus by default.
        backend: ``radial`` (compiled, radial networks, numba), ``sparse`` (any network), or ``auto``: radial where it
            can serve and the network has FEWEST_BUSES_OF_RADIAL buses or more, whatever is loaded already.

    >>> import consensus_dsse as dsse
    >>> scenario = dsse.load_scenario("ieee33")
    >>> dsse.build_estimation_plan(scenario.network, scenario.meters).degrees_of_freedom > 0
    True

    Raises:
        InvalidInputError: listing every meter that does not fit the network; or why radial cannot serve.
        NotObservableError: names the buses that the meters do not determine.
    """
    if backend not in get_args(BackendChoice):
        known = ", ".join(get_args(BackendChoice))
        raise InvalidInputError("state estimation", [f"backend is {backend!r}; choose one of {known}"])
    reference = find_reference(network, reference)
    if not isinstance(meters, Records):
        meters = tuple(meters)
    radial = _find_radial_plan(network, meters, reference, backend)
    if backend == "radial" and isinstance(radial, str):
        problem = f"the radial back end cannot serve: {radial}; choose 'auto' or 'sparse'"
        raise InvalidInputError(f"estimate of network {network.name!r}", [problem])
    return _make_plan(network, meters, reference, radial)


def _make_plan(network: Network, meters: Sequence[Meter], reference: int, radial: RadialPlan | str) -> EstimationPlan:
    """The plan, checked where the back end is sparse; one factor tells what is observable and what can be spared."""
    plan = EstimationPlan(network, meters, reference, radial)
    if isinstance(radial, str):
        _ = plan.indispensable  # raises where the meters do not determine the state
    return plan


def _find_radial_plan(
    network: Network, meters: Sequence[Meter], reference: int, backend: BackendChoice
) -> RadialPlan | str:
    n = len(network.buses)
    if backend == "sparse":
        return "the sparse back end was asked for"
    if backend == "auto" and n < FEWEST_BUSES_OF_RADIAL:
        return f"with {n} buses loading numba takes longer than it saves (below {FEWEST_BUSES_OF_RADIAL})"
    return build_radial_plan(network, meters, reference=reference)
