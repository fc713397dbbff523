"""Effect of signals on the command ``dsse``, stage by stage: they end it at once while it loads, raise while it works,
and end it with the decided exit code once there is one.

Only ``coordinator.__main__`` begins this; where commands are called as functions, the caller's handlers stay.
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
"""All signals that end a process by default, except SIGKILL and those of a defect in the process."""
INTERRUPTED_CODE = 130  # 128 + 2, as a shell reports a process that SIGINT ended
_state: dict[str, int | None] = {"is_command": False, "decided": None, "held": False, "came": False}


class Uninterrupted:
    """A block that Ctrl-C does not interrupt: the command ends after the block; a second Ctrl-C ends it at once."""

    def __enter__(self) -> None:
        _state["held"], _state["came"] = True, False

    def __exit__(self, *_: object) -> None:
        _state["held"] = False
        if _state["came"]:
            _state["came"] = False
            raise _make_end()


def end_at_once() -> None:
    """Stage of loading: Ctrl-C ends the process at once, since an interrupted import would show a traceback."""
    _state.update(is_command=True, decided=None)
    _set(SIGINT, _end_interrupted)


def raise_interrupts() -> None:
    """Stage of work: Ctrl-C raises KeyboardInterrupt as usual in Python, but not inside an import."""
    _set(SIGINT, _interrupt)


def end_orderly_on_signals() -> None:
    """Let every signal of ENDS do what Ctrl-C does: by default it would end the command and leave its processes."""
    _set(ENDS, _interrupt)


def decide(code: int) -> None:
    """Stage after the verdict: a signal ends the command with ``code``, after its files are tidied up."""
    _state["decided"] = code
    _set(ENDS, _interrupt_once)


def ignore() -> None:
    """Stage after the command: signals are ignored. Python resets handlers as it ends, but not ignored signals."""
    _set(ENDS, signal.SIG_IGN)


def _set(numbers: tuple[int, ...], handler: object) -> None:
    for number in numbers:
        if _state["is_command"] and signal.getsignal(number) != signal.SIG_IGN:  # SIGHUP under nohup stays ignored
            signal.signal(number, handler)  # type: ignore[arg-type]


def _end_interrupted(*_: object) -> NoReturn:
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED_CODE)


def _interrupt_once(number: int, frame: FrameType | None) -> None:
    """``_interrupt``, with further signals ignored, so that they do not interrupt the tidying up."""
    ignore()
    _interrupt(number, frame)


def _interrupt(_number: int, frame: FrameType | None) -> None:
    """Raise the exception that ends the command; inside an import, raise it after the import.

    A compiled module that is being imported would swallow the exception, or show a traceback.
    """
    if _state["held"] and not _state["came"]:
        _state["came"] = True
        return
    importer = _find_importer(frame)
    if importer is None:
        raise _make_end()
    import sys  # loaded already wherever a module is imported

    importer.f_trace = _raise_interrupt
    sys.settrace(lambda *_: None)  # without a global one, Python does not call that of the frame


def _make_end() -> BaseException:
    """KeyboardInterrupt; once an exit code is decided, SystemExit with that code."""
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
