"""How tests start ``dsse`` as a process of its own, and where it may listen."""

from __future__ import annotations

import contextlib
import os
import random
import socket
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
COMMAND = [sys.executable, "-P", "-m", "coordinator"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
WITH_LIMITS = ENVIRONMENT | {"PYTHONDONTWRITEBYTECODE": "1"}
"""Of processes that may write little: Python would keep bytecode that is cut off, for all who come after."""


BELOW_THOSE_OF_LINKS = range(10_000, 32_000)  # ports that no system gives to a link that somebody opens meanwhile
_drawn: set[int] = set()  # some are listened on later, or again after a while


def free_port() -> int:
    """A port of this host that nobody listens on, and that no other test draws, nor another worker of the tests."""
    worker, count = os.environ.get("PYTEST_XDIST_WORKER", "gw0"), os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")
    own = BELOW_THOSE_OF_LINKS[int(worker.removeprefix("gw")) :: int(count)]
    while True:
        port = random.SystemRandom().choice(own)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            if port not in _drawn:
                _drawn.add(port)
                return port


def free_endpoint(protocol: str = "tcp") -> str:
    return f"{protocol}/127.0.0.1:{free_port()}"
