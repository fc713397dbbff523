"""Wrong input on the command line: exit code 2 and one message that names the place and what to do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from agents.__main__ import main as run_agent
from coordinator.cli.main import run_command
from scenarios.files.shipped_files import find_shipped

Dsse = Callable[..., tuple[int, str, str]]


@pytest.fixture
def dsse(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Dsse:
    """Run ``dsse`` in an empty folder; exit code, standard output, standard error."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: object) -> tuple[int, str, str]:
        command, *others = map(str, arguments)
        try:
            code = run_agent(others) if command == "agent" else run_command([command, *others])
        except SystemExit as end:  # of argparse
            code = int(end.code or 0)
        return code, *capsys.readouterr()

    return run


AREA1 = "buses = [1, 2, 3, 4, 5, 6, 19, 20, 21, 22, 23, 24, 25]"
AREA2 = "buses = [16, 17, 18, 15, 14, 13, 12, 11, 10, 9, 8, 7, 6]"
AREA3 = "buses = [30, 31, 32, 33, 29, 28, 27, 26, 6]"
FLOW = 'flow = { branches = "all", sigma_percent = 1.0 }'
INJECTION = 'injection = { buses = "all", sigma_percent = 10.0 }'

CASES = {
    "unknown key": (
        [("noise = true", "noise = true\ncolour = 3")],
        ["telemetry.colour: unknown key", "allowed here: source, ticks, leader, file, noise"],
    ),
    "missing network": ([('network = "ieee33"\n', "")], ["network: missing", "name of a shipped network"]),
    "network that does not exist": ([('network = "ieee33"', 'network = "ieee34"')], ["network", "ieee34", "ieee33"]),
    "bus in no area": ([(AREA3, AREA3.replace("33, ", ""))], ["bus 33 is in no area", "add it to"]),
    "area that is not connected": (
        [(AREA2, AREA2.replace("10, ", "")), (AREA3, AREA3.replace("6]", "6, 10]"))],
        ["area area3 is not connected", "falls into buses"],  # area2 is connected by its open tie 9-15
    ),
    "two areas that share a branch": (
        [(AREA1, AREA1.replace("25]", "25, 26]"))],
        ["areas area1, area3 all list both ends of branch 6-26", "leave bus 6 or 26 out"],
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
def test_a_wrong_scenario_is_rejected_with_what_is_wrong(
    dsse, edited_scenario, command: str, edits: list[tuple[str, str]], expected: list[str]
):
    code, _, err = dsse(command, edited_scenario("ieee33", *edits))
    assert code == 2
    assert err.startswith("error: ")
    assert "Traceback" not in err
    for text in expected:
        assert text in err


def test_a_ring_through_areas_is_named_where_the_strategy_takes_none(dsse, edited_scenario, tmp_path: Path):
    network = find_shipped("cases")["ieee33"].read_text()
    tie = "from = 18, to = 33, r_ohm = 0.5, x_ohm = 0.5"
    assert network.count(f"{tie}, in_service = false") == 1
    (tmp_path / "meshed.toml").write_text(network.replace(f"{tie}, in_service = false", tie))
    path = edited_scenario(
        "ieee33",
        ('network = "ieee33"', 'network = "meshed.toml"'),
        ('strategy = "information"', 'strategy = "admm"'),
    )
    code, _, err = dsse("check", path)
    assert code == 2
    assert "a ring, which strategy 'admm' cannot take" in err
    assert "areas area2 and area3 share bus 6, 33" in err


def test_text_that_is_not_toml_is_rejected_with_its_line(dsse, tmp_path: Path):
    (tmp_path / "broken.toml").write_text("version = 1\nseed = = 2\n")
    code, _, err = dsse("check", "broken.toml")
    assert code == 2
    assert "broken.toml" in err
    assert "line 2" in err


def test_an_unknown_scenario_is_answered_with_those_that_exist(dsse):
    code, _, err = dsse("run", "ieee3")
    assert code == 2
    assert "industrial13-lossy" in err


def test_a_run_folder_that_holds_something_is_not_touched(dsse, tmp_path: Path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note").write_text("mine")
    code, _, err = dsse("run", "industrial13", "--out", "full")
    assert code == 2
    assert "full" in err
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["note"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("plant", "ieee33", "--every", "nan"),
        ("watch", "--wait", "nan"),
        ("keys", "create", "ieee33", "--days", "nan"),
        ("simulate", "ieee33", "--delay-ms", "nan"),
        ("import", "case.m", "--out", "case", "--frequency", "inf"),
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_a_number_that_is_not_finite_is_rejected(dsse, arguments: tuple[str, ...]):
    code, _, err = dsse(*arguments)
    assert code == 2
    assert "is not a finite number" in err


def test_an_unknown_command_and_a_bad_option_are_rejected(dsse):
    assert dsse("frobnicate")[0] == 2
    assert dsse("run", "industrial13", "--seed", "-1")[0] == 2
    assert dsse("run", "industrial13", "--timeout", "-1")[0] == 2


@pytest.mark.parametrize("time", ["nan", "inf", "0", "-1"])
@pytest.mark.parametrize(
    "command",
    [("run", "industrial13", "--timeout"), ("plant", "industrial13", "--wait"), ("agent", "area1.toml", "--wait")],
)
def test_a_time_limit_that_is_none_is_rejected(dsse, command, time: str):
    code, _, err = dsse(*command, time)
    assert code == 2
    assert "Traceback" not in err
    assert err


def test_an_area_may_not_be_called_like_a_process(dsse, edited_scenario):
    path = edited_scenario("industrial13", ("[areas.area1]", "[areas.router]"))
    code, _, err = dsse("check", path)
    assert code == 2
    assert "areas.router: this name belongs to another process" in err


def test_area_files_cannot_be_written_where_a_file_stands(dsse, tmp_path: Path):
    (tmp_path / "taken").write_text("")
    code, _, err = dsse("split", "ieee33", "--out", "taken")
    assert code == 2
    assert "taken" in err
    assert "Traceback" not in err


def test_an_endpoint_that_is_none_is_rejected_before_files_are_written(dsse, tmp_path: Path):
    code, _, err = dsse("split", "ieee33", "--out", "areas", "--connect", "garbage")
    assert code == 2
    assert "--connect: 1 problem\n  - 'tcp/garbage': the port is missing" in err
    assert not (tmp_path / "areas").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["watch"],
        ["metrics"],
        ["serve"],
        ["flows", "area1.toml"],
        ["plant", "ieee33"],
        ["record", "--out", "r"],
        ["gateway", "map.toml"],
        ["meter", "off", "x"],
        ["scan"],
        ["stop"],
        ["router"],
        ["agent", "area1.toml"],
    ],
    ids=" ".join,
)
def test_an_endpoint_that_is_none_ends_every_command_at_once(dsse, arguments: list[str]):
    code, _, err = dsse(*arguments, "--connect", "tcp/127.0.0.1:9", "--connect", "garbage")
    assert code == 2
    assert err.startswith(
        "error: --connect: 1 problem\n  - 'tcp/garbage': the port is missing; one looks like tcp/192.0.2.7:7447"
    )


def test_where_a_router_is_to_listen_is_checked_too(dsse):
    code, _, err = dsse("router", "--listen", "tcp/127.0.0.1")
    assert code == 2
    assert err.startswith("error: --listen: 1 problem")
