"""A strategy of another distribution runs like the shipped ones, simulated and as processes, with lost messages."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from tests.support.dsse_command import COMMAND, ENVIRONMENT
from tests.support.foreign_distribution import write_example
from tests.support.levels import further
from tests.support.waiting import DEADLINE_S

LIMIT = ("--timeout", str(DEADLINE_S))


def dsse(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """With the example's distribution on the path."""
    installed = write_example(folder / "installed")
    path = os.pathsep.join([ENVIRONMENT["PYTHONPATH"], str(installed)])
    return subprocess.run(
        [*COMMAND, *arguments],
        cwd=folder,
        env={**ENVIRONMENT, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )


@pytest.mark.parametrize("command", ["simulate", *further("run")])
def test_a_strategy_of_ones_own_reaches_consensus_where_messages_are_lost(command: str, tmp_path: Path):
    run = dsse(tmp_path, command, "ieee33-lossy", "--strategy", "boundary-average", *LIMIT, "--out", "out")
    assert run.returncode == 0, run.stderr
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert (result["scenario"]["strategy"], result["verdict"]["consensus"]) == ("boundary-average", True)
    worth = {area["quality"] for area in result["areas"].values()}
    assert worth == {"good"} or (command == "run" and worth <= {"good", "degraded"})  # as the last message was lost
    assert 1e-6 < result["verdict"]["gap_vm_pu"] < 0.002  # below that of angle-offset, 0.0021


@pytest.mark.long
def test_dsse_compare_shows_it_beside_the_others(tmp_path: Path):
    run = dsse(tmp_path, "compare", "ieee33", "--out", "out")
    assert run.returncode == 0, run.stderr
    rows = [line.split()[0] for line in run.stdout.splitlines() if " consensus " in line]
    assert rows == ["admm", "angle-offset", "boundary-average", "information"]


def test_an_agent_without_the_distribution_names_the_strategies_that_it_has(tmp_path: Path):
    split = dsse(tmp_path, "split", "ieee33", "--out", "split")
    assert split.returncode == 0, split.stderr
    area = tmp_path / "split" / "area1.toml"
    area.write_text(area.read_text().replace('strategy = "information"', 'strategy = "boundary-average"'))
    agent = subprocess.run(
        [*COMMAND, "agent", str(area)],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert agent.returncode == 2
    assert "unknown strategy 'boundary-average'; allowed: admm, angle-offset, information" in agent.stderr
