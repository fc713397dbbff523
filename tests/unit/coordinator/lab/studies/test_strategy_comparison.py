"""``dsse compare``: one table whose rows are the results of the runs."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from agents.strategies.installed import list_strategies
from coordinator.cli.main import run_command
from coordinator.lab.studies.strategy_comparison import choose_strategies
from coordinator.lab.studies.study_row import COLUMNS, from_cells, to_cells
from dsse_core.errors import InvalidInputError
from scenarios.files.shipped_files import find_shipped

STRATEGIES = list_strategies()


def read_rows(path: Path) -> dict[str, dict[str, str]]:
    with path.open() as file:
        return {row["strategy"]: row for row in csv.DictReader(file)}


def table_in(text: str) -> dict[str, list[str]]:
    """Strategy -> the other cells, of the table on the terminal."""
    lines = [line.replace("no consensus", "no-consensus").split() for line in text.splitlines()]
    return {cells[0]: cells[1:] for cells in lines if cells and cells[0] in STRATEGIES and len(cells) == 13}


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compare") / "out"
    assert run_command(["compare", "ieee33-lossy", "--out", str(folder)]) == 0
    return folder


def test_every_strategy_there_is_has_its_row(compared: Path):
    assert list(read_rows(compared / "comparison.csv")) == list(STRATEGIES)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_row_has_the_figures_of_its_run(compared: Path, strategy: str):
    row = read_rows(compared / "comparison.csv")[strategy]
    verdict = json.loads((compared / strategy / "result.json").read_text())["verdict"]
    assert tuple(row) == COLUMNS
    assert len(row["scenario_sha256"]) == 64
    for key in ("gap_vm_pu", "gap_va_deg", "error_vm_pu", "error_va_deg"):
        assert float(row[key]) == verdict[key]
    for key in ("exchanges", "messages", "bytes", "lost"):
        assert int(row[key]) == verdict[key]
    assert float(row["end_s"]) == verdict["virtual_s"]
    assert (row["outcome"] == "consensus") == verdict["consensus"]


def test_a_strategy_that_does_not_aim_at_the_centralised_estimate_never_reaches_it(compared: Path):
    row = read_rows(compared / "comparison.csv")["angle-offset"]
    assert (row["outcome"], row["below_1e6_s"]) == ("consensus", "")
    exact = read_rows(compared / "comparison.csv")["information"]
    assert 0 < float(exact["below_1e3_s"]) <= float(exact["below_1e6_s"]) <= float(exact["below_1e8_s"])


def test_the_terminal_and_markdown_show_the_same_rows(compared: Path, capsys: pytest.CaptureFixture[str]):
    run_command(["compare", "ieee33-lossy"])
    printed = table_in(capsys.readouterr().out)
    written = read_rows(compared / "comparison.csv")
    markdown = (compared / "comparison.md").read_text()
    assert printed.keys() == written.keys()
    for strategy, cells in printed.items():
        assert cells[1] == f"{float(written[strategy]['gap_vm_pu']):.1e}"
        assert cells[3] == f"{float(written[strategy]['error_vm_pu']):.1e}"
        assert cells[6] == written[strategy]["messages"]
        assert f"| {strategy} | consensus | {cells[1]} | {cells[2]} |" in markdown


def test_a_strategy_without_consensus_is_a_row_that_says_so(capsys: pytest.CaptureFixture[str]):
    assert run_command(["compare", "ieee33", "--strategies", "information", "--timeout", "0.003"]) == 0
    out = capsys.readouterr().out
    assert table_in(out)["information"][0] == "no-consensus"
    assert "information: no consensus: no consensus within 0.003 s: " in out


def scenario_with_injection_meters(folder: Path, buses: list[int], flow: str = '"all"') -> Path:
    text = find_shipped("shipped")["ieee33"].read_text()
    text = text.replace('injection = { buses = "all"', f"injection = {{ buses = {buses}")
    path = folder / "sparse.toml"
    path.write_text(text.replace('flow = { branches = "all"', f"flow = {{ branches = {flow}"))
    return path


def test_a_strategy_that_cannot_run_is_a_row_with_the_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = scenario_with_injection_meters(tmp_path, buses=list(range(2, 34)))  # none at the substation
    assert run_command(["compare", str(path), "--strategies", "angle-offset,information"]) == 0
    out = capsys.readouterr().out
    assert "angle-offset  not possible         -" in out
    assert "angle-offset: not possible: " in out
    assert table_in(out)["information"][0] == "consensus"


def test_it_is_an_error_if_no_strategy_can_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = scenario_with_injection_meters(tmp_path, buses=[1, 2, 3], flow='["6-7"]')
    assert run_command(["compare", str(path)]) == 2
    error = capsys.readouterr().err
    assert all(f"strategy {name}: " in error for name in STRATEGIES)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["ieee33", "--strategies", "information,gossip"], "unknown strategy 'gossip'; allowed: admm, angle-offset"),
        (["ieee33", "--strategies", "information,information"], "'information' is given twice"),
        (["ieee33", "--strategies", ""], "unknown strategy ''"),
        (["ieee33", "--out", "."], "is not empty"),
        (["nowhere.toml"], "cannot be read"),
    ],
)
def test_a_users_mistake_ends_with_exit_code_2(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    (tmp_path / "occupied").touch()
    monkeypatch.chdir(tmp_path)
    assert run_command(["compare", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_all_unknown_strategies_are_named_at_once():
    with pytest.raises(InvalidInputError) as error:
        choose_strategies("a,information,b")
    assert len(error.value.problems) == 2


def test_a_row_survives_being_written(compared: Path):
    with (compared / "comparison.csv").open() as file:
        for cells in list(csv.reader(file))[1:]:
            assert to_cells(from_cells(cells)) == cells
