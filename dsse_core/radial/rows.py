"""Many scans of the same meters in one compiled loop, on memory that is allocated once."""

from __future__ import annotations

import math

from dsse_core.code_cache import compiled
from dsse_core.gauss_newton import LOST
from dsse_core.radial.block import modulus, scaled
from dsse_core.radial.iteration import carve, find_residuals, iterate, store
from dsse_core.radial.lanes import LANES
from dsse_core.radial.layout import NOT_STUCK, find_stuck
from dsse_core.radial.together import estimate_together


@compiled
def estimate_rows(
    parent, place, Y, no_load_Y, order, meter, exact, start, start_va, starts, has_currents,
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
    states, (z, w), work = carve(space, n)
    is_weighed, done = False, 0  # the weights are those of all rows; rows before ``done`` are done
    for k in range(len(values)):
        if k < done:
            continue
        here = slice(k, k + LANES)
        if len(lanes) > 0 and k + LANES <= len(values) and k % LANES == 0:
            is_weighed = is_weighed or store(meter, exact, values[k], sigmas[0], z, w) == 0
            if is_weighed and estimate_together(
                parent, place, Y, order, meter, exact, start, start_va, starts[min(k, len(starts) - 1) : k + LANES],
                tolerance, limit[here], values[here], w, lanes, vm[here], va_found[here], objective[here], steps[here],
            ):  # fmt: skip
                succeeded[here] = True
                done = k + LANES
                continue
        missing = store(meter, exact, values[k], sigmas[min(k, len(sigmas) - 1)], z, w)
        is_weighed = missing == 0
        succeeded[k] = missing == 0 or (
            missing > 0 and find_stuck(parent, place, no_load_Y, w, start, start_va, z, work) == NOT_STUCK
        )
        if not succeeded[k]:
            continue
        if len(starts) == 0:
            states[0][:] = start
            states[1][:] = start_va
        else:
            _begin(order, starts[min(k, len(starts) - 1)], states[0], states[1])
        currents = has_currents and (missing == 0 or _has_currents(w))
        end, steps[k], _, v, va = iterate(
            parent, place, Y, z, w, states, currents, tolerance, most_steps, limit[k], work
        )  # fmt: skip
        succeeded[k] = end != LOST
        if not succeeded[k]:
            continue
        objective[k] = find_residuals(
            0, n, parent, place, Y, z, w, v, va, currents, meter, work[0], work[3][0], work[3][0, :0]
        )  # fmt: skip
        for i in range(n):
            vm[k, order[i]], va_found[k, order[i]] = modulus(v[i]), va[i]


@compiled
def _has_currents(w):
    """True where ``w`` has a meter of a current magnitude."""
    left = False
    for i in range(len(w)):
        left = left or w[i, 6] > 0.0 or w[i, 9] > 0.0
    return left


@compiled
def _begin(order, begin, v, va):
    for i in range(len(order)):
        va[i] = begin[1, order[i]]
        v[i] = scaled(complex(math.cos(va[i]), math.sin(va[i])), begin[0, order[i]])
