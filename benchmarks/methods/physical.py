"""A network of lines in ohms, siemens and kV, from which the peers' inputs are made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.network import Network


@dataclass(frozen=True)
class LineNetwork:
    """Buses by row, lines by row of ``network.active_branches``; ``b`` is the whole charging of a line."""

    kv: np.ndarray
    from_row: np.ndarray
    to_row: np.ndarray
    r_ohm: np.ndarray
    x_ohm: np.ndarray
    b_siemens: np.ndarray
    slack_row: int
    slack_vm: float


def describe_lines(network: Network) -> LineNetwork:
    """The network without per unit.

    Raises:
        InvalidInputError: it has no substation, or transformers, shunts or losses of lines, which are not translated.
    """
    branches, slack = network.active_branches, network.slack
    problems = [
        f"branch {b.id} is a transformer or has losses g; the peers are given lines only"
        for b in branches
        if (b.tap, b.shift, b.g) != (1.0, 0.0, 0.0)
    ]
    problems += [f"bus {bus.id} has a shunt; the peers are given lines only" for bus in network.buses if bus.has_shunt]
    if slack is None or problems:
        problems += ["it has no slack bus"] if slack is None else []
        raise InvalidInputError(f"network {network.name!r} for the peers", problems)
    kv = np.array([bus.base_kv for bus in network.buses])
    from_row, to_row = np.array([(network.row[b.from_bus], network.row[b.to_bus]) for b in branches]).T
    z_base = kv[from_row] ** 2 / network.base_mva
    r, x, b = np.array([(branch.r, branch.x, branch.b) for branch in branches]).T
    return LineNetwork(
        kv=kv,
        from_row=from_row,
        to_row=to_row,
        r_ohm=r * z_base,
        x_ohm=x * z_base,
        b_siemens=b / z_base,
        slack_row=network.row[slack.bus],
        slack_vm=slack.vm,
    )
