"""Wrong input on the command line: exit code 2 and one message that names the place and what to do."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from dsse_command import ROOT, free_endpoint

import coordinator
import coordinator.process_run.system

AREA1 = "buses = [1, 2, 3, 4, 5, 6, 19, 20, 21, 22, 23, 24, 25]"
AREA2 = "buses = [16, 17, 18, 15, 14, 13, 12, 11, 10, 9, 8, 7, 6]"
AREA3 = "buses = [30, 31, 32, 33, 29, 28, 27, 26, 6]"
FLOW = 'flow = { branches = "all", sigma_percent = 1.0 }'
INJECTION = 'injection = { buses = "all", sigma_percent = 10.0 }'

CASES = {
    "unknown key": (
        [("noise = true", "noise = true\ncolour = 3")],
        ["telemetry.colour: unknown key", "allowed here: source, file, noise"],
    ),
    "missing network": ([('network = "ieee33"\n', "")], ["network: missing", "name of a shipped network"]),
    "network that does not exist": ([('network = "ieee33"', 'network = "ieee34"')], ["network", "ieee34", "ieee33"]),
    "bus in no area": ([(AREA3, AREA3.replace("33, ", ""))], ["bus 33 is in no area", "add it to"]),
    "area that is not connected": (
        [(AREA2, AREA2.replace("10, ", "")), (AREA3, AREA3.replace("6]", "6, 10]"))],
        ["area area2 is not connected", "area area3 is not connected", "falls into buses"],
    ),
    "two areas that share a branch": (
        [(AREA1, AREA1.replace("25]", "25, 26]"))],
        ["areas area1, area3 form a loop", "branch 6-26"],
    ),
    "area without observability": (
        [
            (FLOW, 'flow = { branches = ["1-2", "2-3", "3-4", "4-5", "5-6"], sigma_percent = 1.0 }'),
            (INJECTION, "injection = { buses = [2, 3, 4, 5, 7, 8, 9, 10], sigma_percent = 10.0 }"),
            ('strategy = "information"', 'strategy = "angle-offset"'),
        ],
        ["area area2: the measurements do not determine the state of bus", "13, 14", "area area3: ", "whole grid: "],
    ),
    "whole grid without observability": (
        [
            (FLOW, 'flow = { branches = ["1-2", "2-3", "3-4", "4-5", "5-6"], sigma_percent = 1.0 }'),
            (INJECTION, "injection = { buses = [2, 3, 4, 5, 7, 8, 9, 10], sigma_percent = 10.0 }"),
        ],
        ["1 problem", "whole grid: the measurements do not determine the state of bus 7, 8", "no single added meter"],
    ),
    "sigma of zero": ([("sigma_percent = 0.2", "sigma_percent = 0.0")], ["measurements.voltage.sigma_percent", "0.0"]),
    "negative sigma": ([("sigma_percent = 1.0", "sigma_percent = -1.0")], ["measurements.flow.sigma_percent", "-1.0"]),
    "two mistakes at once": (
        [("sigma_percent = 0.2", "sigma_percent = 0.0"), ("noise = true", "noise = 7")],
        ["2 problems", "measurements.voltage.sigma_percent", "telemetry.noise"],
    ),
}


@pytest.mark.parametrize(("edits", "expected"), CASES.values(), ids=CASES.keys())
@pytest.mark.parametrize("command", ["check", "run"])
def test_a_wrong_scenario_is_refused_with_what_is_wrong(
    dsse, edited_scenario, command: str, edits: list[tuple[str, str]], expected: list[str]
):
    done = dsse(command, edited_scenario("ieee33", *edits))
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert "Traceback" not in done.stderr
    for text in expected:
        assert text in done.stderr


def test_a_loop_of_areas_is_named(dsse, edited_scenario, tmp_path: Path):
    network = (ROOT / "scenarios" / "cases" / "ieee33.toml").read_text()
    tie = "from = 18, to = 33, r_ohm = 0.5, x_ohm = 0.5"
    assert network.count(f"{tie}, in_service = false") == 1
    (tmp_path / "meshed.toml").write_text(network.replace(f"{tie}, in_service = false", tie))
    path = edited_scenario(
        "ieee33",
        ('network = "ieee33"', 'network = "meshed.toml"'),
        (AREA2, AREA2.replace("6]", "6, 33]")),
    )
    done = dsse("check", path)
    assert done.returncode == 2
    assert "areas form a loop" in done.stderr
    assert "area2" in done.stderr
    assert "area3" in done.stderr


def test_text_that_is_not_toml_is_refused_with_its_line(dsse, tmp_path: Path):
    (tmp_path / "broken.toml").write_text("version = 1\nseed = = 2\n")
    done = dsse("check", "broken.toml")
    assert done.returncode == 2
    assert "broken.toml" in done.stderr
    assert "line 2" in done.stderr


def test_an_unknown_scenario_is_answered_with_those_that_exist(dsse):
    done = dsse("run", "ieee3")
    assert done.returncode == 2
    assert "industrial13-lossy" in done.stderr


def test_a_run_folder_that_holds_something_is_not_touched(dsse, tmp_path: Path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note").write_text("mine")
    done = dsse("run", "industrial13", "--out", "full")
    assert done.returncode == 2
    assert "full" in done.stderr
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["note"]


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


@pytest.mark.parametrize(
    "arguments",
    [
        ("plant", "ieee33", "--every", "nan"),
        ("watch", "--timeout", "nan"),
        ("keys", "create", "ieee33", "--days", "nan"),
        ("simulate", "ieee33", "--delay-ms", "nan"),
        ("import", "case.m", "--out", "case", "--frequency", "inf"),
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_a_number_that_is_not_finite_is_refused(dsse, arguments: tuple[str, ...]):
    done = dsse(*arguments)
    assert done.returncode == 2
    assert "is not a finite number" in done.stderr


def test_an_agent_that_reaches_no_router_says_so(dsse):
    assert dsse("split", "industrial13", "--out", "areas").returncode == 0
    endpoint = free_endpoint()
    done = dsse("agent", "areas/area1.toml", "--connect", endpoint, "--timeout", 1)
    assert done.returncode == 2
    assert f"error: cannot reach {endpoint}" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_plant_that_reaches_no_router_says_so(dsse):
    endpoint = free_endpoint()
    done = dsse("plant", "industrial13", "--connect", endpoint, "--timeout", 1)
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


def test_a_run_says_which_agent_refused_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write = coordinator.process_run.system.write_area_files

    def spoil(*arguments: object) -> Iterator[tuple[str, Path]]:
        for name, path in write(*arguments):  # type: ignore[arg-type]
            if name == "area2":
                path.write_text("nonsense")
            yield name, path

    monkeypatch.setattr(coordinator.process_run.system, "write_area_files", spoil)
    result = coordinator.run("industrial13", out=tmp_path / "out", plots=False)
    assert not result.verdict.consensus
    assert result.verdict.reason is not None
    assert "area area2 died with exit code 2" in result.verdict.reason
    assert "not valid JSON" in result.verdict.reason


def test_an_unknown_command_and_a_bad_option_are_refused(dsse):
    assert dsse("frobnicate").returncode == 2
    assert dsse("run", "industrial13", "--seed", "-1").returncode == 2
    assert dsse("run", "industrial13", "--timeout", "-1").returncode == 2


@pytest.mark.parametrize("command", ["run", "check", "scenarios", "powerflow", "estimate", "split", "agent", "plant"])
def test_every_command_explains_itself_with_an_example(dsse, command: str):
    done = dsse(command, "--help")
    assert done.returncode == 0
    assert f"dsse {command}" in done.stdout.lower().split("example")[-1]


@pytest.mark.parametrize("timeout", ["nan", "inf", "0", "-1"])
@pytest.mark.parametrize("command", [("run", "industrial13"), ("plant", "industrial13"), ("agent", "area1.toml")])
def test_a_time_limit_that_is_none_is_refused(dsse, command, timeout: str):
    done = dsse(*command, "--timeout", timeout)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert done.stderr


def test_an_area_may_not_be_called_like_a_process(dsse, edited_scenario):
    path = edited_scenario("industrial13", ("[areas.area1]", "[areas.router]"))
    done = dsse("check", path)
    assert done.returncode == 2
    assert "areas.router: this name belongs to a process of every run" in done.stderr


def test_area_files_cannot_be_written_where_a_file_stands(dsse, tmp_path: Path):
    (tmp_path / "taken").write_text("")
    done = dsse("split", "ieee33", "--out", "taken")
    assert done.returncode == 2
    assert "taken" in done.stderr
    assert "Traceback" not in done.stderr


def test_an_endpoint_that_is_none_is_refused_before_files_are_written(dsse, tmp_path: Path):
    done = dsse("split", "ieee33", "--out", "areas", "--connect", "garbage")
    assert done.returncode == 2
    assert "'garbage' is no Zenoh endpoint" in done.stderr
    assert not (tmp_path / "areas").exists()


def test_a_reader_who_leaves_changes_neither_the_result_nor_the_exit_code(start_run):
    run = start_run("industrial13")
    assert run.process.stdout is not None
    run.process.stdout.close()
    assert run.process.wait(60) == 0
    assert (run.folder / "result.json").exists()


def test_without_a_centralised_estimate_the_run_still_ends_with_its_own_verdict(dsse, edited_scenario):
    error = 'noise = true\n\n[[telemetry.gross_error]]\nmeter = "p_flow@1:1-2"\nsigmas = 1e8\n'
    path = edited_scenario("ieee33", ("noise = true", error))
    done = dsse("run", path, "--out", "out", "--timeout", "3", "--no-plots", "--quiet")
    assert done.returncode == 1
    assert "there is no centralised estimate to compare with" in done.stdout
    assert "NO CONSENSUS" in done.stdout
