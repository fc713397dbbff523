"""The round trip of a message between two HELICS federates in two processes, through a broker on ZeroMQ."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from importlib.util import find_spec
from typing import Any

THIS = "benchmarks.latency.helics_round_trip"
LIMIT_S = 60.0
FOREVER = 1e9  # of federation time
ASK, ANSWER = "ask", "answer"


def time_helics_round_trips(size: int, count: int) -> list[float] | str:
    """Seconds of ``count`` round trips of ``size`` bytes; without any, the reason as text."""
    if find_spec("helics") is None:
        return "not installed"
    command = [sys.executable, "-m", THIS, ASK, str(size), str(count)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=True)
    except subprocess.TimeoutExpired:
        return f"not done in {LIMIT_S:g} s"
    except subprocess.CalledProcessError as error:
        return f"fails: {error.stderr.strip().splitlines()[-1]}"
    times: list[float] = json.loads(done.stdout.splitlines()[-1])
    return times


def _ask(size: int, count: int) -> None:
    import helics

    broker = helics.helicsCreateBroker("zmq", "", "--federates=2")
    with subprocess.Popen([sys.executable, "-m", THIS, ANSWER, str(size), str(count)]):
        federate, endpoint = _join(ASK)
        times = []
        for _ in range(count):
            start = time.perf_counter()
            endpoint.send_data(bytes(size), ANSWER)
            _receive(federate, endpoint)
            times.append(time.perf_counter() - start)
        federate.disconnect()
    broker.disconnect()
    print(json.dumps(times))


def _answer(size: int, count: int) -> None:
    federate, endpoint = _join(ANSWER)
    for _ in range(count):
        _receive(federate, endpoint)
        endpoint.send_data(bytes(size), ASK)
    federate.disconnect()


def _receive(federate: Any, endpoint: Any) -> None:
    """Let federation time pass until there is a message: it is granted as soon as there is one."""
    while not endpoint.has_message():
        federate.request_time(FOREVER)
    endpoint.get_message()


def _join(name: str) -> tuple[Any, Any]:
    import helics

    info = helics.helicsCreateFederateInfo()
    info.core_type = "zmq"
    info.core_init = "--federates=1"
    federate = helics.helicsCreateMessageFederate(name, info)
    endpoint = federate.register_global_endpoint(name)
    federate.enter_executing_mode()
    return federate, endpoint


if __name__ == "__main__":
    side = {ASK: _ask, ANSWER: _answer}[sys.argv[1]]
    side(int(sys.argv[2]), int(sys.argv[3]))
