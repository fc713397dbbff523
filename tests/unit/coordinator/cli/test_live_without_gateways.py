"""Live readings without a named gateway: with keys nobody may send them, which must not be found out in the field."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from coordinator.cli.main import run_command

LIVE = ('source = "network" ', 'source = "live" '), ("noise = true", "[run]\nscan_s = 1.0")
TABLE = ("[run]\n", '[gateways.north]\nareas = "all"\n[run]\n')
REMARK = "with keys no gateway but plant may; for keys, add a table [gateways.NAME]"


@pytest.mark.parametrize(
    ("changes", "is_reported"), [(LIVE, True), ((*LIVE, TABLE), False), ((), False)], ids=["live", "named", "network"]
)
def test_who_makes_keys_or_checks_learns_that_nobody_may_send(
    capsys: pytest.CaptureFixture[str],
    edited_scenario: Callable[..., Path],
    tmp_path: Path,
    changes: tuple[tuple[str, str], ...],
    is_reported: bool,
):
    scenario = edited_scenario("ieee33", *changes)
    assert run_command(["check", str(scenario)]) == 0
    assert (REMARK in capsys.readouterr().out) == is_reported
    assert run_command(["keys", "create", str(scenario), "--out", str(tmp_path / "keys")]) == 0
    output = capsys.readouterr()
    assert "a folder for each of router" in output.out
    assert (REMARK in output.err) == is_reported
