"""Statuses of switches that the readings contradict: by how much J of the whole grid is less with the other status.

J of the whole grid is the sum of all areas' J. At the state where messages are found, each neighbour's information is
the least J of its side, all but the boundary variables eliminated, up to a constant: ``|z - R y|^2``. No other area
depends on the status, so this and the constant are the same for both. So the area that holds the switch finds the
change of J of the whole grid from its own rows and the messages that it has, beside what others are not linear.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from dsse_core.errors import DsseError
from dsse_core.estimation.residuals import THRESHOLD, find_switches, name_switch
from dsse_core.gauss_newton import LAST_STEP, MAX_DVA, MAX_DVM
from dsse_core.grid.network import Network
from dsse_core.grid.switches import find_meters_in_service
from dsse_core.linear.area_measurements import AreaMeasurements
from dsse_core.linear.area_model import with_network
from dsse_core.linear.interface import Received
from dsse_core.linear.rows import TableauSolver
from dsse_core.linear.sparse import SparseRows

MOST_ITERATIONS = 20  # of Gauss-Newton with the other status


Alternatives = Mapping[str, tuple[TableauSolver, np.ndarray]]
"""Switch -> solver of the area with its other status, and the positions of the meters that are in service then."""


def build_alternatives(model: AreaMeasurements, networks: Mapping[str, Network]) -> Alternatives:
    """The alternatives to ``model`` for any readings of its meters; ``networks``: see ``find_alternatives``."""
    return {
        switch: (_on_rows(with_network(model, network)), find_meters_in_service(network, model.meters))
        for switch, network in networks.items()
    }


class Gain(NamedTuple):
    """The other status of a switch, weighed."""

    fall: float
    """By how much J of the whole grid is less with it; negative where J is more."""
    doubt: float
    """By how much ``fall`` may be off. The messages hold the first step of other areas: as that of the own rows misses
    their least J, so may theirs. 0 without neighbours."""

    @property
    def is_undecided(self) -> bool:
        """True where the status as it is may be right, and the other one, too."""
        return self.fall <= THRESHOLD**2 and self.fall + self.doubt >= -(THRESHOLD**2)


def weigh_switches(
    model: AreaMeasurements, x: np.ndarray, received: Received, alternatives: Alternatives
) -> dict[str, Gain]:
    """Switch -> the gain of its other status, of all ``alternatives``.

    ``received``: the information of neighbours at ``x``. A meter at a switch that is opened should read 0. A switch is
    left out where one of its statuses leads to no end.
    """
    found: dict[str, Gain] = {}
    if not alternatives or (own := _find_least(_on_rows(model), x, received)) is None:
        return found
    for switch, (solver, rows) in alternatives.items():
        read = solver.model.with_values(model.z[rows], model.sigma[rows], further=model.further)
        if (other := _find_least(solver.with_readings(read), x, received)) is None:
            continue
        at_switch = ~model.virtual
        at_switch[rows] = False
        reads_0 = float(((model.z[at_switch] / model.sigma[at_switch]) ** 2).sum())
        (least, _), (of_other, promised) = own, other
        found[switch] = Gain(least - of_other - reads_0, abs(promised - of_other) if received else 0.0)
    return found


def _on_rows(model: AreaMeasurements) -> TableauSolver:
    return TableauSolver(model, SparseRows(model), "sparse")


def find_wrong_switches(gains: Mapping[str, Gain]) -> dict[str, float]:
    """``name_switch`` of each switch whose other status lowers J by more than THRESHOLD^2 -> root of the change.

    So large is the normalised residual of a meter whose removal lowers J as much.
    """
    return {name_switch(s): float(np.sqrt(g.fall)) for s, g in gains.items() if g.fall > THRESHOLD**2}


def describe_switches(switched: Iterable[str], gains: Mapping[str, Gain]) -> Iterator[str]:
    """Sentences on switches: on those ``switched``, in use with the other status than was read, and by ``gains`` on
    those that fit better with the other one, and on those whose status the readings do not tell.
    """
    for switch in switched:
        yield f"{name_switch(switch)} counts the other way, as the readings contradict its status: check it"
    for switch in find_switches(find_wrong_switches(gains)):
        what = f"the readings fit better with the other status of {name_switch(switch)}"
        yield f"{what} (J less by {gains[switch].fall:.3g}): check it"
    if undecided := [switch for switch, gain in gains.items() if gain.is_undecided]:
        yield f"undecided, the readings may fit both statuses: switch {', '.join(undecided)}"


def _find_least(solver: TableauSolver, x: np.ndarray, received: Received) -> tuple[float, float] | None:
    """The least J of the area's rows and of the messages ``received``, found from ``x`` on by Gauss-Newton, and the J
    that the first step has promised; None where there is no end.
    """
    model, n, promised = solver.model, solver.model.n_nodes, None

    def find_objective(r: np.ndarray, sigma: np.ndarray) -> float:
        counts = np.ones(len(r), dtype=bool)
        counts[: len(model.z)] = ~model.virtual
        return float(((r[counts] / sigma[counts]) ** 2).sum())

    for _ in range(MOST_ITERATIONS):
        try:
            H, r, sigma = solver.stack(x, received)
            dx = solver.step(x, received)
        except (ArithmeticError, RuntimeError, DsseError):
            return None
        dva, dvm = float(abs(dx[:n]).max()), float(abs(dx[n : 2 * n]).max())
        if not np.isfinite(dx).all():
            return None
        promised = find_objective(r - H @ dx, sigma) if promised is None else promised
        x = x + dx / max(1.0, dva / MAX_DVA, dvm / MAX_DVM)
        if max(dva, dvm) < LAST_STEP:
            _, r, sigma = solver.stack(x, received)
            return find_objective(r, sigma), promised
    return None
