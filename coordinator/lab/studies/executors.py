"""Executors of studies: they compute runs on this machine or others, in units of a size fit for a scheduler."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, as_completed
from typing import TypeVar

from dsse_core.errors import DsseError, InvalidInputError
from dsse_core.files.installation import install_command

Item = TypeVar("Item")
Result = TypeVar("Result")
RUNS_OF_UNIT = 20  # a unit takes seconds: a scheduler has few units, and a killed worker loses few runs
DASK = "dask://"
CONNECT_S = 10.0


class WorkerError(DsseError):
    """A worker ended before its run, or has other versions of packages than this process."""


def run_units(
    executor: Executor,
    function: Callable[[Sequence[Item]], Sequence[Result]],
    items: Sequence[Item],
    size: int = RUNS_OF_UNIT,
) -> Generator[Result, None, None]:
    """Results of ``function``, called with units of ``size`` items; unit by unit in the order in which they end.

    Raises:
        WorkerError: a worker ended before its unit, and the executor does not give the unit to another worker.
    """
    units = [items[first : first + size] for first in range(0, len(items), size)]
    futures = [executor.submit(function, unit) for unit in units]
    try:
        for future in as_completed(futures):
            yield from future.result()
    except (BrokenExecutor, CancelledError) as error:
        raise WorkerError(f"a worker has ended before its runs: {error or type(error).__name__}; try again") from None
    except BaseException as error:
        if type(error).__name__ == "KilledWorker":  # of dask, which need not be installed
            raise WorkerError(f"workers were killed, for lack of memory perhaps: {error}") from None
        raise
    finally:
        for future in futures:
            future.cancel()


@contextlib.contextmanager
def open_executor(address: str) -> Iterator[Executor]:
    """Opens the executor at ``address``, ``dask://HOST:PORT`` of a scheduler, for the block.

    Raises:
        InvalidInputError: ``address`` has another form, dask is not installed, or no scheduler answers.
    """
    if not address.startswith(DASK) or not address.removeprefix(DASK).rpartition(":")[2].isdigit():
        raise InvalidInputError("--executor", [f"found {address!r}; give {DASK}HOST:PORT of a dask scheduler"])
    try:
        from distributed import Client
    except ImportError:
        problem = f"dask is not installed; {install_command('dask')}"
        raise InvalidInputError("--executor", [problem]) from None
    try:
        client = Client(f"tcp://{address.removeprefix(DASK)}", timeout=CONNECT_S, set_as_default=False)
    except OSError:
        problem = f"no dask scheduler answers at {address} within {CONNECT_S:g} s; start `dask scheduler` there"
        raise InvalidInputError("--executor", [problem]) from None
    with client:
        yield client.get_executor()
