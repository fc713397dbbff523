"""Wrong input and processes that cannot go on: exit code 2, or a verdict, and one message. More: the tests of units."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

import coordinator
import coordinator.lab.process_run.system
from tests.support.dsse_command import free_endpoint
from tests.support.waiting import DEADLINE_S


@pytest.mark.parametrize("command", ["check", "run"])
def test_a_wrong_scenario_ends_the_process_with_all_that_is_wrong(dsse, edited_scenario, command: str):
    mistakes = [("sigma_percent = 0.2", "sigma_percent = 0.0"), ("noise = true", "noise = 7")]
    done = dsse(command, edited_scenario("ieee33", *mistakes))
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert "Traceback" not in done.stderr
    for text in ("2 problems", "measurements.voltage.sigma_percent", "telemetry.noise"):
        assert text in done.stderr


@pytest.mark.parametrize("command", ["run", "agent"])
def test_a_process_explains_itself_with_an_example(dsse, command: str):
    done = dsse(command, "--help")
    assert done.returncode == 0
    assert f"dsse {command}" in done.stdout.lower().split("example")[-1]


def test_an_occupied_endpoint_is_named(dsse, edited_scenario):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        path = edited_scenario("industrial13-lossy", ("[faults]", f'[transport]\nlisten = "{endpoint}"\n\n[faults]'))
        done = dsse("run", path, "--no-plots")
    assert done.returncode == 2
    assert f"error: cannot listen on {endpoint}" in done.stderr
    assert "taken by another program" in done.stderr


def test_an_agent_that_reaches_no_router_says_so(dsse):
    assert dsse("split", "industrial13", "--out", "areas").returncode == 0
    endpoint = free_endpoint()
    done = dsse("agent", "areas/area1.toml", "--connect", endpoint, "--wait", 1)
    assert done.returncode == 2
    assert f"error: cannot reach {endpoint}" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_plant_that_reaches_no_router_says_so(dsse):
    endpoint = free_endpoint()
    done = dsse("plant", "industrial13", "--connect", endpoint, "--wait", 1)
    assert done.returncode == 2
    assert f"error: cannot reach {endpoint}" in done.stderr


def test_an_agent_without_its_file_says_so(dsse):
    done = dsse("agent", "nowhere.toml")
    assert done.returncode == 2
    assert "nowhere.toml" in done.stderr


def test_a_run_says_which_agent_died_with_the_end_of_its_log(start_run, deaf_scenario):
    run = start_run(deaf_scenario)
    run.wait_until_joined("area1", "area2")
    os.kill(run.pids()["area2"], signal.SIGABRT)
    code, out, _ = run.end()
    assert code == 1
    assert "area area2 died with signal SIGABRT" in out
    assert str(run.folder / "logs" / "area2.log") in out
    log = (run.folder / "logs" / "area2.log").read_text()
    assert "Fatal Python error: Aborted" in log  # its length depends on where the agent was
    assert "\n".join(line[:100] for line in log.splitlines()[-2:]) in out


def test_a_run_says_which_agent_rejected_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write = coordinator.lab.process_run.system.write_area_files

    def spoil(*arguments: object) -> Iterator[tuple[str, Path]]:
        for name, path in write(*arguments):  # type: ignore[arg-type]
            if name == "area2":
                path.write_text("nonsense")
            yield name, path

    monkeypatch.setattr(coordinator.lab.process_run.system, "write_area_files", spoil)
    result = coordinator.run("industrial13", out=tmp_path / "out", plots=False, timeout_s=DEADLINE_S)
    assert not result.verdict.consensus
    assert result.verdict.reason is not None
    assert "area area2 died with exit code 2" in result.verdict.reason
    assert "not valid JSON" in result.verdict.reason


def test_a_reader_who_leaves_changes_neither_the_result_nor_the_exit_code(start_run):
    run = start_run("industrial13")
    assert run.process.stdout is not None
    run.process.stdout.close()
    assert run.process.wait(DEADLINE_S) == 0
    assert (run.folder / "result.json").exists()


def test_without_a_centralised_estimate_the_run_still_ends_with_its_own_verdict(dsse, edited_scenario):
    error = 'noise = true\n\n[[telemetry.gross_error]]\nmeter = "p_flow@1:1-2"\nsigmas = 1e8\n'
    path = edited_scenario("ieee33", ("noise = true", error))
    done = dsse("run", path, "--out", "out", "--timeout", "3", "--no-plots", "--quiet")
    assert done.returncode == 1
    assert "there is no centralised estimate to compare with" in done.stdout
    assert "NO CONSENSUS" in done.stdout
