"""``dsse sweep``: many runs on the simulator, on all cores or by an executor."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace

from coordinator.lab.simulator.simulate import Simulation
from coordinator.lab.strategy_check import check_with_strategy
from coordinator.lab.studies.executors import RUNS_OF_UNIT, WorkerError, run_units
from coordinator.lab.studies.study_row import (
    StudyRow,
    check_one_is_possible,
    describe_versions,
    make_impossible_row,
    make_row,
)
from coordinator.lab.studies.sweep_plan import SweepPlan, Task, hash_scenario
from coordinator.watch.interrupts import ENDS
from dsse_core import operating_system
from dsse_core.errors import DsseError
from scenarios.scenario import Scenario

_plan: SweepPlan  # of a worker process


def run_tasks(
    plan: SweepPlan, tasks: Sequence[Task], jobs: int, executor: Executor | None = None, size: int = RUNS_OF_UNIT
) -> Iterator[tuple[Task, StudyRow]]:
    """Runs ``tasks`` in ``jobs`` processes, or by ``executor`` in units of ``size``. Yields each task with its row, in
    the order in which they end.

    Raises:
        WorkerError: a worker was killed, or has other versions than this process.
    """
    content = hash_scenario(plan.base)
    if executor is None:
        found = _run_here(plan, tasks, jobs)
    else:
        ordered = sorted(tasks, key=lambda task: task.values)  # so that a unit has few networks
        found = run_scenarios(executor, [(task, plan.scenario_of(task)) for task in ordered], size)
    with contextlib.closing(found):
        for task, row in found:
            yield task, replace(row, scenario_sha256=content)


def run_scenarios(
    executor: Executor, runs: Sequence[tuple[Task, Scenario]], size: int
) -> Generator[tuple[Task, StudyRow], None, None]:
    """Runs scenarios by ``executor`` in units of ``size``. Yields each task with its row, unit by unit as they end.

    Raises:
        WorkerError: a worker was killed, or has other versions than this process.
    """
    with contextlib.closing(run_units(executor, run_unit, runs, size)) as found:
        for task, row in found:
            if row.versions != describe_versions():
                raise WorkerError(
                    f"the worker on {row.host} has {row.versions}, and this process {describe_versions()}; "
                    "install the same versions"
                )
            yield task, row


def compare_side_by_side(
    scenario: Scenario, strategies: Sequence[str], executor: Executor | None = None
) -> tuple[StudyRow, ...]:
    """A row per strategy, run side by side in processes of this machine, or by ``executor``.

    Raises:
        InvalidInputError: no strategy can be run, with the reasons.
        WorkerError: a worker was killed, or has other versions than this process.
    """
    plan = SweepPlan((), scenario, {(): scenario}, tuple(strategies), 1, {})
    jobs = operating_system.count_processors()
    row_of = {task.strategy: row for task, row in run_tasks(plan, plan.tasks, jobs, executor, size=1)}
    rows = tuple(row_of[name] for name in strategies)
    check_one_is_possible(scenario, rows)
    return rows


def run_unit(runs: Sequence[tuple[Task, Scenario]]) -> list[tuple[Task, StudyRow]]:
    """Rows of one unit of work. Apart from host and versions, they depend on the scenarios only."""
    return [(task, run_on_simulator(scenario)) for task, scenario in runs]


def _run_here(plan: SweepPlan, tasks: Sequence[Task], jobs: int) -> Generator[tuple[Task, StudyRow], None, None]:
    jobs = min(jobs, len(tasks))
    if jobs <= 1:
        for task in tasks:
            yield task, run_on_simulator(plan.scenario_of(task))
        return
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(jobs, context, initializer=_start_worker, initargs=(plan,))
    try:
        with _signals_held_back():  # workers inherit the mask, and leave signals to this process from their start on
            tasks_of = {pool.submit(_run_task, task): task for task in tasks}
        for future in as_completed(tasks_of):
            yield tasks_of[future], future.result()
    except BrokenProcessPool:
        raise WorkerError(
            "a worker was killed: for lack of memory perhaps, then try again with fewer --jobs; or a script calls this "
            'without `if __name__ == "__main__":`, which workers need'
        ) from None
    except BaseException:
        with _signals_held_back():
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in set(multiprocessing.active_children()) - others:
                worker.kill()  # a worker ignores other signals, and has nothing to clean up
        raise
    pool.shutdown()


@contextlib.contextmanager
def _signals_held_back() -> Iterator[None]:
    """Delays the signals ``ENDS`` until the end of the block: a worker that has received half of its task would print a
    traceback.

    Workers inherit the mask. The mask does not keep a signal from other threads of this process, so the handlers are
    delayed, too.
    """
    came: list[int] = []
    with operating_system.blocked(ENDS):
        handlers = {number: signal.getsignal(number) for number in ENDS}
        is_main = threading.current_thread() is threading.main_thread()  # no other thread may set handlers
        waiting = [number for number, handler in handlers.items() if is_main and callable(handler)]
        for number in waiting:
            signal.signal(number, lambda number, _: came.append(number))
        try:
            yield
        finally:
            for number in waiting:
                signal.signal(number, handlers[number])
    for arrived in came:
        signal.raise_signal(arrived)


def run_on_simulator(scenario: Scenario) -> StudyRow:
    """The row of a run on the simulator, or the row of an impossible run with the reason."""
    try:
        check_with_strategy(scenario)
        simulation = Simulation(scenario)
    except DsseError as error:
        return make_impossible_row(scenario, error)
    return make_row(simulation.evaluate(simulation.run()))


def _run_task(task: Task) -> StudyRow:
    return run_on_simulator(_plan.scenario_of(task))


def _start_worker(plan: SweepPlan) -> None:
    """Initialises a worker: it ignores signals, which the parent handles, and ends when the parent ends."""
    global _plan
    _plan = plan
    for number in ENDS:
        signal.signal(number, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
