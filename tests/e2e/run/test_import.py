"""A network of another project: one command takes it over, the next runs its areas as real processes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.support.pandapower_tables import LoadedLate
from tests.support.verdicts import assert_centralised

pandapower: Any = LoadedLate("pandapower")
networks: Any = LoadedLate("pandapower.networks")

pytestmark = [pytest.mark.filterwarnings("ignore::Warning:pandapower", "ignore::Warning:pandas"), pytest.mark.long]


def test_a_town_of_pandapower_is_imported_and_its_eight_areas_agree_with_the_centralised_estimate(
    dsse, start_run, assert_nothing_left, tmp_path: Path
):
    net = networks.mv_oberrhein(separation_by_sub=True)[1]
    pandapower.to_json(net, str(tmp_path / "oberrhein.json"))
    done = dsse("import", "oberrhein.json", "--out", "town", "--areas", 8)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "next: dsse run town/scenario.toml"
    run = start_run("town/scenario.toml")
    code, _, err = run.end()
    assert code == 0, err
    result = json.loads((run.folder / "result.json").read_text())
    assert result["scenario"]["buses"] > 100
    assert result["scenario"]["strategy"] == "information"
    assert len(result["areas"]) == 8
    assert_centralised(run.folder)
    assert_nothing_left(run.pids())
