"""``dsse flows`` shows one area of a system that runs, with its area file alone."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.lab.evaluation.evaluation import estimate_centralised
from dsse_core.results.results import results_of_estimate
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.levels import SECURED_FURTHER
from tests.support.system_by_hand import SystemByHand, agreeing_system, prepare_by_hand
from tests.support.waiting import wait_until


@pytest.mark.parametrize("secured", SECURED_FURTHER)
def test_what_flows_in_an_area_is_what_the_centre_would_say(dsse, tmp_path: Path, secured: bool):
    with agreeing_system(dsse, tmp_path, secured) as (_, _, _, keys):
        shown = dsse("flows", "areas/area2.toml", *keys, "--csv", "branches")
        assert shown.returncode == 0, shown.stderr
        output: dict[str, Any] = {}

        def is_good() -> bool:  # also that has an end, where a neighbour gets no processor for a while
            output.update(json.loads(dsse("flows", "areas/area2.toml", *keys, "--json").stdout))
            return output["quality"] == "good"

        wait_until(is_good)
        wait_until(lambda: "area area2: good, scan" in dsse("flows", "areas/area2.toml", *keys).stdout)
    rows = list(csv.DictReader(io.StringIO(shown.stdout)))
    scenario = load_scenario("industrial13")
    network, own = scenario.network, scenario.partition.area("area2").network.branches
    place = {branch: row for row, branch in enumerate(network.branch_ids)}
    assert {row["branch"] for row in rows} == {branch.id for branch in own}
    assert (output["area"], len(output["branches"])) == ("area2", len(rows))
    central = results_of_estimate(estimate_centralised(scenario, make_telemetry(scenario)).report).branches
    found = [float(row["i_from_a"]) for row in rows]
    np.testing.assert_allclose(found, central.i_from_a[[place[row["branch"]] for row in rows]], rtol=0, atol=1e-3)


def test_an_area_that_publishes_nothing_is_named(dsse, tmp_path: Path):
    endpoint, _ = prepare_by_hand(dsse, secured=False)
    with SystemByHand(tmp_path) as system:
        system.start("router", "router", "--listen", endpoint)
        wait_until(lambda: "listening on" in system.read_log("router"))
        done = dsse("flows", "areas/area1.toml", "--wait", "2")
    assert done.returncode == 1
    assert "area area1 of run industrial13 has published no estimate within 2 s" in done.stderr
