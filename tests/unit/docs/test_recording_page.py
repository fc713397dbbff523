"""The lines of docs/reference/recording.md read a recording, and its columns are those that there are."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from coordinator.lab.simulator.simulate import simulate_scenario
from coordinator.watch.recording.closing import close_ended
from coordinator.watch.recording.recorded_tables import COLUMNS
from scenarios.scenario import load_scenario

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "recording.md"
TEXT = PAGE.read_text(encoding="utf-8")
LINES = re.findall(r"```python\n(.*?)\n```", TEXT, re.DOTALL)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "run"
    simulate_scenario(load_scenario("ieee33", changes={"record": {}}), out=folder)
    assert close_ended(folder / "recording") == []
    return folder / "recording"


@pytest.mark.parametrize("line", LINES, ids=["DuckDB", "pandas"])
def test_one_line_reads_a_recording(recording: Path, line: str) -> None:
    assert len([text for text in line.splitlines() if text and not text.startswith("import ")]) == 1
    done = subprocess.run(
        [sys.executable, "-c", line], cwd=recording, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "area1" in done.stdout
    assert "vm_pu" in done.stdout or "mean" in done.stdout


def test_every_column_is_documented_and_no_other() -> None:
    rows = TEXT.split("## Columns")[1].split("## The log")[0].split("| Event |")[0].splitlines()
    documented = {name for row in rows if row.startswith("| `") for name in re.findall(r"`(\w+)`", row.split("|")[1])}
    assert documented == {name for columns in COLUMNS.values() for name in columns} - {"time"}
