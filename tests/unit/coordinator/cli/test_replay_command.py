"""What a script learns of ``dsse replay`` by its exit code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coordinator.cli.main import run_command
from coordinator.lab.stages import play
from coordinator.watch.replay.replay import Comparison

GOOD = {"scans": 2, "compared": 6}
HOLE = {"left_out": {3: "no readings of area2 are recorded"}}


@pytest.mark.parametrize(
    ("found", "code"),
    [
        (Comparison(**GOOD), 0),
        (Comparison(**GOOD, **HOLE), 5),
        (Comparison(**GOOD, notes=["lost: {}"]), 5),
        (Comparison(**GOOD, **HOLE, largest=np.ones(4)), 1),
    ],
    ids=["whole", "a scan is left out", "entries are lost", "another state"],
)
def test_a_script_learns_whether_a_replay_agrees_and_is_whole(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, found: Comparison, code: int
):
    monkeypatch.setattr(play, "play_on_simulator", lambda *_: found)
    assert run_command(["replay", str(tmp_path)]) == code
    output = capsys.readouterr().out
    assert ("2 of 3 scans played" in output) == bool(found.left_out)
    assert ("all states are those" in output) == (code == 0), "gaps are passed over"
