"""What signals do to the command ``dsse``, stage by stage: end it at once while it loads, raise while it works, end it
with the exit code that has been decided once there is one.

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
_ASKED = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGPWR", "SIGPOLL", "SIGSTKFLT")
_TIME_IS_UP = ("SIGALRM", "SIGVTALRM", "SIGPROF", "SIGXCPU")
_REAL_TIME = range(getattr(signal, "SIGRTMIN", 0), getattr(signal, "SIGRTMAX", -1) + 1)
ENDS = (*(getattr(signal, name) for name in (*_ASKED, *_TIME_IS_UP) if hasattr(signal, name)), *_REAL_TIME)
"""All signals that end a process by default, but for SIGKILL and those that stand for a defect of it."""
INTERRUPTED_CODE = 1
_state: dict[str, int | None] = {"is_command": False, "decided": None, "held": False, "came": False}


class Held:
    """A block that Ctrl-C does not break off: the command ends after it; a second Ctrl-C is followed at once."""

    def __enter__(self) -> None:
        _state["held"], _state["came"] = True, False

    def __exit__(self, *_: object) -> None:
        _state["held"] = False
        if _state["came"]:
            _state["came"] = False
            raise _make_end()


def end_at_once() -> None:
    """Loading: nothing is there to be tidied up, and imports that are broken off show tracebacks."""
    _state.update(is_command=True, decided=None)
    _set(SIGINT, _end_interrupted)


def raise_interrupts() -> None:
    """Working: Ctrl-C raises KeyboardInterrupt, as Python has it, but not out of an import."""
    _set(SIGINT, _interrupt)


def end_orderly_on_signals() -> None:
    """Let every signal of ENDS do what Ctrl-C does: by default it would end the command and leave its processes."""
    _set(ENDS, _interrupt)


def decide(code: int) -> None:
    """The verdict is known: from now on a signal ends the command with ``code``, after what it writes is tidied up."""
    _state["decided"] = code
    _set(ENDS, _interrupt_once)


def ignore() -> None:
    """The command is over: Python, ending, gives handlers back to the system, but leaves alone what is ignored."""
    _set(ENDS, signal.SIG_IGN)


def _set(numbers: tuple[int, ...], handler: object) -> None:
    for number in numbers:
        if _state["is_command"] and signal.getsignal(number) != signal.SIG_IGN:  # as nohup has it
            signal.signal(number, handler)  # type: ignore[arg-type]


def _end_interrupted(*_: object) -> NoReturn:
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED_CODE)


def _interrupt_once(number: int, frame: FrameType | None) -> None:
    """As ``_interrupt``; another signal does not break off the tidying up."""
    ignore()
    _interrupt(number, frame)


def _interrupt(_number: int, frame: FrameType | None) -> None:
    """Raise what ends the command, or once the import under way is over: compiled modules swallow it, or make a
    traceback of it.
    """
    if _state["held"] and not _state["came"]:
        _state["came"] = True
        return
    importer = _find_importer(frame)
    if importer is None:
        raise _make_end()
    import sys  # loaded already wherever a module is imported

    importer.f_trace = _raise_interrupt
    sys.settrace(lambda *_: None)  # without any, that of the frame is not asked


def _make_end() -> BaseException:
    """KeyboardInterrupt; once there is an exit code, the end with that."""
    return KeyboardInterrupt() if _state["decided"] is None else SystemExit(_state["decided"])


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
    raise _make_end()
