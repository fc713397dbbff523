"""Inputs of the estimates: networks, measurement sets, noise, and J, which one function computes for all tools."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Network
from dsse_core.power_flow.newton_raphson import PowerFlowResult, solve_power_flow
from scenarios.files.network_file import load_case
from scenarios.generate.feeder import generate_feeder

IEEE33_BUSES = 33
SEED = 7
SHARP = "-sharp"  # ending of a set's name: the floor of SHARP_FLOOR_MVA on every network
FLOOR_MVA, SHARP_FLOOR_MVA = 2e-3, 2e-4
VM_SIGMA = 0.002  # of the reading
LOAD_LEVELS = (0.3, 1.1)  # of the random draws


@dataclass(frozen=True)
class MeasurementSet:
    """Shares of the buses and branches with meters, beside the substation's, and sigmas as shares of |S|."""

    vm_share: float
    flow_share: float
    flow_sigma: float
    injection_sigma: float


SETS = {
    "full": MeasurementSet(vm_share=0.10, flow_share=1.0, flow_sigma=0.01, injection_sigma=0.10),
    "dist": MeasurementSet(vm_share=0.05, flow_share=0.02, flow_sigma=0.01, injection_sigma=0.30),
}


@dataclass(frozen=True)
class Readings:
    """Readings of one kind of place, p.u.: complex power P + jQ, or |V| + 0j; one sigma for P and for Q."""

    row: np.ndarray
    value: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class Case:
    """One estimate to be made. Rows of ``vm`` and ``injection`` are buses, of ``flow`` active branches (from side)."""

    network: Network
    set_name: str
    vm: Readings
    flow: Readings
    injection: Readings

    @cached_property
    def measurements(self) -> tuple[Measurement, ...]:
        """The same readings in our form."""
        kind, found = MeasurementKind, []
        buses, branches = self.network.buses, self.network.active_branches
        for row, value, sigma in _rows(self.vm):
            found.append(Measurement(Meter(kind.VM, buses[row].id), value.real, sigma))
        for row, value, sigma in _rows(self.flow):
            place = branches[row].from_bus, branches[row].id
            found.append(Measurement(Meter(kind.P_FLOW, *place), value.real, sigma))
            found.append(Measurement(Meter(kind.Q_FLOW, *place), value.imag, sigma))
        for row, value, sigma in _rows(self.injection):
            found.append(Measurement(Meter(kind.P_INJECTION, buses[row].id), value.real, sigma))
            found.append(Measurement(Meter(kind.Q_INJECTION, buses[row].id), value.imag, sigma))
        return tuple(found)

    def objective(self, vm: np.ndarray, va: np.ndarray) -> float:
        """J(x) = sum(((z - h(x)) / sigma)^2) of a state in p.u. and rad: the measure of every tool."""
        model = build_measurement_model(
            self.network, build_admittance(self.network), [m.meter for m in self.measurements]
        )
        z, sigma = np.array([(m.value, m.sigma) for m in self.measurements]).T
        return float(np.sum(((z - model.predict(np.r_[va, vm])) / sigma) ** 2))


def build_network(n_bus: int) -> Network:
    """``ieee33`` for 33 buses, else the seeded feeder of the generator."""
    if n_bus == IEEE33_BUSES:
        return load_case("ieee33")
    return generate_feeder(n_bus, np.random.default_rng([SEED, n_bus]))[0]


def build_case(network: Network, set_name: str, draw: int | None = None) -> Case:
    """The readings of a set: ``full``, ``dist``, or one with ``-sharp``; at the scheduled loads, or of a random draw.

    A draw has its own load level, the same for all loads, and its own noise; the meters stand where they always do.
    """
    name = set_name.removesuffix(SHARP)
    chosen = SETS[name]
    kind = list(SETS).index(name)
    places = np.random.default_rng([SEED, len(network.buses), kind])
    noise = places if draw is None else np.random.default_rng([SEED, len(network.buses), kind, draw])
    assert network.slack is not None  # neither ieee33 nor the generator leaves it out
    slack_row = network.row[network.slack.bus]
    buses = np.delete(np.arange(len(network.buses)), slack_row)
    branches = np.arange(len(network.active_branches))
    vm_row = np.r_[slack_row, _choose(places, buses, chosen.vm_share)]
    heads = [k for k, b in enumerate(network.active_branches) if network.slack.bus in (b.from_bus, b.to_bus)]
    flow_row = np.union1d(heads, _choose(places, branches, chosen.flow_share)).astype(int)

    truth = _solve_truth(network, 1.0 if draw is None else noise.uniform(*LOAD_LEVELS))
    sharp = set_name.endswith(SHARP) or len(network.buses) == IEEE33_BUSES
    floor = (SHARP_FLOOR_MVA if sharp else FLOOR_MVA) / network.base_mva
    v = truth.vm * np.exp(1j * truth.va)
    from_row = np.array([network.row[branch.from_bus] for branch in network.active_branches])
    from_rows = slice(len(v), len(v) + len(from_row))
    flow = (v[from_row] * (build_admittance(network).stacked @ v)[from_rows].conj())[flow_row]
    injection = truth.injection[buses]
    return Case(
        network=network,
        set_name=set_name,
        vm=_read(noise, vm_row, truth.vm[vm_row], VM_SIGMA * truth.vm[vm_row]),
        flow=_read(noise, flow_row, flow, chosen.flow_sigma * abs(flow) + floor),
        injection=_read(noise, buses, injection, chosen.injection_sigma * abs(injection) + floor),
    )


def _solve_truth(network: Network, level: float) -> PowerFlowResult:
    """The power flow at ``level`` times the scheduled loads and sources."""
    slack = network.slack.bus if network.slack else None
    extra = {b.id: (1 - level) * network.scheduled_injection(b.id) for b in network.buses if b.id != slack}
    return solve_power_flow(network, extra_load=extra)


def _read(noise: np.random.Generator, row: np.ndarray, exact: np.ndarray, sigma: np.ndarray) -> Readings:
    error = noise.standard_normal((2, len(row))) * sigma
    return Readings(row, exact + error[0] + 1j * error[1] * np.iscomplexobj(exact), sigma)


def _choose(rng: np.random.Generator, rows: np.ndarray, share: float) -> np.ndarray:
    return np.sort(rng.choice(rows, max(1, round(share * len(rows))), replace=False))


def _rows(readings: Readings) -> zip[tuple[int, complex, float]]:
    return zip(readings.row.tolist(), readings.value.tolist(), readings.sigma.tolist(), strict=True)
