"""h(x) and the entries of H(x), compiled, meter by meter: see ``MeasurementModel.linearize``."""

from __future__ import annotations

import math

import numpy as np

from dsse_core.code_cache import compiled
from dsse_core.grid.quantities import Quantity

P, Q, CURRENT, VM, VA, I_REAL, I_IMAG = map(int, Quantity)


@compiled
def linearize(x, reads, indptr, column, y, at_node, wanted, floors):
    """h(x), (n_meas,), and derivatives at the places ``wanted`` among those by va, then by vm, of all entries of y.

    ``reads`` (n_meas,): the quantity that each meter reads. ``floors``: below the first the derivative of a current
    magnitude is 0; the second is the least divisor of the derivatives of |u| and arg u. Without ``wanted`` no
    derivative is found.
    """
    n, n_entries = len(x) // 2, len(column)
    phase = np.empty(n, dtype=np.complex128)
    for k in range(n):
        phase[k] = complex(math.cos(x[k]), math.sin(x[k]))
    h, derivatives = np.empty(len(reads)), np.empty(2 * n_entries if len(wanted) > 0 else 0)
    for m in range(len(reads)):
        u = i = 0j
        for e in range(indptr[m], indptr[m + 1]):
            c = column[e]
            v = complex(x[n + c] * phase[c].real, x[n + c] * phase[c].imag)
            i += y[e] * v
            if at_node[e] != 0.0:
                u += at_node[e] * v
        h[m], of_u, of_i = read(reads[m], u, i, floors)
        if len(wanted) > 0:
            for e in range(indptr[m], indptr[m + 1]):
                along = of_i * y[e]
                if at_node[e] != 0.0:
                    along += at_node[e] * of_u
                along *= phase[column[e]]
                derivatives[e] = -along.imag * x[n + column[e]]
                derivatives[n_entries + e] = along.real
    found = np.empty(len(wanted))
    for k in range(len(wanted)):
        found[k] = derivatives[wanted[k]]
    return h, found


@compiled
def read(quantity, u, i, floors):
    """h of a ``Quantity`` at voltage ``u`` and current ``i``; ``of_u``, ``of_i`` of dh = Re(of_u du + of_i di)."""
    if quantity == P:
        return u.real * i.real + u.imag * i.imag, i.conjugate(), u.conjugate()
    if quantity == Q:
        return u.imag * i.real - u.real * i.imag, complex(-i.imag, -i.real), complex(u.imag, u.real)
    if quantity == CURRENT:
        size = math.sqrt(i.real**2 + i.imag**2)
        return size, 0j, complex(i.real / size, -i.imag / size) if size > floors[0] else 0j
    if quantity == I_REAL:
        return i.real, 0j, 1.0 + 0j
    if quantity == I_IMAG:
        return i.imag, 0j, -1j
    size = math.sqrt(u.real**2 + u.imag**2)
    least = max(size, floors[1])
    if quantity == VM:
        return size, complex(u.real / least, -u.imag / least), 0j
    over = 1.0 / (least * least)
    return math.atan2(u.imag, u.real), complex(-u.imag * over, -u.real * over), 0j
