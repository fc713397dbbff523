"""What is forked from a warmed parent finds the compiled exchange ready."""

from __future__ import annotations

import pytest

from agents.runtime.warm_up import warm_up
from dsse_core.linear.radial import RadialSolver


def test_warming_up_goes_through_every_pass_of_the_tree(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("numba")
    from dsse_core.radial import boundary as tree_boundary
    from dsse_core.radial import root as tree_root

    declined: list[str] = []
    monkeypatch.setattr(RadialSolver, "_decline", lambda self, reason: declined.append(reason))
    warm_up()
    assert not declined
    for kernel in (
        tree_boundary.pass_upward,
        tree_root.describe_root,
        tree_boundary.step_downward,
        tree_boundary.variances_downward,
    ):
        assert len(kernel.signatures) >= 1
