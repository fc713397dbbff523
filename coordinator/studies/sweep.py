"""``dsse sweep``: many runs on the simulator, on all cores."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool

from coordinator.interrupts import ENDS
from coordinator.simulator.simulate import Simulation
from coordinator.strategy_check import check_with_strategy
from coordinator.studies.study_row import StudyRow, make_impossible_row, make_row
from coordinator.studies.sweep_plan import SweepPlan, Task
from dsse_core.errors import DsseError
from scenarios.scenario import Scenario

_plan: SweepPlan  # of a worker process


class WorkerError(DsseError):
    """A worker process ended before its run did."""


def run_tasks(plan: SweepPlan, tasks: Sequence[Task], jobs: int) -> Iterator[tuple[Task, StudyRow]]:
    """Run ``tasks`` in ``jobs`` processes; each with its row, as they end."""
    jobs = min(jobs, len(tasks))
    if jobs <= 1:
        for task in tasks:
            yield task, run_on_simulator(plan.scenario_of(task))
        return
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(jobs, context, initializer=_start_worker, initargs=(plan,))
    try:
        with _signals_held_back():  # inherited: workers leave them to us from their first moment on
            tasks_of = {pool.submit(_run_task, task): task for task in tasks}
        for future in as_completed(tasks_of):
            yield tasks_of[future], future.result()
    except BrokenProcessPool:
        raise WorkerError("a worker was killed, for lack of memory perhaps; try again with fewer --jobs") from None
    except BaseException:
        with _signals_held_back():
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in set(multiprocessing.active_children()) - others:
                worker.kill()  # which hears no signal, and has nothing to tidy up
        raise
    pool.shutdown()


@contextlib.contextmanager
def _signals_held_back() -> Iterator[None]:
    """Let those that end us wait: a worker that has received only half of its task would show a traceback.

    Workers inherit the mask. It does not keep a signal from another thread of ours, so that the handlers wait, too.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    came: list[int] = []
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDS)
    handlers = {number: signal.getsignal(number) for number in ENDS}
    is_main = threading.current_thread() is threading.main_thread()  # no other may set handlers
    waiting = [number for number, handler in handlers.items() if is_main and callable(handler)]
    for number in waiting:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number in waiting:
            signal.signal(number, handlers[number])
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for arrived in came:
            signal.raise_signal(arrived)


def run_on_simulator(scenario: Scenario) -> StudyRow:
    """The row of one run; one that is not possible has a row that says why."""
    try:
        check_with_strategy(scenario)
        simulation = Simulation(scenario)
    except DsseError as error:
        return make_impossible_row(scenario, error)
    return make_row(simulation.evaluate(simulation.run()))


def _run_task(task: Task) -> StudyRow:
    return run_on_simulator(_plan.scenario_of(task))


def _start_worker(plan: SweepPlan) -> None:
    """Leave signals to the parent, for good, and end with it, however it ends."""
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
