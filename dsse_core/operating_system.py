"""Pieces of an operating system that not every system has, each with its fallback; no other module names them.

| piece | fallback |
|---|---|
| file locks | none: drafts left by killed processes stay, and two writers are not kept apart |
| processors of this process | all processors |
| owner of a file | every file counts as this user's |
| opening without links, without waiting | an ordinary opening |
| rights of an open file | the rights from its creation |
| niceness | none |
| SIGHUP, SIGUSR1, SIGUSR2, SIGSTOP, SIGCONT | None: the callers do without, or say that it is missing |
| SIGKILL | SIGTERM, which ends a process at once on systems without SIGKILL |
| masks of signals | signals are not held back |
| limits of open files, of the size of files, of memory | none |
| fork | ordinary processes (``coordinator/lab/process_run/fork_server.py``) |
| process groups | the process alone |
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
from collections.abc import Iterable, Iterator

try:
    import fcntl
except ImportError:
    HAS_LOCKS = False
else:
    HAS_LOCKS = hasattr(fcntl, "flock")
try:
    import resource
except ImportError:
    HAS_LIMITS = False
else:
    HAS_LIMITS = True

HAS_FORK = hasattr(os, "fork")
HAS_CHILDREN_SIGNAL = hasattr(signal, "SIGCHLD") and hasattr(os, "waitpid") and os.name == "posix"
FLAGS_UNFOLLOWED: int = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
FLAG_NO_TERMINAL: int = getattr(os, "O_NOCTTY", 0)
FLAG_NO_WAIT: int = getattr(os, "O_NONBLOCK", 0)  # an ordinary opening of a pipe waits for its other end


def _signal(name: str) -> signal.Signals | None:
    found: signal.Signals | None = getattr(signal, name, None)
    return found


HANGUP = _signal("SIGHUP")
CHILD = _signal("SIGCHLD")
USER_1, USER_2 = _signal("SIGUSR1"), _signal("SIGUSR2")
PAUSE, GO_ON = _signal("SIGSTOP"), _signal("SIGCONT")
KILL = _signal("SIGKILL") or signal.SIGTERM


def lock(fd: int, *, wait: bool = False) -> None:
    """Lock an open file or folder until it is closed, however this process ends.

    Raises:
        BlockingIOError: another process holds the lock, and ``wait`` is not given.
        OSError: the file system, or the whole system, has no locks.
    """
    if not HAS_LOCKS:
        raise OSError(errno.ENOLCK, "this system has no file locks")
    fcntl.flock(fd, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)


def count_processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def has_owners() -> bool:
    """True where files have owners, and rights that keep others from changing them."""
    return hasattr(os, "geteuid")


def is_own(status: os.stat_result) -> bool:
    """True for a file of this user."""
    return not has_owners() or status.st_uid == os.geteuid()


def set_rights(fd: int, mode: int) -> None:
    """Set the rights of an open file to ``mode``."""
    if hasattr(os, "fchmod"):
        os.fchmod(fd, mode)


def be_nice(by: int) -> None:
    """Adds ``by`` to the niceness of this process."""
    if hasattr(os, "nice"):
        os.nice(by)


def find_limit_of_open_files() -> int | None:
    """Number of files that this process may have open; None without a limit."""
    if not HAS_LIMITS:
        return None
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def confine(memory: int) -> None:
    """Limits of this process from now on: no file grows by a byte (pipes are none), and ``memory`` bytes at most."""
    if HAS_LIMITS:
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        memory = memory if hard == resource.RLIM_INFINITY else min(memory, hard)
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))


@contextlib.contextmanager
def blocked(numbers: Iterable[int]) -> Iterator[None]:
    """A block in which these signals wait; processes started in it inherit the mask."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def block(numbers: Iterable[int]) -> None:
    """Let these signals wait from now on, in processes started later, too."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, numbers)


def unblock(numbers: Iterable[int]) -> None:
    """Let these signals arrive."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)


def name_signal(number: int) -> str:
    """Name of a signal; the number of a real-time signal, which has no name."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return str(number)


def signal_thread(thread: int, number: int) -> None:
    """Send a signal to a thread of this process; to the process where threads get none."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(thread, number)
    else:
        os.kill(os.getpid(), number)


def signal_group(group: int, number: int) -> None:
    """Send a signal to the process group ``group``; to the process of that number where there are no groups.

    Raises:
        ProcessLookupError: it has ended.
    """
    if hasattr(os, "killpg"):
        os.killpg(group, number)
    else:
        os.kill(group, number)


def continue_own_group() -> None:
    """Let all paused processes of this process's group go on."""
    if GO_ON is not None and hasattr(os, "getpgrp"):
        signal_group(os.getpgrp(), GO_ON)


def go_on(pid: int) -> None:
    """Let a paused process go on."""
    if GO_ON is not None:
        os.kill(pid, GO_ON)


def fork() -> int:
    """Forks this process as ``os.fork`` does: the child's process id, 0 in the child; only where ``HAS_FORK``."""
    return os.fork()


def find_ended_child() -> tuple[int, int]:
    """Process id and exit code, negative for a signal, of a child that has ended; (0, 0) while all run."""
    pid, status = os.waitpid(-1, os.WNOHANG)
    return pid, os.waitstatus_to_exitcode(status) if pid else 0
