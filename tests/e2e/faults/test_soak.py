"""The soak, a few seconds of it: the command ends well, and finds nothing to complain of."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.dsse_command import ENVIRONMENT, ROOT

DEADLINE_S = 600.0


@pytest.mark.long
def test_a_short_soak_ends_whole(tmp_path: Path):
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.soak", "--minutes", "0.1", "--out", str(tmp_path / "soak")],
        cwd=ROOT,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert seen["gap at the end"] <= 1e-8
    assert seen["faults of processes"]
