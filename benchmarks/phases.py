"""Estimates of feeders of three coupled phases, beside power-grid-model's asymmetric Newton-Raphson."""

from __future__ import annotations

import importlib.metadata
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsse_core.estimation.estimator import estimate_with_plan
from dsse_core.estimation.plan import build_estimation_plan
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.loads import Load
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.primitives import build_line
from dsse_core.power_flow.newton_raphson import solve_power_flow

KIND, PHASES = MeasurementKind, "abc"
Z = np.array([[0.3465 + 1.0179j, 0.156, 0.158], [0.0, 0.3375 + 1.0478j, 0.1535], [0.0, 0.0, 0.3414 + 1.0348j]])
Z = Z + 1j * np.array([[0.0, 0.5017, 0.4236], [0.0, 0.0, 0.3849], [0.0, 0.0, 0.0]])
OHM_PER_MILE = Z + np.triu(Z, 1).T  # of ieee13's configuration 601
BASE_KV, BASE_MVA, CLOCK = 12.47, 3.0, 10**9  # CLOCK: a bus apart whose angles are given, as theirs has angles measured
SETS = ("injections", "flows")
RUNS = 15
EQUAL = 1e-10  # J, relative; voltages, p.u. and rad


@dataclass(frozen=True)
class PhasesRow:
    """One case: J of both, the largest difference of voltages, and seconds of an estimate, the least of RUNS.

    Theirs has angles measured at the first bus; so has ours, and those of a bus apart are given. Its seconds are those
    of the same readings with the angles of the first bus given, as an estimate of ours has them.
    """

    n_bus: int
    set_name: str
    ours: float
    theirs: float
    difference: float
    ours_s: float
    theirs_s: float


def compare_phases(sizes: Sequence[int], report: Callable[[str], None]) -> list[PhasesRow]:
    """Both estimates of random feeders of ``sizes`` buses, with power injections alone, and with flows."""
    found = []
    for n_bus in sizes:
        network, z = _make_feeder(n_bus)
        for set_name in SETS:
            report(f"{n_bus} buses of three phases, {set_name}")
            found.append(_compare(network, z, set_name))
    return found


def find_missed(rows: Sequence[PhasesRow]) -> list[str]:
    """The cases in which ours is not the minimum, or with injections alone not theirs, as text."""
    return [
        f"{row.n_bus} buses, {row.set_name}: J {row.ours:.8g} and {row.theirs:.8g}, voltages {row.difference:.1e} apart"
        for row in rows
        if row.ours > row.theirs * (1 + EQUAL) or (row.set_name == "injections" and row.difference > EQUAL)
    ]


def format_phases(rows: Sequence[PhasesRow]) -> str:
    peer = f"power-grid-model {importlib.metadata.version('power-grid-model')}"
    lines = [
        f"| buses, meters | J | J of {peer} | voltages apart, p.u. or rad | processor, ms | its ms |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.n_bus:,}, {r.set_name} | {r.ours:.6g} | {r.theirs:.6g} | {r.difference:.1e} | {1e3 * r.ours_s:.3g} "
        f"| {1e3 * r.theirs_s:.3g} |"
        for r in rows
    ]
    return "\n".join(lines)


def _make_feeder(n_bus: int) -> tuple[Network, np.ndarray]:
    """A tree of ``n_bus`` buses, each with a load in each phase, and the ohms of its lines, (n_bus - 1, 3, 3)."""
    rng = np.random.default_rng(n_bus)
    above = [int(rng.integers(max(0, k - 40), k)) if rng.random() < 0.5 else k - 1 for k in range(1, n_bus)]
    ohm = OHM_PER_MILE * rng.uniform(0.02, 0.2, n_bus - 1)[:, None, None]
    lines = tuple(
        Branch(f"{up}-{k}", up, k, r=1.0, x=1.0, primitive=build_line(PHASES, z * BASE_MVA / BASE_KV**2))
        for k, (up, z) in enumerate(zip(above, ohm, strict=True), 1)
    )
    draw = rng.uniform(0.2, 1.8, (n_bus - 1, 3)) * (1 + 0.35j) * 0.5 / n_bus
    loads = tuple(Load(k + 1, p, complex(draw[k, j])) for k in range(n_bus - 1) for j, p in enumerate(PHASES))
    buses = tuple(Bus(k, BASE_KV, phases=PHASES) for k in range(n_bus))
    return Network("feeder", BASE_MVA, buses, lines, (Generator(0, Control.SLACK),), loads), ohm


def _compare(network: Network, ohm: np.ndarray, set_name: str) -> PhasesRow:
    n, rng, power_flow = len(network.buses), np.random.default_rng(7), solve_power_flow(network)
    flows = [KIND.P_FLOW, KIND.Q_FLOW] if set_name == "flows" else []
    metered = [b for b in network.branches if rng.random() < 0.5]
    meters = [Meter(KIND.VM, k, phases=p) for k in range(n) for p in PHASES]
    meters += [
        Meter(kind, k, phases=p) for kind in (KIND.P_INJECTION, KIND.Q_INJECTION) for k in range(1, n) for p in PHASES
    ]
    meters += [Meter(kind, b.from_bus, b.id, phases=p) for kind in flows for b in metered for p in PHASES]
    x = np.concatenate([power_flow.va, power_flow.vm])
    sigma = np.array([1e-3 if m.kind is KIND.VM else 2e-3 if m.branch else 2e-4 for m in meters])
    z = build_measurement_model(network, power_flow.admittance, meters).predict(x)
    z = z + sigma * rng.standard_normal(len(z))
    at_root = [Meter(KIND.VA, 0, phases=p) for p in PHASES] + [Meter(KIND.VM, CLOCK, phases=p) for p in PHASES]
    z, sigma = np.r_[z, np.radians([0, -120, 120]), np.ones(3)], np.r_[sigma, np.full(6, 1e-3)]
    apart = Network("apart", BASE_MVA, (*network.buses, Bus(CLOCK, BASE_KV, phases=PHASES)), network.branches)
    plan = build_estimation_plan(apart, [*meters, *at_root], reference=CLOCK)
    ours, usual = estimate_with_plan(plan, z, sigma), build_estimation_plan(network, meters)
    estimate_by_peer = _prepare_peer(network, ohm, metered if flows else [], z, sigma)
    theirs = estimate_by_peer()
    ours_s, theirs_s = _time(lambda: estimate_with_plan(usual, z[:-6], sigma[:-6]), estimate_by_peer)
    x_ours = np.concatenate([ours.va[:-3], ours.vm[:-3]])
    x_theirs = np.concatenate([theirs["u_angle"].ravel(), theirs["u_pu"].ravel()])
    difference = x_ours - x_theirs
    difference[: 3 * n] = np.angle(np.exp(1j * difference[: 3 * n]))
    model = build_measurement_model(network, build_admittance(network), [*meters, *at_root[:3]])
    r = model.subtract(z[:-3], model.predict(x_theirs)) / sigma[:-3]
    return PhasesRow(n, set_name, ours.objective, float(r @ r), float(abs(difference).max()), ours_s, theirs_s)


def _prepare_peer(
    network: Network, ohm: np.ndarray, metered: Sequence[Branch], z: np.ndarray, sigma: np.ndarray
) -> Callable[[], Any]:
    """Their estimate of all nodes, for readings ``z``: voltages, injections, flows, and the angles of bus 0."""
    import power_grid_model as pgm

    n, make = len(network.buses), pgm.initialize_array
    volt, watt = BASE_KV * 1e3 / np.sqrt(3), BASE_MVA * 1e6 / 3
    nodes, lines = make("input", "node", n), make("input", "asym_line", n - 1)
    nodes["id"], nodes["u_rated"] = np.arange(n), BASE_KV * 1e3
    lines["id"], lines["from_status"], lines["to_status"] = n + np.arange(n - 1), 1, 1
    lines["from_node"], lines["to_node"] = (
        [getattr(b, end) for b in network.branches] for end in ("from_bus", "to_bus")
    )
    lines["c0"] = lines["c1"] = 0.0
    lines["i_n"] = 1000.0
    for i, first in enumerate(PHASES):
        for j, second in enumerate(PHASES[: i + 1]):
            lines[f"r_{first}{second}"], lines[f"x_{first}{second}"] = ohm[:, i, j].real, ohm[:, i, j].imag
    source, loads = make("input", "source", 1), make("input", "asym_load", n - 1)
    source["id"], source["node"], source["status"], source["u_ref"] = 2 * n, 0, 1, 1.0
    loads["id"], loads["node"], loads["status"], loads["type"] = 2 * n + 1 + np.arange(n - 1), np.arange(1, n), 1, 0
    loads["p_specified"] = loads["q_specified"] = 0.0
    voltages, k = make("input", "asym_voltage_sensor", n), 3 * n + 10
    voltages["id"], voltages["measured_object"] = k + np.arange(n), np.arange(n)
    voltages["u_measured"], voltages["u_sigma"] = z[: 3 * n].reshape(n, 3) * volt, sigma[0] * volt
    voltages["u_angle_measured"][0] = np.radians([0, -120, 120])
    powers = make("input", "asym_power_sensor", n - 1 + len(metered))
    powers["id"] = k + n + np.arange(len(powers))
    rows = {b.id: n + at for at, b in enumerate(network.branches)}
    powers["measured_object"] = [*range(1, n), *(rows[b.id] for b in metered)]
    at_node, at_from = pgm.MeasuredTerminalType.node, pgm.MeasuredTerminalType.branch_from
    powers["measured_terminal_type"] = [at_node] * (n - 1) + [at_from] * len(metered)
    of_power, ends = [3 * n, 6 * n - 3, 9 * n - 6], 9 * n - 6 + 3 * len(metered)
    for part, flow, key in ((0, of_power[2], "p"), (1, ends, "q")):
        at = np.r_[of_power[part] : of_power[part + 1], flow : flow + 3 * len(metered)]
        powers[f"{key}_measured"], powers[f"{key}_sigma"] = (of[at].reshape(-1, 3) * watt for of in (z, sigma))
    powers["power_sigma"] = np.sqrt(2) * powers["p_sigma"].mean(axis=1)
    content = {"node": nodes, "asym_line": lines, "source": source, "asym_load": loads}
    grid = pgm.PowerGridModel(content | {"asym_voltage_sensor": voltages, "asym_power_sensor": powers})
    newton = pgm.CalculationMethod.newton_raphson
    options: dict[str, Any] = {"symmetric": False, "calculation_method": newton, "max_iterations": 100}
    return lambda: grid.calculate_state_estimation(error_tolerance=1e-12, **options)["node"]


def _time(*estimates: Callable[[], Any]) -> list[float]:
    """The least processor time of each of ``estimates``, s, of RUNS turns."""
    seconds = np.zeros((RUNS, len(estimates)))
    for turn in range(RUNS):
        for k, estimate in enumerate(estimates):
            begin = time.process_time()
            estimate()
            seconds[turn, k] = time.process_time() - begin
    least: list[float] = seconds.min(axis=0).tolist()
    return least
