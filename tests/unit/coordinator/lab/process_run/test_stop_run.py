"""``dsse stop`` ends the processes of a run, whatever has become of its numbers, and believes no strange folder."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import psutil
import pytest

from coordinator.cli.main import run_command
from coordinator.lab.process_run import stop_run as stopping
from coordinator.lab.process_run.processes import Launcher
from coordinator.lab.process_run.stop_run import find_marked, read_started_run, stop_run
from dsse_core.errors import InvalidInputError


def make_folder(folder: Path, **about: object) -> Path:
    event = {"time": 0.0, "event": "run started", "run": "mine", "parent_pid": os.getpid()} | about
    (folder / "events.jsonl").write_text(json.dumps(event) + "\n")
    return folder


@pytest.mark.parametrize("list_by_ps", [False, True])
def test_the_processes_of_a_run_are_known_by_their_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, list_by_ps: bool
):
    if list_by_ps:
        monkeypatch.setattr(stopping, "PROC", tmp_path / "no-proc")
    with Launcher() as launcher, Launcher() as other:
        for one in (launcher, other):
            one.start("one", "time:sleep", 3600, log=tmp_path / "one.log")
        children = psutil.Process(launcher.pid).children
        while not children():
            assert psutil.pid_exists(launcher.pid)
        assert set(find_marked(launcher.mark)) == {launcher.pid, children()[0].pid}


def test_a_number_that_is_anothers_by_now_is_not_signalled(tmp_path: Path):
    received: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: received.append(number))
    try:
        run, count = stop_run(make_folder(tmp_path, mark="0123456789abcdef"))
    finally:
        signal.signal(signal.SIGTERM, before)
    assert (run.id, count, received) == ("mine", 0, [])


@pytest.mark.parametrize("about", [{}, {"mark": ""}, {"mark": 7}, {"mark": "python"}, {"mark": "0123456789ABCDEF"}])
def test_a_folder_of_no_run_is_rejected(tmp_path: Path, about: dict[str, object]):
    with pytest.raises(InvalidInputError, match="give the run folder of `dsse run`"):
        read_started_run(make_folder(tmp_path, **about))


def test_a_folder_without_events_is_rejected(tmp_path: Path):
    with pytest.raises(InvalidInputError, match=r"no events\.jsonl is in it; give the run folder of `dsse run`"):
        read_started_run(tmp_path)
    with pytest.raises(InvalidInputError, match="there is no such folder; give the run folder of `dsse run`"):
        read_started_run(tmp_path / "absent")


@pytest.mark.parametrize("parts", [("areas",), ("areas", "logs"), ("areas", "logs", "events.jsonl")])
def test_a_run_that_was_killed_before_its_first_event_has_nothing_to_stop(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], parts: tuple[str, ...]
):
    for part in parts:
        (tmp_path / part).touch() if "." in part else (tmp_path / part).mkdir()
    assert run_command(["stop", str(tmp_path)]) == 0
    output = capsys.readouterr()
    assert output.out == f"{tmp_path}: nothing to stop; the run was killed before it had started a process\n"


def test_a_folder_with_other_things_and_no_events_is_still_rejected(tmp_path: Path):
    (tmp_path / "areas").mkdir()
    (tmp_path / "areas" / "area1.toml").touch()
    with pytest.raises(InvalidInputError, match=r"no events\.jsonl is in it"):
        stop_run(tmp_path)
    (tmp_path / "events.jsonl").touch()
    with pytest.raises(InvalidInputError, match="does not begin with the start of a run"):
        stop_run(tmp_path)


def test_a_pipe_in_place_of_the_events_is_not_an_empty_log(tmp_path: Path):
    os.mkfifo(tmp_path / "events.jsonl")
    with pytest.raises(InvalidInputError, match="is a pipe or a device"):
        stop_run(tmp_path)


def test_the_name_of_a_strange_run_moves_no_terminal(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    make_folder(tmp_path, run="\x1b]0;mine\x07", mark="0123456789abcdef")
    assert run_command(["stop", str(tmp_path)]) == 0
    assert capfd.readouterr().out == "run \\x1b]0;mine\\x07: no process of it is left on this host\n"


def test_stop_removes_what_a_killed_run_has_left(tmp_path: Path):
    make_folder(tmp_path, mark="0123456789abcdef")
    (tmp_path / "areas").mkdir()
    for folder in (tmp_path, tmp_path / "areas"):
        (folder / ".dsse-new-0123456789abcdef.json").touch()
    stop_run(tmp_path)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["events.jsonl"]
