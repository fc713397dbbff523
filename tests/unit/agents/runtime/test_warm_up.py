"""What is forked from a warmed parent finds the compiled exchange ready."""

from __future__ import annotations

import pytest

from agents.runtime.warm_up import warm_up
from dsse_core.linear.radial import RadialSolver


@pytest.mark.long  # it compiles
def test_warming_up_goes_through_every_pass_of_the_tree(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("numba")
    from dsse_core.radial import boundary as radial_boundary
    from dsse_core.radial import root as radial_root

    declined: list[str] = []
    monkeypatch.setattr(RadialSolver, "_decline", lambda self, reason: declined.append(reason))
    warm_up()
    assert not declined
    for kernel in (
        radial_boundary.pass_upward,
        radial_root.describe_root,
        radial_boundary.step_downward,
        radial_boundary.variances_downward,
    ):
        assert len(kernel.signatures) >= 1
