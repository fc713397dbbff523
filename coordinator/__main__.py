"""``dsse``: an agent starts with nothing but what it needs; everything else goes to the command line."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence

SWITCH_S = 1e-3  # after which a thread that computes lets in one that has news from the bus


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command in ``argv`` (default: that of the process) and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # spinning threads would take the agents' cores
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # to look for some, it reads about all packages
    gc.set_threshold(100_000, 50, 100)  # a large grid is millions of objects without cycles: look for some rarely
    sys.setswitchinterval(SWITCH_S)
    if arguments[:1] == ["agent"]:
        from agents.__main__ import main as agent

        return agent(arguments[1:])
    from agents.heap import keep_small
    from coordinator.cli import run_command

    keep_small()
    return run_command(arguments)


if __name__ == "__main__":
    sys.exit(main())
