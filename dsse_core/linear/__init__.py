"""The numerics of one area behind one interface: step, information of a boundary, variances, covariance of rows."""

from dsse_core.linear.area_measurements import Backend
from dsse_core.linear.choose import choose_backend, make_linear, make_rows, needs_compiled_code
from dsse_core.linear.interface import LinearArea, Matrix, Received, Rows
from dsse_core.linear.no_load import NoLoadSolver

__all__ = [
    "Backend",
    "LinearArea",
    "Matrix",
    "NoLoadSolver",
    "Received",
    "Rows",
    "choose_backend",
    "make_linear",
    "make_rows",
    "needs_compiled_code",
]
