"""What signals do to the command ``dsse``, stage by stage: end it at once while it loads, raise while it works, change
no exit code that has been decided.

Only ``coordinator.__main__`` begins this; where commands are called as functions, signals stay the caller's.
"""

from __future__ import annotations

import os
import signal

TYPE_CHECKING = False  # as that of ``typing``: until this module works, Ctrl-C shows a traceback, so it imports nothing
if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn

SIGINT = (signal.SIGINT,)
ENDS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
INTERRUPTED_CODE = 1
_state = {"is_command": False, "code": INTERRUPTED_CODE}


def end_at_once() -> None:
    """Loading: nothing is there to be tidied up, and imports that are broken off show tracebacks."""
    _state["is_command"] = True
    _set(SIGINT, _end_interrupted)


def raise_interrupts() -> None:
    """Working: Ctrl-C raises KeyboardInterrupt, as Python has it, but not out of an import."""
    _set(SIGINT, _interrupt)


def end_orderly_on_signals() -> None:
    """Let SIGTERM and SIGHUP do what Ctrl-C does."""
    _set(ENDS, _interrupt)


def decide(code: int) -> None:
    """The verdict is known: from now on signals end the command at once, with ``code``."""
    _state["code"] = code
    _set(ENDS, _end_decided)


def ignore() -> None:
    """The command is over: Python, ending, gives handlers back to the system, but leaves alone what is ignored."""
    _set(ENDS, signal.SIG_IGN)


def _set(numbers: tuple[signal.Signals, ...], handler: object) -> None:
    for number in numbers:
        if _state["is_command"] and signal.getsignal(number) != signal.SIG_IGN:  # as nohup has it
            signal.signal(number, handler)  # type: ignore[arg-type]


def _end_interrupted(*_: object) -> NoReturn:
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED_CODE)


def _end_decided(*_: object) -> NoReturn:
    os._exit(_state["code"])


def _interrupt(_number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or once the import under way is over: compiled modules swallow it, or make a traceback
    of it.
    """
    importer = _find_importer(frame)
    if importer is None:
        raise KeyboardInterrupt
    import sys  # loaded already wherever a module is imported

    importer.f_trace = _raise_interrupt
    sys.settrace(lambda *_: None)  # without any, that of the frame is not asked


def _find_importer(frame: FrameType | None) -> FrameType | None:
    """The frame whose import statement is under way, None without one."""
    found = None
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            found = frame.f_back
        frame = frame.f_back
    return found


def _raise_interrupt(frame: FrameType, _event: str, _argument: object) -> NoReturn:
    import sys

    sys.settrace(None)
    frame.f_trace = None
    raise KeyboardInterrupt
