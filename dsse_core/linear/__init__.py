"""The numerics of one area behind one interface: step, information of a boundary, variances."""

from dsse_core.linear.choose import Backend, choose_backend, make_linear, make_no_load, make_rows, needs_compiled_code
from dsse_core.linear.interface import Received, LinearArea, Matrix, Rows
from dsse_core.linear.no_load import NoLoadSolver

__all__ = [
    "Backend",
    "Received",
    "LinearArea",
    "Matrix",
    "NoLoadSolver",
    "Rows",
    "choose_backend",
    "make_linear",
    "make_no_load",
    "make_rows",
    "needs_compiled_code",
]
