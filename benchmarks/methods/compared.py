"""The tools that are compared. A further back end of ours, or a further peer, is one more entry."""

from __future__ import annotations

from benchmarks.methods.gridstate import GridstateMethod
from benchmarks.methods.method import Method
from benchmarks.methods.ours import Ours
from benchmarks.methods.pandapower import PandapowerMethod
from benchmarks.methods.power_grid_model import PowerGridModelMethod

OURS: tuple[Method, ...] = (Ours("ours, radial", "radial"), Ours("ours, sparse", "sparse"))
"""Every peer is timed beside each of these; ratios are given to each."""

OURS_WITH_RESIDUALS: tuple[Method, ...] = (
    Ours("ours, radial, all normalised residuals", "radial", with_residuals=True),
    Ours("ours, sparse, all normalised residuals", "sparse", with_residuals=True),
)

PEERS: tuple[Method, ...] = (
    PowerGridModelMethod("power-grid-model newton_raphson", "newton_raphson"),
    PowerGridModelMethod("power-grid-model iterative_linear", "iterative_linear"),
    PandapowerMethod(),
    GridstateMethod(),
)
