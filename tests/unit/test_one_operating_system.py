"""Pieces that not every operating system has are named in one module only."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("agents", "consensus_dsse", "coordinator", "dsse_core", "scenarios")
HOME = ROOT / "dsse_core/operating_system.py"
MODULES = {"fcntl", "resource", "msvcrt", "pwd", "grp", "termios", "tty", "pty"}
ATTRIBUTES = {
    "os": {
        *("fork", "forkpty", "geteuid", "getuid", "nice", "killpg", "getpgrp", "setsid", "sched_getaffinity"),
        *("sched_setaffinity", "fchmod", "fchown", "mkfifo", "sync", "uname", "statvfs", "getloadavg", "WNOHANG"),
        *("O_NOFOLLOW", "O_NONBLOCK", "O_NOCTTY", "O_DIRECTORY", "O_CLOEXEC"),
    },
    "signal": {
        *("SIGHUP", "SIGQUIT", "SIGKILL", "SIGUSR1", "SIGUSR2", "SIGSTOP", "SIGCONT", "SIGCHLD", "SIGPIPE", "SIGTSTP"),
        *("pthread_sigmask", "pthread_kill", "SIG_BLOCK", "SIG_UNBLOCK", "SIG_SETMASK"),
    },
}


def find_pieces(source: str) -> list[str]:
    """Line and name of each piece of a system that ``source`` names."""
    found = []
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Import(names=names):
                found += [f"{node.lineno}: {name.name}" for name in names if name.name in MODULES]
            case ast.ImportFrom(module=str(module), names=names):
                forbidden = {name.name for name in names} & ATTRIBUTES.get(module, set())
                found += [f"{node.lineno}: {name}" for name in sorted(forbidden)]
                found += [f"{node.lineno}: {module}"] if module in MODULES else []
            case ast.Attribute(value=ast.Name(id=module), attr=name) if name in ATTRIBUTES.get(module, ()):
                found.append(f"{node.lineno}: {module}.{name}")
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_only_the_module_of_the_operating_system_names_its_pieces(package: str):
    paths = [path for path in (ROOT / package).rglob("*.py") if path != HOME]
    found = {str(path.relative_to(ROOT)): find_pieces(path.read_text(encoding="utf-8")) for path in paths}
    assert not {path: pieces for path, pieces in found.items() if pieces}


def test_the_search_finds_each_way_to_name_a_piece():
    assert find_pieces(HOME.read_text(encoding="utf-8"))
    assert find_pieces("import fcntl\nfrom signal import SIGKILL\nfrom fcntl import flock\nos.fork()") == [
        "1: fcntl",
        "2: SIGKILL",
        "3: fcntl",
        "4: os.fork",
    ]
