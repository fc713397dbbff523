"""However a run ends, no process of it is left."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import coordinator
from agents.messages.keys import all_states
from agents.messages.packing import decode
from agents.runtime.inbox import Inbox
from agents.transport.zenoh_bus import Session
from coordinator.lab.process_run.compile_clock import clock
from coordinator.watch.interrupts import ENDS
from coordinator.watch.observe.progress import Progress
from dsse_core.operating_system import name_signal
from tests.support.dsse_command import ROOT
from tests.support.levels import further
from tests.support.waiting import DEADLINE_S, wait_until

FEW = (signal.SIGTERM,)  # and SIGINT in tests of its own
FURTHER = (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGRTMIN + 1)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Some of the signals that end a command, with --long more, with --thorough all; to the parent, two are orders."""
    if "number" in metafunc.fixturenames:
        orders = (signal.SIGUSR1, signal.SIGUSR2) if "parent" in metafunc.function.__name__ else ()
        levels = dict.fromkeys(ENDS, pytest.mark.thorough) | dict.fromkeys(FURTHER, pytest.mark.long)
        levels = {number: level for number, level in levels.items() if number not in FEW}
        numbers = [number for number in ENDS if number not in orders]
        params = [pytest.param(number, marks=levels.get(number, ()), id=name_signal(number)) for number in numbers]
        metafunc.parametrize("number", params)


def test_a_signal_to_the_terminals_process_group_stops_everything(
    start_run, deaf_scenario, assert_nothing_left, number: int
):
    run = start_run(deaf_scenario)
    run.wait_until_joined("area1", "area2")
    os.killpg(run.process.pid, number)
    code, out, err = run.end()
    assert code == 130
    assert "interrupted" in err
    assert "Traceback" not in out + err
    assert_nothing_left(run.pids())
    assert run.events()[-1]["event"] == "run ended"
    assert json.loads((run.folder / "result.json").read_text())["verdict"]["reason"] == "interrupted"


def test_ctrl_c_does_not_reach_the_agents_who_are_stopped_in_order(start_run, deaf_scenario):
    run = start_run(deaf_scenario)
    run.wait_until_joined("area1", "area2")
    os.killpg(run.process.pid, signal.SIGINT)
    run.end()
    ends = {e["name"]: e["code"] for e in run.events() if e["event"] == "process ended"}
    assert ends == {"area1": 0, "area2": 0, "plant": 0, "router": 0}
    log = (run.folder / "logs" / "area1.log").read_text()
    assert "strategy information, back end dense, incarnation" in log
    assert "SIGTERM" in log


def test_a_killed_coordinator_stops_nothing_and_one_signal_to_the_parent_stops_all(start_run, assert_nothing_left):
    run = start_run("ieee33")
    run.wait_until_joined("area1", "area2", "area3")
    run.process.kill()
    run.end()
    states = Inbox()
    endpoints = (run.folder / "logs" / "router.endpoints").read_text().split()
    with Session.connect(endpoints, DEADLINE_S) as session:
        session.subscribe(all_states(run.events()[0]["run"]), lambda key, payload: states.put(key, decode(payload)))
        seen = {}
        wait_until(
            lambda: (
                seen.update({s.header.sender: s for s in states.take(0.1)})
                or (len(seen) == 3 and all(s.referenced for s in seen.values()))
            )
        )
    os.kill(run.pids()["parent"], signal.SIGTERM)
    assert_nothing_left(run.pids())


def test_a_killed_coordinator_and_a_killed_parent_leave_nothing_for_ever(start_run, assert_nothing_left):
    run = start_run("ieee33")
    run.wait_until_joined("area1", "area2", "area3")
    pids = run.pids()
    run.process.kill()
    run.end()
    os.kill(pids["area2"], signal.SIGSTOP)  # which of itself would learn of nothing
    os.kill(pids["parent"], signal.SIGKILL)
    assert_nothing_left(pids)
    for area in ("area1", "area2"):
        assert "ends: SIGTERM" in (run.folder / "logs" / f"{area}.log").read_text()


def test_stop_ends_what_a_killed_coordinator_has_left_and_nothing_else(start_run, dsse, assert_nothing_left):
    run = start_run("ieee33")
    run.wait_until_joined("area1", "area2", "area3")
    pids = run.pids()
    run.process.kill()
    run.end()
    os.kill(pids["area3"], signal.SIGSTOP)
    mark = run.events()[0]["mark"]
    with subprocess.Popen([sys.executable, "-c", "input()", str(mark)], stdin=subprocess.PIPE) as bystander:
        done = dsse("stop", run.folder)
        assert bystander.poll() is None
    assert (done.returncode, done.stderr) == (0, "")
    assert f"run {run.events()[0]['run']}: 6 processes ended" in done.stdout  # parent, router, plant, areas
    assert_nothing_left(pids)
    assert "no process of it is left" in dsse("stop", run.folder).stdout
    assert json.loads(dsse("stop", run.folder, "--json").stdout) == {"run": run.events()[0]["run"], "ended": 0}


def test_stop_ends_a_parent_that_is_frozen(start_run, dsse, deaf_scenario, assert_nothing_left):
    run = start_run(deaf_scenario)
    run.wait_until_joined("area1", "area2")
    run.process.kill()
    run.end()
    os.kill(run.pids()["parent"], signal.SIGSTOP)
    assert dsse("stop", run.folder).returncode == 0
    assert_nothing_left(run.pids())


def test_a_signal_to_the_parent_stops_all_in_order_and_shows_no_traceback(
    start_run, deaf_scenario, assert_nothing_left, number: int
):
    run = start_run(deaf_scenario)
    run.wait_until_joined("area1", "area2")
    os.kill(run.pids()["parent"], number)
    code, out, err = run.end()
    assert code == 1
    assert f"parent of all processes died with signal {name_signal(number)}" in out
    assert "Traceback" not in out + err
    assert_nothing_left(run.pids())
    assert "ends: SIGTERM" in (run.folder / "logs" / "area1.log").read_text()


def test_a_killed_parent_of_all_ends_the_run_and_leaves_nothing_behind(start_run, deaf_scenario, assert_nothing_left):
    run = start_run(deaf_scenario)
    run.wait_until_joined("area1", "area2")
    os.kill(run.pids()["parent"], signal.SIGKILL)
    code, out, _ = run.end()
    assert code == 1
    assert "parent of all processes died with signal SIGKILL" in out
    assert "its log" not in out  # it has none
    assert_nothing_left(run.pids())


@pytest.mark.long
def test_the_time_limit_ends_the_run(start_run, deaf_scenario, assert_nothing_left):
    run = start_run(deaf_scenario, "--timeout", "0.5")
    code, out, _ = run.end()
    assert code == 1
    assert "NO CONSENSUS" in out
    assert "no consensus within 0.5 s: " in out  # what is missing by then depends on the machine
    assert_nothing_left(run.pids())


def test_the_time_limit_says_what_was_missing(
    tmp_path: Path, deaf_scenario, assert_nothing_left, monkeypatch: pytest.MonkeyPatch
):
    """The limit passes as soon as the areas have reported so much, however long that takes them."""
    missing = "the angles of area1 do not count from the substation"

    def pass_when_reported(progress: Progress) -> None:
        if any(missing in obstacle for obstacle in progress.obstacles):
            monkeypatch.setattr(clock, "find_start", lambda _: -math.inf)

    folder = tmp_path / "out"
    result = coordinator.run(deaf_scenario, out=folder, timeout_s=DEADLINE_S, on_update=pass_when_reported, plots=False)
    assert clock.find_start(0.0) == -math.inf, "the areas have not reported so much"
    assert not result.verdict.consensus
    assert (result.verdict.reason or "").startswith(f"no consensus within {DEADLINE_S:g} s: ")
    assert missing in (result.verdict.reason or "")
    assert_nothing_left(started_in(events_in(folder)))


@pytest.mark.parametrize("victim", ["area2", *further("plant", "router")])
def test_a_crashed_process_ends_the_run(start_run, deaf_scenario, assert_nothing_left, victim: str):
    run = start_run(deaf_scenario)
    run.wait_until_joined("area1", "area2")
    os.kill(run.pids()[victim], signal.SIGKILL)
    code, out, _ = run.end()
    assert code == 1
    assert f"{victim} died with signal SIGKILL" in out
    assert_nothing_left(run.pids())


def events_in(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]


def started_in(events: list[dict[str, Any]]) -> dict[str, int]:
    return {e["name"]: e["pid"] for e in events if e["event"] == "process started"}


def test_an_exception_in_the_callers_code_leaves_nothing_behind(tmp_path: Path, deaf_scenario, assert_nothing_left):
    def fail(progress: object) -> None:
        raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        coordinator.run(deaf_scenario, out=tmp_path / "out", on_update=fail, plots=False)
    events = events_in(tmp_path / "out")
    assert_nothing_left(started_in(events))
    assert events[-1]["event"] == "run ended"


def test_a_script_without_a_main_guard_may_run_a_scenario(tmp_path: Path, assert_nothing_left: Callable[..., None]):
    script = tmp_path / "script.py"
    script.write_text(
        "import coordinator\n"
        "print('once')\n"
        f"result = coordinator.run('industrial13', out='out', plots=False, timeout_s={DEADLINE_S})\n"
        "print(result.verdict.consensus)\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("once\nTrue\n", "")
    assert_nothing_left(started_in(events_in(tmp_path / "out")))


def test_folders_of_the_user_with_our_names_do_not_disturb(tmp_path: Path, dsse_from_nothing):
    for name in ("agents", "scenarios"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise ImportError('not ours')")
    done = dsse_from_nothing("run", "industrial13", "--no-plots", "--quiet", "--json", "--timeout", DEADLINE_S)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["verdict"]["consensus"]
