"""The centralised estimate that a run is measured against, made beside the watching: of a large grid it takes long."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future

from coordinator.evaluation.evaluation import Centralised


def start_reference_estimate(estimate: Callable[[], Centralised]) -> Future[Centralised]:
    """Make the centralised estimate on a thread, which does not hold up the end of the program."""
    future: Future[Centralised] = Future()

    def make() -> None:
        try:
            future.set_result(estimate())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=make, name="centralised estimate", daemon=True).start()
    return future
