"""Every signal that ends a process by default is one at which a command ends its processes, too."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from coordinator.lab.process_run.processes import describe_end
from coordinator.watch.interrupts import ENDS
from tests.support.dsse_command import ENVIRONMENT, ROOT

# Of a defect of the process itself, whose handlers cannot go on; and SIGKILL, which no process handles.
DEFECTS = {"SIGILL", "SIGTRAP", "SIGABRT", "SIGBUS", "SIGFPE", "SIGSEGV", "SIGSYS", "SIGKILL"}
IGNORED_BY_PYTHON = {"SIGPIPE", "SIGXFSZ"}

ENDS_BY_DEFAULT = """
import os, signal
for number in sorted(signal.valid_signals()):
    child = os.fork()
    if not child:
        if number not in (signal.SIGKILL, signal.SIGSTOP):
            signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        os._exit(0)
    status = os.waitpid(child, os.WUNTRACED)[1]
    if os.WIFSTOPPED(status):
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    elif os.WIFSIGNALED(status):
        print(number)
"""
ORDERLY = """
import os, sys, time
from coordinator.watch import interrupts
interrupts.end_at_once()
interrupts.end_orderly_on_signals()
for number in interrupts.ENDS:
    try:
        os.kill(os.getpid(), number)
        time.sleep(30)  # a handler may run a moment later, and ends this
    except KeyboardInterrupt:
        continue
    sys.exit(f"{number} was not heard")
interrupts.ignore()
for number in interrupts.ENDS:
    os.kill(os.getpid(), number)
print("heard")
"""


IGNORED = """
import os, signal
from coordinator.watch import interrupts
for number in (signal.SIGHUP, signal.SIGQUIT):  # as nohup and background jobs have it
    signal.signal(number, signal.SIG_IGN)
interrupts.end_at_once()
interrupts.end_orderly_on_signals()
os.kill(os.getpid(), signal.SIGQUIT)
print("goes on")
"""


def run(program: str) -> str:
    command = [sys.executable, "-c", program]
    return subprocess.run(command, env=ENVIRONMENT, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_all_signals_that_end_a_process_by_default_end_a_command_in_order() -> None:
    ending = {*map(int, run(ENDS_BY_DEFAULT).split())}
    others = {int(getattr(signal, name)) for name in DEFECTS | IGNORED_BY_PYTHON}
    assert {*map(int, ENDS)} == ending - others


def test_a_command_hears_each_of_them_and_none_after_its_end() -> None:
    assert run(ORDERLY) == "heard\n"


def test_what_is_ignored_stays_ignored() -> None:
    assert run(IGNORED) == "goes on\n"


@pytest.mark.parametrize(("code", "words"), [(-3, "signal SIGQUIT"), (-40, "signal 40"), (1, "exit code 1")])
def test_the_end_of_a_process_has_words_for_every_signal(code: int, words: str) -> None:
    assert describe_end(code) == words
