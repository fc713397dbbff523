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


def free_port() -> int:
    """A port of this host that nobody listens on, and that no other test will draw before it is used."""
    while True:
        port = random.SystemRandom().choice(BELOW_THOSE_OF_LINKS)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


def free_endpoint(protocol: str = "tcp") -> str:
    return f"{protocol}/127.0.0.1:{free_port()}"
