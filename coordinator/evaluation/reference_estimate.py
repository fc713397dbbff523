"""The centralised estimate that a run is measured against, made beside the watching: of a large grid it takes long."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future

from coordinator.evaluation.evaluation import Centralised, estimate_centralised
from scenarios.scenario import Scenario
from scenarios.telemetry import Telemetry


def start_reference_estimate(
    scenario: Scenario, telemetry: Telemetry, when_done: Callable[[], None]
) -> Future[Centralised]:
    """Make the centralised estimate on a thread, which does not hold up the end of the program."""
    future: Future[Centralised] = Future()

    def make() -> None:
        try:
            result = estimate_centralised(scenario, telemetry)
        except BaseException as error:
            future.set_exception(error)
        else:
            when_done()
            future.set_result(result)

    threading.Thread(target=make, name="centralised estimate", daemon=True).start()
    return future
