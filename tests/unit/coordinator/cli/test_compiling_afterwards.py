"""A command on a large network compiles after its answer: which reader, exit code and Ctrl-C do not notice."""

import io
import sys

import pytest

from coordinator.cli import main, terminal
from coordinator.lab.process_run import compile_ahead
from dsse_core import compiling


@pytest.fixture
def compiled(monkeypatch):
    """What is compiled after a command, which has done without the estimate."""
    found = []
    monkeypatch.setattr(compiling, "_done_without", {"estimate", "sparse"})
    monkeypatch.setattr("agents.runtime.warm_up.warm_up_estimate", lambda: found.append("estimate"))
    monkeypatch.setattr("agents.runtime.warm_up.warm_up_sparse", lambda: found.append("sparse"))
    monkeypatch.setattr(main, "end_output", lambda: found.append("output ended"))
    return found


def test_after_the_answer_what_was_missing_is_compiled_once(compiled, capsys):
    for _ in range(2):
        assert main.run_command(["--version"]) == 0
    assert compiled == ["output ended", "estimate"]
    out, err = capsys.readouterr()
    assert out.startswith("consensus-dsse")
    assert err.count("the answer is complete") == 1


def test_a_command_that_fails_compiles_nothing(compiled):
    assert main.run_command(["powerflow", "no such scenario"]) == 2
    assert compiled == []


def test_ctrl_c_while_it_compiles_leaves_the_exit_code_of_the_answer(compiled, monkeypatch):
    def interrupt():
        raise KeyboardInterrupt

    monkeypatch.setattr(compile_ahead, "compile_for_next_time", interrupt)
    assert main.run_command(["--version"]) == 0


def test_a_network_with_loops_has_elimination_compiled(monkeypatch, compiled):
    monkeypatch.setattr(compiling, "_done_without", {"sparse"})
    compile_ahead.compile_for_next_time()
    assert compiled == ["sparse"]


def test_output_that_is_no_file_is_left_alone(monkeypatch):
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    terminal.end_output()
    print("goes on", end="")
    assert sys.stdout.getvalue() == "goes on"
