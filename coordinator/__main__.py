"""``dsse``: starts an agent with only the imports that it needs; all other commands go to the command line."""

from __future__ import annotations

import gc
import io
import os
import sys
from collections.abc import Sequence

from coordinator.watch import interrupts

SWITCH_S = 1e-3  # after which a computing thread yields to one with messages from the bus


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command in ``argv`` (default: that of the process) and return its exit code, which no signal changes."""
    interrupts.end_at_once()
    _replace_closed_streams()
    arguments = list(sys.argv[1:] if argv is None else argv)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # spinning threads would take the agents' cores
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # the search for some reads about all packages
    gc.set_threshold(100_000, 50, 100)  # a large grid is millions of objects without cycles: look for some rarely
    sys.setswitchinterval(SWITCH_S)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a terminal of another alphabet shows an escape, as standard error does
        sys.stdout.reconfigure(errors="backslashreplace")
    code = _run_agent(arguments[1:]) if arguments[:1] == ["agent"] else _run_command(arguments)
    interrupts.ignore()
    gc.freeze()  # the process ends: no search for cycles in what is left
    return code


def _replace_closed_streams() -> None:
    """Open the null device for standard streams that the caller has closed.

    Otherwise the first files opened get their numbers, and output goes into these files.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115


def _run_agent(arguments: Sequence[str]) -> int:
    from agents.__main__ import main as agent

    return agent(arguments)


def _run_command(arguments: Sequence[str]) -> int:
    from agents.runtime.heap import keep_small
    from coordinator.cli.main import report_interrupted, run_command
    from coordinator.cli.terminal import notify
    from coordinator.lab.process_run.compile_clock import clock

    keep_small()
    clock.notify = notify
    try:
        interrupts.raise_interrupts()
        code = run_command(arguments)
        interrupts.ignore()
    except KeyboardInterrupt:  # before the command began, or when it was over
        code = report_interrupted()
    return code


if __name__ == "__main__":
    sys.exit(main())
