"""Whether two answers to one case are the same, and if not, whether the new one is the better fit."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from tests.golden.centralised.dense_reference import objective_of
from tests.golden.centralised.oracle_cases import Readings

STATE = 1e-9  # p.u. and rad
# Relative. Where readings are as stored, sigmas move by up to 400 times what the state does (measured, branches of
# 1e-6 p.u.), so that 1e-9 of the state allows 4e-7.
SIGMA = 1e-6
FIXED = 1e-8  # p.u. and rad; a sigma below it is what rounding leaves of 0
# Of J, or of 1 where J is less. Rounding of h moves J by up to 1.4e-6 where sigmas are spread over four decades.
OBJECTIVE = 1e-5
LOWER = 1e-6  # of J in extended precision, or of 1


class Answer(Protocol):
    """State, standard deviations, (n_bus,) in network order, J, and the ids of the meters taken out, in order."""

    @property
    def vm(self) -> np.ndarray: ...
    @property
    def va(self) -> np.ndarray: ...
    @property
    def sigma_vm(self) -> np.ndarray: ...
    @property
    def sigma_va(self) -> np.ndarray: ...
    @property
    def objective(self) -> float: ...
    @property
    def removed(self) -> tuple[str, ...]: ...


def find_differences(found: Answer, expected: Answer) -> list[str]:
    """As text; none where the two are the same."""
    differences = []
    if found.removed != expected.removed:
        differences.append(f"removed {list(found.removed)}, not {list(expected.removed)}")
    gap = max(
        float(abs(found.vm - expected.vm).max()),
        float(abs(np.angle(np.exp(1j * (found.va - expected.va)))).max()),
    )
    if not gap <= STATE:
        differences.append(f"the state is {gap:.1e} off")
    for name in ("sigma_vm", "sigma_va"):
        sigma, right = getattr(found, name), getattr(expected, name)
        off = np.where(np.maximum(sigma, right) < FIXED, 0.0, abs(sigma - right) / np.maximum(right, FIXED))
        if not off.max() <= SIGMA:
            differences.append(f"{name} is off by {off.max():.1e} of itself")
    off_by = abs(found.objective - expected.objective) / max(expected.objective, 1.0)
    if not off_by <= OBJECTIVE:
        differences.append(f"J is {found.objective:.9g}, not {expected.objective:.9g}")
    return differences


def fits_better(found: Answer, expected: Answer, readings: Readings) -> bool:
    """Whether J of ``found`` is lower by more than LOWER, and not because more meters were taken out."""
    new, old = (_objective(answer, readings) for answer in (found, expected))
    return len(found.removed) <= len(expected.removed) and new < old - LOWER * max(old, 1.0)


def _objective(answer: Answer, readings: Readings) -> float:
    left = [m for m in readings.measurements if m.meter.id not in answer.removed]
    return objective_of(readings.network, left, answer.vm, answer.va)
