"""Interface of a tool that is timed. A tool is one class; ours and the peers' are listed in ``compared.py``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from benchmarks.estimates.cases import Case

TOLERANCE = 1e-6  # of max |dx|, p.u. and rad, for every tool
MAX_ITERATIONS = 50


class NotConvergedError(Exception):
    """No estimate was found: the tool reports it, or its voltages show it."""


@dataclass(frozen=True)
class State:
    """An estimate in network order, ``vm`` p.u., ``va`` rad (0 at the substation); iterations where they are known."""

    vm: np.ndarray
    va: np.ndarray
    iterations: int | None = None


class Method(Protocol):
    """One tool, one algorithm. Timed: cold = ``build`` + ``solve``, warm = ``solve`` again on the same model.

    ``translate`` (the case in the tool's own input format) and ``read`` are not timed. Every failure is an exception.
    """

    @property
    def name(self) -> str: ...

    @property
    def package(self) -> str:
        """Name of the package in pip: its version is reported, and a method without its package is not run."""
        ...

    def translate(self, case: Case) -> Any: ...

    def build(self, data: Any) -> Any: ...

    def solve(self, model: Any) -> Any: ...

    def read(self, case: Case, result: Any) -> State: ...
