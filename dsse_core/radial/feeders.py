"""The iteration of a large network on several threads: the feeders below its first fork are independent of each other.

Every thread has some feeders, whose buses are numbered in one piece. In each step every thread moves the voltages of
its buses and eliminates them. Then the trunk, from the root to the fork, is solved, and every thread substitutes.
"""

from __future__ import annotations

import itertools

import numpy as np

from dsse_core.code_cache import compiled
from dsse_core.radial.block import N_INVERSE
from dsse_core.radial.iteration import move
from dsse_core.radial.kernel import STEP, eliminate_below, eliminate_root, root_objective, substitute_below
from dsse_core.radial.root import N_KNOWN


def find_feeders(parent: np.ndarray, threads: int) -> tuple[int, list[tuple[int, int]]]:
    """The bus of the first fork, and for each thread the first of its buses and the bus after its last.

    The parts are as even as the feeders allow. There are fewer than ``threads`` parts where feeders are fewer, and none
    where the network has no fork.
    """
    n = len(parent)
    children = np.bincount(parent[1:], minlength=n)
    fork = int(np.argmax(children != 1))  # before it each bus is followed by its only child
    heads = np.flatnonzero(parent == fork)
    heads = heads[heads > fork]
    if len(heads) == 0:
        return fork, []
    wanted = fork + 1 + np.arange(1, threads) * (n - fork - 1) / threads
    cuts = heads[np.searchsorted(heads, wanted).clip(max=len(heads) - 1)]
    bounds = np.unique(np.concatenate([[fork + 1], cuts, [n]])).tolist()
    return fork, list(itertools.pairwise(bounds))


@compiled
def go_up(
    first, end, fork, parent, place, Y, z, w, v, va, currents, share, dva, above, factor, more, step, to_fork
):  # fmt: skip
    """Moves the voltages from ``first`` to ``end`` - 1 by ``share`` of the last step and eliminates their buses; J.

    ``above`` (deepest level + 1, 16), 0: memory of one thread. Fills ``to_fork`` (16,), the message to the fork.
    """
    if share > 0.0:
        move(v[first:end], va[first:end], step[first:end], share, dva)
    block = np.empty((4, N_INVERSE))
    J = eliminate_below(
        first, end, parent, Y, z, w, v, va, currents, STEP, place, above, factor, more, block, 0.0
    )[2]  # fmt: skip
    for k in range(N_KNOWN):
        to_fork[k] = above[place[fork], k]
        above[place[fork], k] = 0.0
    return J


@compiled
def pass_trunk(fork, parent, place, Y, z, w, v, va, currents, above, factor, more, block, step, to_fork):
    """Eliminates the trunk with all rows of ``to_fork`` (:, 16), and substitutes.

    Returns J, max |dva|, max |dvm|, and True where the step is finite.
    """
    for t in range(len(to_fork)):
        for k in range(N_KNOWN):
            above[place[fork], k] += to_fork[t, k]
    J = eliminate_below(
        1, fork + 1, parent, Y, z, w, v, va, currents, STEP, place, above, factor, more, block, 0.0
    )[2]  # fmt: skip
    J += root_objective(Y, z, w, v, va, above[0, 14], above[0, 15])
    eliminate_root(Y, z, w, v, va, False, above[0], block, step)
    dva, dvm = abs(step[0, 2]), abs(v[0]) * abs(step[0, 3])
    dva, dvm, finite = substitute_below(1, fork + 1, parent, factor, v, step, dva, dvm)
    return J, dva, dvm, finite and np.isfinite(step[0, 2] + step[0, 3])
