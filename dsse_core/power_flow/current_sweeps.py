"""Power flows of networks with phases by sweeps: the currents that loads draw, then the voltages that these cause.

``v = Y^-1 (conj(s(v) / v) - Y_s v_s)`` at the nodes but those of the source, s; the factors of Y serve all sweeps and
all schedules. On a tree substitution goes to the root and back, as the sweeps of balanced networks do; these need no
matrix, and take a third to a fifth of the time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dsse_core.grid.admittance import Admittance
from dsse_core.grid.network import Network

MOST = 60  # sweeps; loads for which more are needed are near the most that the network carries
SMALLEST = 1e-13  # p.u.: a change of voltage below it is rounding


@dataclass(frozen=True)
class CurrentSweeps:
    """Sweeps over ``network`` from the voltages ``start`` (n_nodes,), held at the nodes ``given``."""

    network: Network
    admittance: Admittance
    start: np.ndarray
    given: np.ndarray

    @cached_property
    def free(self) -> np.ndarray:
        """Rows of the nodes whose voltages are found."""
        return np.setdiff1d(np.arange(len(self.start)), self.given)

    @cached_property
    def _between(self) -> sp.csr_array:
        return sp.csr_array(self.admittance.ybus[self.free])

    @cached_property
    def _factors(self) -> spla.SuperLU:
        return spla.splu(self._between[:, self.free].tocsc())

    def run(self, scheduled: np.ndarray) -> tuple[np.ndarray, int] | None:
        """The voltages (n_nodes,) at injections ``scheduled``, complex, at nominal voltages, and the number of sweeps;
        None where they do not settle.
        """
        legs, v, free, before = self.network.legs, self.start.copy(), self.free, np.inf
        with np.errstate(all="ignore"):
            for sweep in range(1, MOST + 1):
                s = scheduled - legs.find_excess(v)
                short = (s / v).conj()[free] - self._between @ v  # of current at each node
                step = self._factors.solve(short)
                v[free] += step
                change = float(abs(step).max(initial=0.0))
                if not change < np.inf:
                    return None
                if change < SMALLEST or (change >= before and change < 100 * SMALLEST):
                    return v, sweep
                before = change
        return None
