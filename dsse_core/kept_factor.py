"""Steps of the exact exchange on a factor that is kept: as long as the state and what is heard stay nearby.

A step by itself costs a new factor. With an older one the system ``R s = r(x)``, ``H(x)' s = 0`` is refined instead,
its residuals taken where the state is: the steps end where those with new factors would, and shrink by as much as H and
the messages have changed, a thousandfold and more between two scans.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dsse_core.area_model import AreaModel
from dsse_core.augmented import AugmentedFactor
from dsse_core.augmented_dense import DenseFactor
from dsse_core.boundary_information import BoundaryInformation
from dsse_core.exchange_sparse import factor_rows, stack_rows

ON_THE_WAY = 1e-9  # p.u., rad: after a larger last step there is more to be done; below it may be rounding
NO_FURTHER = 0.1  # rate of steps, below which the last one tells how large the next one would be
NEARBY = 1e-2  # p.u. and rad of the state, and of the largest number in a message's row
SHRINKS = 0.03  # of a step to the one before; where they shrink less a new factor costs less
MOST_STEPS = 6


@dataclass(frozen=True)
class KeptFactor:
    """``factor`` of the rows of ``model`` and the messages ``heard`` at state ``x``; ``s`` as the steps left it."""

    model: AreaModel
    x: np.ndarray
    heard: Mapping[str, BoundaryInformation]
    factor: AugmentedFactor | DenseFactor
    s: np.ndarray

    def serves(self, model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation]) -> bool:
        """Whether steps from ``x`` with ``heard`` will shrink fast, for all that can be seen beforehand."""
        return (
            model.model is self.model.model
            and (model.sigma is self.model.sigma or np.array_equal(model.sigma, self.model.sigma))
            and float(abs(x - self.x).max()) <= NEARBY
            and heard.keys() == self.heard.keys()
            and all(heard[name] is then or _are_alike(heard[name].R, then.R) for name, then in self.heard.items())
        )


def _are_alike(R: np.ndarray, then: np.ndarray) -> bool:
    return bool((abs(R - then).max(axis=1) <= NEARBY * abs(then).max(axis=1)).all())


def find_rest(sizes: Sequence[float]) -> float:
    """The size of the next step, as far as those of the last two tell it; else that of the last one."""
    before, last = [np.inf, np.inf, *sizes][-2:]
    shrinks = last <= ON_THE_WAY and last <= NO_FURTHER * before < np.inf
    return last * last / before if shrinks else last


def solve_steps_anew(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], damping: np.ndarray, enough: float
) -> tuple[np.ndarray, list[float], KeptFactor]:
    """The step of ``solve_damped`` and those that follow on its factor: their sum, max |dx| of each, and the factor.

    ``enough``: of ``find_rest``, for no further step.
    """
    H, r, sigma = stack_rows(model, x, heard)
    factor = factor_rows(H[:, model.free], sigma, damping)
    s, d = factor.solve(r, np.zeros(len(model.free)), refined=False)
    dx = np.zeros(model.size)
    dx[model.free] = d
    kept = KeptFactor(model, x, heard, factor, s)
    sizes = [float(abs(dx).max(initial=0.0))]
    if sizes[0] > NEARBY:
        return dx, sizes, kept
    return _follow(kept, model, x, heard, enough, dx, sizes)


def solve_steps_on(
    kept: KeptFactor, model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], enough: float
) -> tuple[np.ndarray, list[float], KeptFactor] | None:
    """The same on a factor that is there; None where the steps do not shrink as they should."""
    if not kept.serves(model, x, heard):
        return None
    dx, sizes, kept = _follow(kept, model, x, heard, enough, np.zeros(model.size), [])
    return (dx, sizes, kept) if find_rest(sizes) <= enough else None


def _follow(
    kept: KeptFactor,
    model: AreaModel,
    x: np.ndarray,
    heard: Mapping[str, BoundaryInformation],
    enough: float,
    dx: np.ndarray,
    sizes: list[float],
) -> tuple[np.ndarray, list[float], KeptFactor]:
    """Further steps from ``x + dx``, until the next one would be small ``enough`` or they no longer shrink."""
    s, variance = kept.s, kept.factor.variance
    while find_rest(sizes) > enough and len(sizes) < MOST_STEPS:
        r, g = _find_residuals(model, x + dx, heard, s)
        ds, d = kept.factor.solve(r - variance * s, -g[model.free], refined=False)
        size = float(abs(d).max(initial=0.0))
        if size > (SHRINKS * sizes[-1] if sizes else NEARBY):
            break
        s = s + ds
        dx[model.free] += d
        sizes.append(size)
    return dx, sizes, KeptFactor(kept.model, kept.x, kept.heard, kept.factor, s)


def _find_residuals(
    model: AreaModel, x: np.ndarray, heard: Mapping[str, BoundaryInformation], s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """r(x), shape (rows,), and H(x)' s, shape (size,), of the rows of ``stack_rows``."""
    m = len(model.z)
    r, g = [model.residual(x)], np.asarray(model.jacobian(x).T @ s[:m])
    end = m
    for n in model.area.neighbours:
        if (message := heard.get(n.area)) is None:
            continue
        R, z = message.rows
        first, end = end, end + len(z)
        weight = R.T @ s[first:end]
        if n.is_parent or model.dense:
            y, T = model.boundary(x, n)
            g += T.T @ weight
        else:
            columns = model.boundary_columns(n)
            y = x[columns]
            g[columns] += weight
        r.append(z - R @ y)
    return np.concatenate(r), g
