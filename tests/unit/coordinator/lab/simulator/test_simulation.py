"""``dsse simulate``: the verdict, files and exit codes of ``dsse run``, from one process in virtual time."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import coordinator
from coordinator.cli.main import run_command
from coordinator.show.report.text import format_verdict
from dsse_core.errors import InvalidInputError
from scenarios.files.shipped_files import find_shipped
from scenarios.scenario import load_scenario


def simulate(
    folder: Path, name: str = "ieee33-lossy", **options: object
) -> coordinator.lab.evaluation.result.RunResult:
    return coordinator.simulate(name, out=folder, plots=False, **options)


def as_written(folder: Path) -> tuple[object, ...]:
    """All that a run has written, but for the time that it took to compute."""
    result = json.loads((folder / "result.json").read_text())
    del result["verdict"]["wall_s"]
    return result, (folder / "events.jsonl").read_text(), (folder / "buses.csv").read_text()


def test_the_same_seed_writes_the_same_files_and_another_seed_does_not(tmp_path: Path):
    for name, seed in (("one", 4), ("same", 4), ("other", 5)):
        simulate(tmp_path / name, seed=seed, strategy="information", links={"jitter_s": 0.05, "duplicate": 0.3})
    assert as_written(tmp_path / "one") == as_written(tmp_path / "same")
    assert as_written(tmp_path / "one") != as_written(tmp_path / "other")


def test_the_verdict_says_that_time_is_virtual(tmp_path: Path):
    result = simulate(tmp_path / "out")
    assert result.verdict.virtual_s == result.timing_s["verdict"] > 0
    assert f"consensus after {result.verdict.virtual_s:.2f} s of virtual time" in format_verdict(result)


def test_a_run_without_consensus_ends_at_its_time_limit_and_says_why(tmp_path: Path):
    verdict = simulate(tmp_path / "out", timeout_s=0.05).verdict
    assert (verdict.consensus, verdict.virtual_s) == (False, 0.05)
    assert verdict.reason is not None
    assert verdict.reason.startswith("no consensus within 0.05 s: ")


@pytest.mark.parametrize("at_s", [0.05, 1.0005])  # at 1.0005 s the last readings are on their way
def test_areas_that_agree_after_the_death_of_their_plant_are_no_consensus_and_all_files_are_there(
    tmp_path: Path, at_s: float
):
    events = [{"at_s": at_s, "kill": "plant"}]
    scenario = load_scenario("ieee33", changes={"faults.events": events})
    result = simulate(tmp_path / "out", scenario)  # type: ignore[arg-type]
    assert result.verdict.reason is not None
    assert "the areas agree, but on stale estimates: area1, area2, area3" in result.verdict.reason
    assert "of scan 1" in result.verdict.reason
    assert result.verdict.virtual_s is not None
    assert result.verdict.virtual_s < scenario.run.timeout_s / 2, "it is not worth the whole time limit"
    assert {area.quality for area in result.area_results} == {"stale"}
    assert json.loads((tmp_path / "out" / "result.json").read_text())["verdict"]["gap_vm_pu"] < 1e-8


def test_events_are_those_of_a_run_with_virtual_times(tmp_path: Path):
    result = simulate(tmp_path / "out", "industrial13")
    events = [json.loads(line) for line in (tmp_path / "out" / "events.jsonl").read_text().splitlines()]
    assert [e["event"] for e in events[:3]] == ["run started", "appeared", "appeared"]
    assert [e["event"] for e in events[-2:]] == ["consensus", "run ended"]
    times = [e["time"] for e in events]
    assert times == sorted(times)
    assert times[-1] == result.verdict.virtual_s


def test_a_loss_of_all_messages_leaves_every_area_alone(tmp_path: Path):
    verdict = simulate(tmp_path / "out", load_scenario("ieee33", changes={"faults.loss": 1.0}), timeout_s=2.0).verdict  # type: ignore[arg-type]
    assert not verdict.consensus
    assert verdict.lost == verdict.messages > 0


@pytest.mark.slow
def test_the_command_ends_with_the_exit_codes_of_dsse_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run_command(["simulate", "ieee33", "--out", str(tmp_path / "one"), "--quiet"]) == 0
    assert "virtual time" in capsys.readouterr().out
    assert (tmp_path / "one" / "gap.png").stat().st_size > 10_000
    options = ["--timeout", "0.003", "--no-plots", "--quiet"]
    assert run_command(["simulate", "ieee33", "--out", str(tmp_path / "two"), *options]) == 1
    assert not (tmp_path / "two" / "gap.png").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["simulate", "ieee34"],
        ["simulate", "ieee33", "--strategy", "gossip"],
        ["simulate", "ieee33", "--delay-ms", "-1"],
        ["simulate", "ieee33", "--duplicate", "1.5"],
        ["simulate", "ieee33", "--timeout", "0"],
        ["simulate", "ieee33", "--out", "."],
    ],
)
def test_a_users_mistake_ends_with_exit_code_2_and_no_traceback(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "occupied").touch()
    monkeypatch.chdir(tmp_path)
    assert run_command(arguments) == 2
    assert "rror: " in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["occupied"]


def test_link_faults_are_checked_from_python_too(tmp_path: Path):
    with pytest.raises(InvalidInputError, match="delay_s is -1"):
        simulate(tmp_path / "out", links={"delay_s": -1.0})


def router_events(*events: dict[str, object]) -> object:
    changes = {"faults.events": list(events), "transport.routers": 2}
    return load_scenario("ieee33", changes=changes)


def test_on_the_simulator_too_one_of_two_routers_may_die_unnoticed_and_both_may_not(tmp_path: Path):
    first, second = {"at_s": 0.01, "kill": "router"}, {"at_s": 0.02, "kill": "router2"}
    one = simulate(tmp_path / "one", router_events(first, {"at_s": 0.05, "restart": "router"}))  # type: ignore[arg-type]
    assert one.verdict.consensus
    both = simulate(tmp_path / "both", router_events(first, second), timeout_s=3.0)  # type: ignore[arg-type]
    assert not both.verdict.consensus
    back = router_events(first, second, {"at_s": 1.0, "restart": "router2"})
    assert simulate(tmp_path / "back", back).verdict.consensus  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "passes"), [("router", False), ("router2", True)])
def test_on_the_simulator_too_a_frozen_router_holds_up_those_who_are_linked_to_it_until_they_give_it_up(
    tmp_path: Path, name: str, passes: bool
):
    simulate(tmp_path / "out", router_events({"at_s": 0.001, "pause": name, "for_s": 5.0}))  # type: ignore[arg-type]
    lines = (tmp_path / "out" / "events.jsonl").read_text().splitlines()
    agreed = [e["time"] for e in map(json.loads, lines) if e["event"] == "quality" and e["quality"] == "good"]
    assert len(agreed) == 3
    assert (max(agreed) < 0.5) == passes
    assert max(agreed) < 3.0


def test_a_scan_that_does_not_determine_the_state_ends_with_exit_code_1_and_says_why(tmp_path: Path, dsse):
    """The only voltmeter is among the missing readings."""
    text = find_shipped("shipped")["ieee33"].read_text(encoding="utf-8")
    text = text.replace("voltage = { buses = [1, 16, 22, 30]", "voltage = { buses = [1]")
    scenario = tmp_path / "unobservable.toml"
    scenario.write_text(text + "\n[faults.telemetry]\nmissing = 0.02\n", encoding="utf-8")
    code, out, _ = dsse("simulate", scenario, "--seed", 14, "--out", tmp_path / "out", "--no-plots")
    assert code == 1
    assert out.startswith("NO CONSENSUS")
    assert "do not determine the state: not observable: no reading of this scan determines buses 1-6, 7-18" in out
    areas = json.loads((tmp_path / "out" / "result.json").read_text())["areas"]
    assert {(area["quality"], area["degraded"], bool(area["notes"])) for area in areas.values()} == {
        ("unobservable", True, True)
    }
    assert sum(line.startswith("unobservable: area") for line in out.splitlines()) == 3
