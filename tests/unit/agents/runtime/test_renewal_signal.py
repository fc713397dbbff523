"""SIGHUP asks for renewed keys, and ends a process whose terminal was closed."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.dsse_command import ENVIRONMENT
from tests.support.waiting import is_gone, wait_until

LISTENER = """
import signal, sys, time
from pathlib import Path
from agents.runtime.renewal import on_hangup
log = Path(sys.argv[1])
def say(what):
    with log.open("a") as file:
        file.write(what + " ")
signal.signal(signal.SIGHUP, signal.SIG_IGN if sys.argv[2] == "nohup" else signal.SIG_DFL)
on_hangup(lambda: say("asked"), lambda: (say("ended"), sys.exit()))
say("ready")
while True:
    time.sleep(0.01)
"""


def listen_on_a_terminal(log: Path, how: str) -> tuple[int, int]:
    """A process with a terminal of its own; its pid and the other end of the terminal."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.execve(sys.executable, [sys.executable, "-c", LISTENER, str(log), how], ENVIRONMENT)
    wait_until(lambda: log.exists() and "ready" in log.read_text())
    return pid, terminal


def test_asked_by_somebody_a_process_without_a_terminal_renews(tmp_path: Path):
    log = tmp_path / "log"
    process = subprocess.Popen([sys.executable, "-c", LISTENER, log, ""], env=ENVIRONMENT, start_new_session=True)
    try:
        wait_until(lambda: log.exists() and "ready" in log.read_text())
        for count in (1, 2):
            process.send_signal(signal.SIGHUP)
            wait_until(lambda count=count: log.read_text().count("asked") == count)
        assert "ended" not in log.read_text()
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("how", ["", "nohup"])
def test_nobody_goes_on_unseen_when_its_terminal_is_closed_unless_under_nohup(tmp_path: Path, how: str):
    log = tmp_path / "log"
    pid, terminal = listen_on_a_terminal(log, how)
    try:
        os.kill(pid, signal.SIGHUP)
        wait_until(lambda: log.read_text().count("asked") == 1)
        os.close(terminal)
        if not how:
            wait_until(lambda: is_gone(pid))
            assert log.read_text() == "ready asked ended "
            return

        def asked_again() -> bool:
            os.kill(pid, signal.SIGHUP)  # one that comes together with the terminal's is one with it
            return log.read_text().count("asked") > 1

        wait_until(asked_again)
        assert "ended" not in log.read_text()
    finally:
        if not is_gone(pid):
            os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
