"""``dsse sweep``: what is run, what is kept, what is gone on with, and what is rejected."""

from __future__ import annotations

import csv
import json
import os
import signal
from dataclasses import replace
from multiprocessing import util
from pathlib import Path

import pytest

from coordinator.cli.main import run_command
from coordinator.lab.studies import sweep as sweep_module
from coordinator.lab.studies.study_row import COLUMNS
from coordinator.lab.studies.sweep import run_tasks
from coordinator.lab.studies.sweep_plan import Task, make_plan, parse_vary
from coordinator.lab.studies.sweep_table import SweepTable
from dsse_core.errors import InvalidInputError
from scenarios.files.shipped_files import find_shipped
from tests.support.waiting import is_gone, wait_until

SMALL = ["industrial13", "--vary", "faults.loss=0,0.3", "--strategies", "information", "--quiet"]


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, str, int]]:
    """(loss, strategy, seed) of every run that is done in this process."""
    done: list[tuple[float, str, int]] = []
    real = sweep_module.run_on_simulator

    def run(scenario):
        done.append((next(iter(scenario.faults.links.values())).loss, scenario.strategy, scenario.seed))
        return real(scenario)

    monkeypatch.setattr(sweep_module, "run_on_simulator", run)
    return done


def sweep(folder: Path, *more: str, seeds: int = 2, jobs: int = 1, base: list[str] = SMALL) -> int:
    return run_command(["sweep", *base, "--seeds", str(seeds), "--jobs", str(jobs), "--out", str(folder), *more])


def rows_in(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_every_value_strategy_and_seed_is_run_once_and_has_its_row(tmp_path: Path, runs: list):
    assert sweep(tmp_path / "s", "--strategies", "information,angle-offset") == 0
    expected = {(v, s, n) for v in (0.0, 0.3) for s in ("information", "angle-offset") for n in (1, 2)}
    assert len(runs) == len(expected)
    assert set(runs) == expected
    rows = rows_in(tmp_path / "s")
    assert tuple(rows[0]) == ("faults.loss", *COLUMNS)
    assert {(float(r["faults.loss"]), r["strategy"], int(r["seed"])) for r in rows} == expected
    assert all((int(r["lost"]) > 0) == (r["faults.loss"] == "0.3") for r in rows)
    assert (tmp_path / "s" / "sweep.png").stat().st_size > 10_000


@pytest.mark.slow
def test_many_processes_give_the_rows_that_one_gives(tmp_path: Path):
    assert sweep(tmp_path / "one") == 0
    assert sweep(tmp_path / "two", jobs=2) == 0

    rows = rows_in(tmp_path / "one")
    assert rows == rows_in(tmp_path / "two")
    assert [(row["faults.loss"], row["seed"]) for row in rows] == [("0", "1"), ("0", "2"), ("0.3", "1"), ("0.3", "2")]


@pytest.mark.slow
def test_runs_that_the_table_has_are_not_run_again(tmp_path: Path, runs: list):
    sweep(tmp_path / "s")
    first = rows_in(tmp_path / "s")
    runs.clear()
    assert sweep(tmp_path / "s", seeds=3) == 0
    assert sorted(runs) == [(0.0, "information", 3), (0.3, "information", 3)]
    assert [row for row in rows_in(tmp_path / "s") if row["seed"] != "3"] == first
    runs.clear()
    assert sweep(tmp_path / "s", seeds=3) == 0
    (tmp_path / "s" / "sweep.csv").write_text((tmp_path / "s" / "sweep.csv").read_text().replace("\n0,", "\n0.00,"))
    assert sweep(tmp_path / "s", seeds=3) == 0
    assert runs == []


def test_a_number_written_in_two_ways_is_one_value():
    with pytest.raises(InvalidInputError, match=r"faults.loss: 0 is given twice"):
        make_plan("ieee33", [parse_vary("faults.loss=0,0.0")], ["information"], 1)


@pytest.mark.slow
def test_a_row_that_was_cut_off_is_run_again_and_reported(
    tmp_path: Path, runs: list, capsys: pytest.CaptureFixture[str]
):
    sweep(tmp_path / "s")
    path = tmp_path / "s" / "sweep.csv"
    text = path.read_text()
    path.write_text(text[:-10])
    runs.clear()
    assert sweep(tmp_path / "s") == 0
    assert len(runs) == 1
    assert path.read_text() == text
    assert "half written" in capsys.readouterr().err


@pytest.mark.slow
def test_an_interrupted_sweep_keeps_what_is_done_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    real, done = sweep_module.run_on_simulator, []

    def interrupted_after_one(scenario):
        if done:
            raise KeyboardInterrupt
        done.append(scenario)
        return real(scenario)

    monkeypatch.setattr(sweep_module, "run_on_simulator", interrupted_after_one)
    assert sweep(tmp_path / "s") == 130
    assert len(rows_in(tmp_path / "s")) == 1
    assert f"--out {tmp_path / 's'} goes on from there" in capsys.readouterr().err
    monkeypatch.setattr(sweep_module, "run_on_simulator", real)
    assert sweep(tmp_path / "s") == 0
    assert len(rows_in(tmp_path / "s")) == 4


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_while_workers_are_started_shows_no_traceback_of_theirs(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], number: signal.Signals
):
    spawn, workers = util.spawnv_passfds, []

    def spawn_under_a_signal(path: object, arguments: list[str], files: object) -> int:
        pid = spawn(path, arguments, files)
        if "--multiprocessing-fork" in arguments:
            workers.append(pid)
            os.kill(os.getpid(), number)
        return pid

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(util, "spawnv_passfds", spawn_under_a_signal)
    plan = make_plan("industrial13", [parse_vary("faults.loss=0,0.1")], ["information"], 1)
    former = signal.signal(number, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            list(run_tasks(plan, plan.tasks, 2))
    finally:
        signal.signal(number, former)
    assert workers
    wait_until(lambda: all(map(is_gone, workers)))  # the pool collects them; who does it in its place stops it for ever
    assert capfd.readouterr().err == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("other", "message"),
    [
        (["industrial13-lossy", *SMALL[1:]], "scenario is 'industrial13'"),
        pytest.param(
            ["industrial13", "--vary", "run.beat_s=0.1,0.2", *SMALL[3:]],
            "vary is [['faults.loss']]",
            marks=pytest.mark.long,
        ),
        pytest.param([*SMALL, "--delay-ms", "3"], "links is {}", marks=pytest.mark.long),
        ([*SMALL, "--timeout", "7"], "scenario_sha256 is"),
    ],
)
def test_rows_of_different_sweeps_never_mix(
    tmp_path: Path, runs: list, other: list[str], message: str, capsys: pytest.CaptureFixture[str]
):
    sweep(tmp_path / "s", seeds=1)
    before = (tmp_path / "s" / "sweep.csv").read_text()
    runs.clear()
    assert sweep(tmp_path / "s", seeds=1, base=other) == 2
    assert message in capsys.readouterr().err
    assert runs == []
    assert (tmp_path / "s" / "sweep.csv").read_text() == before


def test_a_scenario_file_that_has_changed_is_another_scenario(tmp_path: Path):
    path = tmp_path / "mine.toml"
    path.write_text(find_shipped("shipped")["industrial13"].read_text())
    mine = [str(path), *SMALL[1:]]
    assert sweep(tmp_path / "s", seeds=1, base=mine) == 0
    path.write_text(path.read_text().replace("sigma_percent = 10.0", "sigma_percent = 9.0"))
    assert sweep(tmp_path / "s", seeds=1, base=mine) == 2


def test_a_network_file_that_has_changed_is_another_scenario():
    plan = make_plan("industrial13", [parse_vary("faults.loss=0")], ["information"], 1)
    first, *others = plan.base.network.buses
    network = replace(plan.base.network, buses=(replace(first, p_load=first.p_load + 1e-9), *others))
    changed = replace(plan, base=replace(plan.base, network=network)).settings
    assert changed["scenario_sha256"] != plan.settings["scenario_sha256"]
    assert changed | {"scenario_sha256": ""} == plan.settings | {"scenario_sha256": ""}


def test_a_foreign_table_is_rejected_and_left_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "sweep.csv").write_text("a,b\n1,2\n")
    assert sweep(tmp_path) == 2
    assert "holds something that is no sweep" in capsys.readouterr().err
    assert (tmp_path / "sweep.csv").read_text() == "a,b\n1,2\n"


@pytest.mark.parametrize("text", ["a,b\n1,2\n", ""])
def test_a_table_with_other_columns_or_lines_is_rejected(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]):
    sweep(tmp_path / "s", seeds=1)
    path = tmp_path / "s" / "sweep.csv"
    broken = text or path.read_text() + "0.5,information,x\n"
    path.write_text(broken)
    assert sweep(tmp_path / "s", seeds=1) == 2
    assert "other columns" in (error := capsys.readouterr().err) or "line 4 is no row" in error
    assert path.read_text() == broken


@pytest.mark.parametrize("content", [None, b"\xff\xfe\n", b"\n\n", b'a,"\n'])
def test_a_table_that_is_a_pipe_or_no_text_is_one_error(tmp_path: Path, content: bytes | None):
    plan = make_plan("industrial13", [parse_vary("faults.loss=0,0.3")], ("information",), 1)
    with SweepTable(tmp_path / "s", plan.settings) as table:
        header = table.path.read_bytes()
    table.path.unlink()
    os.mkfifo(table.path) if content is None else table.path.write_bytes(header + content)
    with pytest.raises(InvalidInputError) as caught:
        SweepTable(tmp_path / "s", plan.settings)
    assert caught.value.problems


def test_two_sweeps_do_not_write_to_one_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    plan = make_plan("industrial13", [parse_vary("faults.loss=0,0.3")], ("information",), 1)
    with SweepTable(tmp_path / "s", plan.settings):
        assert sweep(tmp_path / "s") == 2
    assert "another sweep is writing" in capsys.readouterr().err


def test_a_run_that_is_not_possible_is_a_row_with_the_reason(tmp_path: Path):
    base = ["ieee33", "--vary", "measurements.injection.buses=[1],[2]", *SMALL[3:]]
    assert sweep(tmp_path / "s", "--strategies", "angle-offset", seeds=1, base=base) == 0
    rows = {row["measurements.injection.buses"]: row for row in rows_in(tmp_path / "s")}
    assert rows["[1]"]["outcome"] == "consensus"
    assert rows["[2]"]["outcome"] == "not possible"
    assert "substation" in rows["[2]"]["reason"]
    assert rows["[2]"]["gap_vm_pu"] == ""
    assert (tmp_path / "s" / "sweep.png").exists()


def test_tied_keys_take_the_same_value_and_repeated_options_all_pairs():
    tied, crossed = parse_vary("faults.loss,faults.link[1].loss=0,0.25"), parse_vary("run.beat_s=1,2")
    assert tied.keys == ("faults.loss", "faults.link[1].loss")
    assert parse_vary('faults."a,b".loss,c=1').keys == ('faults."a,b".loss', "c")
    plan = make_plan("ieee33-cut", [parse_vary("faults.loss,faults.jitter_ms=0,0.5"), crossed], ["admm"], 1)
    found = {
        values: (next(iter(scenario.faults.links.values())), scenario.run.beat_s)
        for values, scenario in plan.scenarios.items()
    }
    assert {v: (link.loss, 1000 * link.jitter_s, beat) for v, (link, beat) in found.items()} == {
        (text, beat): (float(text), float(text), float(beat)) for text in ("0", "0.5") for beat in ("1", "2")
    }


def test_a_table_of_tied_and_crossed_keys_has_a_column_for_each_and_goes_on(
    tmp_path: Path, runs: list, capsys: pytest.CaptureFixture[str]
):
    vary = ["--vary", "faults.loss,faults.jitter_ms=0,0.5", "--vary", "run.beat_s=0.5,0.25"]
    base = ["industrial13", *vary, "--strategies", "information", "--quiet", "--format", "svg"]
    quantities = ["--quantity", "error_vm_pu", "--quantity", "messages"]
    assert sweep(tmp_path / "s", *quantities, seeds=1, base=base) == 0
    rows = rows_in(tmp_path / "s")
    assert [(row["faults.loss"], row["faults.jitter_ms"], row["run.beat_s"]) for row in rows] == [
        *(("0", "0", "0.25"), ("0", "0", "0.5"), ("0.5", "0.5", "0.25"), ("0.5", "0.5", "0.5")),
    ]
    assert all(float(row["error_vm_pu"]) > 0 for row in rows)
    assert {row["error_vm_pu"][:12] for row in rows} == {row["centralised_error_vm_pu"][:12] for row in rows}
    picture = (tmp_path / "s" / "sweep.svg").read_text(encoding="utf-8")
    assert all(text in picture for text in ("run.beat_s = 0.25", "error to the truth, magnitude (p.u.)", "messages"))
    runs.clear()
    capsys.readouterr()
    assert sweep(tmp_path / "s", *quantities, "--json", seeds=1, base=base) == 0
    assert runs == []
    printed = json.loads(capsys.readouterr().out)["rows"]
    assert list(printed[0]) == list(rows[0])
    for row, written in zip(printed, rows, strict=True):
        assert [row[key] for key in list(row)[:3]] == [float(written[key]) for key in list(row)[:3]]


def test_a_quantity_that_no_run_has_is_one_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert sweep(tmp_path / "s", "--quantity", "eror_vm_pu") == 2
    assert "did you mean 'error_vm_pu'?" in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


def test_settings_do_not_depend_on_where_the_file_lies(tmp_path: Path):
    found = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / "mine.toml"
        path.write_text(find_shipped("shipped")["industrial13"].read_text())
        found.append(make_plan(str(path), [parse_vary("faults.loss=0,0.3")], ("information",), 1).settings)
    assert found[0] == found[1]
    assert json.loads(json.dumps(found[0])) == found[0]


def test_a_plan_runs_the_seeds_from_the_scenarios_own_on():
    plan = make_plan("industrial13", [parse_vary("run.beat_s=1")], ("admm",), 3)
    assert plan.tasks == [Task(("1",), "admm", seed) for seed in (1, 2, 3)]
    assert plan.scenario_of(plan.tasks[2]).run.beat_s == 1


@pytest.mark.parametrize(
    ("vary", "values"),
    [
        ("faults.loss=0:0.9:10", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]),
        ("areas.count=2:6:3", [2, 4, 6]),
        ("a.b=1:2:3", [1.0, 1.5, 2.0]),
        ("a.b=1e-9,1e-3", [1e-9, 1e-3]),
        ("telemetry.noise=true,false", [True, False]),
        ("telemetry.source=network,area-power-flow", ["network", "area-power-flow"]),
        ("transport.listen=tcp/127.0.0.1:0", ["tcp/127.0.0.1:0"]),
        ("a.b=[1, 2],[3]", [[1, 2], [3]]),
    ],
)
def test_values_are_a_range_or_a_list_as_toml_writes_them(vary: str, values: list[object]):
    found = parse_vary(vary).values
    assert found == values
    assert list(map(type, found)) == list(map(type, values))


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ("faults.loss,faults.loss=0,1", "faults.loss is varied twice"),
        ("faults.loss,seed=0,1", "seed is varied by --seeds"),
        ("faults.loss", "must be KEY=START:STOP:N"),
        ("faults.loss=", "must be KEY=START:STOP:N"),
        ("faults.loss=0:0.9", "must be START:STOP:N"),
        ("faults.loss=0:1:x", "must be START:STOP:N"),
        ("faults.loss=0:1:1", "must be START:STOP:N"),
        ("faults.loss=0:1:2:3", "must be START:STOP:N"),
        ("faults.loss=0,0.5,0.5", "0.5 is given twice"),
        ("seed=1,2", "seed is varied by --seeds"),
        ("strategy=admm", "strategy is varied by --strategies"),
        ("faults.los=0,1", "faults.los: unknown key; allowed here: loss"),
        ("faults.loss=0.5,2", "with faults.loss = 2: faults.loss: must be less than or equal to 1"),
        ("faults.loss=high", "must be a valid number, found 'high'"),
        ("faults.link[3].loss=0,1", "faults.link is no list"),
        ("seed.x=1", "seed is no table"),
        ("a..b=1", "'a..b' is no key"),
    ],
)
def test_a_key_or_value_that_the_scenario_rejects_is_one_clear_error(
    vary: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert run_command(["sweep", "industrial13", "--vary", vary, "--out", str(tmp_path / "s")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


def test_an_unknown_scenario_is_reported_once(capsys: pytest.CaptureFixture[str]):
    assert run_command(["sweep", "ieee34", "--vary", "faults.loss=0:1:5"]) == 2
    assert capsys.readouterr().err.count("no shipped scenario") == 1


def test_the_picture_says_how_many_runs_ended_without_consensus(tmp_path: Path):
    base = ["industrial13", "--vary", "faults.loss=0,1", "--timeout", "1", "--quiet", "--format", "svg"]
    assert sweep(tmp_path / "s", "--strategies", "information", base=base) == 0
    for picture in ("sweep.svg", "report.html"):
        assert "information (no consensus in 2 of 4 runs)" in (tmp_path / "s" / picture).read_text(encoding="utf-8")
