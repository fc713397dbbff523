"""Many scans of the same meters in one compiled loop, on memory that is allocated once."""

from __future__ import annotations

import math

import numpy as np

from dsse_core.code_cache import compiled
from dsse_core.gauss_newton import LOST
from dsse_core.limits import LEAST_USABLE_SIGMA, MOST_USABLE_SIGMA
from dsse_core.radial.block import modulus, scaled
from dsse_core.radial.iteration import carve, carve_next, find_objective, forget_meters, iterate, place_of
from dsse_core.radial.kernel import CHECK, eliminate
from dsse_core.radial.lanes import LANES
from dsse_core.radial.layout import LEAST_PIVOT_RATIO
from dsse_core.radial.together import estimate_together

UNREADABLE = -1  # in place of the number of missing readings: some readings are unusable


@compiled
def estimate_rows(
    parent, place, Y, no_load_Y, order, slot, exact, start, start_va, starts, has_currents,
    tolerance, most_steps, limit, values, sigmas, space, lanes, vm, va_found, objective, steps, succeeded,
):  # fmt: skip
    """The iteration of each row of ``values`` (n_row, n_meas); a reading that is NaN is missing.

    ``sigmas`` (n_row or 1, n_meas), 0 where a reading is ``exact``. ``starts`` (n_row, 1 or 0, 2, n_bus): vm and va in
    network order; without them the start of the plan. ``limit`` (n_row,): limit of J. ``lanes``: memory of
    LANES rows side by side. A row is done by itself without that memory, where fewer than LANES rows are left, or where
    ``estimate_together`` fails for its LANES rows. Fills ``vm`` and ``va_found`` (n_row, n_bus) in network order,
    ``objective``, ``steps`` and ``succeeded`` (n_row,); where that is False the row's numbers do not count.
    """
    n = len(parent)
    v, va, z, w, above, factor, more, step, block = carve(space, n)
    z[:] = 0.0
    forget_meters(w)
    weighed = False
    done = 0  # rows before it
    for k in range(len(values)):
        if k < done:
            continue
        if not weighed:
            weighed = _weigh(slot, exact, sigmas[min(k, len(sigmas) - 1)], w)
        here = slice(k, k + LANES)
        if weighed and len(lanes) > 0 and k + LANES <= len(values) and k % LANES == 0 and estimate_together(
            parent, place, Y, order, slot, exact, start, start_va, starts[min(k, len(starts) - 1) : k + LANES],
            tolerance, limit[here], values[here], w, lanes, vm[here], va_found[here], objective[here], steps[here],
        ):  # fmt: skip
            succeeded[here] = True
            done = k + LANES
            continue
        missing = _store_row(slot, exact, values[k], z, w) if weighed else UNREADABLE
        weighed = weighed and missing == 0 and len(sigmas) == 1
        succeeded[k] = missing == 0 or (
            missing != UNREADABLE
            and _are_determined(parent, place, no_load_Y, z, w, start, start_va, above, factor, more, block, step)
        )
        if not succeeded[k]:
            continue
        if len(starts) == 0:
            v[:] = start
            va[:] = start_va
        else:
            _begin(order, starts[min(k, len(starts) - 1)], v, va)
        currents = has_currents and (missing == 0 or _has_currents(w))
        end, steps[k], _ = iterate(
            parent, place, Y, z, w, v, va, currents, tolerance, most_steps, limit[k],
            above, factor, more, block, step, carve_next(space, n),
        )  # fmt: skip
        succeeded[k] = end != LOST
        if not succeeded[k]:
            continue
        objective[k] = find_objective(parent, Y, z, w, v, va, currents, step)
        for i in range(n):
            vm[k, order[i]], va_found[k, order[i]] = modulus(v[i]), va[i]


@compiled
def _weigh(slot, exact, sigmas, w):
    """Stores the weights of all meters in ``w``: see ``store``. True where all sigmas are usable."""
    usable = True
    for m in range(len(slot)):
        i, column = place_of(slot[m])
        variance = sigmas[m] * sigmas[m]
        usable = usable and (exact[m] or LEAST_USABLE_SIGMA < sigmas[m] < MOST_USABLE_SIGMA)
        w[i, column] = variance if column == 2 or column == 3 else 1.0 / variance
    return usable


@compiled
def _store_row(slot, exact, values, z, w):
    """Stores readings in ``z``, drops missing ones from ``w``; their number, or UNREADABLE with unusable readings."""
    missing = 0
    for m in range(len(slot)):
        i, column = place_of(slot[m])
        value = values[m]
        if math.isnan(value):
            z[i, column] = 0.0
            w[i, column] = -1.0 if column == 2 or column == 3 else 0.0
            missing += 1
        else:
            if not abs(value) < np.inf or (exact[m] and value != 0.0):
                return UNREADABLE
            z[i, column] = value
    return missing


@compiled
def _has_currents(w):
    """True where ``w`` has a meter of a current magnitude."""
    left = False
    for i in range(len(w)):
        left = left or w[i, 6] > 0.0 or w[i, 9] > 0.0
    return left


@compiled
def _are_determined(parent, place, no_load_Y, z, w, start, start_va, above, factor, more, block, step):
    """True where the meters in ``w`` determine the state, by the test of ``find_stuck``."""
    all_alike = np.empty_like(w)
    for i in range(len(w)):
        for k in range(10):
            all_alike[i, k] = 1.0 if w[i, k] > 0.0 and k != 6 and k != 9 else 0.0
        for k in range(2, 4):
            all_alike[i, k] = 1.0 if w[i, k] >= 0.0 else -1.0
    ratio = eliminate(
        parent, no_load_Y, z, all_alike, start, start_va, False, CHECK, place, above, factor, more, block, step
    )[0]
    return ratio > LEAST_PIVOT_RATIO


@compiled
def _begin(order, begin, v, va):
    for i in range(len(order)):
        va[i] = begin[1, order[i]]
        v[i] = scaled(complex(math.cos(va[i]), math.sin(va[i])), begin[0, order[i]])
