"""What is forked from a warmed parent finds the compiled exchange ready."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest

from agents.runtime.warm_up import warm_up
from dsse_core import compiling
from dsse_core.linear.radial import RadialSolver


@pytest.mark.slow  # it compiles
def test_warming_up_goes_through_every_pass_of_the_tree(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("numba")
    from dsse_core.radial import boundary as radial_boundary
    from dsse_core.radial import inverse as radial_inverse
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
        radial_inverse.find_last_angle,
    ):
        assert len(kernel.signatures) >= 1


BATCHES = """
import numpy as np
from agents.runtime.warm_up import warm_up, warm_up_batches, warm_up_estimate
from dsse_core import compiling
from dsse_core.estimation.batch import estimate_batch
from dsse_core.estimation.estimator import estimate_with_plan
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.power_flow.batch import solve_power_flow_batch
from dsse_core.results.results import results_of_estimate
from scenarios.scenario import load_scenario
from scenarios.telemetry import read_meters

for warm in (warm_up, warm_up_estimate, warm_up_batches):
    warm()
compiled = []
compiling.listen(lambda begins, folder: compiled.append(begins))
scenario = load_scenario("case33bw", whole=True)
plan = build_estimation_plan(scenario.network, scenario.meters, backend="radial")
scans = [read_meters(scenario, scan) for scan in (1, 2, 3)]
values, sigmas = np.array([s.values for s in scans]), np.array([s.sigmas for s in scans])
values[1, 4] = np.nan
for threads in (1, 2):
    found = estimate_batch(plan, values, sigmas, threads=threads)
    estimate_batch(plan, values, sigmas[0], start=(found.vm[0], found.va[0]), threads=threads)
results_of_estimate(estimate_with_plan(plan, values[0], sigmas[0])).areas
s = np.tile(scenario.network.scheduled, (3, 1))
solve_power_flow_batch(scenario.network, s.real.copy(), s.imag.copy(), method="sweep")
print("compiled", len(compiled), "failed", len(found.failures))
"""


@pytest.mark.slow
def test_what_is_compiled_ahead_serves_batches_too():
    pytest.importorskip("numba")
    done = subprocess.run([sys.executable, "-c", BATCHES], capture_output=True, text=True, timeout=1800, check=True)
    assert done.stdout == "compiled 0 failed 0\n"


SPARSE = """
import numpy as np
from agents.runtime.warm_up import warm_up_sparse
from dsse_core import compiling
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.matrices import augmented
from dsse_core.results.deviations.choose import find_deviations
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

warm_up_sparse()
compiled = []
compiling.listen(lambda begins, folder: compiled.append(begins))
augmented.FEWEST_COMPILED = 0
scenario = load_scenario("case33bw", whole=True)
report = process_bad_data(scenario.network, make_telemetry(scenario).union, backend="sparse")
assert report.result.plan.sparse.is_compiled
find_deviations(report.result)
print("compiled", len(compiled))
"""


@pytest.mark.slow
def test_what_is_compiled_ahead_serves_sparse_estimates_too():
    pytest.importorskip("numba")
    done = subprocess.run([sys.executable, "-c", SPARSE], capture_output=True, text=True, timeout=1800, check=True)
    assert done.stdout == "compiled 0\n"


def test_a_sparse_estimate_does_not_wait_for_a_compiler(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(compiling, "has_whole", lambda what: what != "sparse")
    with compiling.only_loading():
        assert compiling.find_obstacle("sparse") is not None


def test_a_batch_does_not_wait_for_a_compiler_either(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(compiling, "has_whole", lambda what: what != "batch")
    with compiling.only_loading():
        if importlib.util.find_spec("numba"):
            assert compiling.find_obstacle() is None
        assert compiling.find_obstacle("batch") is not None
