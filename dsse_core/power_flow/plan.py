"""Plan of power flows of a network, found once and used for every schedule of injections."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import Admittance, build_admittance, flat_start
from dsse_core.grid.measurement import MeasurementKind
from dsse_core.grid.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.grid.meter_table import KINDS, NO_BRANCH, make_meters
from dsse_core.grid.network import Control, Network
from dsse_core.power_flow.path_sums import TreePaths, lay_out_paths

P, Q = MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION
MethodChoice = Literal["auto", "sweep", "newton"]
ROUND_OFF = 1e-15  # of the sum of a bus' admittances: its mismatch cannot fall below this share


@dataclass(frozen=True)
class PowerFlowPlan:
    """The plan of power flows of ``network``.

    ``start``: x = [va; vm], (2 n_bus,), rad and p.u., of the unloaded network with all voltages held. ``held``: bus ->
    the voltage that it holds, p.u. ``paths``: the tree to sweep over, or, as text, why Newton's method is taken.
    """

    network: Network
    slack_bus: int
    held: Mapping[int, float]
    start: np.ndarray
    paths: TreePaths | str

    @cached_property
    def admittance(self) -> Admittance:
        return build_admittance(self.network)

    @property
    def start_voltage(self) -> np.ndarray:
        """The voltages of ``start``, complex, p.u., (n_bus,)."""
        va, vm = np.split(self.start, 2)
        v: np.ndarray = vm * np.exp(1j * va)
        return v

    @cached_property
    def p_rows(self) -> np.ndarray:
        """Rows of the buses that meet their P."""
        return np.delete(np.arange(len(self.start) // 2), self.network.row[self.slack_bus])

    @cached_property
    def q_rows(self) -> np.ndarray:
        """Rows of the buses that meet their Q."""
        return np.delete(np.arange(len(self.start) // 2), [self.network.row[bus] for bus in self.held])

    @cached_property
    def model(self) -> MeasurementModel:
        """The measurement model of P at ``p_rows``, then Q at ``q_rows``."""
        p, q = (np.full(len(rows), KINDS.index(kind)) for kind, rows in ((P, self.p_rows), (Q, self.q_rows)))
        bus = self.network.table.bus_id[np.concatenate([self.p_rows, self.q_rows])]
        meters = make_meters(self.network, np.concatenate([p, q]), bus, np.full(len(bus), NO_BRANCH))
        return build_measurement_model(self.network, self.admittance, meters)

    def find_limit(self, tolerance: float) -> np.ndarray:
        """The largest mismatch that each bus may have, (n_bus,), p.u."""
        table, n = self.network.table, len(self.start) // 2
        at_end = abs(table.ys + table.ends)
        total = np.bincount(table.f, at_end / table.tap[table.active] ** 2, n) + np.bincount(table.t, at_end, n)
        between = abs(table.ys / table.ratio)
        total = total + np.bincount(table.f, between, n) + np.bincount(table.t, between, n) + abs(table.shunt)
        limit: np.ndarray = np.maximum(tolerance, ROUND_OFF * total)
        return limit


def build_power_flow_plan(
    network: Network,
    *,
    slack: tuple[int, float] | None = None,
    method: MethodChoice = "auto",
    extra_load: Mapping[int, complex] | None = None,
) -> PowerFlowPlan:
    """The plan for power flows of ``network``; arguments are those of ``solve_power_flow``.

    Raises:
        InvalidInputError: no slack bus, buses that it does not reach, unknown buses in the arguments, sweeps asked for
            that cannot serve.
    """
    network.check_balanced("a power flow")
    slack_bus, slack_vm, slack_va = _slack_of(network, slack)
    if problems := list(_find_problems(network, slack_bus, slack_vm, extra_load or {})):
        raise InvalidInputError(f"power flow of network {network.name!r}", problems)
    held = {g.bus: g.vm for g in network.generators if g.control is Control.VOLTAGE} | {slack_bus: slack_vm}
    vm, va = flat_start(network, slack_bus, held)
    paths = _lay_out(network, slack_bus, held, method, vm)
    return PowerFlowPlan(network, slack_bus, held, np.concatenate([va + slack_va, vm]), paths)


def _lay_out(
    network: Network, slack_bus: int, held: Mapping[int, float], method: MethodChoice, vm: np.ndarray
) -> TreePaths | str:
    """The tree to sweep over, or, as text, why sweeps are not used.

    Raises:
        InvalidInputError: sweeps are asked for and cannot serve.
    """
    if method not in get_args(MethodChoice):
        known = ", ".join(get_args(MethodChoice))
        raise InvalidInputError("power flow", [f"method is {method!r}; choose one of {known}"])
    if method == "newton":
        return "not asked for"
    paths: TreePaths | str = "other buses than the slack hold their voltage"
    if len(held) == 1:
        paths = lay_out_paths(network, slack_bus, vm)
    if isinstance(paths, str) and method == "sweep":
        problem = f"sweeps cannot serve: {paths}; choose 'auto' or 'newton'"
        raise InvalidInputError(f"power flow of network {network.name!r}", [problem])
    return paths


def _find_problems(
    network: Network, slack_bus: int, slack_vm: float, extra_load: Mapping[int, complex]
) -> Iterator[str]:
    if slack_bus not in network.row:
        yield f"the slack bus {slack_bus} is not in the network"
    elif unreached := network.find_unreached_buses(slack_bus):
        names = ", ".join(map(str, unreached))
        yield f"no path of branches in service joins bus {names} to the slack bus {slack_bus}"
    if not (math.isfinite(slack_vm) and slack_vm > 0):
        yield f"the slack voltage is {slack_vm}; it must be a positive number in p.u."
    for bus, load in extra_load.items():
        if bus not in network.row:
            yield f"extra load at bus {bus}, which is not in the network"
        if not cmath.isfinite(load):
            yield f"the extra load at bus {bus} is {load}, not a finite number"


def _slack_of(network: Network, slack: tuple[int, float] | None) -> tuple[int, float, float]:
    if slack is not None:
        return slack[0], slack[1], 0.0
    if network.slack is None:
        raise InvalidInputError(
            f"power flow of network {network.name!r}", ["it has no slack bus; give it one source of kind 'slack'"]
        )
    return network.slack.bus, network.slack.vm, network.slack.va
