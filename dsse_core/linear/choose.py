"""Choice of the back end of an area's numerics; no other module knows all back ends."""

from __future__ import annotations

from typing import Literal

from dsse_core.grid.partition import Area
from dsse_core.linear.area_measurements import AreaMeasurements, Backend
from dsse_core.linear.dense import DenseRows
from dsse_core.linear.interface import LinearArea, Rows
from dsse_core.linear.radial import RadialSolver, find_why_not_radial
from dsse_core.linear.reduced import ReducedSolver
from dsse_core.linear.rows import TableauSolver
from dsse_core.linear.sparse import SparseRows

RADIAL_FROM = 60  # buses of an area from which on radial repays the loading of numba
PIECES_FROM = 60  # nodes of an area from which on pieces cost less than one dense piece
DENSE_BELOW = 40  # buses of an area below which dense matrices cost less than sparse ones


def choose_backend(area: Area, backend: Backend = "auto") -> Literal["radial", "sparse", "dense", "pieces"]:
    """Back end that computes if ``backend`` is asked for; radial, which loads numba, only where it can serve.

    An area with a boundary at several buses or at phases has dense or pieces, by its size where neither is asked for:
    only reflections find the information of such a boundary.
    """
    n_bus = len(area.network.buses)
    if backend == "pieces" or not all(boundary.is_single for boundary in area.boundaries.values()):
        is_small = backend != "pieces" and area.network.n_nodes < PIECES_FROM
        return "dense" if backend == "dense" or is_small else "pieces"
    if backend == "radial" or (backend == "auto" and n_bus >= RADIAL_FROM):
        return "sparse" if not area.is_on_tree or find_why_not_radial(area.network) else "radial"
    return "dense" if backend == "dense" or (backend == "auto" and n_bus < DENSE_BELOW) else "sparse"


def needs_compiled_code(area: Area) -> bool:
    """True where an agent of ``area`` gains from loading the compiled solvers beforehand."""
    return choose_backend(area) == "radial"


def make_rows(model: AreaMeasurements) -> Rows:
    is_dense = model.couples_many or choose_backend(model.area, model.backend) == "dense"
    return DenseRows(model) if is_dense else SparseRows(model)


def make_linear(model: AreaMeasurements, rows: Rows) -> LinearArea:
    """Numerics of ``model`` with its ``rows``, by the back end of ``choose_backend``.

    Further rows that couple many buses need dense rows and reflections.
    """
    if model.couples_many:
        return ReducedSolver(model, rows, "dense, as further rows couple many buses")
    chosen = choose_backend(model.area, model.backend)
    if chosen in ("dense", "pieces"):
        return ReducedSolver(model, rows, chosen)
    assert isinstance(rows, SparseRows)  # by ``make_rows``
    by_rows = TableauSolver(model, rows, "sparse")
    return RadialSolver(model, by_rows) if chosen == "radial" else by_rows
