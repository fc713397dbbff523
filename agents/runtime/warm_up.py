"""Loads the compiled solvers in this process, so that processes forked from it share the machine code."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dsse_core.code_places import Whole
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.estimation.batch import estimate_batch
from dsse_core.estimation.estimator import estimate_state
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.estimation.residuals import chi_square_limit
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.linear.area_model import build_area_model
from dsse_core.matrices.augmented import FEWEST_COMPILED
from dsse_core.power_flow.batch import solve_power_flow_batch
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.power_flow.plan import build_power_flow_plan
from dsse_core.results.deviations.choose import find_deviations

SIGMA = 0.01
INJECTIONS = (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)
NETWORK = Network(
    name="warm-up",
    base_mva=1.0,
    buses=tuple(Bus(i, 20.0, p_load=0.01) for i in range(1, 5)),
    branches=tuple(Branch(f"{i}-{i + 1}", i, i + 1, 0.01, 0.01) for i in range(1, 4)),
    generators=(Generator(1, Control.SLACK),),
)


def warm_up() -> None:
    """Go once through all computations of an area with a parent and a child on its tree, also with the reference in the
    area, and note where their code is kept.
    """
    area = build_partition(NETWORK, {"up": [1, 2], "here": [2, 3], "down": [3, 4]}).area("here")
    kinds = (MeasurementKind.VM, MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)
    meters = [Meter(kind, bus.id) for bus in area.network.buses for kind in kinds]
    flows = (MeasurementKind.P_FLOW, MeasurementKind.Q_FLOW)
    meters += [Meter(kind, branch.from_bus, branch.id) for branch in area.network.branches for kind in flows]
    readings = [Measurement(m, float(m.kind is MeasurementKind.VM), SIGMA) for m in meters]
    model = build_area_model(area, readings, None, backend="radial")
    x = np.zeros(model.size)
    x[model.n_nodes : 2 * model.n_nodes] = 1.0
    received = {n.area: model.linear.information(x, n, {}) for n in area.neighbours}
    for known in ({}, received):
        model.linear.step(x, known)
        model.linear.variances(x, known)
    with_reference = build_area_model(area, readings, NETWORK.buses[1].id, backend="radial")
    for n in area.neighbours:
        with_reference.linear.information(x, n, received)
    chi_square_limit(1, 0.5)  # imports modules that take 0.1 s and 6 MiB
    _note("exchange")


def warm_up_estimate() -> None:
    """Go once through estimate and bad data of a whole radial network, and note where their code is kept."""
    flow = solve_power_flow(NETWORK)
    meters = [Meter(MeasurementKind.VM, bus.id) for bus in NETWORK.buses]
    meters += [Meter(kind, bus.id) for bus in NETWORK.buses for kind in INJECTIONS]
    meters += [Meter(kind, b.from_bus, b.id) for b in NETWORK.branches for kind in MeasurementKind if kind.of_branch]
    readings = [Measurement(m, float(value), SIGMA) for m, value in zip(meters, flow.read_all(meters), strict=True)]
    bad = [replace(readings[0], value=readings[0].value + 100 * SIGMA), *readings[1:]]
    report = process_bad_data(NETWORK, bad, backend="radial")
    estimate_state(NETWORK, readings, start=(report.result.vm, report.result.va), backend="radial")
    find_deviations(report.result).find_totals()
    _note("estimate")


def warm_up_batches() -> None:
    """Go once through batches of power flows and estimates of a forked network."""
    first, second, _ = NETWORK.branches
    forked = replace(NETWORK, branches=(first, second, replace(second, id="2-4", to_bus=4)))
    n, kinds = len(forked.buses), (MeasurementKind.VM, MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)
    loads = np.full((2, n), -0.01)
    flows = solve_power_flow_batch(build_power_flow_plan(forked), loads, loads, threads=1)
    meters = [Meter(kind, bus.id) for bus in forked.buses for kind in kinds]
    plan = build_estimation_plan(forked, meters, backend="radial")
    values = np.tile([1.0, -0.01, -0.01], (2, n))
    values[1, 0] = np.nan
    sigmas = np.full(values.shape, SIGMA)
    estimate_batch(plan, values, sigmas, start=(flows.vm, flows.va), threads=1)
    _note("batch")


def warm_up_sparse() -> None:
    """Estimate a ring that is large enough for compiled elimination, and note where the code is kept."""
    buses = tuple(Bus(i, 20.0, p_load=1e-5) for i in range(1, FEWEST_COMPILED // 4))
    ends = [(bus.id, bus.id % len(buses) + 1) for bus in buses]
    branches = tuple(Branch(f"{f}-{t}", f, t, 1e-3, 1e-3) for f, t in ends)
    ring = Network("ring", 1.0, buses, branches, (Generator(1, Control.SLACK),))
    meters = [Meter(kind, bus.id) for bus in buses for kind in (MeasurementKind.VM, *INJECTIONS)]
    readings = [Measurement(m, 1.0 if m.kind is MeasurementKind.VM else -1e-5, SIGMA) for m in meters]
    result = estimate_state(ring, readings, backend="sparse")
    result.residual_variance.sum()
    _note("sparse")


def _note(what: Whole) -> None:
    from dsse_core.code_cache import note_whole  # numba, which is loaded by now

    note_whole(what)
