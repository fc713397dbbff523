"""Plan of power flows of a network, found once and used for every schedule of injections."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import scipy.sparse as sp

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import Admittance, build_admittance, find_primitives, find_shunts, flat_start
from dsse_core.grid.measurement import MeasurementKind
from dsse_core.grid.measurement_model import MeasurementModel, build_model_of_rows
from dsse_core.grid.meter_table import KINDS
from dsse_core.grid.network import Control, Network
from dsse_core.power_flow.current_sweeps import CurrentSweeps
from dsse_core.power_flow.path_sums import TreePaths, lay_out_paths

P, Q = MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION
MethodChoice = Literal["auto", "sweep", "newton"]
ROUND_OFF = 1e-15  # of the sum of a bus' admittances: its mismatch cannot fall below this share


@dataclass(frozen=True)
class PowerFlowPlan:
    """The plan of power flows of ``network``.

    ``start``: x = [va; vm], (2 n_nodes,), rad and p.u., of the unloaded network with all voltages held. ``held``: bus
    -> the voltage that it holds, p.u. ``paths``: the tree to sweep over, with phases the sweeps, or, as text, why
    Newton's method is taken.
    """

    network: Network
    slack_bus: int
    held: Mapping[int, float]
    start: np.ndarray
    paths: TreePaths | CurrentSweeps | str

    @cached_property
    def admittance(self) -> Admittance:
        return self.paths.admittance if isinstance(self.paths, CurrentSweeps) else build_admittance(self.network)

    @property
    def start_voltage(self) -> np.ndarray:
        """The voltages of ``start``, complex, p.u., (n_nodes,)."""
        return find_voltages(self.start)

    @cached_property
    def p_rows(self) -> np.ndarray:
        """Rows of the nodes that meet their P."""
        return self._nodes_but_at([self.slack_bus])

    @cached_property
    def q_rows(self) -> np.ndarray:
        """Rows of the nodes that meet their Q."""
        return self._nodes_but_at(self.held)

    def _nodes_but_at(self, buses: Iterable[int]) -> np.ndarray:
        """Rows of the nodes with supply of all other buses."""
        is_kept = np.ones(len(self.network.table.bus_id), dtype=bool)
        is_kept[[self.network.row[bus] for bus in buses]] = False
        return np.flatnonzero(is_kept[self.network.table.nodes.item] & ~self.network.is_dead)

    @cached_property
    def model(self) -> MeasurementModel:
        """The measurement model of P at ``p_rows``, then Q at ``q_rows``."""
        p, q = (np.full(len(rows), KINDS.index(kind)) for kind, rows in ((P, self.p_rows), (Q, self.q_rows)))
        nodes = np.concatenate([self.p_rows, self.q_rows])
        return build_model_of_rows(self.admittance.stacked, nodes, np.concatenate([p, q]), nodes)

    def find_injections(self, x: np.ndarray) -> np.ndarray:
        """P at ``p_rows``, then Q at ``q_rows`` at x = [va; vm], and what loads draw there above that at nominal
        voltages: what the schedule has to be.
        """
        injections = self.model.predict(x)
        if self.network.legs.varying is not None:
            excess = self.network.legs.find_excess(find_voltages(x))
            injections += np.concatenate([excess.real[self.p_rows], excess.imag[self.q_rows]])
        return injections

    def jacobian(self, x: np.ndarray) -> sp.csr_array:
        """The derivatives of ``find_injections`` by x."""
        H = self.model.jacobian(x)
        varying = self.network.legs.varying
        if varying is None:
            return H
        drawn = varying.differentiate(find_voltages(x))
        return sp.csr_array(H + sp.vstack([drawn[self.p_rows].real, drawn[self.q_rows].imag], format="csr"))

    def newton_matrix(self, x: np.ndarray, mismatch: np.ndarray) -> sp.csr_array:
        """The matrix of Newton's step at x, whose right side is the ``mismatch``: the derivatives of
        ``find_injections``.

        With phases those of currents ``conj(m / v)``, m the mismatch of a node: ``v (dm / v - m dv / v^2)``. Beside
        loads between phases powers can all be met at a state where the voltage of a node is 0 and its current is not.
        """
        J = self.jacobian(x)
        if self.network.table.nodes.is_balanced:
            return J
        (p, q), vm = mismatch.reshape(2, -1), x[self.network.n_nodes + self.p_rows]
        turn = sp.block_array(
            [[sp.diags_array(-q), sp.diags_array(p / vm)], [sp.diags_array(p), sp.diags_array(q / vm)]]
        )
        columns = np.concatenate([self.p_rows, self.network.n_nodes + self.p_rows])
        at = sp.csr_array((np.ones(len(columns)), (np.arange(len(columns)), columns)), shape=J.shape)
        return sp.csr_array(J + turn @ at)

    def find_limit(self, tolerance: float) -> np.ndarray:
        """The largest mismatch that each node may have, (n_nodes,), p.u."""
        n, (row, _), (shunt, at, _) = self.network.n_nodes, self.network.table.of_ports, find_shunts(self.network)
        at_ports = np.bincount(self.network.table.port_node[row], abs(find_primitives(self.network, True)), n)
        limit: np.ndarray = np.maximum(tolerance, ROUND_OFF * (at_ports + np.bincount(at, abs(shunt), n)))
        return limit


def find_voltages(x: np.ndarray) -> np.ndarray:
    """The complex voltages of x = [va; vm], p.u., (n_nodes,)."""
    va, vm = np.split(x, 2)
    v: np.ndarray = vm * np.exp(1j * va)
    return v


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
    slack_bus, slack_vm, slack_va = _slack_of(network, slack)
    if problems := list(_find_problems(network, slack_bus, slack_vm, extra_load or {})):
        raise InvalidInputError(f"power flow of network {network.name!r}", problems)
    held = {g.bus: g.vm for g in network.generators if g.control is Control.VOLTAGE} | {slack_bus: slack_vm}
    vm, va = flat_start(network, slack_bus, held)
    start = np.concatenate([va + slack_va, vm])
    return PowerFlowPlan(network, slack_bus, held, start, _lay_out(network, slack_bus, held, method, start))


def _lay_out(
    network: Network, slack_bus: int, held: Mapping[int, float], method: MethodChoice, start: np.ndarray
) -> TreePaths | CurrentSweeps | str:
    """The tree to sweep over, with phases the sweeps, or, as text, why sweeps are not used.

    Raises:
        InvalidInputError: sweeps are asked for and cannot serve.
    """
    if method not in get_args(MethodChoice):
        known = ", ".join(get_args(MethodChoice))
        raise InvalidInputError("power flow", [f"method is {method!r}; choose one of {known}"])
    if method == "newton":
        return "not asked for"
    if not network.table.nodes.is_balanced:  # no other bus holds its voltage
        given = np.union1d(network.nodes_at(slack_bus), network.dead).astype(np.intp)
        return CurrentSweeps(network, build_admittance(network), find_voltages(start), given)
    paths: TreePaths | str = "other buses than the slack hold their voltage"
    if len(held) == 1:
        paths = lay_out_paths(network, slack_bus, start[len(start) // 2 :])
    if isinstance(paths, str) and method == "sweep":
        problem = f"sweeps cannot serve: {paths}; choose 'auto' or 'newton'"
        raise InvalidInputError(f"power flow of network {network.name!r}", [problem])
    return paths


def _find_problems(
    network: Network, slack_bus: int, slack_vm: float, extra_load: Mapping[int, complex]
) -> Iterator[str]:
    if slack_bus not in network.row:
        yield f"the slack bus {slack_bus} is not in the network"
    else:
        yield from network.find_unreached(slack_bus, f"the slack bus {slack_bus}")
    if not network.table.nodes.is_balanced:
        yield from _find_voltage_problems(network, slack_bus)
    yield from network.find_ungrounded_supply(extra_load)
    if not (math.isfinite(slack_vm) and slack_vm > 0):
        yield f"the slack voltage is {slack_vm}; it must be a positive number in p.u."
    for bus, load in extra_load.items():
        if bus not in network.row:
            yield f"extra load at bus {bus}, which is not in the network"
        if not cmath.isfinite(load):
            yield f"the extra load at bus {bus} is {load}, not a finite number"


def _find_voltage_problems(network: Network, slack_bus: int) -> Iterator[str]:
    """Generators that hold the voltage of a bus with phases, as text."""
    for generator in network.generators:
        if generator.control is Control.VOLTAGE and generator.bus != slack_bus:
            yield f"a generator holds the voltage of bus {generator.bus}, which has phases; give it its P and Q"


def _slack_of(network: Network, slack: tuple[int, float] | None) -> tuple[int, float, float]:
    if slack is not None:
        return slack[0], slack[1], 0.0
    if network.slack is None:
        raise InvalidInputError(
            f"power flow of network {network.name!r}", ["it has no slack bus; give it one source of kind 'slack'"]
        )
    return network.slack.bus, network.slack.vm, network.slack.va
