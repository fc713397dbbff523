"""Many runs on the simulator as one table: strategies side by side, and one key varied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.lab.studies.strategy_comparison import choose_strategies
from coordinator.lab.studies.study_row import ORIGIN, StudyRow
from coordinator.lab.studies.sweep import compare_side_by_side, run_on_simulator, run_tasks
from coordinator.lab.studies.sweep_plan import hash_scenario, make_plan
from dsse_core.results.table import Table
from scenarios.scenario import Scenario

TEXTS = ("strategy", "outcome", "reason", *ORIGIN)


def compare(
    scenario: str | Path | Scenario,
    *,
    strategies: Sequence[str] | None = None,
    seed: int | None = None,
    changes: Mapping[str, object] | None = None,
    executor: Executor | None = None,
) -> Table:
    """Run every strategy on the telemetry and the faults of ``scenario``, on the simulator, as ``dsse compare`` does.

    Args:
        scenario: name of a shipped scenario, path of a scenario file, or a loaded one.
        strategies: their names; all that are installed if not given.
        seed: replaces the scenario's.
        changes: see ``load_scenario``; for a scenario that is not loaded yet.
        executor: runs the strategies side by side, on this machine or others; without it one after the other in this
            process.

    Returns:
        One row per strategy: ``outcome``, ``gap_vm_pu`` and ``gap_va_deg`` to the centralised estimate, ``messages``,
        ``below_1e6_s`` (virtual seconds until the gap stays below 1e-6 p.u. and rad) and others; nan where not known.

    >>> import consensus_dsse as dsse
    >>> table = dsse.compare("ieee33", strategies=["information", "admm"])
    >>> table.outcome
    ('consensus', 'consensus')
    >>> bool(table.gap_vm_pu[0] < 1e-9)
    True

    Raises:
        InvalidInputError: the scenario cannot be used, or a strategy is unknown or given twice.
        WorkerError: a worker was killed, or has other versions than this process.
    """
    chosen = choose_scenario(scenario, seed, changes=changes or {})
    names = choose_strategies(None if strategies is None else ",".join(strategies))
    if executor is not None:
        return _make_table(compare_side_by_side(chosen, names, executor), {})
    content = hash_scenario(chosen)
    rows = [run_on_simulator(replace(chosen, strategy=name)) for name in names]
    return _make_table([replace(row, scenario_sha256=content) for row in rows], {})


def sweep(
    scenario: str | Path,
    key: str,
    values: Sequence[object],
    *,
    strategies: Sequence[str] | None = None,
    seeds: int = 5,
    jobs: int = 1,
    changes: Mapping[str, object] | None = None,
    executor: Executor | None = None,
) -> Table:
    """Run ``scenario`` on the simulator for each value of a key, each strategy and each seed, as ``dsse sweep`` does.

    Args:
        scenario: name of a shipped scenario, or path of a scenario file.
        strategies: as of ``compare``.
        key, values: a key path such as ``faults.loss`` and what it becomes, in the units of the file.
        seeds: runs per value and strategy; they count up from the scenario's seed.
        jobs: processes at a time. With more than one, a script needs ``if __name__ == "__main__":``.
        changes: see ``load_scenario``; they hold in all runs.
        executor: runs units of 20 runs instead of ``jobs`` processes, on this machine or others.

    Returns:
        One row per run: ``value`` (as text), and the columns of ``compare``.

    >>> import consensus_dsse as dsse
    >>> table = dsse.sweep("ieee33", "faults.loss", [0.0, 0.3], strategies=["information"], seeds=2)
    >>> table.value, table.seed.tolist()
    (('0.0', '0.3', '0.0', '0.3'), [1, 1, 2, 2])
    >>> table.lost[1] > 0
    np.True_

    Raises:
        InvalidInputError: the scenario, the key, one of the values or a strategy cannot be used.
        WorkerError: a worker was killed, or has other versions than this process.
    """
    names = choose_strategies(None if strategies is None else ",".join(strategies))
    plain = [value.item() if isinstance(value, np.generic) else value for value in values]
    plan = make_plan(str(scenario), key, plain, names, seeds, changes=changes or {})
    rows = dict(run_tasks(plan, plan.tasks, jobs, executor))
    return _make_table([rows[task] for task in plan.tasks], {"value": [task.value for task in plan.tasks]})


def _make_table(rows: Sequence[StudyRow], first: Mapping[str, Sequence[str]]) -> Table:
    columns: dict[str, Any] = dict(first)
    for name in (field.name for field in fields(StudyRow)):
        cells = [getattr(row, name) for row in rows]
        columns[name] = cells if name in TEXTS else _numbers(cells)
    return Table("runs", columns)


def _numbers(cells: Sequence[float | None]) -> np.ndarray:
    if all(isinstance(cell, int) for cell in cells):
        return np.array(cells)
    return np.array([np.nan if cell is None else cell for cell in cells], dtype=float)
