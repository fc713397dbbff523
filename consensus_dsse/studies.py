"""Studies as one table: strategies side by side, keys varied, and the thesis reproduced."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.lab.studies.strategy_comparison import choose_strategies
from coordinator.lab.studies.study_row import COLUMNS, ORIGIN, StudyRow
from coordinator.lab.studies.sweep import compare_side_by_side, run_on_simulator, run_tasks
from coordinator.lab.studies.sweep_plan import Axis, hash_scenario, make_plan, number_of, sorted_tasks, split_keys
from dsse_core.errors import InvalidInputError
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
        One row per strategy: ``outcome``, ``gap_vm_pu`` and ``gap_va_deg`` to the centralised estimate, ``error_vm_pu``
        and ``error_va_deg`` to the truth, ``messages``, ``below_1e6_s`` (virtual seconds until the gap stays below 1e-6
        p.u. and rad) and others; nan where not known.

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
    names = choose_strategies(strategies if strategies is None or isinstance(strategies, str) else ",".join(strategies))
    if executor is not None:
        return _make_table(compare_side_by_side(chosen, names, executor), {})
    content = hash_scenario(chosen)
    rows = [run_on_simulator(replace(chosen, strategy=name)) for name in names]
    return _make_table([replace(row, scenario_sha256=content) for row in rows], {})


def sweep(
    scenario: str | Path,
    vary: Mapping[str, Sequence[object]],
    *,
    strategies: Sequence[str] | None = None,
    seeds: int = 5,
    jobs: int = 1,
    changes: Mapping[str, object] | None = None,
    executor: Executor | None = None,
) -> Table:
    """Run ``scenario`` on the simulator for each value of keys, each strategy and each seed, as ``dsse sweep`` does.

    Args:
        scenario: name of a shipped scenario, or path of a scenario file.
        vary: key path such as ``faults.loss`` -> its values, in the units of the file. Of several, all combinations are
            run; keys with commas between them take the same value.
        strategies: as of ``compare``.
        seeds: runs per combination of values and strategy; they count up from the scenario's seed.
        jobs: processes at a time. With more than one, a script needs ``if __name__ == "__main__":``.
        changes: see ``load_scenario``; they hold in all runs.
        executor: runs units of 20 runs instead of ``jobs`` processes, on this machine or others.

    Returns:
        One row per run, sorted by values, strategy and seed: a column per key, and those of ``compare``.

    >>> import consensus_dsse as dsse
    >>> table = dsse.sweep("ieee33", {"faults.loss": [0.0, 0.3]}, strategies=["information"], seeds=2)
    >>> table["faults.loss"].tolist(), table.seed.tolist()
    ([0.0, 0.0, 0.3, 0.3], [1, 2, 1, 2])
    >>> table.lost[2] > 0
    np.True_

    Raises:
        InvalidInputError: the scenario, a key, one of the values or a strategy cannot be used.
        WorkerError: a worker was killed, or has other versions than this process.
    """
    if isinstance(scenario, Scenario):
        raise InvalidInputError("sweep", [f"scenario {scenario.name!r} is loaded already; give its name or its path"])
    names = choose_strategies(strategies if strategies is None or isinstance(strategies, str) else ",".join(strategies))
    if problems := [
        f"{keys!r}: {values!r:.80}; give a key with commas where several vary, and a list of values"
        for keys, values in vary.items()
        if not isinstance(keys, str) or isinstance(values, str) or not np.iterable(values)
    ]:
        raise InvalidInputError("sweep", problems)
    axes = [Axis(split_keys(keys), list(map(_plain, values))) for keys, values in vary.items()]
    plan = make_plan(str(scenario), axes, names, seeds, changes=changes or {})
    rows = dict(run_tasks(plan, plan.tasks, jobs, executor))
    tasks = sorted_tasks(rows)
    varied: dict[str, Any] = {}
    for place, axis in enumerate(axes):
        numbers = [number_of(task.values[place]) for task in tasks]
        texts = [task.values[place] for task in tasks]
        varied |= dict.fromkeys(axis.keys, texts if None in numbers else np.array(numbers))
    return _make_table([rows[task] for task in tasks], varied)


def thesis() -> Table:
    """The tables of the thesis beside ours, as ``dsse thesis`` prints them: one row per printed row.

    Columns: ``table`` and ``printed_bus`` as in the thesis, ``bus`` of the grid, ``printed_vm_pu``, ``vm_pu``,
    ``difference_vm_pu``, the same of ``va_deg`` and, of power flows, of ``load_mw``, ``load_mvar``, ``gen_mw`` and
    ``gen_mvar``; ``misprint`` (a text, empty where there is none), ``ours``: what it is. ``against``: the table to
    which ``printed_effect_vm_pu``, ``effect_vm_pu`` and those of ``va_deg`` are differences.

    >>> import consensus_dsse as dsse
    >>> table = dsse.thesis()
    >>> len(table), len(set(table.table))
    (291, 22)
    >>> sound = [text == "" for text in table.misprint]
    >>> bool(abs(table.difference_va_deg[sound]).max() < 0.05)
    True
    """
    from coordinator.lab.thesis.comparison import as_one_table, compare_tables

    return as_one_table(compare_tables())


def _plain(value: object) -> object:
    return value.item() if isinstance(value, np.generic) else value


def _make_table(rows: Sequence[StudyRow], varied: Mapping[str, Any]) -> Table:
    columns: dict[str, Any] = dict(varied)
    for name in COLUMNS:
        cells = [getattr(row, name) for row in rows]
        columns[name] = cells if name in TEXTS else _numbers(cells)
    return Table("runs", columns)


def _numbers(cells: Sequence[float | None]) -> np.ndarray:
    if all(isinstance(cell, int) for cell in cells):
        return np.array(cells)
    return np.array([np.nan if cell is None else cell for cell in cells], dtype=float)
