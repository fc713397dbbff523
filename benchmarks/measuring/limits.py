"""A call in a process of its own that may run out of memory, out of time or crash without taking the others along."""

from __future__ import annotations

import multiprocessing
import re
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

GIB = 2**30


class LimitedCallError(Exception):
    """The call gave no answer; the text is the reason, in one line."""


def call_limited(function: Callable[..., Any], *args: Any, limit_s: float, limit_gib: float) -> Any:
    """``function(*args)`` in a fresh process.

    Raises:
        LimitedCallError: it raised, crashed, or took more than ``limit_s`` seconds or ``limit_gib`` of address space.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(sender, limit_gib, function, args), daemon=True)
    process.start()
    sender.close()
    try:
        if not receiver.poll(limit_s):
            raise LimitedCallError(f"out of time ({limit_s:g} s)")
        answer, problem = receiver.recv()
    except EOFError:
        process.join()
        raise LimitedCallError(f"its process ended with exit code {process.exitcode}") from None
    finally:
        process.kill()
        process.join()
        receiver.close()
    if problem is not None:
        raise LimitedCallError(problem)
    return answer


def _answer(sender: Connection, limit_gib: float, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the parent, which ends this process
    _limit_memory(limit_gib)
    message: tuple[Any, str | None]
    try:
        message = function(*args), None
    except MemoryError:
        message = None, f"out of memory ({limit_gib:g} GiB)"
    except Exception as error:
        first_sentence = re.split(r"[.!](?:\s|$)|\n", str(error).strip(), maxsplit=1)[0]
        message = None, f"fails: {type(error).__name__}: {first_sentence}".rstrip(": ")
    sender.send(message)


def _limit_memory(limit_gib: float) -> None:
    try:
        import resource
    except ImportError:  # no such limit on Windows
        return
    limit = int(limit_gib * GIB)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
