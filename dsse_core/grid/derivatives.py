"""The entries of H(x), compiled: see ``MeasurementModel.linearize``."""

from __future__ import annotations

import numpy as np

from dsse_core.code_cache import compiled


@compiled
def find_entries(of_u, of_i, meter_row, at_bus, y, column, phase, vm, wanted):
    """Of the derivatives by va of all stored entries of y, and then by vm, those at the places ``wanted``, (n_wanted,).

    In single numbers: numba has no product of a complex and a real one.
    """
    n, derivatives, found = len(y), np.empty(2 * len(y)), np.empty(len(wanted))
    for e in range(n):
        m, c = meter_row[e], column[e]
        i, u, p = of_i[m], of_u[m], phase[c]
        real = u.real * at_bus[e] + i.real * y[e].real - i.imag * y[e].imag
        imag = u.imag * at_bus[e] + i.real * y[e].imag + i.imag * y[e].real
        derivatives[e] = -(real * p.imag + imag * p.real) * vm[c]
        derivatives[n + e] = real * p.real - imag * p.imag
    for k in range(len(wanted)):
        found[k] = derivatives[wanted[k]]
    return found
