"""The centralised estimate as reference of a run, made on a thread during the run, as a large grid takes long."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future

from coordinator.lab.evaluation.evaluation import Centralised


def start_reference_estimate(estimate: Callable[[], Centralised]) -> Future[Centralised]:
    """Make the centralised estimate on a daemon thread, which does not delay the end of the program."""
    future: Future[Centralised] = Future()

    def make() -> None:
        try:
            future.set_result(estimate())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=make, name="centralised estimate", daemon=True).start()
    return future
