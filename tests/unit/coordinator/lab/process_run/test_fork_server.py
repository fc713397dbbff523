"""The parent of all processes: what a compiler leaves in memory is not in it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from pathlib import Path

import pytest

from coordinator.lab.process_run import fork_server
from coordinator.lab.process_run.fork_server import ForkServer

WRITES_ITS_PID = """
import os
from pathlib import Path

def compile_all():
    with Path(__file__).with_name("pids").open("a") as file:
        file.write(f"{os.getpid()}\\n")
"""
TARGET = "compiles_for_a_test:compile_all"


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "compiles_for_a_test.py").write_text(WRITES_ITS_PID)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(fork_server, "COMPILES", {TARGET: "exchange"})
    monkeypatch.setattr(fork_server, "find_folder_to_keep_in", lambda: tmp_path)
    monkeypatch.setattr(fork_server, "has_whole", lambda _: (tmp_path / "pids").exists())
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs:
        yield ForkServer(theirs)
    sys.modules.pop("compiles_for_a_test", None)


def pids(tmp_path: Path) -> list[int]:
    return [int(line) for line in (tmp_path / "pids").read_text().split()]


def test_the_parent_of_all_processes_does_not_compile(server: ForkServer, tmp_path: Path):
    server.compile_in_child(TARGET)
    (compiler,) = pids(tmp_path)
    assert compiler != os.getpid()
    with pytest.raises(ChildProcessError):
        os.waitpid(compiler, 0)  # it has been waited for


def test_what_is_kept_takes_no_process(server: ForkServer, tmp_path: Path):
    server.compile_in_child(TARGET)
    server.compile_in_child(TARGET)
    server.compile_in_child("anything:else")
    assert len(pids(tmp_path)) == 1


def test_without_a_place_to_keep_it_no_other_process_compiles(
    server: ForkServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(fork_server, "find_folder_to_keep_in", lambda: None)
    server.compile_in_child(TARGET)
    assert not (tmp_path / "pids").exists()


class Sibling:
    def __repr__(self) -> str:
        raise AssertionError("a child that finds the signals of its parent describes all its siblings")


def test_a_forked_child_does_not_describe_all_that_were_forked_before_it(server: ForkServer):
    """``signal.getsignal`` puts the handler, a method of the parent, into the words of an error that nobody sees."""
    server.children[1] = Sibling()  # type: ignore[assignment]
    before = signal.signal(signal.SIGUSR1, server.stop)
    try:
        assert signal.getsignal(signal.SIGUSR1) == server.stop
    finally:
        signal.signal(signal.SIGUSR1, before)
