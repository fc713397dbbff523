"""Units of instruments, from p.u. and rad: kV, kW and kvar, A in each line, degrees.

Of a balanced network kV are between lines, kW and kvar of all three phases; of a node with a phase kV are to ground, kW
and kvar its own: a third of the power base.
"""

from __future__ import annotations

import math

import numpy as np

from dsse_core.grid.network import Network


def base_kw(network: Network) -> float:
    """The size of 1 p.u. of power at each node, kW, kvar or kVA."""
    return 1000.0 * network.node_mva


def base_kv(network: Network) -> np.ndarray:
    """The size of 1 p.u. of voltage at each node, kV, shape (n_nodes,)."""
    kv, nodes = network.table.base_kv, network.table.nodes
    return kv if nodes.is_balanced else kv[nodes.item] / math.sqrt(3.0)


def base_a(network: Network) -> np.ndarray:
    """The size of 1 p.u. of current at each bus, A, shape (n_bus,): ``S_base / (sqrt(3) V_base)``."""
    base: np.ndarray = 1000.0 * network.base_mva / (math.sqrt(3.0) * network.table.base_kv)
    return base


def wrap_degrees(va: np.ndarray) -> np.ndarray:
    """Angles or their differences, rad, as degrees from -180 to 180; nan stays nan.

    Angles in this range keep all digits.
    """
    degrees = np.degrees(va)
    return np.asarray(degrees - 360.0 * np.round(degrees / 360.0))


def base_current(base_mva: float, base_kv: float) -> float:
    """The size of 1 p.u. of current, A: ``S_base / (sqrt(3) V_base)``; ``base_mva`` MVA, ``base_kv`` kV."""
    return 1000.0 * base_mva / (math.sqrt(3.0) * base_kv)
